"""The Ray worker of one run: reuse a stored result, or train, save checkpoints and publish."""

from __future__ import annotations

import contextlib
import gc
import time
from functools import cache
from typing import TYPE_CHECKING, Any

from ray.tune import PlacementGroupFactory, Trainable

from music_rllib import names
from music_rllib.redaction import redact
from music_rllib.runtime.process import without_collections
from music_rllib.store.history import Report, to_json_lines
from music_rllib.store.lease import LeaseLostError
from music_rllib.store.patience import be_patient
from music_rllib.store.storage import StorageError
from music_rllib.training.failure_reason import cause_of, trace_of
from music_rllib.training.hang_watch import RECORD, HangWatch, check_hung
from music_rllib.training.job import NodeJob, StopWatch
from music_rllib.training.run_storage import RunStorage

if TYPE_CHECKING:
    from music_rllib.training.run import TrainingRun

REPORTS, NOTES = "reports", "notes"
"""Keys of a Tune result: new reports as JSON lines, and messages for the user."""
PAUSED = "paused"
"""Key of a Tune result: environment steps of a run that has reached its job's `until`."""
LEFT = "left"
"""Key of a Tune result: the process, in words, that computes the run in place of this one."""
STOPPED = "stopped"
"""Key of a Tune result: True from a run that was asked to stop and has saved its state."""
CAUSE, TRACEBACK = "cause", "traceback"
"""Keys of a Tune result: why the run failed. Tune would start a run that raises again."""
WAIT_SECONDS = 1.0
"""Time between two results of a stopped run."""


@cache
def _request(**bundle: float) -> PlacementGroupFactory:
    """One object for all runs, because Tune keeps it, and it has some kilobytes."""
    return PlacementGroupFactory([bundle])


class RunTrainable(Trainable):
    """Train a run from its newest checkpoint, or from scratch, to its budget.

    A step of the trainable lasts until the next report. The run is saved after each evaluation, and
    every few minutes if evaluations are rare. At the end, its network weights, history and settings
    are published and the checkpoints deleted. The worker holds the run's lease all this time.
    """

    @classmethod
    def default_resource_request(cls, config: dict[str, Any]) -> PlacementGroupFactory:
        return _request(**NodeJob.from_tune(config).resources.bundle)

    def setup(self, config: dict[str, Any]) -> None:
        """Prepare only what can't fail; `step` reports errors with their cause."""
        self._job = NodeJob.from_tune(config)
        self._notes: list[str] = []
        be_patient(self._job.resources.storage_minutes)
        self._run_storage = RunStorage(self._job, self._notes.append)
        self._stop = StopWatch(self._job.stop_key)
        self._training: TrainingRun | None = None
        self._watch: HangWatch | None = None
        self._history: list[Report] = []
        self._stopped = False
        self._seconds_before = self._began = self._saved_at = 0.0
        self._unsent = 0
        """Index in the history of the first report that the driver does not have."""

    def reset_config(self, new_config: dict[str, Any]) -> bool:
        """Start another run as in a new process."""
        self.cleanup()
        self.setup(new_config)
        gc.collect()  # networks, replay and environments refer to each other in circles
        return True

    @property
    def _seconds(self) -> float:
        """Training time so far, over all attempts."""
        return self._seconds_before + time.monotonic() - self._began

    def step(self) -> dict[str, Any]:
        """Train to the next report."""
        try:
            return self._step_or_leave()
        except BaseException as error:  # an environment's SystemExit would end the worker
            text = redact(trace_of(error))
            self._release()
            return self._result(done=True) | {CAUSE: redact(cause_of(error, text)), TRACEBACK: text}

    def _step_or_leave(self) -> dict[str, Any]:
        try:
            return self._step()
        except (LeaseLostError, StorageError, OSError):
            # The new owner may have deleted the folder into which this process was writing.
            if self._run_storage.lease is None or not self._run_storage.lease.is_lost():
                raise
        self._end_watch()
        return self._left(self._run_storage.leave_to_others())

    def _left(self, holder: str) -> dict[str, Any]:
        """The result of a run that another process computes; its CPUs are free for another one."""
        self._unsent = len(self._history)
        return self._result(done=True) | {LEFT: holder}

    def _step(self) -> dict[str, Any]:
        if self._stopped:
            time.sleep(WAIT_SECONDS)
            return self._result(done=False)
        if self._training is None:
            if self._run_storage.store.is_finished(self._job.key):
                return self._finished_elsewhere()
            if self._stop.asked():
                self._stopped = True
                return self._result(done=False)
            if (holder := self._run_storage.acquire()) is not None:
                return self._left(str(holder))
            if self._run_storage.store.is_finished(self._job.key):  # meanwhile
                return self._finished_elsewhere()
            self._training = self._begin()
            if self._history:
                return self._progress()
        finished = self._advance(self._training)
        return self._result(done=True) if finished else self._progress()

    def _progress(self) -> dict[str, Any]:
        """The result of an unfinished run; it pauses after the evaluation at the job's `until`."""
        until = self._job.until
        evaluated = any(
            names.EVAL_EPISODES in report.metrics
            for report in self._history
            if until is not None and report.env_steps >= until
        )
        if self._stopped or not evaluated:
            return self._result(done=False)
        if not self._run_storage.work.names():  # a finished shorter run has reached `until`
            assert self._training is not None
            self._save(self._training)
        self._release()
        return self._result(done=True) | {PAUSED: self._history[-1].env_steps}

    def _finished_elsewhere(self) -> dict[str, Any]:
        """The result of a run that another process has finished."""
        self._run_storage.check_finished()
        self._run_storage.clear()
        return self._left("another process, which has finished it")

    def _result(self, *, done: bool) -> dict[str, Any]:
        """A Tune result with all reports and notes that the driver does not have.

        After a restart it has the checkpoint's whole history, because the earlier driver may have
        ended before it passed on its reports.
        """
        reports = to_json_lines(self._history[self._unsent :]).decode()
        self._unsent = len(self._history)
        notes = self._notes.copy()
        self._notes.clear()
        return {REPORTS: reports, NOTES: notes, STOPPED: self._stopped, "done": done}

    def _begin(self) -> TrainingRun:
        """Build the run and restore its checkpoint, if it has one."""
        self._start_watch()
        self._run_storage.check_environment()
        weights = self._run_storage.source_weights()
        training = _training_run()(self._job.run, weights, self._job.resources.gpus_per_run)
        self._history, self._seconds_before = self._run_storage.restore(training)
        self._began = self._saved_at = time.monotonic()
        return training

    def _start_watch(self) -> None:
        """End this process if the environment hangs.

        Raises:
            HangError: The worker before this one was ended because its environment hung.
        """
        attempt = self._job.stop_key or "alone"
        record = self._run_storage.work.folder.read_text(RECORD)
        self._run_storage.work.folder.remove(RECORD)
        check_hung(record, attempt, self._job.run.task.env_id)
        if (minutes := self._job.resources.hang_minutes) is None:
            return
        try:
            uri = self._run_storage.store.uri
            self._watch = HangWatch(60 * minutes, uri, self._job.key, attempt)
        except OSError as error:  # no space for temporary files, or too many processes
            self._notes.append(f"is not watched for an environment that hangs: {error}")

    def _end_watch(self) -> None:
        if self._watch is not None:
            self._watch.end()
            self._watch = None

    def _release(self) -> None:
        self._end_watch()
        self._run_storage.release()

    def _advance(self, training: TrainingRun) -> bool:
        """Train to the next report; whether the run is finished."""
        from music_rllib.training.run import Paused

        lease = self._run_storage.lease
        assert lease is not None
        try:
            metrics = training.advance(pause=lambda: lease.lost or self._stop.asked())
        except Paused:
            lease.check()
            self._save_and_stop(training)
            return False
        now = round(time.time() * 1000)
        report = Report(
            env_steps=training.env_steps, seconds=self._seconds, timestamp_ms=now, metrics=metrics
        )
        self._history.append(report)
        if (divergence := training.divergence(self._history)) is not None:
            self._notes.append(divergence)
        if not training.env_steps and training.will_compile:
            self._notes.append("compiles its updates first, once per machine (about 20 s)")
        late = time.monotonic() - self._saved_at >= 60.0 * self._job.checkpoints.minutes
        if training.finished:
            self._run_storage.publish(training, self._history)
            self._run_storage.keep_for_longer(training, self._history, self._seconds)
            self._end_watch()
            self._run_storage.clear()
        elif training.env_steps and (names.EVAL_EPISODES in metrics or late):
            self._save(training)
        return training.finished

    def _save(self, training: TrainingRun) -> None:
        self._run_storage.save_checkpoint(training, self._history, self._seconds)
        self._saved_at = time.monotonic()

    def _save_and_stop(self, training: TrainingRun) -> None:
        """Save the run if the storage allows it, and let other processes compute it."""
        try:
            self._save(training)
        except StorageError as error:
            self._notes.append(f"could not be saved, it resumes from an older checkpoint: {error}")
        else:
            self._notes.append(f"saved at {training.env_steps:,} env steps")
        self._stopped = True
        self._release()

    def cleanup(self) -> None:
        """Release environments, networks and the lease."""
        self._stop.end()
        with contextlib.suppress(StorageError):
            self._release()
        if self._training is not None:
            self._training.close()


@cache
def _training_run() -> type[TrainingRun]:
    """The class; importing its libraries takes seconds."""
    with without_collections():
        from music_rllib.training.run import TrainingRun
    gc.freeze()  # 0.2 s less for the collection after each run
    return TrainingRun
