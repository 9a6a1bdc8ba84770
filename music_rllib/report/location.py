"""Finding the sweep that a user names by its folder, by an exported folder or by its name."""

from __future__ import annotations

from collections.abc import Collection
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from music_rllib import names
from music_rllib.experiment import sweep_files
from music_rllib.results.archive.folder import is_archive, read_archive
from music_rllib.results.data import ReportError, Sweep
from music_rllib.results.from_mlflow import read_mlflow
from music_rllib.store.node_store import NodeStore, damage_in_words
from music_rllib.store.object_folder import StorageError
from music_rllib.store.paths import folder_at, resolve_storage, storage_and_name, sweep_folder
from music_rllib.tracking.store import SweepRecord, TrackingStore, local_folder, resolve_store


@dataclass(frozen=True, kw_only=True)
class ReportSource:
    """A sweep and the places where it was found."""

    sweep: Sweep
    folder: Path
    """Folder for its report."""
    store: TrackingStore | None
    """MLflow store that it is logged to; None for an exported sweep."""
    undelivered: int = 0
    """Number of finished runs that are not yet complete in MLflow."""
    damaged: str | None = None
    """A sentence about finished runs whose files in the storage are damaged; None without any."""


def find_sweep(
    place: str,
    *,
    storage: str = "results",
    tracking_uri: str | None = None,
    metrics: Collection[str] | None = None,
    processes: Executor | None = None,
) -> ReportSource:
    """Read the sweep that `place` names.

    Args:
        place: a sweep's folder (`results/smoke`) or URI, an exported folder, or a sweep's name.
        storage: the storage in which a name is looked up.
        tracking_uri: an MLflow store to read instead of the sweep's own.
        metrics: the metrics to read from MLflow; None for all.
        processes: worker processes that read the values.

    Raises:
        ReportError: if there is no such sweep.
        TrackingError: if its store is not reachable.
    """
    folder = folder_at(place) or Path(resolve_storage(place)[0])
    if is_archive(folder):
        return ReportSource(sweep=read_archive(folder), folder=folder, store=None)
    name, parent = folder.name, str(folder.parent)
    if "://" in place:
        storage, name = storage_and_name(place)
    elif SweepRecord.read(parent, name) is not None:
        storage = parent
    elif "/" in place or place in {".", ".."}:
        raise ReportError(
            f"SWEEP must be the folder of a sweep, an exported folder or a sweep's name, got "
            f"{place}: no sweep has logged to {folder}"
        )
    storage = str(local_folder(storage) or storage)
    folder = sweep_folder(storage, name)
    record = SweepRecord.read(storage, name)
    if record is None:
        store = resolve_store(tracking_uri, storage)
        sweep = read_mlflow(store, name, metrics=metrics)
        return ReportSource(sweep=sweep, folder=folder, store=store)
    store = resolve_store(tracking_uri or record.tracking_uri, storage)
    sweep_name, sweep_id = record.sweep_name, record.sweep_id
    sweep = read_mlflow(store, sweep_name, sweep_id=sweep_id, metrics=metrics, processes=processes)
    return ReportSource(
        sweep=sweep,
        folder=folder,
        store=store,
        undelivered=_undelivered(sweep, storage, name),
        damaged=_damaged(sweep, storage),
    )


def _undelivered(sweep: Sweep, storage: str, name: str) -> int:
    """Number of runs that have finished in the storage but are not complete in MLflow."""
    complete = {
        run.node_key
        for run in sweep.runs
        if run.status == "FINISHED" and names.TAG_INCOMPLETE not in run.tags
    }
    try:
        plan = sweep_files.read(storage, f"{name}/{sweep_files.PLAN}") or {"nodes": []}
        nodes = NodeStore(storage)
        return sum(nodes.is_finished(key) for key in {n["key"] for n in plan["nodes"]} - complete)
    except (OSError, StorageError):  # a report does not need the storage
        return 0


def _damaged(sweep: Sweep, storage: str) -> str | None:
    try:
        nodes = NodeStore(storage)
        labels = {run.node_key: run.name for run in sweep.runs if nodes.is_finished(run.node_key)}
        damage = nodes.damage(labels)
    except (OSError, StorageError):  # a report does not need the storage
        return None
    return damage_in_words({labels[key]: why for key, why in damage.items()}) if damage else None
