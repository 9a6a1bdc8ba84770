"""What a user means by SWEEP: a folder, a URI, a name in a storage, or a YAML file."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from music_rllib.config.load import load_sweep
from music_rllib.config.schema import SweepConfig
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.plan import make_plan
from music_rllib.experiment.session import Sweep, open_sweep
from music_rllib.redaction import redact
from music_rllib.store.paths import check_answers, resolve_storage, sweep_folder

__all__ = ["SweepLocation", "find_sweep"]


@dataclass(frozen=True, kw_only=True)
class SweepLocation:
    """A sweep that has been started at some time."""

    storage: str
    """Absolute folder, or URI."""
    name: str

    def read(self, file: str) -> Any:
        """One of its records; None where it isn't there.

        Raises:
            StorageError: It is damaged.
        """
        return sweep_files.read(self.storage, f"{self.name}/{file}")

    def config(self, seeds: str | None = None) -> SweepConfig:
        """Its configuration, as it was last run, with other `seeds` if they are given.

        Raises:
            ConfigError: This version can't make sense of it.
        """
        document = self.read(sweep_files.CONFIG)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"{self.name}.json")
            path.write_text(sweep_files.as_json(document), encoding="utf-8")
            return load_sweep(path, storage=self.storage, seeds=seeds)

    def open(self) -> Sweep:
        """With its plan, searched trials among it, and what is finished."""
        config = self.config()
        plan = make_plan(config)
        for trial in (self.read(sweep_files.PLAN) or {}).get("trials", ()):
            plan.add_trial(
                trial["stage"], trial["trial"], trial["values"], trial["seeds"], trial["part"]
            )
        return open_sweep(config, plan, self.storage, sweep_folder(self.storage, self.name))

    @property
    def place(self) -> str:
        """For messages."""
        return f"{redact(self.storage)}/{self.name}"


def find_sweep(place: str, storage: str | None) -> SweepLocation:
    """The sweep that a user means.

    Raises:
        BadInputError: There is none.
    """
    found = _found(place, storage)
    check_answers(found.storage)
    if found.read(sweep_files.CONFIG) is None:
        others = ", ".join(_others(found.storage)) or "none"
        raise BadInputError(
            f"SWEEP must be a sweep that was started, got {redact(place)}: there is no "
            f"{found.place}/{sweep_files.CONFIG} (sweeps there: {others})"
        )
    return found


def _found(place: str, storage: str | None) -> SweepLocation:
    if not place or storage == "":
        raise BadInputError(f"{'--storage' if place else 'SWEEP'} must not be empty, got ''")
    if place.endswith((".yaml", ".yml")):
        config = load_sweep(place, storage=storage)
        return SweepLocation(storage=resolve_storage(config.storage)[0], name=config.name)
    place = place.rstrip("/")
    if storage is None and "://" in place:
        above, _, name = place.rpartition("/")
        return SweepLocation(storage=above, name=name)
    if storage is None and Path(place).expanduser().is_dir():
        folder = Path(place).expanduser().absolute()
        return SweepLocation(storage=str(folder.parent), name=folder.name)
    if storage is None and "/" in place:
        folder = Path(place).expanduser().absolute()
        others = ", ".join(_others(str(folder.parent))) or "none"
        raise BadInputError(
            f"SWEEP must be the folder of a sweep, a sweep's name or its YAML file, got {place}: "
            f"there is no folder {folder} (sweeps beside it: {others})"
        )
    return SweepLocation(storage=resolve_storage(storage or "results")[0], name=place)


def _others(storage: str) -> list[str]:
    """Names of sweeps in a storage."""
    return sorted(other.name for other in sweeps_in(storage))


def sweeps_in(storage: str) -> list[SweepLocation]:
    """Every sweep in a storage that has been planned."""
    import pyarrow.fs as pafs

    from music_rllib.store.object_folder import open_storage

    filesystem, root = open_storage(storage)
    selector = pafs.FileSelector(root, allow_not_found=True)
    names = [info.base_name for info in filesystem.get_file_info(selector) if not info.is_file]
    plans = [f"{root}/{name}/{sweep_files.PLAN}" for name in names]
    found = filesystem.get_file_info(plans) if plans else []
    return [
        SweepLocation(storage=storage, name=name)
        for name, plan in zip(names, found, strict=True)
        if plan.is_file
    ]
