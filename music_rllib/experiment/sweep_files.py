"""A sweep's small files, below `<storage>/<name>`: in a bucket too, where other machines read them.

`config.json` is the whole configuration, `plan.json` the runs known beforehand, `search.json` what
came of its searches, `state.json` how far it is.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from music_rllib.config.problems import shown
from music_rllib.store.files import write_atomically
from music_rllib.store.lease import runs_here, this_machine
from music_rllib.store.object_folder import StorageError, open_storage

if TYPE_CHECKING:
    from music_rllib.experiment.session import Sweep

__all__ = [
    "CONFIG",
    "PLAN",
    "SEARCH",
    "STATE",
    "STOP",
    "as_json",
    "is_alive",
    "keep",
    "plain",
    "read",
    "remove",
]

CONFIG, PLAN, SEARCH, STATE = "config.json", "plan.json", "search.json", "state.json"
STOP = "stop.json"
"""Asks the driver to stop."""
SILENCE_SECONDS = 90.0
"""After so long a driver on another machine counts as dead."""


def is_alive(state: Mapping[str, Any] | None) -> bool:
    """Whether a sweep's driver is at work, by its `state.json`."""
    if state is None or state["driver"]["ended"] is not None:
        return False
    driver = state["driver"]
    if driver["machine"] == this_machine():
        return runs_here(driver["pid"], driver["process_started"])
    return bool(time.time() - driver["heartbeat"] < SILENCE_SECONDS)


def plain(value: Any) -> Any:
    """JSON has no NaN: null in its place."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_json(document: Any) -> str:
    """As it is kept."""
    return json.dumps(plain(document), indent=1, ensure_ascii=False, default=str)


def keep(sweep: Sweep, name: str, text: str) -> None:
    """Write a file of the sweep, on this machine and, where that is a bucket, in its storage.

    Raises:
        StorageError: It can't be written.
    """
    try:
        sweep.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(sweep.folder / name, text.encode())
    except OSError as error:
        place = error.filename or sweep.folder
        raise StorageError(f"{place} must be writable: {error.strerror}") from error
    if is_remote(sweep.storage):
        write(sweep.storage, f"{sweep.config.name}/{name}", text)


def is_remote(storage: str) -> bool:
    """Whether the sweep's folder isn't in its storage."""
    return "://" in storage and not storage.startswith("file://")


def write(storage: str, path: str, text: str) -> None:
    """Write a file below a storage, whole or not at all.

    Raises:
        StorageError: It can't be written.
    """
    filesystem, root = open_storage(storage)
    target = f"{root}/{path}"
    try:
        filesystem.create_dir(target.rpartition("/")[0], recursive=True)
        if not is_remote(storage):
            write_atomically(Path(target), text.encode())
            return
        with filesystem.open_output_stream(target) as sink:
            sink.write(text.encode())
    except OSError as error:
        raise StorageError(f"{target} must be writable: {error}") from error


_STATE_KEYS = {"sweep", "driver", "stages", "env_steps", "running", "best", "searches", "failures"}
_DRIVER_KEYS = {
    "pid",
    "host",
    "machine",
    "process_started",
    "started",
    "heartbeat",
    "ended",
    "outcome",
}


def _is_plan(document: Any) -> bool:
    nodes = document.get("nodes") if isinstance(document, dict) else None
    return isinstance(nodes, list) and all(
        isinstance(node, dict) and {"key", "label"} <= node.keys() for node in nodes
    )


def _is_state(document: Any) -> bool:
    driver = document.get("driver") if isinstance(document, dict) else None
    return (
        isinstance(driver, dict)
        and document.keys() >= _STATE_KEYS
        and (driver.keys() >= _DRIVER_KEYS)
    )


def _is_config(document: Any) -> bool:
    return isinstance(document, dict) and _is_list_of_mappings(document.get("stages"))


def _is_list_of_mappings(document: Any) -> bool:
    return isinstance(document, list) and all(isinstance(one, dict) for one in document)


_SOUND: dict[str, Callable[[Any], bool]] = {
    CONFIG: _is_config,
    PLAN: _is_plan,
    STATE: _is_state,
    SEARCH: _is_list_of_mappings,
}
"""Whether a record has what its readers count on."""


def read(storage: str, path: str) -> Any:
    """The content of a JSON file below a storage; None where there is none.

    Raises:
        StorageError: It can't be read, or isn't the record that its name says.
    """
    document = _read(storage, path)
    name = path.rpartition("/")[2]
    if document is not None and name in _SOUND and not _SOUND[name](document):
        target = f"{open_storage(storage)[1]}/{path}"
        raise StorageError(
            f"{target} must be a sweep's {name.removesuffix('.json')} as its driver writes it, got "
            f"{shown(document)}: running the sweep again writes it anew"
        )
    return document


def _read(storage: str, path: str) -> Any:
    filesystem, root = open_storage(storage)
    target = f"{root}/{path}"
    try:
        with filesystem.open_input_stream(target) as stream:
            return json.loads(stream.read())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise StorageError(f"{target} must be a readable JSON file: {error}") from error


def remove(storage: str, path: str) -> None:
    """Delete a file below a storage, if it is there."""
    filesystem, root = open_storage(storage)
    try:
        filesystem.delete_file(f"{root}/{path}")
    except FileNotFoundError:
        return
