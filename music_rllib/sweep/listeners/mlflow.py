"""A sweep's runs into MLflow: names, tags and settings of each, and its reports as they come."""

from __future__ import annotations

from functools import partial

from music_rllib import names
from music_rllib.experiment.listener import Failure, Listener
from music_rllib.experiment.plan import Node
from music_rllib.experiment.run_info import run_info
from music_rllib.store.node_store import NodeStore
from music_rllib.store.run_record import Report, RunResult
from music_rllib.tracking.from_store import finished_run
from music_rllib.tracking.mlflow_client import Status
from music_rllib.tracking.sender import Pending
from music_rllib.tracking.tracker import Tracker

__all__ = ["MlflowListener"]


class MlflowListener(Listener):
    """Passes on what happens to the tracker."""

    def __init__(self, tracker: Tracker, store: NodeStore) -> None:
        """Speak to `tracker` of runs that end up in `store`."""
        self._tracker = tracker
        self._store = store
        self._open: set[str] = set()
        """Nodes whose run has begun and not ended."""

    def started(self, node: Node) -> None:
        """Open the node's MLflow run, or go on with the one it has."""
        self._tracker.start(run_info(node))
        self._open.add(node.key)

    def reported(self, node: Node, reports: list[Report]) -> None:
        """Log metrics with their original time, so that repeats are the same."""
        self._tracker.log(node.key, reports)

    def finished(self, node: Node, result: RunResult | None = None) -> None:
        """Close the run, with its policy: from the store, by this sweep or an earlier one."""
        self._tracker.mirror(run_info(node), partial(finished_run, self._store, node))
        self._open.discard(node.key)

    def failed(self, node: Node, failure: Failure) -> None:
        """Close the run with its cause."""
        if node.key not in self._open:
            self.started(node)
        self._end(node, "FAILED", {names.TAG_FAILURE: failure.cause})

    def pruned(self, node: Node, reason: str) -> None:
        """Close a run that isn't computed any further, and say why."""
        if node.key in self._open:
            self._end(node, "KILLED", {names.TAG_PRUNED: reason})

    def _end(self, node: Node, status: Status, tags: dict[str, str]) -> None:
        self._tracker.end(node.key, status, tags)
        self._open.discard(node.key)

    def end(self, *, killed: bool) -> None:
        """Close the sweep's run and those that are open, as far as that can be done in a moment."""
        self._tracker.close("KILLED" if killed else "FAILED", timeout=10.0)

    def pending(self) -> Pending:
        """What MLflow does not have yet."""
        return self._tracker.pending()
