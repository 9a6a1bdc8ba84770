"""Leases: only one process at a time may write a run.

A worker can outlive the driver that started it, and a second sweep may need the same run, so the
process that computes a run holds its lease. A lease expires unless it is renewed. If the owner was
a process of this machine and is dead, its lease is taken over at once. A process that was suspended
(a sleeping laptop) finds its lease lost when it resumes, and stops writing.

On a disk, a file lock protects acquiring and renewing a lease. A bucket has no locks: the last
writer has the lease, and every writer reads it again after a moment.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import psutil
from filelock import FileLock
from pydantic import BaseModel, ConfigDict, ValidationError

from music_rllib.store.files import write_atomically
from music_rllib.store.storage import StorageError, StorageFolder, must_be_writable

EXPIRES_SECONDS = 60.0
"""Time until a lease expires; the clocks of machines must agree better than that."""
RENEWALS = 4
SETTLE_SECONDS = 2.0
"""Wait between writing a lease into a bucket and reading it again."""
LOCK_SECONDS, LOCK_ATTEMPTS = 30.0, 100
LOOK_SECONDS = 1.0
"""Longest time until a renewing thread notices that the system time was changed."""


class LeaseLostError(RuntimeError):
    """Another process has the lease, so this one must not write."""


class Lease(BaseModel):
    """The owner of a lease, and the time when it expires."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    owner: str
    what: str
    """Purpose of the lease, for messages."""
    host: str
    machine: str
    """Value of `this_machine`, where `pid` is valid."""
    pid: int
    process_started: float
    """Value of `process_start`."""
    since: float
    """Seconds since the epoch, like `expires`."""
    expires: float

    @classmethod
    def of_this_process(cls, what: str, seconds: float | None = None) -> Lease:
        """A new lease of this process that starts now."""
        now = time.time()
        seconds = EXPIRES_SECONDS if seconds is None else seconds
        return cls(
            owner=uuid.uuid4().hex,
            what=what,
            host=socket.gethostname(),
            machine=this_machine(),
            pid=os.getpid(),
            process_started=process_start(os.getpid()),
            since=now,
            expires=now + seconds,
        )

    @property
    def seconds(self) -> float:
        """Seconds until the lease expires."""
        return max(0.0, self.expires - time.time())

    def holds(self) -> bool:
        """Whether the lease is valid: not expired, and its owner may be running."""
        if time.time() >= self.expires:
            return False
        return self.machine != this_machine() or runs_here(self.pid, self.process_started)

    def __str__(self) -> str:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.since))
        return f"{self.what} (process {self.pid} on {self.host}, since {since})"


def this_machine() -> str:
    """Id of the boot of this machine and of the container, within which process ids are unique."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return f"{socket.gethostname()} {uuid.getnode()}"


def process_start(pid: int) -> float:
    """Start time of a process of this machine, in seconds of a clock that cannot be changed.

    Raises:
        psutil.NoSuchProcess: The process does not exist.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_bytes()
    except FileNotFoundError:
        # Not Linux, or no such process. psutil's value depends on the time of day of the boot.
        return float(psutil.Process(pid).create_time())
    # The 22nd field. The third one follows the name, which may contain anything, in parentheses.
    return int(stat.rpartition(b")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")


def runs_here(pid: int, started: float) -> bool:
    """Whether this machine runs the process `pid` that started at `started`."""
    try:
        return abs(process_start(pid) - started) < 1 and psutil.Process(pid).status() != "zombie"
    except psutil.NoSuchProcess:
        return False
    except (OSError, psutil.Error):
        return True


class LeaseFile:
    """The file of one lease; it and its folder need not exist.

    Methods raise StorageError if it cannot be written.
    """

    def __init__(self, folder: StorageFolder, name: str) -> None:
        self._folder, self._name = folder, name
        self.path = f"{folder.path}/{name}"
        self._seen: tuple[Lease | None, float] = (None, 0.0)
        """The lease of another owner, and the monotonic time when it was first seen."""

    def read(self) -> Lease | None:
        """The lease in the file; None if the file does not exist or is incomplete."""
        try:
            return Lease.model_validate_json(self._folder.read(self._name) or b"")
        except ValidationError:
            return None

    def acquire(self, lease: Lease) -> Lease | None:
        """Acquire the lease and return None, or return the valid lease of another owner."""
        # A process that only waits must not write to a folder that the owner may be deleting.
        with contextlib.suppress(OSError):  # raised below, with the path
            if (holder := self.holder(lease.owner)) is not None:
                return holder
        with self._locked(LOCK_ATTEMPTS):
            if (holder := self.holder(lease.owner)) is not None:
                return holder
            self._write(lease)
        if self._folder.is_local:
            return None
        time.sleep(SETTLE_SECONDS)
        holder = self.read()
        return None if holder is None or holder.owner == lease.owner else holder

    def holder(self, me: str = "", *, watch: bool = False) -> Lease | None:
        """The valid lease of another owner than `me`.

        A lease that a fast clock has dated ahead is valid while it is renewed. This takes several
        looks; with `watch` this method looks for up to a minute.
        """
        while True:
            holder, first = self.read(), self._seen[0]
            if holder is None or holder.owner == me or not holder.holds():
                return None
            if holder != first:
                self._seen = (holder, time.monotonic())
            # It was dated by another clock, or before this one was set back.
            ahead = holder.seconds > EXPIRES_SECONDS
            if ahead and time.monotonic() - self._seen[1] >= EXPIRES_SECONDS:
                return None
            renewed = first is not None and first.owner == holder.owner and first != holder
            if renewed or not (watch and ahead):
                return holder
            time.sleep(LOOK_SECONDS)

    def remove_invalid(self) -> None:
        """Delete the lease that `holder` has seen and does not return any more.

        Other processes need not watch it for as long.
        """
        if (seen := self._seen[0]) is not None:
            self.release(seen.owner)
            self._seen = (None, 0.0)

    def renew(self, lease: Lease) -> bool:
        """Write the lease again, unless another owner has it; returns whether it was written."""
        return self._if_owned_by(lease.owner, partial(self._write, lease))

    def is_owned_by(self, owner: str) -> bool:
        holder = self.read()
        return holder is not None and holder.owner == owner

    def release(self, owner: str) -> None:
        """Delete the lease if it is this owner's."""
        with contextlib.suppress(OSError, StorageError):
            self._if_owned_by(owner, self._delete)

    def _if_owned_by(self, owner: str, act: Callable[[], None]) -> bool:
        """Call `act` under the lock if the lease is this owner's; returns whether it was called."""
        # Also checked before locking, which creates a file: a new owner may delete the folder.
        if not self.is_owned_by(owner):
            return False
        with self._locked():
            if not self.is_owned_by(owner):
                return False
            act()
        return True

    @contextlib.contextmanager
    def _locked(self, attempts: int = 1) -> Iterator[None]:
        """Hold the lock file on a disk; several `attempts` create its folder if it is deleted."""
        if not self._folder.is_local:
            yield
            return
        lock = FileLock(self._lock_path, timeout=LOCK_SECONDS)
        with must_be_writable(self.path):
            for left in reversed(range(attempts)):
                try:
                    if attempts > 1:
                        self._lock_path.parent.mkdir(parents=True, exist_ok=True)
                    lock.acquire()
                    break
                except (FileNotFoundError, FileExistsError):  # the folder was deleted just now
                    if not left:
                        raise
        try:
            yield
        finally:
            lock.release()

    @property
    def _lock_path(self) -> Path:
        return Path(self._folder.path, f".{self._name}.lock")

    def _write(self, lease: Lease) -> None:
        data = lease.model_dump_json().encode()
        if not self._folder.is_local:
            self._folder.write(self._name, data)
            return
        # Not in a new folder, if the old one was deleted; no owner survives a power cut.
        with must_be_writable(self.path):
            write_atomically(Path(self.path), data, sync=False)

    def _delete(self) -> None:
        self._folder.remove(self._name)
        if self._folder.is_local:  # a process that waits for the lock creates another file
            self._lock_path.unlink()


class HeldLease:
    """A lease that was just acquired in `file`, which a thread renews until it is released."""

    def __init__(self, file: LeaseFile, lease: Lease) -> None:
        self._file, self._lease = file, lease
        self._duration = lease.expires - lease.since
        self._ended = threading.Event()
        self.lost = False
        """Whether another process is known to have the lease."""
        self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)
        self._thread.start()

    def is_lost(self) -> bool:
        """Read the file again; returns whether another process has the lease."""
        with contextlib.suppress(OSError):  # a bucket that does not answer proves nothing
            self.lost = self.lost or not self._file.is_owned_by(self._lease.owner)
        return self.lost

    def check(self) -> None:
        """Read the file again, before something is written that only the owner may write.

        Raises:
            LeaseLostError: Another process has the lease.
        """
        if self.is_lost():
            raise LeaseLostError(
                f"{self._file.path} must name this process (owner {self._lease.owner}), it names "
                f"{self._file.read() or 'nobody'}: the lease expired and another process took "
                "over; stopping without writing"
            )

    def release(self) -> None:
        """Stop renewing, and delete the lease."""
        self.end()
        self._file.release(self._lease.owner)

    def end(self) -> None:
        """Stop renewing."""
        self._ended.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)

    def _renew(self) -> None:
        while self._wait_until_due():
            later = self._lease.model_copy(update={"expires": time.time() + self._duration})
            # A full disk, or a bucket that does not answer, may recover before the lease expires.
            with contextlib.suppress(OSError, StorageError):
                if not self._file.renew(later):
                    self.lost = True
                    return

    def _wait_until_due(self) -> bool:
        """Wait for the next renewal; returns False after `end`.

        A renewal is due at once after the machine slept or its time was changed.
        """
        pause = self._duration / RENEWALS
        day, steady = time.time(), time.monotonic()
        while not self._ended.wait(min(LOOK_SECONDS, pause)):
            if time.monotonic() - steady >= pause or abs(time.time() - day) >= pause:
                return True
        return False
