"""The lease that lets only one process at a time drive a sweep."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from music_rllib.errors import FAILED
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.runtime.process import end_process
from music_rllib.store.lease import HeldLease, Lease, LeaseFile
from music_rllib.store.storage import StorageError, open_storage

FILE = "driver.json"


def has_driver(storage: str, name: str) -> bool:
    """Whether a process drives the sweep, even if it has not written `state.json` yet."""
    lease = LeaseFile(open_storage(storage) / name, FILE).read()
    return lease is not None and lease.holds()


@contextlib.contextmanager
def hold_driver_lock(sweep: OpenSweep, say: Callable[[str], None] = print) -> Iterator[None]:
    """Hold the lease of the sweep's driver, which only one process on any machine can have.

    A process that was suspended ends at once if another process now drives the sweep, because both
    would write the sweep's files.

    Args:
        sweep: The sweep to drive.
        say: Receives the reason before the process ends.

    Raises:
        StorageError: Another process has the lease, or the storage can't be written.
    """
    place, owner = open_storage(sweep.storage) / sweep.plan.name, f"sweep {sweep.plan.name!r}"
    file, folder = LeaseFile(place, FILE), place.path
    lease = Lease.of_this_process(owner)
    holder = file.acquire(lease)
    if holder is not None:
        raise StorageError(
            f"{folder} must be used by one process at a time, and another one has it: {holder}. "
            "Wait for its end, stop it, or give this sweep another --name"
        )

    def lost() -> None:
        again = Lease.of_this_process(owner)
        taken_by = file.acquire(again)
        if taken_by is None:  # the other process has ended
            held.append(HeldLease(file, again, lost))
            return
        say(
            f"{folder} has been taken over by {taken_by} while this process was suspended; this "
            f"process ends. Its progress: music-rllib status {sweep.folder}"
        )
        end_process(FAILED)

    held = [HeldLease(file, lease, lost)]
    try:
        yield
    finally:
        held[-1].release()
