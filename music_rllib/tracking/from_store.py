"""Runs of the store, sent to MLflow."""

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

logger = logging.getLogger(__name__)

_STATUS_OF_OUTCOME: dict[str, Status] = {"finished": "FINISHED", "failed": "FAILED"}
"""MLflow's status of a sweep's outcome; it is KILLED for any other."""


def finished_run(store: NodeStore, node: Node) -> StoredRun:
    """A finished run with its policy, or without one if that cannot be read.

    Raises:
        DamagedError: The run's history cannot be read.
    """
    reports, policy = store.history(node.key), None
    with TemporaryDirectory() as folder:
        try:
            store.fetch(node.key, Path(folder))
            policy = policy_from_folder(Path(folder), [node.run.task]).to_bytes()
        except (OSError, ValueError, StorageError) as error:
            logger.warning("MLflow gets no policy of %s: %s", node.label, error)
    return StoredRun(reports, policy)


def deliver(place: str, tracking_uri: str | None, timeout: float) -> Pending:
    """Send to MLflow all that it does not have of a sweep that is not running.

    Args:
        place: The sweep's folder, its URI in a bucket, or its name.
        tracking_uri: The store, if not the one that the sweep was logged to, whose URI is kept
            without its password.
        timeout: Longest time to try, in seconds.

    Returns:
        What is not delivered.

    Raises:
        BadInputError: The sweep does not exist.
        TrackingError: The sweep is running or was not tracked, another process tracks it, or the
            store is not reachable.
        StorageError: The storage is not readable, or finished runs in it are damaged.
    """
    location = find_sweep(place, None)
    record = SweepRecord.read(location.storage, location.name)
    if record is None:
        raise TrackingError(f"SWEEP must be a sweep that was tracked, got {location.place}")
    state = location.read(sweep_files.STATE)
    if sweep_files.is_alive(state):
        raise TrackingError(f"{location.place} is running, and sends all that it has itself")
    sweep = location.open()
    tracker = Tracker(
        sweep_name=location.name,
        storage=location.storage,
        config=location.document(),
        tracking_uri=tracking_uri or record.tracking_uri,
        plan=record.plan,
    )
    outcome = state["driver"]["outcome"] if state else ""
    causes = {failure["run"]: failure["cause"] for failure in state["failures"]} if state else {}
    begun = sweep.store.begun()
    try:
        for name, file in (
            (names.ARTEFACT_ANALYSIS_PLAN, sweep_files.ANALYSIS_PLAN),
            (names.ARTEFACT_SEARCH, sweep_files.SEARCH),
        ):
            if (document := location.read(file)) is not None:
                tracker.put_sweep_artefact(name, sweep_files.as_json(document))
        tracker.keep_current(node.key for node in sweep.plan.nodes)
        for node in sweep.plan.nodes:
            if sweep.store.is_finished(node.key):
                info = run_info(node, sweep.store.environment(node.key))
                tracker.mirror(info, partial(finished_run, sweep.store, node))
            elif node.key in begun:
                cause = causes.get(node.label)
                tracker.mirror(run_info(node), partial(_unfinished_run, sweep.store, node, cause))
    finally:
        pending = tracker.close(_STATUS_OF_OUTCOME.get(outcome, "KILLED"), timeout)
    return pending


def _unfinished_run(store: NodeStore, node: Node, cause: str | None) -> StoredRun:
    reports = store.work_folder(node.key).history()
    if cause is None:
        return StoredRun(reports, status="KILLED")
    return StoredRun(reports, status="FAILED", tags={names.TAG_FAILURE: cause})
