"""Passes the events of runs to the tracker."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial

from music_rllib import names
from music_rllib.envs.fingerprint import Fingerprint
from music_rllib.experiment.plan import Node
from music_rllib.experiment.run_info import run_info
from music_rllib.experiment.scheduler import Failure, Listener
from music_rllib.policy.policy import policy_from_folder
from music_rllib.store.history import Report, RunResult
from music_rllib.store.node_store import NodeStore
from music_rllib.store.storage import StorageError
from music_rllib.tracking.run_queue import StoredRun
from music_rllib.tracking.tracker import Tracker

logger = logging.getLogger(__name__)


class MlflowListener(Listener):
    """Logs the runs of a sweep: reports of running ones, and finished ones from the store."""

    def __init__(
        self, tracker: Tracker, store: NodeStore, environments: Mapping[str, Fingerprint]
    ) -> None:
        """Log by `tracker`; `environments` are those of the tasks of running runs."""
        self.tracker = tracker
        self._store = store
        self._environments = environments

    def started(self, node: Node) -> None:
        """Start the node's MLflow run, or continue an earlier one."""
        self.tracker.start(run_info(node, self._environments.get(node.run.task.name)))

    def reported(self, node: Node, reports: list[Report]) -> None:
        """Log metrics with their original time, so that repeats are identical."""
        self.tracker.log(node.key, reports)

    def finished(self, node: Node, result: RunResult | None = None) -> None:
        """Log a run that this sweep or an earlier one has finished, with its policy."""
        info = run_info(node, self._store.environment(node.key))
        self.tracker.mirror(info, partial(finished_run, self._store, node))

    def failed(self, node: Node, failure: Failure) -> None:
        """End the run with its cause."""
        if not self.tracker.is_running(node.key):
            self.started(node)
        self.tracker.end(node.key, "FAILED", {names.TAG_FAILURE: failure.cause})

    def pruned(self, node: Node, reason: str) -> None:
        """End a run that was stopped early, with the reason."""
        if self.tracker.is_running(node.key):
            self.tracker.end(node.key, "KILLED", {names.TAG_PRUNED: reason})


def finished_run(store: NodeStore, node: Node) -> StoredRun:
    """A finished run with its policy, or without one if that cannot be read.

    Raises:
        DamagedError: The run's history cannot be read.
    """
    reports, policy = store.history(node.key), None
    try:
        with store.files(node.key) as folder:
            policy = policy_from_folder(folder, [node.run.task]).to_bytes()
    except (OSError, ValueError, StorageError) as error:
        logger.warning("MLflow gets no policy of %s: %s", node.label, error)
    return StoredRun(reports, policy)
