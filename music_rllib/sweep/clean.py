"""Deletion of what a sweep has left in its storage."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pyarrow.fs as pafs

from music_rllib.config.schema import IMPORTED
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.location import SweepLocation, sweeps_in
from music_rllib.redaction import redact
from music_rllib.store.node_store import CONTINUATIONS
from music_rllib.store.storage import is_remote, open_storage, sweep_folder
from music_rllib.sweep.driver_lock import has_driver

Item = dict[str, str]


@dataclass(kw_only=True)
class Cleaning:
    """What a clean would do, each item as `{"path": ..., "what": ...}`."""

    going: list[tuple[pafs.FileSystem, Item]] = field(default_factory=list)
    """Folders to delete, in the storage or on this machine."""
    kept: list[Item] = field(default_factory=list)
    """What one might expect to be deleted, and why it is kept."""

    @property
    def items(self) -> list[Item]:
        """All that is deleted."""
        return [item for _, item in self.going]

    def add(self, filesystem: pafs.FileSystem, path: str, what: str) -> None:
        """Mark a folder to be deleted."""
        self.going.append((filesystem, {"path": path, "what": what}))

    def keep(self, path: str, what: str) -> None:
        """Note what is kept, and why."""
        self.kept.append({"path": path, "what": what})

    def delete(self) -> None:
        """Delete the folders, a node's manifest first: half a node is none."""
        for filesystem, item in self.going:
            with contextlib.suppress(FileNotFoundError):
                filesystem.delete_file(f"{item['path']}/manifest.json")
            with contextlib.suppress(FileNotFoundError):
                filesystem.delete_dir(item["path"])


def what_can_go(location: SweepLocation, *, unfinished: bool, everything: bool) -> Cleaning:
    """Folders that can be deleted, with the reason.

    Args:
        location: The sweep.
        unfinished: Include checkpoints of interrupted runs.
        everything: Include results and the sweep's own files.

    Raises:
        BadInputError: The sweep is running, or another one is that shares runs with it.
        StorageError: A record of this sweep or of another one in the storage is damaged, so that
            what the sweep needs is not known.
    """
    state = location.read(sweep_files.STATE)
    if _is_driven(location, state):
        raise BadInputError(
            f"SWEEP must not be running to be cleaned, {location.name} is: stop it first"
        )
    nodes = _nodes(location)
    users = _users(location, nodes)
    pruned = set((state or {}).get("pruned", ()))
    cleaning = Cleaning()
    storage = open_storage(location.storage)
    filesystem, root = storage.filesystem, storage.path

    def exists(path: str) -> bool:
        return bool(filesystem.get_file_info(path).type != pafs.FileType.NotFound)

    for node in nodes:
        key, label = node["key"], node["label"]
        result, checkpoints = f"{root}/nodes/{key}", f"{root}/work/{key}"
        finished = exists(f"{result}/manifest.json")
        if key in users:
            if everything and finished:
                cleaning.keep(result, f"result of {label}: {', '.join(users[key])} has it too")
            continue
        if exists(checkpoints):
            why = "finished" if finished else "stopped early" if key in pruned else "interrupted"
            if why != "interrupted" or unfinished:
                cleaning.add(filesystem, checkpoints, f"checkpoints of {label}: {why}")
        if finished and "continuation" in node:
            last = f"{root}/{CONTINUATIONS}/{node['continuation']}"
            what = f"last checkpoint of {label}"
            if exists(last) and node["continuation"] in users:
                others = ", ".join(users[node["continuation"]])
                cleaning.keep(last, f"{what}: {others} has it too")
            elif exists(last):
                cleaning.add(filesystem, last, f"{what}: kept for a run with more env_steps")
        if everything and finished:
            cleaning.add(filesystem, result, f"result of {label}")
    if everything:
        cleaning.add(filesystem, f"{root}/{location.name}", "the sweep's own files")
        here = sweep_folder(location.storage, location.name)
        if is_remote(location.storage) and here.is_dir():
            # A study is in it: the next sweep of this name would take that for its own.
            what = "the sweep's own files on this machine"
            cleaning.add(pafs.LocalFileSystem(), str(here), what)
        for database, study in _studies(location):
            what = f"study {study!r}: delete it with Optuna's tools where nobody needs it any more"
            cleaning.keep(redact(database), what)
    return cleaning


def _is_driven(location: SweepLocation, state: Mapping[str, Any] | None) -> bool:
    return sweep_files.is_alive(state) or has_driver(location.storage, location.name)


def _nodes(location: SweepLocation) -> list[dict[str, Any]]:
    """The nodes of a sweep's plan, and the handoffs from outside that they start from."""
    nodes = location.nodes()
    imported = {node["input"]: None for node in nodes if str(node["input"]).startswith(IMPORTED)}
    return [
        *nodes,
        *({"key": key, "label": f"{key} (imported)", "input": None} for key in imported),
    ]


def _users(location: SweepLocation, nodes: Iterable[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Key to the names of other sweeps that have the node, or whose searches count on it.

    Likewise for the key of a last checkpoint, which runs share that differ in their budget alone.

    Raises:
        BadInputError: One of them is running.
    """
    mine = {node["key"]: node for node in nodes}
    studies = _studies(location)
    users: dict[str, list[str]] = {}
    for other in sweeps_in(location.storage):
        if other.name == location.name:
            continue
        other_nodes = _nodes(other)
        theirs = {node["key"] for node in other_nodes}
        # A trial that only this sweep has computed is part of their study's results all the same.
        for study in studies.keys() & _studies(other).keys():
            theirs |= _keys_of_stage(studies[study], mine)
        shared = theirs & mine.keys()
        if shared and _is_driven(other, other.read(sweep_files.STATE)):
            raise BadInputError(
                f"SWEEP must share no runs with a running sweep to be cleaned, {location.name} "
                f"shares {len(shared)} with {other.name}: stop that first"
            )
        for key in shared | {n["continuation"] for n in other_nodes if "continuation" in n}:
            users.setdefault(key, []).append(other.name)
    return users


def _studies(location: SweepLocation) -> dict[tuple[str, str], str]:
    """Database and name of each study that other sweeps may use too, to its stage."""
    studies = {}
    for stage in (location.read(sweep_files.CONFIG) or {"stages": []})["stages"]:
        search = stage.get("search") or {}
        if search.get("storage"):
            name = f"{search.get('study') or location.name}/{stage['name']}"
            studies[search["storage"], name] = str(stage["name"])
    return studies


def _keys_of_stage(stage: str, nodes: Mapping[str, Mapping[str, Any]]) -> set[str]:
    """Keys of a stage's nodes and of all that they start from."""
    keys: set[str] = set()
    wanted = [key for key, node in nodes.items() if node["label"].startswith(f"{stage}/")]
    while wanted:
        key = wanted.pop()
        if key in nodes and key not in keys:
            keys.add(key)
            wanted.append(nodes[key].get("input") or "")
    return keys
