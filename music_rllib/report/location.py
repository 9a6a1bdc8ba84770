"""What a user means by SWEEP: a sweep's folder, an exported folder, or a name."""

from __future__ import annotations

from collections.abc import Collection
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from music_rllib import names
from music_rllib.experiment import sweep_files
from music_rllib.results.archive.folder import is_archive, read_archive
from music_rllib.results.data import Sweep
from music_rllib.results.from_mlflow import read_mlflow
from music_rllib.store.node_store import NodeStore, damage_in_words
from music_rllib.store.object_folder import StorageError
from music_rllib.store.paths import sweep_folder
from music_rllib.tracking.store import SweepRecord, TrackingStore, local_folder, resolve_store

__all__ = ["ReportSource", "find_sweep"]


@dataclass(frozen=True, kw_only=True)
class ReportSource:
    """A sweep and where it was found."""

    sweep: Sweep
    folder: Path
    """Where its report goes."""
    store: TrackingStore | None
    """Where it is logged; None for an exported sweep."""
    undelivered: int = 0
    """Runs of which MLflow does not have everything yet."""
    damaged: str | None = None
    """Finished runs that are not any more in the storage what MLflow says of them, in words."""


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
        storage: where a name is looked for.
        tracking_uri: in place of the store that the sweep was logged to.
        metrics: which ones to read from MLflow; None for all.
        processes: of which one may read, too.

    Raises:
        ReportError: where there is no such sweep.
        TrackingError: where its store is not reachable.
    """
    folder = Path(place).expanduser()
    if is_archive(folder):
        return ReportSource(sweep=read_archive(folder), folder=folder, store=None)
    name, above = folder.absolute().name, str(folder.absolute().parent)
    if "://" in place:
        storage = place.rstrip("/").rpartition("/")[0]
    elif SweepRecord.read(above, name) is not None:
        storage = above
    storage = str(local_folder(storage) or storage)
    folder = sweep_folder(storage, name)
    record = SweepRecord.read(storage, name)
    if record is None:
        store = resolve_store(tracking_uri, storage)
        sweep = read_mlflow(store, name, metrics=metrics)
        return ReportSource(sweep=sweep, folder=folder, store=store)
    store = resolve_store(tracking_uri or record.tracking_uri, storage)
    sweep = read_mlflow(
        store,
        record.sweep_name,
        sweep_id=record.sweep_id,
        metrics=metrics,
        processes=processes,
    )
    return ReportSource(
        sweep=sweep,
        folder=folder,
        store=store,
        undelivered=_undelivered(sweep, storage, name),
        damaged=_damaged(sweep, storage),
    )


def _undelivered(sweep: Sweep, storage: str, name: str) -> int:
    """Finished runs of the sweep that MLflow has not wholly, if the storage can be asked."""
    whole = {
        run.node_key
        for run in sweep.runs
        if run.status == "FINISHED" and names.TAG_INCOMPLETE not in run.tags
    }
    try:
        planned = sweep_files.read(storage, f"{name}/{sweep_files.PLAN}") or {"nodes": []}
        nodes = NodeStore(storage)
        keys = {node["key"] for node in planned["nodes"]}
        return sum(nodes.is_finished(key) for key in keys - whole)
    except (OSError, StorageError):  # a report needs MLflow only
        return 0


def _damaged(sweep: Sweep, storage: str) -> str | None:
    try:
        nodes = NodeStore(storage)
        labels = {run.node_key: run.name for run in sweep.runs if nodes.is_finished(run.node_key)}
        damage = nodes.damage(labels)
    except (OSError, StorageError):  # a report needs MLflow only
        return None
    return damage_in_words({labels[key]: why for key, why in damage.items()}) if damage else None
