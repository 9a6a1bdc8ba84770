"""A sweep's runs into MLflow: names, tags and settings of each, and its reports as they come."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.experiment.listener import Failure, Listener
from music_rllib.experiment.plan import Node
from music_rllib.experiment.run_info import run_info
from music_rllib.policy.policy import policy_from_folder
from music_rllib.store.node_store import NodeStore
from music_rllib.store.object_folder import DamagedError, StorageError
from music_rllib.store.run_record import Report, RunResult
from music_rllib.tracking.sender import Backlog
from music_rllib.tracking.tracker import Point, Tracker

__all__ = ["MlflowListener"]


class MlflowListener(Listener):
    """Passes on what happens to the tracker; where that can't keep it, training goes on."""

    def __init__(
        self, tracker: Tracker, complain: Callable[[str], None], store: NodeStore | None = None
    ) -> None:
        """Tell `complain` once where the tracker can't write; log final policies from `store`."""
        self._tracker = tracker
        self._complain = complain
        self._store = store
        self._open: set[str] = set()
        """Nodes whose run the tracker has begun."""
        self._waiting: dict[str, list[Report]] = {}
        """Reports that the tracker could not keep yet, by node."""
        self._complained = False

    def reused(self, node: Node, store: NodeStore) -> None:
        """Log a node of an earlier sweep with its history, if it isn't there yet."""
        try:
            history = store.history(node.key)
        except DamagedError as error:
            self._complain(f"MLflow gets nothing of {node.label}: {error}")
            return
        points = [
            Point(
                env_steps=report.env_steps,
                timestamp=report.timestamp_ms / 1000,
                metrics=report.metrics,
            )
            for report in history
        ]
        with self._policy(node) as artefacts:
            self._try(lambda: self._tracker.log_history(run_info(node), points, artefacts))

    def started(self, node: Node) -> None:
        """Open the node's MLflow run, or go on with the one it has."""
        self._begin(node)

    def _begin(self, node: Node) -> bool:
        if self._try(lambda: self._tracker.start(run_info(node))):
            self._open.add(node.key)
        return node.key in self._open

    def reported(self, node: Node, reports: list[Report]) -> None:
        """Log metrics with their original time, so that repeats are the same."""
        self._waiting.setdefault(node.key, []).extend(reports)
        self._catch_up(node)

    def _catch_up(self, node: Node) -> bool:
        """Log what waits, in order: a later step must not come before an earlier one."""
        waiting = self._waiting.get(node.key, [])

        def log() -> None:
            while waiting:
                report = waiting[0]
                self._tracker.log(
                    node.key, report.metrics, report.env_steps, report.timestamp_ms / 1000
                )
                del waiting[0]

        return (node.key in self._open or self._begin(node)) and self._try(log)

    def finished(self, node: Node, result: RunResult) -> None:
        """Close the run, with its policy; where that can't be, the next sweep does it."""
        if not self._catch_up(node):
            return
        with self._policy(node) as artefacts:
            self._try(lambda: self._tracker.finish(node.key, "FINISHED", artefacts=artefacts))

    @contextlib.contextmanager
    def _policy(self, node: Node) -> Iterator[dict[str, Path]]:
        """The finished node's policy as one file, for this `with`; nothing where it has none."""
        with TemporaryDirectory() as temporary:
            folder, packed = Path(temporary, "node"), Path(temporary, names.ARTEFACT_POLICY)
            try:
                if self._store is not None:
                    folder.mkdir()
                    self._store.fetch(node.key, folder)
                    policy = policy_from_folder(folder, [node.run.task])
                    packed.write_bytes(policy.to_bytes())
            except (OSError, ValueError, StorageError) as error:
                self._complain(f"MLflow gets no policy of {node.label}: {error}")
            yield {names.ARTEFACT_POLICY: packed} if packed.exists() else {}

    def failed(self, node: Node, failure: Failure) -> None:
        """Close the run with its cause."""
        if self._catch_up(node):
            self._try(lambda: self._tracker.finish(node.key, "FAILED", failure=failure.cause))

    def pruned(self, node: Node, reason: str) -> None:
        """Close a run that isn't computed any further, and say why."""
        if node.key not in self._open:
            return
        info = run_info(node)
        told = dataclasses.replace(info, tags={**info.tags, names.TAG_PRUNED: reason})
        self._try(lambda: self._tracker.start(told))
        self._try(lambda: self._tracker.finish(node.key, "KILLED"))
        self._open.discard(node.key)

    def end(self, *, killed: bool) -> None:
        """Close the sweep's run and those that are open, as far as that can be done in a moment."""
        self._tracker.close("KILLED" if killed else "FAILED", timeout=10.0)

    def backlog(self) -> Backlog:
        """What MLflow does not have yet."""
        return self._tracker.backlog()

    def _try(self, log: Callable[[], object]) -> bool:
        """Log; False, with a complaint the first time, where the tracker can't."""
        try:
            log()
        except TrackingError as error:
            if not self._complained:
                self._complain(f"MLflow gets nothing for now, training goes on: {error}")
            self._complained = True
            return False
        if self._complained:
            self._complained = False
            self._complain("what MLflow is to get can be kept again")
        return True
