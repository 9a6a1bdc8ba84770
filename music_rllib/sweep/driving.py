"""One process drives a sweep."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from music_rllib.experiment.lease import HeldLease, Lease, LeaseFile
from music_rllib.experiment.sealed import StorageError, open_storage
from music_rllib.sweep.session import Sweep

__all__ = ["driving"]


@contextlib.contextmanager
def driving(sweep: Sweep) -> Iterator[None]:
    """Be the one process that drives the sweep, on whatever machine, for this `with`.

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
    held = HeldLease(file, lease)
    try:
        yield
    finally:
        held.release()
