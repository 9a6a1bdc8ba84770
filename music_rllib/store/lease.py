"""Leases: only one process at a time may write a run.

A worker can outlive the driver that started it, and a second sweep may need the same run, so
whoever computes a run holds its lease. A lease expires unless it is renewed. The lease of a process
of this machine that is known to be dead need not expire first. A process that was suspended (a
laptop asleep) finds its lease lost when it resumes, and stops writing.

On a disk, a file lock protects taking and renewing a lease. An object store has no locks: the last
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
from pathlib import Path

import psutil
import pyarrow.fs as pafs
from filelock import FileLock
from pydantic import BaseModel, ConfigDict, ValidationError

from music_rllib.store.object_folder import StorageError, must_be_writable

EXPIRES_SECONDS = 60.0
"""Time until a lease expires that is not renewed; machines' clocks must agree better than that."""
RENEWALS = 4
"""Number of renewals in that time."""
SETTLE_SECONDS = 2.0
"""Wait between writing a lease into an object store and reading it again."""
LOCK_SECONDS = 30.0
LOOK_SECONDS = 1.0
"""Longest time in which a renewing thread does not see that the time of day was set."""


class LeaseLostError(RuntimeError):
    """Another process computes the run now, so this one must not write its results."""


class Lease(BaseModel):
    """The process that holds the lease, and until when."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    owner: str
    """Unique id of the owner."""
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
        """Whether the owner may still be at work."""
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
    """Start time of a process of this machine, in seconds of a clock that nobody can set.

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

    def __init__(self, filesystem: pafs.FileSystem, path: str) -> None:
        self._fs = filesystem
        self.path = path
        self._local = isinstance(filesystem, pafs.LocalFileSystem)
        self._seen: tuple[Lease | None, float] = (None, 0.0)
        """The lease of another owner, and the monotonic time when it was first seen."""

    def read(self) -> Lease | None:
        """The lease in the file; None if the file does not exist or is not readable."""
        try:
            with self._fs.open_input_stream(self.path) as stream:
                return Lease.model_validate_json(stream.read())
        except (FileNotFoundError, ValidationError):
            return None

    def acquire(self, lease: Lease) -> Lease | None:
        """Take the lease and return None, or return the lease of another owner that holds."""
        # A process that only waits must not write to a folder that the owner may be deleting.
        with contextlib.suppress(OSError):  # raised below, with the path
            if (holder := self._other_holder(lease)) is not None:
                return holder
        with self._exclusively(make_folder=True):
            if (holder := self._other_holder(lease)) is not None:
                return holder
            self._write(lease)
        if self._local:
            return None
        time.sleep(SETTLE_SECONDS)
        holder = self.read()
        return None if holder is None or holder.owner == lease.owner else holder

    def _other_holder(self, lease: Lease) -> Lease | None:
        holder = self.read()
        if holder is None or holder.owner == lease.owner or not holder.holds():
            return None
        if holder != self._seen[0]:
            self._seen = (holder, time.monotonic())
        # A lease that holds longer was dated by another clock, or before this one was set back.
        stale = time.monotonic() - self._seen[1] >= EXPIRES_SECONDS
        return None if holder.seconds > EXPIRES_SECONDS and stale else holder

    def renew(self, lease: Lease) -> bool:
        """Write the lease again, unless another owner has it; returns whether it was written."""
        if not self.is_owned_by(lease.owner):
            return False
        with self._exclusively():
            if not self.is_owned_by(lease.owner):
                return False
            self._write(lease)
        return True

    def is_owned_by(self, owner: str) -> bool:
        """Whether the file has a lease of this owner."""
        holder = self.read()
        return holder is not None and holder.owner == owner

    def release(self, owner: str) -> None:
        """Delete the lease if it is this owner's."""
        with contextlib.suppress(OSError, StorageError):
            if not self.is_owned_by(owner):
                return  # creates no lock file in a folder that the new owner may have deleted
            with self._exclusively():
                if self.is_owned_by(owner):
                    self._fs.delete_file(self.path)
                    if (
                        self._local
                    ):  # a process that waits for the lock notices, and creates another
                        self._lock_path.unlink()

    @contextlib.contextmanager
    def _exclusively(self, *, make_folder: bool = False) -> Iterator[None]:
        if not self._local:
            yield
            return
        with must_be_writable(self.path):
            lock = self._lock(make_folder=make_folder)
        try:
            yield
        finally:
            lock.release()

    def _lock(self, *, make_folder: bool, attempts: int = 100) -> FileLock:
        lock = FileLock(self._lock_path, timeout=LOCK_SECONDS)
        while True:
            try:
                if make_folder:
                    self._lock_path.parent.mkdir(parents=True, exist_ok=True)
                lock.acquire()
            except (FileNotFoundError, FileExistsError):  # the folder was deleted just now
                attempts -= 1
                if not make_folder or not attempts:
                    raise
            else:
                return lock

    @property
    def _lock_path(self) -> Path:
        path = Path(self.path)
        return path.with_name(f".{path.name}.lock")

    def _write(self, lease: Lease) -> None:
        data = lease.model_dump_json().encode()
        try:
            if not self._local:
                with self._fs.open_output_stream(self.path) as sink:
                    sink.write(data)
                return
            # Renamed, so that nobody reads half of it; not flushed: no owner survives a power cut.
            temporary = Path(f"{self.path}.{lease.owner}")
            temporary.write_bytes(data)
            temporary.replace(self.path)
        except OSError as error:
            raise StorageError(
                f"{self.path} must be writable: {error.strerror or error}"
            ) from error


class HeldLease:
    """A lease that was just acquired in `file`, which a thread renews until it is released.

    The thread calls `on_lost` when it finds that another process has taken the lease.
    """

    def __init__(
        self, file: LeaseFile, lease: Lease, on_lost: Callable[[], None] = lambda: None
    ) -> None:
        self._file, self._lease = file, lease
        self._duration = lease.expires - lease.since
        self._ended = threading.Event()
        self._on_lost = on_lost
        self.lost = False
        """Whether another process is known to have the lease."""
        self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)
        self._thread.start()

    def is_lost(self) -> bool:
        """Read the file again; returns whether another process has the lease."""
        with contextlib.suppress(OSError):  # a store that does not answer proves nothing
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
                f"{self._file.read() or 'nobody'}: this one was taken for dead, and writes nothing "
                "any more"
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
            # A full disk, or a store that does not answer, may recover before the lease expires.
            with contextlib.suppress(OSError, StorageError):
                if not self._file.renew(later):
                    self.lost = True
                    self._on_lost()
                    return

    def _wait_until_due(self) -> bool:
        """Wait for the next renewal; False if there is none because of `end`.

        A renewal is due at once after the machine slept or the time of day was set.
        """
        pause = self._duration / RENEWALS
        day, steady = time.time(), time.monotonic()
        while not self._ended.wait(min(LOOK_SECONDS, pause)):
            if time.monotonic() - steady >= pause or abs(time.time() - day) >= pause:
                return True
        return False
