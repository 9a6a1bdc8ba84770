"""One node as a Tune trial: looks into the store first, trains, checkpoints, publishes."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from ray.tune import PlacementGroupFactory, Trainable

from music_rllib import names
from music_rllib.config.run_settings import handed_over
from music_rllib.experiment.continuation import (
    budget_settings,
    continuation_key,
    is_continuable,
)
from music_rllib.redaction import redact
from music_rllib.store.handoff import Weights, read_handoff, write_handoff
from music_rllib.store.lease import HeldLease, Lease, LeaseLostError
from music_rllib.store.node_store import NodeStore, Saved, WorkFolder, steps_of
from music_rllib.store.object_folder import StorageError
from music_rllib.store.run_record import (
    HISTORY,
    Report,
    RunResult,
    from_json_lines,
    last_values,
    to_json_lines,
)
from music_rllib.training.failure_reason import cause_of
from music_rllib.training.hang_watch import RECORD, HangWatch, check_hung
from music_rllib.training.job import NodeJob
from music_rllib.training.stop import StopWatch

if TYPE_CHECKING:
    from music_rllib.training.run import TrainingRun

__all__ = ["CAUSE", "NOTES", "PAUSED", "REPORTS", "STOPPED", "TRACEBACK", "RunTrainable"]

REPORTS, NOTES = "reports", "notes"
"""Keys of a Tune result: reports as JSON lines, and what a person should be told."""
PAUSED = "paused"
"""Key of a Tune result: environment steps of a run that is computed as far as it is wanted."""
STOPPED = "stopped"
"""Key of a Tune result: True from a run that has kept its state, as it was asked to stop."""
CAUSE, TRACEBACK = "cause", "traceback"
"""Keys of a Tune result: why the run failed. Tune would start one that raises again."""
SECONDS = "seconds"
"""File in a checkpoint: training time so far."""
WAIT_SECONDS = 1.0
"""Between two looks at what somebody else is computing."""


class RunTrainable(Trainable):
    """Trains a node from its newest checkpoint, or from scratch, to its budget.

    A step is the time between two reports. After each evaluation there is a checkpoint, and where
    evaluations are rare after some minutes; at the end the handoff, the history and the settings
    are published and the checkpoints deleted. Whoever does this holds the node's lease.
    """

    @classmethod
    def default_resource_request(cls, config: dict[str, Any]) -> PlacementGroupFactory:
        """One bundle with what a run uses."""
        job = NodeJob.from_tune(config)
        bundle: dict[str, float] = {"CPU": job.cpus, "GPU": job.gpus, "memory": job.memory}
        return PlacementGroupFactory([{name: amount for name, amount in bundle.items() if amount}])

    def setup(self, config: dict[str, Any]) -> None:
        """Only what can't fail: errors in a step are reported with their cause."""
        self._job = NodeJob.from_tune(config)
        self._stop = StopWatch(self._job.stop_key)
        self._training: TrainingRun | None = None
        self._held: HeldLease | None = None
        self._watch: HangWatch | None = None
        self._history: list[Report] = []
        self._notes: list[str] = []
        self._stopped = self._waits = False
        self._seconds_before = self._began = self._saved = 0.0
        self._unsent = 0
        """Position in the history up to which the driver has been told."""

    def step(self) -> dict[str, Any]:
        """Go on to the next report."""
        try:
            return self._step_or_make_way(NodeStore(self._job.storage))
        except Exception as error:
            text = redact(traceback.format_exc())
            self._release()
            return self._result(done=True) | {CAUSE: redact(cause_of(error, text)), TRACEBACK: text}

    def _step_or_make_way(self, store: NodeStore) -> dict[str, Any]:
        try:
            return self._step(store)
        except (LeaseLostError, StorageError):
            # Its new owner may have deleted what this one was about to write into.
            if self._held is None or not self._held.is_lost():
                raise
            return self._make_way()

    def _make_way(self) -> dict[str, Any]:
        """Drop a run that another sweep took over; it is waited for, as one that is found held."""
        assert self._held is not None
        self._watch_no_more()
        self._held.end()
        if self._training is not None:
            self._training.close()
        self._held = self._training = None
        self._history, self._unsent, self._seconds_before = [], 0, 0.0
        self._waits = False
        self._notes.append("was taken over while this process was suspended, and writes no more")
        return self._result(done=False)

    def _step(self, store: NodeStore) -> dict[str, Any]:
        if self._stopped:
            time.sleep(WAIT_SECONDS)
            return self._result(done=False)
        if self._training is None:
            if store.is_finished(self._job.key):
                return self._finished_elsewhere(store)
            if self._stop.asked():
                self._stopped = True
                return self._result(done=False)
            if not self._hold(store):
                time.sleep(WAIT_SECONDS)
                return self._result(done=False)
            if store.is_finished(self._job.key):  # in the meantime
                return self._finished_elsewhere(store)
            self._training = self._begin(store)
            if self._history:
                return self._so_far()
        done = self._advance(self._training, store)
        return self._result(done=True) if done else self._so_far()

    def _so_far(self) -> dict[str, Any]:
        """A result of a run that isn't over, but may be as far as it is wanted for now."""
        until = self._job.until
        evaluated = any(
            names.EVAL_EPISODES in report.metrics
            for report in self._history
            if until is not None and report.env_steps >= until
        )
        if self._stopped or not evaluated:
            return self._result(done=False)
        self._release()
        return self._result(done=True) | {PAUSED: self._history[-1].env_steps}

    def _finished_elsewhere(self, store: NodeStore) -> dict[str, Any]:
        """Another sweep, or a worker that outlived its driver, was faster."""
        store.verify(self._job.key)
        self._history = store.history(self._job.key)
        if self._held is not None:
            self._clear(store)
        return self._result(done=True)

    def _work(self, store: NodeStore) -> WorkFolder:
        return store.work_folder(self._job.key, self._job.checkpoints.keep)

    def _hold(self, store: NodeStore) -> bool:
        """Acquire the node's lease; False while somebody else has it."""
        work = self._work(store)
        lease = Lease.of_this_process(f"sweep {self._job.sweep!r}" if self._job.sweep else "a run")
        holder = work.lease.acquire(lease)
        if holder is None:
            self._held = HeldLease(work.lease, lease)
            work.tidy()
            return True
        if not self._waits:
            self._waits = True
            self._notes.append(
                f"waits, as it is being computed by {holder}; goes on when that ends, or is "
                f"not heard of for {holder.seconds:.0f} s"
            )
        return False

    def _watch_no_more(self) -> None:
        if self._watch is not None:
            self._watch.end()
            self._watch = None

    def _release(self) -> None:
        self._watch_no_more()
        if self._held is not None:
            self._held.release()
            self._held = None
            self._work(NodeStore(self._job.storage)).remove_if_empty()

    def _begin(self, store: NodeStore) -> TrainingRun:
        from music_rllib.training.run import TrainingRun

        self._have_watched(store)
        training = TrainingRun(self._job.run, self._weights(store), self._job.gpus)
        with self._work(store).newest(self._notes.append) as saved:
            if saved is not None:
                training.restore(saved)
                self._take_over(saved, training)
        if saved is None:
            self._continue_shorter(training, store)
        self._began = self._saved = time.monotonic()
        return training

    def _take_over(self, saved: Saved, training: TrainingRun, of: str = "") -> None:
        self._history = from_json_lines((saved.folder / HISTORY).read_bytes())
        self._seconds_before = float((saved.folder / SECONDS).read_text())
        self._notes.append(f"continues {of}at {training.env_steps:,} env steps")

    def _continue_shorter(self, training: TrainingRun, store: NodeStore) -> None:
        """Go on from the end of a run with a smaller budget, where there is one."""
        if budget_settings(self._job.run):
            return
        kept = store.continuation(self._continuation)
        with kept.newest(self._notes.append, most=self._job.run.env_steps - 1) as saved:
            if saved is not None:
                training.restore_foreign(saved)
                self._take_over(saved, training, "a finished run with fewer env_steps, ")

    @property
    def _continuation(self) -> str:
        return continuation_key(self._job.run, self._job.source_key)

    def _keep_for_longer(self, training: TrainingRun, store: NodeStore) -> None:
        """Leave the run's end to one with a larger budget. Without it nothing is wrong."""
        if (
            not is_continuable(self._job.run)
            or training.replay_mb > self._job.checkpoints.finished_mb
            or not self._job.checkpoints.finished_mb
        ):
            return
        kept = store.continuation(self._continuation)
        if any(steps_of(name) >= training.env_steps for name in kept.names()):
            return
        try:
            with kept.new_checkpoint(training.env_steps) as draft:
                training.save_alone(draft)
                (draft.folder / SECONDS).write_text(repr(self._seconds))
                (draft.folder / HISTORY).write_bytes(to_json_lines(self._history))
        except StorageError as error:
            self._notes.append(f"keeps no checkpoint for longer training: {error}")

    def _have_watched(self, store: NodeStore) -> None:
        """Be ended where the environment hangs; and say so, if the worker before this one was.

        Raises:
            HangError: It was.
        """
        work, attempt = self._work(store), self._job.stop_key or "alone"
        record = work.read(RECORD)
        work.remove_file(RECORD)
        check_hung(record, attempt, self._job.run.task.env_id)
        if (minutes := self._job.hang_minutes) is None:
            return
        try:
            self._watch = HangWatch(60 * minutes, store.uri, self._job.key, attempt)
        except OSError as error:  # a full disk for temporary files, or no process to spare
            self._notes.append(f"is not watched for an environment that hangs: {error}")

    def _weights(self, store: NodeStore) -> Weights | None:
        job = self._job
        if job.source_key is None or job.source_task is None:
            return None
        with TemporaryDirectory() as folder:
            store.fetch(job.source_key, Path(folder))
            return read_handoff(Path(folder), handed_over(job.run), job.source_task)

    @property
    def _seconds(self) -> float:
        """Training time so far, over all attempts."""
        return self._seconds_before + time.monotonic() - self._began

    def _advance(self, training: TrainingRun, store: NodeStore) -> bool:
        """Train to the next report; whether the run is over."""
        from music_rllib.training.run import Paused

        held = self._held
        assert held is not None
        try:
            metrics = training.advance(pause=lambda: held.lost or self._stop.asked())
        except Paused:
            held.check()
            self._pause(training, store)
            return False
        self._history.append(
            Report(
                env_steps=training.env_steps,
                seconds=self._seconds,
                timestamp_ms=round(time.time() * 1000),
                metrics=metrics,
            )
        )
        if not training.env_steps and training.will_compile:
            self._notes.append("compiles its updates first, once on a machine: some 20 seconds")
        if training.finished:
            self._publish(training, store)
            self._keep_for_longer(training, store)
            self._clear(store)
        elif training.env_steps and (names.EVAL_EPISODES in metrics or self._is_late()):
            self._checkpoint(training, store)
        return training.finished

    def _is_late(self) -> bool:
        return time.monotonic() - self._saved >= 60.0 * self._job.checkpoints.minutes

    def _checkpoint(self, training: TrainingRun, store: NodeStore) -> None:
        assert self._held is not None
        self._held.check()
        with self._work(store).new_checkpoint(training.env_steps) as draft:
            training.save(draft)
            (draft.folder / SECONDS).write_text(repr(self._seconds))
            # What acts, for `load_policy`.
            modules = training.modules()
            acting: dict[str, Any] = {
                name: modules[name] for name in ("policy", "normaliser") if name in modules
            }
            with contextlib.suppress(ValueError):  # diverged: the end of the run will say so
                self._write_outcome(draft.folder, training, acting)
        self._saved = time.monotonic()

    def _pause(self, training: TrainingRun, store: NodeStore) -> None:
        """Keep what there is, where that can be, and let others have the node."""
        try:
            self._checkpoint(training, store)
        except StorageError as error:
            self._notes.append(f"could not be saved, it will go on from an older state: {error}")
        else:
            self._notes.append(f"saved at {training.env_steps:,} env steps")
        self._stopped = True
        self._release()

    def _publish(self, training: TrainingRun, store: NodeStore) -> None:
        assert self._held is not None
        self._held.check()
        last = self._history[-1]
        store.tidy(self._job.key)
        with TemporaryDirectory() as temporary:
            folder = Path(temporary)
            self._write_outcome(folder, training, training.modules())
            result = RunResult(
                label=self._job.label,
                env_steps=last.env_steps,
                seconds=last.seconds,
                metrics=last_values(self._history),
            )
            store.publish(self._job.key, folder, result)

    def _clear(self, store: NodeStore) -> None:
        """Delete checkpoints and lease of a run that is finished. Only for the lease's holder."""
        assert self._held is not None
        self._watch_no_more()
        self._held.end()  # a renewal would make the folder again
        self._held = None
        try:
            self._work(store).clear()
        except OSError as error:  # the result is there
            self._notes.append(f"its checkpoints could not be deleted: {error}")

    def _write_outcome(
        self, folder: Path, training: TrainingRun, modules: Mapping[str, Mapping[str, Any]]
    ) -> None:
        """What others may read: weights, history, settings. In nodes and in checkpoints.

        Raises:
            ValueError: The weights are not finite.
        """
        (folder / HISTORY).write_bytes(to_json_lines(self._history))
        (folder / "run.json").write_text(self._job.run.model_dump_json(indent=1))
        info = self._job.run.handoff_info(self._job.key, training.env_steps, training.spaces)
        write_handoff(folder / "handoff", modules, info)

    def _result(self, *, done: bool) -> dict[str, Any]:
        """What the driver hasn't been told yet.

        After a restart that is the checkpoint's whole history: the driver that was told of it may
        have died before it passed it on.
        """
        reports = to_json_lines(self._history[self._unsent :]).decode()
        self._unsent = len(self._history)
        notes, self._notes = self._notes, []
        return {REPORTS: reports, NOTES: notes, STOPPED: self._stopped, "done": done}

    def cleanup(self) -> None:
        """Release environments, networks and the node."""
        self._stop.end()
        with contextlib.suppress(StorageError):
            self._release()
        if self._training is not None:
            self._training.close()
