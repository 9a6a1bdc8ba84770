"""The Ray worker of one node: reuses a stored result, else trains, checkpoints and publishes."""

from __future__ import annotations

import contextlib
import gc
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from ray.tune import PlacementGroupFactory, Trainable

from music_rllib import names
from music_rllib.config.run_settings import handed_over
from music_rllib.experiment.continuation import budget_settings, continuation_key, is_continuable
from music_rllib.redaction import redact
from music_rllib.runtime.provenance import provenance_tags
from music_rllib.store.handoff import NetworkWeights, read_handoff, write_handoff
from music_rllib.store.history import (
    HISTORY,
    Report,
    RunResult,
    from_json_lines,
    last_values,
    to_json_lines,
)
from music_rllib.store.lease import HeldLease, Lease, LeaseLostError
from music_rllib.store.node_store import NodeStore
from music_rllib.store.storage import StorageError
from music_rllib.store.work_folder import NewCheckpoint, SavedCheckpoint, WorkFolder, steps_of
from music_rllib.training.divergence import divergence
from music_rllib.training.environment import RunEnvironment
from music_rllib.training.failure_reason import cause_of, trace_of
from music_rllib.training.hang_watch import RECORD, HangWatch, check_hung
from music_rllib.training.job import NodeJob
from music_rllib.training.stop import StopWatch

if TYPE_CHECKING:
    from music_rllib.training.run import TrainingRun

REPORTS, NOTES = "reports", "notes"
"""Keys of a Tune result: new reports as JSON lines, and messages for the user."""
PAUSED = "paused"
"""Key of a Tune result: environment steps of a run that has reached its job's `until`."""
STOPPED = "stopped"
"""Key of a Tune result: True from a run that has saved its state, as it was asked to stop."""
CAUSE, TRACEBACK = "cause", "traceback"
"""Keys of a Tune result: why the run failed. It does not raise, as Tune would start it again."""
SECONDS = "seconds"
"""File in a checkpoint: training time so far."""
WAIT_SECONDS = 1.0
"""Pause between two looks at a run that another process computes."""


class RunTrainable(Trainable):
    """Trains a node from its newest checkpoint, or from scratch, to its budget.

    A step is the time between two reports. There is a checkpoint after each evaluation, and where
    evaluations are rare after some minutes; at the end the handoff, the history and the settings
    are published and the checkpoints deleted. The worker holds the node's lease all the while.
    """

    @classmethod
    def default_resource_request(cls, config: dict[str, Any]) -> PlacementGroupFactory:
        """One bundle with what a run uses."""
        job = NodeJob.from_tune(config)
        bundle: dict[str, float] = {"CPU": job.cpus, "GPU": job.gpus, "memory": job.memory}
        return PlacementGroupFactory([{name: amount for name, amount in bundle.items() if amount}])

    def setup(self, config: dict[str, Any]) -> None:
        """Prepare only what can't fail: `step` reports errors with their cause."""
        self._job = NodeJob.from_tune(config)
        self._stop = StopWatch(self._job.stop_key)
        self._training: TrainingRun | None = None
        self._held: HeldLease | None = None
        self._watch: HangWatch | None = None
        self._history: list[Report] = []
        self._notes: list[str] = []
        self._environment = RunEnvironment(self._job)
        self._stopped = self._waits = False
        self._seconds_before = self._began = self._saved_at = 0.0
        self._unsent = 0
        """Position in the history of the first report that the driver does not have."""

    def reset_config(self, new_config: dict[str, Any]) -> bool:
        """Take on another run, which starts as it would in a new process."""
        self.cleanup()
        self.__dict__.pop("_store", None)
        self.__dict__.pop("_work", None)
        self.setup(new_config)
        gc.collect()  # networks, replay and environments refer to each other in circles
        return True

    @cached_property
    def _store(self) -> NodeStore:
        return NodeStore(self._job.storage)

    @cached_property
    def _work(self) -> WorkFolder:
        # Kept, as its lease file remembers since when somebody else's lease is there.
        return self._store.work_folder(self._job.key, self._job.checkpoints.keep)

    @property
    def _continuation(self) -> WorkFolder:
        """Where runs that differ from this one in their budget alone leave their end."""
        return self._store.continuation(continuation_key(self._job.run, self._job.source_key))

    @property
    def _lease(self) -> HeldLease:
        """The lease, without which nothing may be written."""
        assert self._held is not None
        return self._held

    @property
    def _seconds(self) -> float:
        """Training time so far, over all attempts."""
        return self._seconds_before + time.monotonic() - self._began

    def step(self) -> dict[str, Any]:
        """Go on to the next report."""
        try:
            return self._step_or_make_way()
        except BaseException as error:  # an environment's SystemExit would end the worker
            text = redact(trace_of(error))
            self._release()
            return self._result(done=True) | {CAUSE: redact(cause_of(error, text)), TRACEBACK: text}

    def _step_or_make_way(self) -> dict[str, Any]:
        try:
            return self._step()
        except (LeaseLostError, StorageError):
            # Its new owner may have deleted what this one was about to write into.
            if self._held is None or not self._held.is_lost():
                raise
            return self._make_way()

    def _step(self) -> dict[str, Any]:
        if self._stopped:
            time.sleep(WAIT_SECONDS)
            return self._result(done=False)
        if self._training is None:
            if self._store.is_finished(self._job.key):
                return self._finished_elsewhere()
            if self._stop.asked():
                self._stopped = True
                return self._result(done=False)
            if not self._acquire_lease():
                time.sleep(WAIT_SECONDS)
                return self._result(done=False)
            if self._store.is_finished(self._job.key):  # in the meantime
                return self._finished_elsewhere()
            self._training = self._begin()
            if self._history:
                return self._progress()
        finished = self._advance(self._training)
        return self._result(done=True) if finished else self._progress()

    def _progress(self) -> dict[str, Any]:
        """The result of an unfinished run, which is done for now once it has reached `until`."""
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

    def _finished_elsewhere(self) -> dict[str, Any]:
        """The result of a run that another sweep, or a worker without a driver, has finished."""
        self._store.verify(self._job.key)
        self._environment.check("result", self._store.environment(self._job.key))
        self._history = self._store.history(self._job.key)
        if self._held is not None:
            self._clear()
        return self._result(done=True)

    def _result(self, *, done: bool) -> dict[str, Any]:
        """A Tune result with all reports and notes that the driver does not have.

        After a restart these are the checkpoint's whole history: the driver that had its reports
        may have died before it passed them on.
        """
        reports = to_json_lines(self._history[self._unsent :]).decode()
        self._unsent = len(self._history)
        notes, self._notes = self._notes, []
        return {REPORTS: reports, NOTES: notes, STOPPED: self._stopped, "done": done}

    # -- the lease ---------------------------------------------------------------------------

    def _acquire_lease(self) -> bool:
        """Acquire the node's lease; False while somebody else has it."""
        lease = Lease.of_this_process(f"sweep {self._job.sweep!r}" if self._job.sweep else "a run")
        holder = self._work.lease.acquire(lease)
        if holder is None:
            self._held = HeldLease(self._work.lease, lease)
            self._work.tidy()
            return True
        if not self._waits:
            self._waits = True
            self._notes.append(
                f"waits, as it is being computed by {holder}; goes on when that ends, or is "
                f"not heard of for {holder.seconds:.0f} s"
            )
        return False

    def _make_way(self) -> dict[str, Any]:
        """Drop a run that another sweep has taken over, and wait for that one to finish it."""
        self._end_watch()
        self._lease.end()
        if self._training is not None:
            self._training.close()
        self._held = self._training = None
        self._history, self._unsent, self._seconds_before = [], 0, 0.0
        self._waits = False
        self._notes.append("was taken over while this process was suspended, and writes no more")
        return self._result(done=False)

    def _release(self) -> None:
        """Let others compute the node."""
        self._end_watch()
        if self._held is not None:
            self._held.release()
            self._held = None
            self._work.remove_if_empty()

    def _clear(self) -> None:
        """Delete the checkpoints and the lease of a finished run."""
        self._end_watch()
        self._lease.end()  # a renewal would make the folder again
        self._held = None
        try:
            self._work.clear()
        except OSError as error:  # the result is there
            self._notes.append(f"its checkpoints could not be deleted: {error}")

    def _begin(self) -> TrainingRun:
        """The run from its newest checkpoint, or else from a shorter run's end, or from scratch."""
        from music_rllib.training.run import TrainingRun

        job = self._job
        self._start_watch()
        self._environment.look()
        training = TrainingRun(job.run, self._source_weights(), job.gpus)
        newest = self._work.newest(self._notes.append)
        if not self._restore(training, newest) and not budget_settings(job.run):
            newest = self._continuation.newest(self._notes.append, most=job.run.env_steps - 1)
            self._restore(training, newest, "a finished run with fewer env_steps, ")
        self._began = self._saved_at = time.monotonic()
        return training

    def _restore(
        self,
        training: TrainingRun,
        newest: AbstractContextManager[SavedCheckpoint | None],
        other_run: str = "",
    ) -> bool:
        """Continue from a checkpoint of this or of another run; False where there is none."""
        with newest as saved:
            if saved is None:
                return False
            if other_run and (problem := self._environment.problem(saved.environment)):
                self._notes.append(f"does not continue {other_run}which used another {problem}")
                return False
            self._environment.check("checkpoint", saved.environment)
            training.restore(saved, foreign=bool(other_run))
            self._history = from_json_lines((saved.folder / HISTORY).read_bytes())
            self._seconds_before = float((saved.folder / SECONDS).read_text())
        self._notes.append(f"continues {other_run}at {training.env_steps:,} env steps")
        return True

    def _source_weights(self) -> NetworkWeights | None:
        job = self._job
        if job.source_key is None or job.source_task is None:
            return None
        with self._store.files(job.source_key) as folder:
            return read_handoff(folder, handed_over(job.run), job.source_task)

    def _start_watch(self) -> None:
        """Have this process ended if the environment hangs.

        Raises:
            HangError: The worker before this one was ended for that.
        """
        attempt = self._job.stop_key or "alone"
        record = self._work.folder.read_text(RECORD)
        self._work.folder.remove(RECORD)
        check_hung(record, attempt, self._job.run.task.env_id)
        if (minutes := self._job.hang_minutes) is None:
            return
        try:
            self._watch = HangWatch(60 * minutes, self._store.uri, self._job.key, attempt)
        except OSError as error:  # a full disk for temporary files, or no process to spare
            self._notes.append(f"is not watched for an environment that hangs: {error}")

    def _end_watch(self) -> None:
        if self._watch is not None:
            self._watch.end()
            self._watch = None

    # -- training and saving -----------------------------------------------------------------

    def _advance(self, training: TrainingRun) -> bool:
        """Train to the next report; whether the run is finished."""
        from music_rllib.training.run import Paused

        lease = self._lease
        try:
            metrics = training.advance(pause=lambda: lease.lost or self._stop.asked())
        except Paused:
            lease.check()
            self._pause(training)
            return False
        now = round(time.time() * 1000)
        report = Report(
            env_steps=training.env_steps, seconds=self._seconds, timestamp_ms=now, metrics=metrics
        )
        self._history.append(report)
        self._notes += divergence(self._job.run, self._history)
        if not training.env_steps and training.will_compile:
            self._notes.append("compiles its updates first, once on a machine: some 20 seconds")
        late = time.monotonic() - self._saved_at >= 60.0 * self._job.checkpoints.minutes
        if training.finished:
            self._publish(training)
            self._keep_for_longer(training)
            self._clear()
        elif training.env_steps and (names.EVAL_EPISODES in metrics or late):
            self._checkpoint(training)
        return training.finished

    def _checkpoint(self, training: TrainingRun) -> None:
        self._lease.check()
        with self._work.new_checkpoint(training.env_steps, self._environment.here) as draft:
            training.save(draft)
            self._write_history(draft)
            # The networks that act, for `load_policy`.
            acting = {
                k: v for k, v in training.network_weights().items() if k in {"policy", "normaliser"}
            }
            with contextlib.suppress(ValueError):  # diverged: the end of the run will say so
                self._write_outcome(draft.folder, training, acting)
        self._saved_at = time.monotonic()

    def _write_history(self, draft: NewCheckpoint) -> None:
        (draft.folder / SECONDS).write_text(repr(self._seconds))
        (draft.folder / HISTORY).write_bytes(to_json_lines(self._history))

    def _pause(self, training: TrainingRun) -> None:
        """Save the run if the storage allows it, and let others compute the node."""
        try:
            self._checkpoint(training)
        except StorageError as error:
            self._notes.append(f"could not be saved, it will go on from an older state: {error}")
        else:
            self._notes.append(f"saved at {training.env_steps:,} env steps")
        self._stopped = True
        self._release()

    def _publish(self, training: TrainingRun) -> None:
        self._lease.check()
        last, metrics = self._history[-1], last_values(self._history)
        result = RunResult(
            label=self._job.label, env_steps=last.env_steps, seconds=last.seconds, metrics=metrics
        )
        self._store.tidy(self._job.key)
        with TemporaryDirectory() as temporary:
            folder = Path(temporary)
            (folder / HISTORY).write_bytes(to_json_lines(self._history))
            self._write_outcome(folder, training, training.network_weights())
            environment = self._environment.here
            self._store.publish(self._job.key, folder, result, environment, provenance_tags())

    def _write_outcome(
        self, folder: Path, training: TrainingRun, modules: Mapping[str, Mapping[str, Any]]
    ) -> None:
        """Write a node's or a checkpoint's settings, and its networks as a handoff.

        Raises:
            ValueError: The weights are not finite.
        """
        (folder / "run.json").write_text(self._job.run.model_dump_json(indent=1))
        info = self._job.run.handoff_info(self._job.key, training.env_steps, training.spaces)
        write_handoff(folder / "handoff", modules, info)

    def _keep_for_longer(self, training: TrainingRun) -> None:
        """Leave the run's end to one with a larger budget; a failure is only noted."""
        most = self._job.checkpoints.finished_mb
        if not is_continuable(self._job.run) or not most or training.replay_mb > most:
            return
        kept = self._continuation
        try:
            if any(steps_of(name) >= training.env_steps for name in kept.names()):
                return
            with kept.new_checkpoint(training.env_steps, self._environment.here) as draft:
                training.save(draft, alone=True)
                self._write_history(draft)
        except (StorageError, OSError) as error:
            self._notes.append(f"keeps no checkpoint for longer training: {error}")

    def cleanup(self) -> None:
        """Release environments, networks and the node."""
        self._stop.end()
        with contextlib.suppress(StorageError):
            self._release()
        if self._training is not None:
            self._training.close()
