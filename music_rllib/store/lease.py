"""Who may write something: one owner at a time, for a while, and again while it renews.

A worker can outlive the driver that started it, and a second sweep may want the same run: whoever
computes a run holds its lease. A lease that isn't renewed expires; one whose process is known to
be dead, because it ran on this machine, needs no waiting. A process that was suspended (a laptop
asleep) finds its lease lost when it goes on, and makes way.

On a disk, taking and renewing happen under a file lock. An object store has none: there, who
writes last has the lease, and everybody looks again after a moment.
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

from music_rllib.store.object_folder import StorageError

EXPIRES_SECONDS = 60.0
"""How long a lease holds that isn't renewed; clocks of machines should agree better than that."""
RENEWALS = 4
"""So often it is renewed in that time."""
SETTLE_SECONDS = 2.0
"""Between writing a lease into an object store and trusting that nobody else did."""
LOCK_SECONDS = 30.0


class LeaseLostError(RuntimeError):
    """Somebody else computes the run now: what this process has must not be written."""


class Lease(BaseModel):
    """Who holds it, and until when."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    owner: str
    """Unlike any other."""
    what: str
    """For messages: what the owner is doing it for."""
    host: str
    machine: str
    """Where `pid` has a meaning: a boot of a machine, and a container on it."""
    pid: int
    process_started: float
    """As `process_start` gives it."""
    since: float
    """Seconds since the epoch, as is `expires`."""
    expires: float

    @classmethod
    def of_this_process(cls, what: str, seconds: float | None = None) -> Lease:
        """A new lease, from now on."""
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
        """How long it holds without being renewed: at most."""
        return max(0.0, self.expires - time.time())

    def holds(self) -> bool:
        """Whether its owner may still be at work."""
        if time.time() >= self.expires:
            return False
        return self.machine != this_machine() or runs_here(self.pid, self.process_started)

    def __str__(self) -> str:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.since))
        return f"{self.what} (process {self.pid} on {self.host}, since {since})"


def this_machine() -> str:
    """What tells two places apart whose process ids have nothing to do with each other."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return f"{socket.gethostname()} {uuid.getnode()}"


def process_start(pid: int) -> float:
    """When a process of this machine began, in seconds, by a clock that nobody sets.

    Raises:
        psutil.NoSuchProcess: There is none.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        # Not Linux, or no such process; psutil adds the time of day of the boot.
        return float(psutil.Process(pid).create_time())
    # After the name, which may hold anything, come the third and further fields; this is the 22nd.
    return int(stat.rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")


def runs_here(pid: int, started: float) -> bool:
    """Whether this machine has that process, and it is the one that began then."""
    try:
        return abs(process_start(pid) - started) < 1 and psutil.Process(pid).status() != "zombie"
    except psutil.NoSuchProcess:
        return False
    except (OSError, psutil.Error):
        return True


class LeaseFile:
    """Where one lease is kept."""

    def __init__(self, filesystem: pafs.FileSystem, path: str) -> None:
        """Look at `path`, which need not exist; nor need its folder."""
        self._fs = filesystem
        self.path = path
        self._local = isinstance(filesystem, pafs.LocalFileSystem)
        self._seen: tuple[Lease | None, float] = (None, 0.0)
        """Somebody's lease, and since when it is there, by a clock that nobody sets."""

    def read(self) -> Lease | None:
        """What is there; None if nothing is, or nothing that can be read."""
        try:
            with self._fs.open_input_stream(self.path) as stream:
                return Lease.model_validate_json(stream.read())
        except (FileNotFoundError, ValidationError):
            return None

    def acquire(self, lease: Lease) -> Lease | None:
        """Take it over, unless somebody holds it: then theirs, which is to be waited for.

        Raises:
            StorageError: The place can't be written.
        """
        # Who only waits must not touch a folder that its owner may be deleting.
        with contextlib.suppress(OSError):  # said below, with the place
            if (holder := self._holder_beside(lease)) is not None:
                return holder
        with self._exclusively(make_folder=True):
            if (holder := self._holder_beside(lease)) is not None:
                return holder
            self._write(lease)
        if self._local:
            return None
        time.sleep(SETTLE_SECONDS)
        holder = self.read()
        return None if holder is None or holder.owner == lease.owner else holder

    def _holder_beside(self, lease: Lease) -> Lease | None:
        holder = self.read()
        if holder is None or holder.owner == lease.owner or not holder.holds():
            return None
        if holder != self._seen[0]:
            self._seen = (holder, time.monotonic())
        # One that would hold longer was dated by another clock, or before this one was set back.
        stale = time.monotonic() - self._seen[1] >= EXPIRES_SECONDS
        return None if holder.seconds > EXPIRES_SECONDS and stale else holder

    def renew(self, lease: Lease) -> bool:
        """Write a later expiry; False, and nothing is written, where it is somebody else's.

        Raises:
            StorageError: The place can't be written.
        """
        if not self.is_owned_by(lease.owner):
            return False
        with self._exclusively():
            if not self.is_owned_by(lease.owner):
                return False
            self._write(lease)
        return True

    def is_owned_by(self, owner: str) -> bool:
        """Whether the lease that is there is this owner's."""
        holder = self.read()
        return holder is not None and holder.owner == owner

    def release(self, owner: str) -> None:
        """Remove it, if it is this owner's."""
        with contextlib.suppress(OSError, StorageError):
            if not self.is_owned_by(owner):
                return  # and nothing is made where the new owner may have deleted all
            with self._exclusively():
                if self.is_owned_by(owner):
                    self._fs.delete_file(self.path)
                    if self._local:  # who waits for the lock notices, and makes another one
                        self._lock_path.unlink()

    @contextlib.contextmanager
    def _exclusively(self, *, make_folder: bool = False) -> Iterator[None]:
        if not self._local:
            yield
            return
        try:
            lock = self._lock(make_folder=make_folder)
        except OSError as error:
            place = error.filename or self.path
            raise StorageError(f"{place} must be writable: {error.strerror or error}") from error
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
            except (FileNotFoundError, FileExistsError):  # somebody has just deleted the folder
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
            # Renamed, so that nobody reads half of it; after a power cut nobody needs it.
            temporary = Path(f"{self.path}.{lease.owner}")
            temporary.write_bytes(data)
            temporary.replace(self.path)
        except OSError as error:
            raise StorageError(
                f"{self.path} must be writable: {error.strerror or error}"
            ) from error


class HeldLease:
    """A lease that this process has acquired, renewed in the background until it is released."""

    def __init__(
        self, file: LeaseFile, lease: Lease, on_lost: Callable[[], None] = lambda: None
    ) -> None:
        """Go on renewing `lease`, which `file` has just accepted.

        `on_lost` is called, in a thread, when a renewal finds that it is somebody else's.
        """
        self._file, self._lease = file, lease
        self._duration = lease.expires - lease.since
        self._ended = threading.Event()
        self._on_lost = on_lost
        self.lost = False
        """Whether somebody else has it, as far as that is known without asking."""
        self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)
        self._thread.start()

    def is_lost(self) -> bool:
        """Look again whether somebody else has it."""
        with contextlib.suppress(OSError):  # a store that doesn't answer says nothing
            self.lost = self.lost or not self._file.is_owned_by(self._lease.owner)
        return self.lost

    def check(self) -> None:
        """Look again, before something is written that belongs to the owner.

        Raises:
            LeaseLostError: It is somebody else's by now.
        """
        if self.is_lost():
            raise LeaseLostError(
                f"{self._file.path} must name this process (owner {self._lease.owner}), it names "
                f"{self._file.read() or 'nobody'}: this one was taken for dead, and writes nothing "
                "any more"
            )

    def release(self) -> None:
        """Let others have it."""
        self.end()
        self._file.release(self._lease.owner)

    def end(self) -> None:
        """Renew no more."""
        self._ended.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)

    def _renew(self) -> None:
        while self._wait_until_due():
            later = self._lease.model_copy(update={"expires": time.time() + self._duration})
            # A full disk, or a store that doesn't answer: until it expires there is time.
            with contextlib.suppress(OSError, StorageError):
                if not self._file.renew(later):
                    self.lost = True
                    self._on_lost()
                    return

    def _wait_until_due(self) -> bool:
        """Wait for the next renewal; False at the end.

        It is due at once after the process or the machine slept, or the time of day was set.
        """
        pause = self._duration / RENEWALS
        day, steady = time.time(), time.monotonic()
        while not self._ended.wait(min(1.0, pause)):
            if time.monotonic() - steady >= pause or abs(time.time() - day) >= pause:
                return True
        return False
