"""A sweep's small files below `<storage>/<name>`, in a bucket too, where other machines read them.

`config.json` is the whole configuration, `plan.json` its runs and those of earlier plans,
`settings.json` their settings, `search.json` the results of its searches, `state.json` its
progress, `analysis_plan.json` the versions of its analysis plan.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any

from music_rllib.config.problems import shown
from music_rllib.redaction import redact
from music_rllib.store.lease import runs_here, this_machine
from music_rllib.store.storage import StorageError, is_remote, open_storage, write_atomically

if TYPE_CHECKING:
    from music_rllib.experiment.open_sweep import OpenSweep

CONFIG, PLAN, SEARCH, STATE = "config.json", "plan.json", "search.json", "state.json"
ANALYSIS_PLAN, SETTINGS = "analysis_plan.json", "settings.json"
IN_STORAGE = "storage:"
"""In `config.json`, in front of the key of a handoff: its first folder may be on another machine,
or hold another one by now."""
STOP = "stop.json"
"""Its presence asks the driver to stop."""
SILENCE_SECONDS = 90.0
"""A driver on another machine counts as dead when its last heartbeat is older."""


def is_alive(state: Mapping[str, Any] | None) -> bool:
    """Whether a sweep's driver is at work, by its `state.json`."""
    if state is None or state["driver"]["ended"] is not None:
        return False
    driver = state["driver"]
    if driver["machine"] == this_machine():
        return runs_here(driver["pid"], driver["process_started"])
    return bool(time.time() - driver["heartbeat"] < SILENCE_SECONDS)


def plain(value: Any) -> Any:
    """`value` as JSON can hold it: null in place of NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_json(document: Any) -> str:
    """The text of a sweep's JSON file."""
    return json.dumps(plain(document), indent=1, ensure_ascii=False, default=str)


def keep(sweep: OpenSweep, name: str, text: str) -> None:
    """Write a file of the sweep, on this machine and, where that is a bucket, in its storage.

    Raises:
        StorageError: It can't be written.
    """
    write_locally(sweep.folder / name, text)
    if is_remote(sweep.storage):
        write(sweep.storage, f"{sweep.config.name}/{name}", text)


def write_locally(path: Path, text: str) -> None:
    """Write a file on this machine, whole or not at all.

    Raises:
        StorageError: It can't be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text.encode())
    except OSError as error:
        place = error.filename or path.parent
        raise StorageError(f"{place} must be writable: {error.strerror}") from error


def write(storage: str, path: str, text: str) -> None:
    """Write a file below a storage, whole or not at all.

    Raises:
        StorageError: It can't be written.
    """
    open_storage(storage).write(path, text.encode())


_STATE_KEYS = {"sweep", "driver", "stages", "env_steps", "running", "best", "searches", "failures"}
_PROCESS_KEYS = {"pid", "host", "machine", "process_started"}
_DRIVER_KEYS = _PROCESS_KEYS | {"started", "heartbeat", "ended", "outcome"}


def _has(document: Any, keys: Set[str]) -> bool:
    return isinstance(document, dict) and document.keys() >= keys


def _is_list_with(document: Any, keys: Set[str] = frozenset()) -> bool:
    return isinstance(document, list) and all(_has(item, keys) for item in document)


_SOUND: dict[str, Callable[[Any], bool]] = {
    CONFIG: lambda document: _has(document, {"stages"}) and _is_list_with(document["stages"]),
    PLAN: lambda document: (
        _has(document, {"nodes"})
        and _is_list_with(document["nodes"], {"key", "label"})
        and _is_list_with(document.get("earlier", []), {"key", "label", "why"})
    ),
    STATE: lambda document: _has(document, _STATE_KEYS) and _has(document["driver"], _DRIVER_KEYS),
    SEARCH: _is_list_with,
}
"""File name to a check that its content has what its readers rely on."""


def read(storage: str, path: str) -> Any:
    """The content of a JSON file below a storage; None where there is no such file.

    Raises:
        StorageError: It can't be read, or its content is not what its name says.
    """
    folder = open_storage(storage)
    target = f"{folder.path}/{path}"
    try:
        data = folder.read(path)
        document = None if data is None else json.loads(data)
    except (OSError, ValueError) as error:
        raise StorageError(f"{target} must be a readable JSON file: {error}") from error
    name = path.rpartition("/")[2]
    if document is not None and name in _SOUND and not _SOUND[name](document):
        raise StorageError(
            f"{target} must be a sweep's {name.removesuffix('.json')} as its driver writes it, got "
            f"{shown(document)}: running the sweep again writes it anew"
        )
    return document


def remove(storage: str, path: str) -> None:
    """Delete a file below a storage, if it is there.

    Raises:
        StorageError: It can't be deleted.
    """
    try:
        open_storage(storage).remove(path)
    except OSError as error:
        raise StorageError(f"{redact(storage)}/{path} must be deletable: {error}") from error
