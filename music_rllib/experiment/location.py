"""The sweep that a command's SWEEP argument names: by a folder, a URI, a name, or a YAML file."""

from __future__ import annotations

import contextlib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from music_rllib.config.load import load_sweep
from music_rllib.config.schema import SweepConfig
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.earlier import earlier_text
from music_rllib.experiment.open_sweep import OpenSweep, open_sweep
from music_rllib.experiment.plan import make_plan
from music_rllib.experiment.sweep_files import IN_STORAGE
from music_rllib.redaction import redact
from music_rllib.store.node_store import NodeStore
from music_rllib.store.storage import (
    below,
    check_answers,
    folder_at,
    open_storage,
    resolve_storage,
    storage_and_name,
    sweep_folder,
)


@dataclass(frozen=True, kw_only=True)
class SweepLocation:
    """A sweep that was started before."""

    storage: str
    """Absolute folder, or URI."""
    name: str

    def read(self, file: str) -> Any:
        """The content of one of its files; None where there is no such file.

        Raises:
            StorageError: The file is damaged.
        """
        return sweep_files.read(self.storage, f"{self.name}/{file}")

    def config(self, seeds: str | None = None) -> SweepConfig:
        """Its configuration, as it was last run, with other `seeds` if they are given.

        Raises:
            ConfigError: This version can't make sense of it.
            StorageError: A handoff that it starts from is damaged, or not there.
        """
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"{self.name}.json")
            path.write_text(sweep_files.as_json(self.document()), encoding="utf-8")
            return load_sweep(path, storage=self.storage, seeds=seeds)

    def document(self) -> Any:
        """Its configuration as plain data, with handoffs where this machine has them.

        Raises:
            StorageError: It is damaged, or a handoff is.
        """
        document = self.read(sweep_files.CONFIG)
        store = NodeStore(self.storage)
        for stage in document["stages"]:
            match stage.get("init_from"):
                case {"checkpoint": str(place)} as source if place.startswith(IN_STORAGE):
                    source["checkpoint"] = str(store.folder(place.removeprefix(IN_STORAGE)))
        return document

    def nodes(self) -> list[dict[str, Any]]:
        """The runs in its `plan.json`; empty if it has none."""
        nodes: list[dict[str, Any]] = (self.read(sweep_files.PLAN) or {"nodes": []})["nodes"]
        return nodes

    def open(self, *, lenient: bool = False) -> OpenSweep:
        """The sweep with its plan as it was last run, and its finished runs.

        The plan includes the searched trials. Its keys are of the version of the algorithm that the
        sweep was run with.

        Args:
            lenient: Whether finished runs may be damaged, which then count as not finished.
        """
        config = self.config()
        recorded = self.read(sweep_files.PLAN) or {}
        settings = {} if "algorithm" in recorded else self.read(sweep_files.SETTINGS) or {}
        plan = make_plan(config, algorithm=(recorded | settings).get("algorithm"))
        for trial in recorded.get("trials", ()):
            plan.add_trial(
                trial["stage"], trial["trial"], trial["values"], trial["seeds"], trial["part"]
            )
        folder = sweep_folder(self.storage, self.name)
        return open_sweep(config, plan, self.storage, folder, lenient=lenient)

    def earlier(self) -> str | None:
        """A sentence about runs of earlier versions of its plan; None if there are none."""
        recorded = (self.read(sweep_files.PLAN) or {}).get("earlier", ())
        if not recorded:
            return None
        store = NodeStore(self.storage)
        known = store.begun() | store.finished(one["key"] for one in recorded)
        return earlier_text(one for one in recorded if one["key"] in known)

    @property
    def place(self) -> str:
        """Its folder or URI, for messages."""
        return redact(below(self.storage, self.name))


def find_sweep(place: str, storage: str | None) -> SweepLocation:
    """The started sweep that `place` names.

    Raises:
        BadInputError: There is none.
    """
    location = _locate(place, storage)
    check_answers(location.storage)
    if location.read(sweep_files.CONFIG) is None:
        raise BadInputError(
            f"SWEEP must be a sweep that was started, got {redact(place)}: there is no "
            f"{location.place}/{sweep_files.CONFIG} (sweeps there: {_names(location.storage)})"
        )
    return location


def _locate(place: str, storage: str | None) -> SweepLocation:
    """Where the sweep would be, whether it is there or not."""
    if not place or storage == "":
        raise BadInputError(f"{'--storage' if place else 'SWEEP'} must not be empty, got ''")
    folder = folder_at(place) if storage is None else None
    if folder is not None:
        return SweepLocation(storage=str(folder.parent), name=folder.name)
    if place.endswith((".yaml", ".yml")):
        config = load_sweep(place, storage=storage)
        return SweepLocation(storage=resolve_storage(config.storage)[0], name=config.name)
    place = place.rstrip("/")
    if storage is None and "://" in place:
        above, name = storage_and_name(place)
        return SweepLocation(storage=above, name=name)
    if storage is None and "/" in place:
        folder = Path(resolve_storage(place)[0])
        raise BadInputError(
            f"SWEEP must be the folder of a sweep, a sweep's name or its YAML file, got {place}: "
            f"there is no folder {folder} (sweeps beside it: {_names(str(folder.parent))})"
        )
    return SweepLocation(storage=resolve_storage(storage or "results")[0], name=place)


def _names(storage: str) -> str:
    """Names of the sweeps in a storage, in words."""
    with contextlib.suppress(OSError):  # of a path that can't be, with too long a name in it
        return ", ".join(sorted(sweep.name for sweep in sweeps_in(storage))) or "none"
    return "none"


def sweeps_in(storage: str) -> list[SweepLocation]:
    """Every sweep in a storage that has a plan."""
    root = open_storage(storage)
    names = root.having(sweep_files.PLAN, root.folders())
    return [SweepLocation(storage=storage, name=name) for name in names]
