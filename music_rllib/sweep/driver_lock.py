"""One process drives a sweep."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from music_rllib.errors import FAILED
from music_rllib.experiment.session import Sweep
from music_rllib.runtime.ending import end_process
from music_rllib.store.lease import HeldLease, Lease, LeaseFile
from music_rllib.store.object_folder import StorageError, open_storage

__all__ = ["hold_driver_lock"]


@contextlib.contextmanager
def hold_driver_lock(sweep: Sweep, say: Callable[[str], None] = print) -> Iterator[None]:
    """Be the one process that drives the sweep, on whatever machine, for this `with`.

    A process that was suspended, and finds that another one drives the sweep by now, ends at once:
    they would both write the sweep's files.

    Args:
        sweep: Which one.
        say: Told why the process ends.

    Raises:
        StorageError: Another one does; or the storage can't be written.
    """
    filesystem, root = open_storage(sweep.storage)
    file = LeaseFile(filesystem, f"{root}/{sweep.plan.name}/driver.json")
    lease = Lease.of_this_process(f"sweep {sweep.plan.name!r}")
    holder = file.acquire(lease)
    if holder is not None:
        raise StorageError(
            f"{root}/{sweep.plan.name} must be used by one process at a time, and another one has "
            f"it: {holder}. Wait for its end or stop it, or give this sweep another --name"
        )

    def lost() -> None:
        again = Lease.of_this_process(f"sweep {sweep.plan.name!r}")
        taken_by = file.acquire(again)
        if taken_by is None:  # whoever had it has ended
            held.append(HeldLease(file, again, lost))
            return
        say(
            f"{root}/{sweep.plan.name} has been taken over while this process was suspended, by "
            f"{taken_by}: this one ends. See how far the sweep is with: python -m "
            f"music_rllib.sweep status {sweep.folder}"
        )
        end_process(FAILED)

    held = [HeldLease(file, lease, lost)]
    try:
        yield
    finally:
        held[-1].release()
