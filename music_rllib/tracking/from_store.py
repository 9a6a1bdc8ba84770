"""What the store has of a sweep's runs, for MLflow."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.location import find_sweep
from music_rllib.experiment.plan import Node
from music_rllib.experiment.run_info import run_info
from music_rllib.policy.policy import policy_from_folder
from music_rllib.store.node_store import NodeStore
from music_rllib.store.object_folder import StorageError
from music_rllib.tracking.mlflow_client import Status
from music_rllib.tracking.projection import StoredRun
from music_rllib.tracking.sender import Pending
from music_rllib.tracking.store import SweepRecord
from music_rllib.tracking.tracker import Tracker

__all__ = ["deliver", "finished_run"]

logger = logging.getLogger(__name__)

_OUTCOMES: dict[str, Status] = {"finished": "FINISHED", "failed": "FAILED"}
"""Of a sweep; any other was stopped."""


def finished_run(store: NodeStore, node: Node) -> StoredRun:
    """A finished run with its policy.

    Raises:
        DamagedError: it has no readable history.
    """
    return StoredRun(store.history(node.key), _policy(store, node))


def _policy(store: NodeStore, node: Node) -> bytes | None:
    with TemporaryDirectory() as folder:
        try:
            store.fetch(node.key, Path(folder))
            return policy_from_folder(Path(folder), [node.run.task]).to_bytes()
        except (OSError, ValueError, StorageError) as error:
            logger.warning("MLflow gets no policy of %s: %s", node.label, error)
            return None


def deliver(place: str, tracking_uri: str | None, timeout: float) -> Pending:
    """Send to MLflow what it has not of a sweep that nobody drives.

    Args:
        place: the sweep's folder, its URI in a bucket, or its name.
        tracking_uri: where to, in place of the sweep's own (which is kept without its password).
        timeout: seconds to try for.

    Returns:
        What is left over.

    Raises:
        BadInputError: there is no such sweep, or it is running; as TrackingError, where it was
            not tracked, another process has it, or the store is not reachable.
        StorageError: its storage is not readable, or finished runs in it are damaged.
    """
    found = find_sweep(place, None)
    record = SweepRecord.read(found.storage, found.name)
    if record is None:
        raise TrackingError(f"SWEEP must be a sweep that was tracked, got {found.place}")
    state = found.read(sweep_files.STATE)
    if sweep_files.is_alive(state):
        raise TrackingError(f"{found.place} is running, and sends all that it has itself")
    sweep = found.open()
    tracker = Tracker(
        sweep_name=found.name,
        storage=found.storage,
        config=found.read(sweep_files.CONFIG),
        tracking_uri=tracking_uri or record.tracking_uri,
    )
    outcome = state["driver"]["outcome"] if state else ""
    causes = {one["run"]: one["cause"] for one in state["failures"]} if state else {}
    begun = sweep.store.begun()
    try:
        for node in sweep.plan.nodes:
            if sweep.store.is_finished(node.key):
                tracker.mirror(run_info(node), partial(finished_run, sweep.store, node))
            elif node.key in begun:
                cause = causes.get(node.label)
                tracker.mirror(run_info(node), partial(_unfinished_run, sweep.store, node, cause))
    finally:
        left = tracker.close(_OUTCOMES.get(outcome, "KILLED"), timeout)
    return left


def _unfinished_run(store: NodeStore, node: Node, cause: str | None) -> StoredRun:
    reports = store.work_folder(node.key).history()
    if cause is None:
        return StoredRun(reports, status="KILLED")
    return StoredRun(reports, status="FAILED", tags={names.TAG_FAILURE: cause})
