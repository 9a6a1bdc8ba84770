"""The storage of one run: its lease, its environment's fingerprint, checkpoints and result."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from music_rllib import names
from music_rllib.config.run_settings import handed_over
from music_rllib.envs.fingerprint import (
    Fingerprint,
    differences,
    digest_of,
    fingerprint_of,
    on_another_machine,
)
from music_rllib.experiment.open_sweep import ADVICE, EnvironmentChangedError
from music_rllib.experiment.plan import budget_settings, continuation_key, is_continuable
from music_rllib.runtime.machine import provenance_tags
from music_rllib.store.handoff import NetworkWeights, read_handoff, write_handoff
from music_rllib.store.history import (
    HISTORY,
    Report,
    RunResult,
    from_json_lines,
    last_values,
    to_json_lines,
)
from music_rllib.store.lease import HeldLease, Lease
from music_rllib.store.node_store import NodeStore
from music_rllib.store.storage import StorageError
from music_rllib.store.work_folder import NewCheckpoint, SavedCheckpoint, WorkFolder, steps_of
from music_rllib.training.job import NodeJob

if TYPE_CHECKING:
    from music_rllib.training.run import TrainingRun

SECONDS = "seconds"
"""File in a checkpoint: training time so far."""
VERSIONS = "versions.json"
"""File in a checkpoint: the versions of the program that trained it, and changes of them."""


class RunStorage:
    """Reads and writes the storage of one run; `note` receives messages for the user."""

    def __init__(self, job: NodeJob, note: Callable[[str], None]) -> None:
        self._job, self._note = job, note
        self.lease: HeldLease | None = None
        """The run's lease, without which nothing may be written."""
        self._environment: Fingerprint | None = None
        """Fingerprint on this machine, stored with all results; None before the check."""
        self._changes: list[str] = []
        """Changes of versions during the run."""

    @cached_property
    def store(self) -> NodeStore:
        """The storage; opened at the first use, which may fail."""
        return NodeStore(self._job.storage)

    @cached_property
    def work(self) -> WorkFolder:
        return self.store.work_folder(self._job.key, self._job.checkpoints.keep)

    @property
    def _continuation(self) -> WorkFolder:
        """Final checkpoints of runs that differ from this one only in their budget."""
        return self.store.continuation(continuation_key(self._job.run, self._job.source_key))

    # -- the lease ---------------------------------------------------------------------------

    def acquire(self) -> Lease | None:
        """Acquire the lease and return None, or return the lease of another process."""
        job = self._job
        lease = Lease.of_this_process(f"sweep {job.sweep!r}" if job.sweep else "a run")
        holder = self.work.lease.acquire(lease)
        if holder is None:
            self.lease = HeldLease(self.work.lease, lease)
            self.work.tidy()
        return holder

    def release(self) -> None:
        """Let other processes compute the run."""
        if self.lease is not None:
            self.lease.release()
            self.lease = None
            self.work.remove_if_empty()

    def leave_to_others(self) -> str:
        """Stop using a lease that another process has taken over; that process, in words."""
        assert self.lease is not None
        self.lease.end()
        self.lease = None
        holder = self.work.lease.read()
        deleted = ", or its folder in the storage was deleted" if holder is None else ""
        self._note(
            f"another process took over while this one was suspended{deleted}; writing nothing more"
        )
        return str(holder or "another process")

    def clear(self) -> None:
        """Delete the checkpoints and the lease of a finished run, if this process holds it."""
        if self.lease is None:
            return
        self.lease.end()  # a renewal would create the folder again
        self.lease = None
        try:
            self.work.clear()
        except OSError as error:  # the result is published
            self._note(f"its checkpoints could not be deleted: {error}")

    # -- the environment ---------------------------------------------------------------------

    def check_environment(self) -> None:
        """Compute the environment's fingerprint, and compare it with the driver's.

        Raises:
            EnvironmentChangedError: They differ.
            ImportError: The environment is not installed here.
        """
        run, driver = self._job.run, self._job.environment
        task = run.task
        self._environment = fingerprint_of(task.env_id, task.env_kwargs, run.own_modules)
        if driver is not None and (other := on_another_machine(driver, self._environment)):
            raise EnvironmentChangedError(
                f"the environment of {task.name} must be the same on every machine, on "
                f"{socket.gethostname()} it differs from the driver's: {', '.join(other)}"
            )

    def _changed_environment(self, found: Fingerprint | None) -> str | None:
        """How another environment computed something in the storage; None if it is the same."""
        driver = self._job.environment
        if driver is None or found is None or digest_of(found) in self._job.same_environments:
            return None
        return f"environment ({', '.join(differences(found, driver))}): {ADVICE}"

    def _refuse_other_environment(self, what: str, found: Fingerprint | None) -> None:
        if (problem := self._changed_environment(found)) is not None:
            raise EnvironmentChangedError(f"its {what} is of another {problem}")

    # -- reading -----------------------------------------------------------------------------

    def check_finished(self) -> None:
        """Check a finished run.

        Raises:
            DamagedError: The result is damaged.
            EnvironmentChangedError: The result is of another environment.
        """
        self.store.verify(self._job.key)
        self._refuse_other_environment("result", self.store.environment(self._job.key))

    def source_weights(self) -> NetworkWeights | None:
        """The network weights that the run starts from; None from scratch."""
        job = self._job
        if job.source_key is None or job.source_task is None:
            return None
        with self.store.files(job.source_key) as folder:
            return read_handoff(folder, handed_over(job.run), job.source_task)

    def restore(self, training: TrainingRun) -> tuple[list[Report], float]:
        """Restore the newest checkpoint of the run, or else the end of a shorter run.

        Returns:
            The reports and the training time in seconds up to the checkpoint; none without one.

        Raises:
            EnvironmentChangedError: The run's checkpoint is of another environment.
        """
        found = self._restore(training, self.work.newest(self._note))
        if found is None and not budget_settings(self._job.run):
            newest = self._continuation.newest(self._note, most=self._job.run.env_steps - 1)
            found = self._restore(training, newest, "a finished run with fewer env_steps, ")
        return found or ([], 0.0)

    def _restore(
        self,
        training: TrainingRun,
        newest: AbstractContextManager[SavedCheckpoint | None],
        other_run: str = "",
    ) -> tuple[list[Report], float] | None:
        with newest as saved:
            if saved is None:
                return None
            if other_run and (problem := self._changed_environment(saved.environment)):
                self._note(f"does not continue {other_run}which used another {problem}")
                return None
            self._refuse_other_environment("checkpoint", saved.environment)
            training.restore(saved, other_run=bool(other_run))
            history = from_json_lines((saved.folder / HISTORY).read_bytes())
            seconds = float((saved.folder / SECONDS).read_text())
            text = f"continues {other_run}at {training.env_steps:,} env steps"
            if change := self._version_change(saved.folder / VERSIONS):
                self._changes.append(f"at {training.env_steps:,} env steps: {change}")
                text += f", under other versions than before: {change}"
        self._note(text)
        return history, seconds

    def _version_change(self, file: Path) -> str | None:
        """The versions that changed since a checkpoint with this file; None if none did."""
        if not file.exists():  # of an earlier version of the package
            return None
        known = json.loads(file.read_bytes())
        before, now = known["versions"], provenance_tags()
        self._changes = known["changes"]
        changed = [name for name in sorted(before | now) if before.get(name) != now.get(name)]
        return ", ".join(
            f"{name.removeprefix(names.TAG_VERSION_PREFIX)} {before.get(name)} -> {now.get(name)}"
            for name in changed
        )

    # -- writing -----------------------------------------------------------------------------

    def save_checkpoint(
        self, training: TrainingRun, history: Sequence[Report], seconds: float
    ) -> None:
        """Write a checkpoint, with the networks that act for `load_policy`.

        Raises:
            LeaseLostError: Another process has taken the lease over.
            StorageError: The storage cannot be written.
        """
        assert self.lease is not None
        self.lease.check()
        with self.work.new_checkpoint(training.env_steps, self._environment) as new:
            training.save(new)
            self._write_progress(new, history, seconds)
            weights = training.network_weights()
            acting = {name: weights[name] for name in weights if name in {"policy", "normaliser"}}
            with contextlib.suppress(ValueError):  # not finite: the end of the run fails
                self._write_handoff(new.folder, training, acting)

    def publish(self, training: TrainingRun, history: Sequence[Report]) -> None:
        """Publish the result of a finished run.

        Raises:
            LeaseLostError: Another process has taken the lease over.
            ValueError: The weights are not finite.
        """
        assert self.lease is not None
        self.lease.check()
        last, metrics = history[-1], last_values(history)
        result = RunResult(
            label=self._job.label, env_steps=last.env_steps, seconds=last.seconds, metrics=metrics
        )
        self.store.tidy(self._job.key)
        with TemporaryDirectory() as temporary:
            folder = Path(temporary)
            (folder / HISTORY).write_bytes(to_json_lines(history))
            self._write_handoff(folder, training, training.network_weights())
            tags = provenance_tags()
            if self._changes:
                tags = {**tags, names.TAG_VERSIONS_CHANGED: "; ".join(self._changes)}
            self.store.publish(self._job.key, folder, result, self._environment, tags)

    def _write_handoff(
        self, folder: Path, training: TrainingRun, weights: Mapping[str, Mapping[str, Any]]
    ) -> None:
        """Write the run's settings and network weights."""
        (folder / "run.json").write_text(self._job.run.model_dump_json(indent=1))
        info = self._job.run.handoff_info(self._job.key, training.env_steps, training.spaces)
        write_handoff(folder / "handoff", weights, info)

    def keep_for_longer(
        self, training: TrainingRun, history: Sequence[Report], seconds: float
    ) -> None:
        """Keep the final checkpoint for a run with a larger budget; a failure is only noted."""
        most = self._job.checkpoints.finished_mb
        if not is_continuable(self._job.run) or not most or training.replay_mb > most:
            return
        kept = self._continuation
        try:
            usable = self._changed_environment(kept.environment()) is None
            if usable and any(steps_of(name) >= training.env_steps for name in kept.names()):
                return
            with kept.new_checkpoint(training.env_steps, self._environment) as new:
                training.save(new, alone=True)
                self._write_progress(new, history, seconds)
        except (StorageError, OSError) as error:
            self._note(f"keeps no checkpoint for longer training: {error}")

    def _write_progress(
        self, new: NewCheckpoint, history: Sequence[Report], seconds: float
    ) -> None:
        versions = {"versions": provenance_tags(), "changes": self._changes}
        (new.folder / VERSIONS).write_text(json.dumps(versions))
        (new.folder / SECONDS).write_text(repr(seconds))
        (new.folder / HISTORY).write_bytes(to_json_lines(history))
