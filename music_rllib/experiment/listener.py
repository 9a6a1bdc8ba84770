"""Who is told what happens in a sweep: the screen, MLflow. Knows no Ray."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from music_rllib.experiment.plan import Node
from music_rllib.store.run_record import Report, RunResult

__all__ = ["Failure", "Listener"]


class Failure(NamedTuple):
    """Why a run failed."""

    cause: str
    """One or two lines."""
    log: Path
    """File with the whole traceback."""


class Listener:
    """Told in the driver's loop, so it must be quick and must not raise."""

    def started(self, node: Node) -> None:
        """A worker has begun."""

    def reported(self, node: Node, reports: list[Report]) -> None:
        """New reports; after a restart, those of the checkpoint once more."""

    def noted(self, node: Node, text: str) -> None:
        """Something that a person should know, but no failure."""

    def remarked(self, text: str) -> None:
        """The same of the whole sweep."""

    def finished(self, node: Node, result: RunResult) -> None:
        """The node is in the store."""

    def failed(self, node: Node, failure: Failure) -> None:
        """The run failed."""

    def skipped(self, node: Node, because: Node) -> None:
        """The node won't be computed, because another one failed."""

    def paused(self, node: Node) -> None:
        """The node is computed as far as its trial is looked at next."""

    def pruned(self, node: Node, reason: str) -> None:
        """The node isn't computed any further, because its trial was stopped early."""

    def tick(self) -> None:
        """Some time has passed; often."""
