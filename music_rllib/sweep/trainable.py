"""One node as a Tune trial: looks into the store first, trains, checkpoints, publishes."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict
from ray.tune import PlacementGroupFactory, Trainable

from music_rllib.envs.registry import Task
from music_rllib.experiment.handoff import HandoffInfo, Weights, read_handoff, write_handoff
from music_rllib.experiment.plan import Node
from music_rllib.experiment.result import (
    HISTORY,
    Report,
    RunResult,
    from_json_lines,
    last_values,
    to_json_lines,
)
from music_rllib.experiment.settings import RunSettings, handed_over
from music_rllib.experiment.store import NodeStore
from music_rllib.tracking import names

if TYPE_CHECKING:
    from music_rllib.experiment.training import TrainingRun

__all__ = ["NOTES", "REPORTS", "NodeJob", "RunTrainable"]

REPORTS, NOTES = "reports", "notes"
"""Keys of a Tune result: reports as JSON lines, and what a person should be told."""


class NodeJob(BaseModel):
    """All that a worker needs to compute a node."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str
    label: str
    run: RunSettings
    source_key: str | None
    source_task: Task | None
    storage: str
    cpus: int

    @classmethod
    def of(cls, node: Node, storage: str, cpus: int) -> NodeJob:
        """The job that computes `node` in the storage at this URI on so many CPUs."""
        return cls(
            key=node.key,
            label=node.label,
            run=node.run,
            source_key=node.input.key if node.input else None,
            source_task=node.input.task if node.input else None,
            storage=storage,
            cpus=cpus,
        )

    def to_tune(self) -> dict[str, Any]:
        """As a Tune config; text, so that Tune doesn't look for search spaces in it."""
        return {"job": self.model_dump_json()}

    @classmethod
    def from_tune(cls, config: dict[str, Any]) -> NodeJob:
        """Inverse of `to_tune`."""
        return cls.model_validate_json(config["job"])


class RunTrainable(Trainable):
    """Trains a node from its newest checkpoint, or from scratch, to its budget.

    A step is the time between two reports. After each evaluation there is a checkpoint; at the
    end the handoff, the history and the settings are published and the checkpoints deleted.
    """

    @classmethod
    def default_resource_request(cls, config: dict[str, Any]) -> PlacementGroupFactory:
        """One bundle with the CPUs of a run."""
        return PlacementGroupFactory([{"CPU": NodeJob.from_tune(config).cpus}])

    def setup(self, config: dict[str, Any]) -> None:
        """Only what can't fail: errors in a step are reported with their cause."""
        self._job = NodeJob.from_tune(config)
        self._training: TrainingRun | None = None
        self._history: list[Report] = []
        self._notes: list[str] = []
        self._seconds_before = self._began = 0.0
        self._unsent = 0
        """Position in the history up to which the driver has been told."""

    def step(self) -> dict[str, Any]:
        """Go on to the next report."""
        store = NodeStore(self._job.storage)
        if store.is_finished(self._job.key):
            # Another sweep, or a worker that outlived its driver, was faster.
            self._history = store.history(self._job.key)
            return self._result(done=True)
        if self._training is None:
            self._training = self._begin(store)
            if self._history:
                return self._result(done=False)
        done = self._advance(self._training, store)
        return self._result(done=done)

    def _begin(self, store: NodeStore) -> TrainingRun:
        from music_rllib.experiment.training import TrainingRun

        training = TrainingRun(self._job.run, self._weights(store))
        with store.work_folder(self._job.key).newest(self._notes.append) as folder:
            if folder is not None:
                training.restore(folder / "state")
                self._history = from_json_lines((folder / HISTORY).read_bytes())
                self._notes.append(f"continues at {training.env_steps:,} env steps")
        self._seconds_before = self._history[-1].seconds if self._history else 0.0
        self._began = time.monotonic()
        return training

    def _weights(self, store: NodeStore) -> Weights | None:
        job = self._job
        if job.source_key is None or job.source_task is None:
            return None
        with TemporaryDirectory() as folder:
            store.fetch(job.source_key, Path(folder))
            return read_handoff(Path(folder), handed_over(job.run), job.source_task)

    def _advance(self, training: TrainingRun, store: NodeStore) -> bool:
        """Train to the next report; whether the run is over."""
        metrics = training.advance()
        self._history.append(
            Report(
                env_steps=training.env_steps,
                seconds=self._seconds_before + time.monotonic() - self._began,
                timestamp_ms=round(time.time() * 1000),
                metrics=metrics,
            )
        )
        if training.finished:
            self._publish(training, store)
        elif names.EVAL_EPISODES in metrics:
            with store.work_folder(self._job.key).new_checkpoint(training.env_steps) as folder:
                training.save(folder / "state")
                (folder / HISTORY).write_bytes(to_json_lines(self._history))
                self._write_policy(training, folder)
        return training.finished

    def _write_policy(self, training: TrainingRun, folder: Path) -> None:
        """What acts, as plain weights: `load_policy` unpickles nothing."""
        modules = training.modules()
        acting: dict[str, Any] = {
            name: modules[name] for name in ("policy", "normaliser") if name in modules
        }
        info = HandoffInfo.of(self._job.run, self._job.key, training.env_steps)
        (folder / "run.json").write_text(self._job.run.model_dump_json(indent=1))
        with contextlib.suppress(ValueError):  # diverged: the end of the run will say so
            write_handoff(folder / "handoff", acting, info)

    def _publish(self, training: TrainingRun, store: NodeStore) -> None:
        last = self._history[-1]
        with TemporaryDirectory() as temporary:
            folder = Path(temporary)
            info = HandoffInfo.of(self._job.run, self._job.key, training.env_steps)
            write_handoff(folder / "handoff", training.modules(), info)
            (folder / HISTORY).write_bytes(to_json_lines(self._history))
            (folder / "run.json").write_text(self._job.run.model_dump_json(indent=1))
            result = RunResult(
                label=self._job.label,
                env_steps=last.env_steps,
                seconds=last.seconds,
                metrics=last_values(self._history),
            )
            store.publish(self._job.key, folder, result)
        store.work_folder(self._job.key).clear()

    def _result(self, *, done: bool) -> dict[str, Any]:
        """What the driver hasn't been told yet.

        After a restart that is the checkpoint's whole history: the driver that was told of it may
        have died before it passed it on.
        """
        reports = to_json_lines(self._history[self._unsent :]).decode()
        self._unsent = len(self._history)
        notes, self._notes = self._notes, []
        return {REPORTS: reports, NOTES: notes, "done": done}

    def cleanup(self) -> None:
        """Release environments and networks."""
        if self._training is not None:
            self._training.close()
