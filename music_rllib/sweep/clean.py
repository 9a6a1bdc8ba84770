"""What of a sweep can be deleted, and the deleting."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pyarrow.fs as pafs

from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.location import SweepLocation, sweeps_in
from music_rllib.redaction import redact
from music_rllib.store.node_store import CONTINUATIONS
from music_rllib.store.object_folder import open_storage
from music_rllib.store.paths import sweep_folder

Item = dict[str, Any]


@dataclass(kw_only=True)
class Cleaning:
    """What a clean would do, each as `{"path": ..., "what": ...}`."""

    going: list[Item] = field(default_factory=list)
    """Folders in the storage."""
    going_here: list[Item] = field(default_factory=list)
    """Folders on this machine, of a sweep whose storage is a bucket."""
    kept: list[Item] = field(default_factory=list)
    """What one might expect to go, and why it doesn't."""

    @property
    def items(self) -> list[Item]:
        """All that goes."""
        return [*self.going, *self.going_here]


def what_can_go(found: SweepLocation, *, unfinished: bool, everything: bool) -> Cleaning:
    """Folders that can be deleted, with the reason.

    Args:
        found: The sweep.
        unfinished: Checkpoints of interrupted runs too.
        everything: Results and the sweep's own files too.

    Raises:
        BadInputError: The sweep is running, or another one is that shares runs with it.
        StorageError: A record is damaged, of another sweep in the storage too: nobody can tell
            then what that one needs.
    """
    state = found.read(sweep_files.STATE)
    if sweep_files.is_alive(state):
        raise BadInputError(
            f"SWEEP must not be running to be cleaned, {found.name} is: stop it first"
        )
    nodes = (found.read(sweep_files.PLAN) or {"nodes": []})["nodes"]
    users = _users(found, nodes)
    pruned = set((state or {}).get("pruned", ()))
    cleaning = Cleaning()
    filesystem, root = open_storage(found.storage)
    for node in nodes:
        key, label = node["key"], node["label"]
        finished = _is_there(filesystem, f"{root}/nodes/{key}/manifest.json")
        if key in users:
            if everything and finished:
                what = f"result of {label}: {', '.join(users[key])} has it too"
                cleaning.kept.append({"path": f"{root}/nodes/{key}", "what": what})
            continue
        if _is_there(filesystem, f"{root}/work/{key}"):
            if finished or key in pruned:
                why = "finished" if finished else "stopped early"
            else:
                why = "interrupted"
            if why != "interrupted" or unfinished:
                what = f"checkpoints of {label}: {why}"
                cleaning.going.append({"path": f"{root}/work/{key}", "what": what})
        longer = f"{root}/{CONTINUATIONS}/{node['continuation']}" if "continuation" in node else ""
        if finished and longer and _is_there(filesystem, longer):
            what = f"last checkpoint of {label}: kept for a run with more env_steps"
            cleaning.going.append({"path": longer, "what": what})
        if everything and finished:
            cleaning.going.append({"path": f"{root}/nodes/{key}", "what": f"result of {label}"})
    if everything:
        _add_own_files(found, root, cleaning)
    return cleaning


def _add_own_files(found: SweepLocation, root: str, cleaning: Cleaning) -> None:
    cleaning.going.append({"path": f"{root}/{found.name}", "what": "the sweep's own files"})
    here = sweep_folder(found.storage, found.name)
    if sweep_files.is_remote(found.storage) and here.is_dir():
        # A study is in it: the next sweep of this name would take that for its own.
        what = "the sweep's own files on this machine"
        cleaning.going_here.append({"path": str(here), "what": what})
    for storage, study in _studies(found):
        what = f"study {study!r}: delete it with Optuna's tools where nobody needs it any more"
        cleaning.kept.append({"path": redact(storage), "what": what})


def _users(found: SweepLocation, nodes: Iterable[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Key to the names of other sweeps that have the node, or whose searches count on it.

    Raises:
        BadInputError: One of them is running.
    """
    mine = {node["key"]: node for node in nodes}
    studies = _studies(found)
    users: dict[str, list[str]] = {}
    for other in sweeps_in(found.storage):
        if other.name == found.name:
            continue
        theirs = {node["key"] for node in (other.read(sweep_files.PLAN) or {"nodes": []})["nodes"]}
        # A trial that only this sweep has computed is part of their study's results all the same.
        for study in studies.keys() & _studies(other).keys():
            theirs |= _of_stage(studies[study], mine)
        shared = theirs & mine.keys()
        if shared and sweep_files.is_alive(other.read(sweep_files.STATE)):
            raise BadInputError(
                f"SWEEP must share no runs with a running sweep to be cleaned, {found.name} shares "
                f"{len(shared)} with {other.name}: stop that first"
            )
        for key in shared:
            users.setdefault(key, []).append(other.name)
    return users


def _studies(found: SweepLocation) -> dict[tuple[str, str], str]:
    """Database and name of each study that other sweeps may use too, to its stage."""
    studies = {}
    for stage in (found.read(sweep_files.CONFIG) or {"stages": []})["stages"]:
        search = stage.get("search") or {}
        if search.get("storage"):
            name = f"{search.get('study') or found.name}/{stage['name']}"
            studies[search["storage"], name] = str(stage["name"])
    return studies


def _of_stage(stage: str, nodes: Mapping[str, Mapping[str, Any]]) -> set[str]:
    """Keys of a stage's nodes and of all that they start from."""
    found: set[str] = set()
    wanted = [key for key, node in nodes.items() if node["label"].startswith(f"{stage}/")]
    while wanted:
        key = wanted.pop()
        if key in nodes and key not in found:
            found.add(key)
            wanted.append(nodes[key].get("input") or "")
    return found


def _is_there(filesystem: pafs.FileSystem, path: str) -> bool:
    return bool(filesystem.get_file_info(path).type != pafs.FileType.NotFound)


def delete(found: SweepLocation, cleaning: Cleaning) -> None:
    """Delete folders, a node's manifest first: half a node is none."""
    filesystem, _ = open_storage(found.storage)
    places = [(filesystem, item) for item in cleaning.going]
    places += [(pafs.LocalFileSystem(), item) for item in cleaning.going_here]
    for there, item in places:
        with contextlib.suppress(FileNotFoundError):
            there.delete_file(f"{item['path']}/manifest.json")
        with contextlib.suppress(FileNotFoundError):
            there.delete_dir(item["path"])
