"""The environment of a run on a worker's machine."""

from __future__ import annotations

import socket

from music_rllib.envs.fingerprint import (
    Fingerprint,
    differences,
    digest_of,
    fingerprint_of,
    on_another_machine,
)
from music_rllib.experiment.environments import ADVICE, EnvironmentChangedError
from music_rllib.training.job import NodeJob


class RunEnvironment:
    """Holds the environment against the driver's, and against what the storage has of the run."""

    def __init__(self, job: NodeJob) -> None:
        self._job = job
        self.here: Fingerprint | None = None
        """Fingerprint on this machine, which is kept with all that is saved; None before `look`."""

    def look(self) -> None:
        """Compute the fingerprint.

        Raises:
            EnvironmentChangedError: It is not the driver's.
            ImportError: There is no such environment here.
        """
        task, driver = self._job.run.task, self._job.environment
        self.here = fingerprint_of(task.env_id, task.env_kwargs)
        if driver is not None and (other := on_another_machine(driver, self.here)):
            raise EnvironmentChangedError(
                f"the environment of {task.name} must be the same on every machine, on "
                f"{socket.gethostname()} it is not the driver's: {', '.join(other)}"
            )

    def problem(self, found: Fingerprint | None) -> str | None:
        """How something in the storage used another environment, and what to do; None: the same."""
        driver = self._job.environment
        if driver is None or found is None or digest_of(found) in self._job.same_environments:
            return None
        return f"environment ({', '.join(differences(found, driver))}): {ADVICE}"

    def check(self, what: str, found: Fingerprint | None) -> None:
        """Refuse a result or a checkpoint of another environment.

        Raises:
            EnvironmentChangedError: It is of another one.
        """
        if (problem := self.problem(found)) is not None:
            raise EnvironmentChangedError(f"its {what} is of another {problem}")
