"""The interface of what follows a sweep's events: the screen, MLflow, searches. Knows no Ray."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from music_rllib.experiment.plan import Node
from music_rllib.store.history import Report, RunResult


class Failure(NamedTuple):
    """Why a run failed."""

    cause: str
    """One or two lines."""
    log: Path
    """File with the whole traceback."""


class Listener:
    """Receives a sweep's events in the driver's loop, so it must be quick and must not raise."""

    def started(self, node: Node) -> None:
        """A worker has begun to compute the node."""

    def reported(self, node: Node, reports: list[Report]) -> None:
        """The node has new reports; after a restart, those of its checkpoint once more."""

    def noted(self, node: Node, text: str) -> None:
        """A message about the node that is no failure."""

    def remarked(self, text: str) -> None:
        """A message about the whole sweep."""

    def finished(self, node: Node, result: RunResult) -> None:
        """The node is in the store."""

    def failed(self, node: Node, failure: Failure) -> None:
        """The run failed."""

    def skipped(self, node: Node, because: Node) -> None:
        """The node won't be computed, because another one failed."""

    def paused(self, node: Node) -> None:
        """The node is computed up to its trial's rung."""

    def pruned(self, node: Node, reason: str) -> None:
        """The node isn't computed any further, because its trial was stopped early."""

    def tick(self) -> None:
        """The driver's loop went round once."""
