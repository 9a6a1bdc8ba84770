"""What of a sweep can be deleted, and the deleting."""

from __future__ import annotations

import contextlib
from typing import Any

import pyarrow.fs as pafs

from music_rllib.experiment.sealed import open_storage
from music_rllib.sweep import records
from music_rllib.sweep.beacon import is_alive
from music_rllib.sweep.find import Found, sweeps_in
from music_rllib.sweep.frame import BadInputError

__all__ = ["delete", "what_can_go"]


def what_can_go(found: Found, *, unfinished: bool, everything: bool) -> list[dict[str, Any]]:
    """Folders that can be deleted, with the reason.

    Args:
        found: The sweep.
        unfinished: Checkpoints of interrupted runs too.
        everything: Results and the sweep's own files too.

    Raises:
        BadInputError: The sweep is running, or another one is that shares runs with it.
    """
    state = found.read(records.STATE)
    if is_alive(state):
        raise BadInputError(
            f"SWEEP must not be running to be cleaned, {found.name} is: stop it first"
        )
    plan = found.read(records.PLAN) or {"nodes": []}
    elsewhere: set[str] = set()
    for name, other in sweeps_in(found.storage):
        if name != found.name:
            elsewhere |= {node["key"] for node in other["nodes"]}
    filesystem, root = open_storage(found.storage)
    pruned = set((state or {}).get("pruned", ()))
    going = []
    for node in plan["nodes"]:
        key, label = node["key"], node["label"]
        if key in elsewhere:
            continue
        finished = _is_there(filesystem, f"{root}/nodes/{key}/manifest.json")
        if _is_there(filesystem, f"{root}/work/{key}"):
            if finished or key in pruned:
                why = "finished" if finished else "stopped early"
            else:
                why = "interrupted"
            if why != "interrupted" or unfinished:
                what = f"checkpoints of {label}: {why}"
                going.append({"path": f"{root}/work/{key}", "what": what})
        if everything and finished:
            going.append({"path": f"{root}/nodes/{key}", "what": f"result of {label}"})
    if everything:
        going.append({"path": f"{root}/{found.name}", "what": "the sweep's own files"})
    return going


def _is_there(filesystem: pafs.FileSystem, path: str) -> bool:
    return bool(filesystem.get_file_info(path).type != pafs.FileType.NotFound)


def delete(found: Found, going: list[dict[str, Any]]) -> None:
    """Delete folders, a node's manifest first: half a node is none."""
    filesystem, _ = open_storage(found.storage)
    for item in going:
        with contextlib.suppress(FileNotFoundError):
            filesystem.delete_file(f"{item['path']}/manifest.json")
        with contextlib.suppress(FileNotFoundError):
            filesystem.delete_dir(item["path"])
