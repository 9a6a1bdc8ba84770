"""Passes the events of a sweep's runs to its tracker."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
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
        self.postpones = False
        """Whether another driver may be logging the runs that this process has not computed."""
        self._postponed: list[Node] = []
        self._new: set[str] = set()
        """Keys of started runs without a report; another process may have them."""

    def started(self, node: Node) -> None:
        """The first report will start the node's MLflow run, or continue an earlier one."""
        self._new.add(node.key)

    def _start(self, node: Node) -> None:
        self._new.discard(node.key)
        self.tracker.start(run_info(node, self._environments.get(node.run.code)))

    def reported(self, node: Node, reports: list[Report]) -> None:
        """Log metrics with their original time, so that repeats are identical."""
        if node.key in self._new:
            self._start(node)
        self.tracker.log(node.key, reports)

    def finished(self, node: Node, result: RunResult | None = None) -> None:
        """Log a run that this sweep or an earlier one has finished, with its policy."""
        if self.postpones and not self.tracker.is_running(node.key):
            self._postponed.append(node)
        else:
            self._mirror(node)

    def _mirror(self, node: Node) -> None:
        environment, result = self._store.described(node.key)
        info = run_info(node, environment)
        info = replace(info, tags={**info.tags, names.TAG_RESULT: result})
        self.tracker.mirror(info, partial(finished_run, self._store, node))

    def left(self, node: Node, holder: str) -> None:
        """Send nothing more of a run that another process computes, and logs."""
        self._new.discard(node.key)
        self.postpones = True
        self.tracker.leave(node.key)

    def log_postponed(self) -> None:
        """Log the finished runs that no other driver will log."""
        if self._postponed:
            self.tracker.look_again()
        for node in self._postponed:
            self._mirror(node)

    def failed(self, node: Node, failure: Failure) -> None:
        if not self.tracker.is_running(node.key):
            self._start(node)
        self.tracker.end(node.key, "FAILED", {names.TAG_FAILURE: failure.cause})

    def pruned(self, node: Node, reason: str) -> None:
        if self.tracker.is_running(node.key):
            self.tracker.end(node.key, "KILLED", {names.TAG_PRUNED: reason})


def finished_run(store: NodeStore, node: Node) -> StoredRun:
    """A finished run with its policy, or without one if that cannot be read.

    Raises:
        DamagedError: The run's history cannot be read.
    """
    policy = partial(_policy, store, node)
    return StoredRun(store.history(node.key), policy, store.provenance(node.key))


def _policy(store: NodeStore, node: Node) -> bytes | None:
    try:
        with store.files(node.key) as folder:
            return policy_from_folder(folder, [node.run.task]).to_bytes()
    except (OSError, ValueError, StorageError) as error:
        logger.warning("MLflow gets no policy of %s: %s", node.label, error)
        return None
