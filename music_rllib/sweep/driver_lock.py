"""The drivers of a sweep: any number computes its runs, one at a time prepares or deletes files.

Each driver holds a lease of its own in `<storage>/<sweep>/drivers`, by which others know that it is
running. The runs have leases too, so drivers never compute the same run. The lease `driver.json`
lets one process at a time change what all of them use: the sweep's records, its parent run in
MLflow, its report, and results that are deleted.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from music_rllib.errors import BadInputError
from music_rllib.experiment.sweep_files import STOP, SweepLocation
from music_rllib.store.lease import HeldLease, Lease, LeaseFile

FILE, DRIVERS = "driver.json", "drivers"
WAIT_SECONDS = 1.0
"""Time between two attempts to get `driver.json`."""


def drivers_of(location: SweepLocation, *, watch: bool = False) -> list[Lease]:
    """The leases of the processes that drive a sweep.

    `watch` looks for up to a minute at leases that a fast clock has dated ahead.
    """
    folder = location.files / DRIVERS
    files = [LeaseFile(folder, file) for file in folder.files() if not file.startswith(".")]
    return [lease for file in files if (lease := file.holder(watch=watch)) is not None]


def others_drive(location: SweepLocation, state: Mapping[str, Any] | None) -> bool:
    """Whether a process drives a sweep, other than the one that has written `state.json`.

    A driver that has ended its state only sends records to MLflow or writes the report.
    """
    driver = {} if state is None else state["driver"]
    writer = tuple(driver.get(key) for key in ("machine", "pid", "process_started"))
    drivers = drivers_of(location)
    return any((one.machine, one.pid, one.process_started) != writer for one in drivers)


@dataclass(frozen=True)
class Drivers:
    """The drivers of a sweep, from the view of one of them."""

    location: SweepLocation
    owner: str
    """Owner of this driver's lease."""
    stop_before: Any
    """The request to stop that was there before this driver."""

    def others(self, *, watch: bool = False) -> list[Lease]:
        """The leases of all other drivers."""
        leases = drivers_of(self.location, watch=watch)
        return [lease for lease in leases if lease.owner != self.owner]

    def check_alone(self) -> None:
        """Check that this is the only driver, before results are deleted.

        Raises:
            BadInputError: There is another one.
        """
        if others := self.others(watch=True):
            raise BadInputError(
                "--retrain, --retrain-damaged and --accept-changes delete results or change the "
                f"plan and must be given while no other process runs {self.location.name}, got "
                f"{others[0]}: stop it first"
            )


@contextlib.contextmanager
def alone(location: SweepLocation, say: Callable[[str], None]) -> Iterator[bool]:
    """Hold the lease `driver.json`; yields whether it had to wait for another process.

    Raises:
        StorageError: The storage can't be written.
    """
    file = LeaseFile(location.files, FILE)
    lease, waited = Lease.of_this_process(f"sweep {location.name!r}"), False
    while (holder := file.acquire(lease)) is not None:
        if not waited:
            say(f"waits for {holder}, which prepares or ends")
        waited = True
        time.sleep(WAIT_SECONDS)
        lease = Lease.of_this_process(lease.what)
    held = HeldLease(file, lease)
    try:
        yield waited
    finally:
        held.release()


@contextlib.contextmanager
def driving(location: SweepLocation) -> Iterator[Drivers]:
    """Hold the lease of a driver.

    Raises:
        StorageError: The storage can't be written.
    """
    lease = Lease.of_this_process(f"sweep {location.name!r}")
    file = LeaseFile(location.files / DRIVERS, f"{lease.owner}.json")
    stop_before = location.read(STOP)
    file.acquire(lease)
    held = HeldLease(file, lease)
    try:
        yield Drivers(location, lease.owner, stop_before)
    finally:
        held.release()
