"""Logs the runs of a sweep to MLflow: names, tags, settings and reports."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from music_rllib import names
from music_rllib.envs.fingerprint import Fingerprint
from music_rllib.experiment.listener import Failure, Listener
from music_rllib.experiment.plan import Node
from music_rllib.experiment.run_info import run_info
from music_rllib.store.history import Report, RunResult
from music_rllib.store.node_store import NodeStore
from music_rllib.tracking.from_store import finished_run
from music_rllib.tracking.mlflow_client import Status
from music_rllib.tracking.tracker import Tracker


class MlflowListener(Listener):
    """Passes on to the tracker what happens to runs."""

    def __init__(
        self, tracker: Tracker, store: NodeStore, environments: Mapping[str, Fingerprint]
    ) -> None:
        """Log by `tracker`; finished runs are read from `store`.

        Started ones use the `environments` of their tasks.
        """
        self._environments = environments
        self.tracker = tracker
        self._store = store
        self._open: set[str] = set()
        """Keys of nodes whose run has begun and not ended."""

    def started(self, node: Node) -> None:
        """Open the node's MLflow run, or continue the one that it has."""
        self.tracker.start(run_info(node, self._environments.get(node.run.task.name)))
        self._open.add(node.key)

    def reported(self, node: Node, reports: list[Report]) -> None:
        """Log metrics with their original time, so that repeats are the same."""
        self.tracker.log(node.key, reports)

    def finished(self, node: Node, result: RunResult | None = None) -> None:
        """Close a run that this sweep or an earlier one has finished, with its policy."""
        info = run_info(node, self._store.environment(node.key))
        self.tracker.mirror(info, partial(finished_run, self._store, node))
        self._open.discard(node.key)

    def failed(self, node: Node, failure: Failure) -> None:
        """Close the run with its cause."""
        if node.key not in self._open:
            self.started(node)
        self._end(node, "FAILED", {names.TAG_FAILURE: failure.cause})

    def pruned(self, node: Node, reason: str) -> None:
        """Close a run that was stopped early, with the reason."""
        if node.key in self._open:
            self._end(node, "KILLED", {names.TAG_PRUNED: reason})

    def _end(self, node: Node, status: Status, tags: dict[str, str]) -> None:
        self.tracker.end(node.key, status, tags)
        self._open.discard(node.key)
