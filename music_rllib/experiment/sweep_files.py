"""A started sweep: how commands find it, and its small files below `<storage>/<name>`.

`config.json` is the whole configuration, `plan.json` its runs and those of earlier plans,
`search.json` the results of its searches, `state.json` its progress, `analysis_plan.json` the
versions of its analysis plan. In a bucket, other machines read them there; this machine has a copy.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from music_rllib.command_line import plain
from music_rllib.config.load import load_config
from music_rllib.config.schema import SweepConfig
from music_rllib.errors import BadInputError, reason_of
from music_rllib.redaction import redact
from music_rllib.store.lease import runs_here, this_machine
from music_rllib.store.node_store import NodeStore
from music_rllib.store.storage import (
    DamagedError,
    StorageError,
    StorageFolder,
    below,
    check_answers,
    folder_at,
    is_remote,
    open_storage,
    resolve_storage,
    storage_and_name,
    sweep_folder,
)

CONFIG, PLAN, SEARCH, STATE = "config.json", "plan.json", "search.json", "state.json"
ANALYSIS_PLAN = "analysis_plan.json"
EXPORT = "sweep.json"
"""Only in the folder of an exported sweep."""
IN_STORAGE = "storage:"
"""Prefix of a handoff's key in `config.json`: the folder that the user gave may have changed."""
STOP = "stop.json"
"""A new one asks all drivers to stop."""
SILENCE_SECONDS = 90.0
"""A driver on another machine counts as dead if its last heartbeat is older."""


@dataclass(frozen=True, kw_only=True)
class SweepLocation:
    """The place of a sweep, and its files there.

    Methods raise StorageError for a file that is damaged or cannot be written.
    """

    storage: str
    """Absolute folder, or URI."""
    name: str

    @property
    def place(self) -> str:
        """Its folder or URI, for messages."""
        return redact(below(self.storage, self.name))

    @property
    def folder(self) -> Path:
        """The folder of its files on this machine."""
        return sweep_folder(self.storage, self.name)

    @cached_property
    def files(self) -> StorageFolder:
        """The folder of its files in the storage."""
        return open_storage(self.storage) / self.name

    def read(self, file: str) -> Any:
        """The content of a JSON file; None if it does not exist."""
        return read_json(self.files, file)

    def write(self, file: str, text: str) -> None:
        self.files.write(file, text.encode())

    def keep(self, file: str, text: str) -> None:
        """Write a file into the storage, and if that is a bucket, to this machine too."""
        if is_remote(self.storage):
            open_storage(str(self.folder)).write(file, text.encode())
        self.write(file, text)

    def nodes(self) -> list[dict[str, Any]]:
        """The runs in its `plan.json`; empty if it has none."""
        nodes: list[dict[str, Any]] = (self.read(PLAN) or {"nodes": []})["nodes"]
        return nodes

    def document(self) -> Any:
        """Its configuration as plain data, with handoffs as folders on this machine."""
        document = self.read(CONFIG)
        store = NodeStore(self.storage)
        for stage in document["stages"]:
            match stage.get("init_from"):
                case {"checkpoint": str(place)} as source if place.startswith(IN_STORAGE):
                    key = place.removeprefix(IN_STORAGE)
                    try:
                        source["checkpoint"] = str(store.lasting_files(key))
                    except DamagedError as error:
                        again = "run the sweep's YAML file with --retrain-damaged"
                        raise DamagedError(f"{error}; to import it again, {again}") from error
        return document

    def config(self, seeds: str | None = None) -> SweepConfig:
        """Its configuration as of its last run, with other `seeds` if they are given.

        Raises:
            ConfigError: The configuration is not valid in this version.
        """
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"{self.name}.json")
            path.write_text(as_json(self.document()), encoding="utf-8")
            return load_config(path, storage=self.storage, seeds=seeds)


# Finding sweeps -----------------------------------------------------------------------------------


def find_sweep(place: str, storage: str | None) -> SweepLocation:
    """The started sweep that `place` names: by a folder, a URI, a name, or a YAML file.

    Raises:
        BadInputError: It does not exist.
    """
    location = _locate(place, storage)
    check_answers(location.storage)
    if location.read(CONFIG) is None:
        got = f"SWEEP must be a sweep that was started, got {redact(place)}"
        if EXPORT in location.files.files():
            raise BadInputError(f"{got}, an exported sweep: `music-rllib report` shows it")
        if (inside := _names(location.files)) != "none":
            raise BadInputError(f"{got}, a storage with the sweeps {inside}")
        raise BadInputError(
            f"{got}: there is no {location.place}/{CONFIG} "
            f"(sweeps there: {_names(open_storage(location.storage))})"
        )
    return location


def _locate(place: str, storage: str | None) -> SweepLocation:
    """The place of the sweep, whether it exists or not."""
    if not place or storage == "":
        raise BadInputError(f"{'--storage' if place else 'SWEEP'} must not be empty, got ''")
    folder = folder_at(place) if storage is None else None
    if folder is not None:
        return SweepLocation(storage=str(folder.parent), name=folder.name)
    if place.endswith((".yaml", ".yml")):
        config = load_config(place, storage=storage)
        return SweepLocation(storage=resolve_storage(config.storage)[0], name=config.name)
    place = place.rstrip("/")
    if storage is None and "/" in place:
        above, name = storage_and_name(place)
        return SweepLocation(storage=resolve_storage(above)[0], name=name)
    return SweepLocation(storage=resolve_storage(storage or "results")[0], name=place)


def _names(root: StorageFolder) -> str:
    """Names of the sweeps in a storage, for messages."""
    with contextlib.suppress(OSError):  # the path cannot exist: a name in it is too long
        return ", ".join(sorted(root.having(PLAN, root.folders()))) or "none"
    return "none"


def sweeps_in(storage: str) -> list[SweepLocation]:
    """Every sweep in a storage that has a plan."""
    root = open_storage(storage)
    names = root.having(PLAN, root.folders())
    return [SweepLocation(storage=storage, name=name) for name in names]


# JSON files ---------------------------------------------------------------------------------------


def is_alive(state: Mapping[str, Any] | None) -> bool:
    """Whether a sweep's driver is running, by its `state.json`."""
    if state is None or state["driver"]["ended"] is not None:
        return False
    driver = state["driver"]
    if driver["machine"] == this_machine():
        return runs_here(driver["pid"], driver["process_started"])
    # A heartbeat in the future was written by a fast clock, of a driver that may be dead.
    return bool(abs(time.time() - driver["heartbeat"]) < SILENCE_SECONDS)


def as_json(document: Any) -> str:
    """The text of a sweep's JSON file."""
    return json.dumps(plain(document), indent=1, ensure_ascii=False, default=str)


def read_json(folder: StorageFolder, file: str) -> Any:
    """The content of a JSON file; None if it does not exist.

    Raises:
        StorageError: It cannot be read, or lacks what a file of this name has.
    """
    place = f"{folder.path}/{file}"
    try:
        data = folder.read(file)
        document = None if data is None else json.loads(data)
    except (OSError, ValueError) as error:
        raise StorageError(f"{place} must be a readable JSON file: {error}") from error
    if document is not None and file in _CONTENTS:
        try:
            _CONTENTS[file].model_validate(document)
        except ValidationError as error:
            raise StorageError(
                f"{place} must be a sweep's {file.removesuffix('.json')} as its driver writes it: "
                f"{reason_of(error)}; running the sweep again replaces it"
            ) from error
    return document


class _Content(BaseModel):
    """What is read from a file; it may have more."""

    model_config = ConfigDict(strict=True)


class _Config(_Content):
    stages: list[dict[str, Any]]


class _Node(_Content):
    key: str
    label: str
    input: str | None = None
    env_steps: int = 0


class _Plan(_Content):
    nodes: list[_Node]
    trials: list[dict[str, Any]] = []
    earlier: list[_Node] = []
    retrain: list[str] = []


class _Driver(_Content):
    machine: str
    host: str
    pid: int
    started: float
    heartbeat: float
    ended: float | None
    outcome: str


class _StageState(_Content):
    name: str
    variant: str
    trials: int
    runs: dict[str, int]


class _Best(_Content):
    stage: str
    values: dict[str, Any]
    value: float
    interval: Annotated[list[float | None], Field(min_length=2, max_length=2)]
    """None without enough runs."""
    runs: int
    planned: int = 0


class _State(_Content):
    sweep: str
    driver: _Driver
    stages: list[_StageState]
    env_steps: dict[str, int]
    running: list[dict[str, Any]]
    best: _Best | None
    searches: list[dict[str, Any]]
    pruned: list[str] = []
    failures: list[dict[str, str]]


_CONTENTS: dict[str, type[_Content]] = {CONFIG: _Config, PLAN: _Plan, STATE: _State}
