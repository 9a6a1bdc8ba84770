"""Deletion of a sweep's files and runs in its storage."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pyarrow.fs as pafs

from music_rllib.config.schema import IMPORTED
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.sweep_files import SweepLocation, sweeps_in
from music_rllib.redaction import redact
from music_rllib.store.lease import Lease, LeaseFile
from music_rllib.store.node_store import CONTINUATIONS, NodeStore
from music_rllib.store.sealed import MANIFEST
from music_rllib.store.storage import (
    StorageError,
    StorageFolder,
    is_remote,
    open_storage,
    sweep_folder,
)
from music_rllib.store.work_folder import WorkFolder, steps_of
from music_rllib.sweep.driver_lock import drivers_of

Item = dict[str, str]
"""`{"path": ..., "what": ...}`."""


@dataclass(kw_only=True)
class Cleaning:
    """The folders that `clean` deletes, and those that it keeps."""

    storage: StorageFolder
    folders: list[StorageFolder] = field(default_factory=list)
    """Folders of runs to delete."""
    own: list[StorageFolder] = field(default_factory=list)
    """The sweep's own folders to delete afterwards, in the storage or on this machine."""
    items: list[Item] = field(default_factory=list)
    """A description of each folder to delete."""
    kept: list[Item] = field(default_factory=list)
    """Folders that one might expect to be deleted, and why they are kept."""
    leases: dict[str, LeaseFile] = field(default_factory=dict)
    """Path of each folder that has a lease, to the lease."""

    def add(self, folder: StorageFolder, what: str, *, own: bool = False) -> None:
        (self.own if own else self.folders).append(folder)
        self.items.append({"path": folder.path, "what": what})

    def keep(self, path: str, what: str) -> None:
        self.kept.append({"path": path, "what": what})

    def delete(self) -> None:
        """Delete the folders, each run's manifest first: without it, the run is not finished.

        Raises:
            BadInputError: Another process computes a run. Nothing was deleted, or if it started
                just now, neither this run's checkpoints nor the sweep's own files.
        """
        _refuse(self.storage.map(LeaseFile.holder, self.leases.values()))
        _refuse(self.storage.map(self._delete, self.folders))
        for folder in self.own:
            folder.delete()

    def _delete(self, folder: StorageFolder) -> Lease | None:
        """Delete the folder of a run, or return the lease of another process."""
        # Acquired only now, as a lease is short, and acquiring one in a bucket takes seconds.
        lease = self.leases.get(folder.path)
        holder = None if lease is None else lease.acquire(Lease.of_this_process("clean"))
        if holder is None:
            folder.remove(MANIFEST)
            folder.delete()
        return holder


def _refuse(holders: Iterable[Lease | None]) -> None:
    if found := [holder for holder in holders if holder is not None]:
        raise BadInputError(
            f"SWEEP must have no run that another process computes to be cleaned, got {found[0]}: "
            "stop it, or wait for a minute after its end"
        )


def find_deletable(location: SweepLocation, *, unfinished: bool, everything: bool) -> Cleaning:
    """Folders that can be deleted, with the reason.

    `unfinished` includes checkpoints of interrupted runs, `everything` results and the sweep's own
    files.

    Raises:
        BadInputError: The sweep is running, or another running sweep shares runs with it.
        StorageError: A record of this sweep or of another one in the storage is damaged, so that
            the runs they need are not known.
    """
    state = location.read(sweep_files.STATE)
    if _is_driven(location, state):
        raise BadInputError(
            f"SWEEP must not be running to be cleaned, {location.name} is: stop it first"
        )
    nodes = _nodes(location)
    users = _users(location, nodes)
    pruned = set((state or {}).get("pruned", ()))
    storage = open_storage(location.storage)
    finished = set((storage / "nodes").having(MANIFEST, [node["key"] for node in nodes]))
    begun = {*(storage / "work").folders()}
    continued = {*(storage / CONTINUATIONS).folders()}
    cleaning = Cleaning(storage=storage)
    interrupted = [one for one in nodes if one["key"] not in finished | pruned]
    for node in nodes:
        key, label = node["key"], node["label"]
        result = storage / "nodes" / key
        if key in users:
            if everything and key in finished:
                also = ", ".join(users[key])
                cleaning.keep(result.path, f"result of {label}: {also} has it too")
            continue
        if key in begun:
            why = "finished" if key in finished else "stopped early"
            if key not in finished and key not in pruned:
                why = "interrupted"
            if why != "interrupted" or unfinished:
                work = WorkFolder(storage / "work" / key)
                cleaning.leases[work.folder.path] = work.lease
                cleaning.add(work.folder, f"checkpoints of {label}: {why}")
        if key in finished and (last := node.get("continuation")) in continued:
            continued.remove(last)  # several runs can have it
            folder, what = storage / CONTINUATIONS / last, f"last checkpoint of {label}"
            if last in users:
                cleaning.keep(folder.path, f"{what}: {', '.join(users[last])} has it too")
            elif not unfinished and (waiting := _continues(folder, last, interrupted, storage)):
                cleaning.keep(folder.path, f"{what}: {waiting} starts from it")
            else:
                cleaning.add(folder, f"{what}: kept for a run with more env_steps")
        if everything and key in finished:
            cleaning.add(result, f"result of {label}")
    if everything:
        _add_own_files(location, storage, cleaning)
    return cleaning


def _continues(
    folder: StorageFolder, key: str, nodes: Iterable[Mapping[str, Any]], storage: StorageFolder
) -> str | None:
    """The label of a run that would continue from the last checkpoint `key` in `folder`."""
    steps = min(map(steps_of, WorkFolder(folder).names()), default=None)
    for node in nodes if steps is not None else ():
        longer = node.get("continuation") == key and node.get("env_steps", 0) > steps
        if longer and not WorkFolder(storage / "work" / node["key"]).names():
            return str(node["label"])
    return None


def _add_own_files(location: SweepLocation, storage: StorageFolder, cleaning: Cleaning) -> None:
    cleaning.add(storage / location.name, "the sweep's own files", own=True)
    here = sweep_folder(location.storage, location.name)
    if is_remote(location.storage) and here.is_dir():
        # They include a study, which the next sweep of this name would use as its own.
        folder = StorageFolder(pafs.LocalFileSystem(), str(here))
        cleaning.add(folder, "the sweep's own files on this machine", own=True)
    for database, study in _studies(location):
        what = f"study {study!r}: delete it with Optuna's tools if it is not needed"
        cleaning.keep(redact(database), what)


def _is_driven(location: SweepLocation, state: Mapping[str, Any] | None) -> bool:
    drivers = drivers_of(location, watch=True)
    return sweep_files.is_alive(state) or bool(drivers)


def _nodes(location: SweepLocation) -> list[dict[str, Any]]:
    """The nodes of a sweep's plan and of its earlier versions, and imported handoffs."""
    nodes = location.nodes()
    earlier = (location.read(sweep_files.PLAN) or {}).get("earlier", ())
    imported = {node["input"]: None for node in nodes if str(node["input"]).startswith(IMPORTED)}
    return [
        *nodes,
        *({"key": key, "label": f"{key} (imported)", "input": None} for key in imported),
        *({"input": None, **one, "label": f"{one['label']} (earlier version)"} for one in earlier),
    ]


def check_not_in_use(location: SweepLocation, keys: Collection[str]) -> None:
    """Check that no other running sweep has any of these runs.

    Raises:
        BadInputError: A running sweep has one.
    """
    others = [one for one in sweeps_in(location.storage) if keys and one.name != location.name]
    for other in others:
        shared = []
        with contextlib.suppress(StorageError):  # no driver runs a sweep with a damaged plan
            shared = [node["label"] for node in _nodes(other) if node["key"] in keys]
        if shared and _is_driven(other, other.read(sweep_files.STATE)):
            raise BadInputError(
                "--retrain and --accept-changes must delete no runs of another running sweep, "
                f"{other.name} uses {shared[0]}: stop it first"
            )


def started_from(location: SweepLocation, keys: Collection[str]) -> list[Mapping[str, Any]]:
    """Runs of all sweeps in the storage, and of their earlier plans, that start from these runs."""
    nodes: dict[str, Mapping[str, Any]] = {}
    for sweep in sweeps_in(location.storage):
        with contextlib.suppress(StorageError):
            own = ({**node, "label": f"{sweep.name}: {node['label']}"} for node in _nodes(sweep))
            nodes |= {node["key"]: node for node in own}
    found = set(keys)
    while more := {key for key, node in nodes.items() if node["input"] in found} - found:
        found |= more
    return [nodes[key] for key in sorted(found - set(keys))]


def remove_started(
    store: NodeStore, nodes: Iterable[Mapping[str, Any]], say: Callable[[str], None]
) -> None:
    """Delete results and checkpoints of runs that start from a run to be retrained."""
    begun = store.begun()
    for node in nodes:
        if node["key"] in begun or store.is_finished(node["key"]):
            say(f"{node['label']}: deleted, it starts from a run to be retrained")
            store.remove(node["key"])
            store.work_folder(node["key"]).clear()
        if "continuation" in node:
            store.continuation(node["continuation"]).clear()


def _users(location: SweepLocation, nodes: Iterable[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Key of each node to the names of other sweeps that have it, or whose searches need it.

    Likewise for the key of a last checkpoint, which runs share that differ only in their budget.

    Raises:
        BadInputError: One of these sweeps is running.
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
    """Keys of a stage's nodes and of all nodes that they start from."""
    keys: set[str] = set()
    wanted = [key for key, node in nodes.items() if node["label"].startswith(f"{stage}/")]
    while wanted:
        key = wanted.pop()
        if key in nodes and key not in keys:
            keys.add(key)
            wanted.append(nodes[key].get("input") or "")
    return keys
