"""A lease has one owner at a time, and expires."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pyarrow.fs as pafs
import pytest

from music_rllib.store import lease as lease_module
from music_rllib.store.lease import (
    HeldLease,
    Lease,
    LeaseFile,
    LeaseLostError,
    process_start,
    runs_here,
)
from music_rllib.store.storage import StorageError, StorageFolder, open_storage
from tests.processes import wait_until

pytestmark = pytest.mark.faults


def lease_file(path: Path) -> LeaseFile:
    return LeaseFile(open_storage(str(path.parent)), path.name)


@pytest.fixture(params=["disk", "object store"])
def place(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> LeaseFile:
    if request.param == "disk":
        return lease_file(tmp_path / "work" / "lease.json")
    monkeypatch.setattr(lease_module, "SETTLE_SECONDS", 0.05)
    # Not a file system in memory: its readers share one position in a file.
    (tmp_path / "bucket" / "work").mkdir(parents=True)
    filesystem = pafs.SubTreeFileSystem(str(tmp_path), pafs.LocalFileSystem())
    return LeaseFile(StorageFolder(filesystem, "bucket/work"), "lease.json")


def elsewhere(what: str = "another sweep", seconds: float = 60.0) -> Lease:
    lease = Lease.of_this_process(what, seconds)
    return lease.model_copy(update={"machine": "another one", "host": "far-away", "pid": 1})


def test_a_valid_lease_is_refused_and_its_owner_named(place: LeaseFile) -> None:
    theirs = elsewhere()
    assert place.acquire(theirs) is None
    holder = place.acquire(Lease.of_this_process("mine"))
    assert holder == theirs
    assert str(holder).startswith("another sweep (process 1 on far-away, since ")
    place.release(theirs.owner)
    assert place.acquire(Lease.of_this_process("mine")) is None


def test_an_expired_lease_is_taken_over_and_its_old_owner_stops_writing(place: LeaseFile) -> None:
    theirs, mine = elsewhere(seconds=-1.0), Lease.of_this_process("mine")
    assert place.acquire(theirs) is None
    assert place.acquire(mine) is None
    held = HeldLease(place, theirs)  # not before: its owner would renew it at once
    with pytest.raises(
        LeaseLostError, match=r"lease\.json must name this process .* it names mine"
    ):
        held.check()
    assert not place.renew(theirs)
    held.release()
    assert place.is_owned_by(mine.owner), "the old owner removes nothing"


def test_a_lease_is_renewed_while_it_is_held(place: LeaseFile) -> None:
    mine = Lease.of_this_process("mine", seconds=0.5)
    place.acquire(mine)
    held = HeldLease(place, mine)
    deadline = time.monotonic() + 60
    while (now := place.read()) is None or now.expires <= mine.expires + 0.5:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    held.check()
    held.release()
    assert place.read() is None


def test_the_lease_of_a_dead_local_process_is_taken_over_at_once(tmp_path: Path) -> None:
    code = (
        "import sys, time\n"
        "from music_rllib.store.lease import Lease, LeaseFile\n"
        "from music_rllib.store.storage import open_storage\n"
        "file = LeaseFile(open_storage(sys.argv[1]), 'lease.json')\n"
        "file.acquire(Lease.of_this_process('theirs'))\n"
        "print('held', flush=True)\n"
        "time.sleep(600)\n"
    )
    path = tmp_path / "lease.json"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        file, mine = lease_file(path), Lease.of_this_process("mine")
        assert file.acquire(mine) is not None
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert file.acquire(mine) is None


def test_exactly_one_of_many_processes_gets_the_lease(tmp_path: Path) -> None:
    path = str(tmp_path / "lease.json")
    won: list[str] = []

    def contend() -> None:
        file, lease = lease_file(Path(path)), Lease.of_this_process("one of many")
        if file.acquire(lease) is None:
            won.append(lease.owner)

    threads = [threading.Thread(target=contend) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1


def test_an_incomplete_lease_file_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "lease.json"
    path.write_text('{"owner": "x", "pi')
    file = lease_file(path)
    assert file.read() is None
    assert file.acquire(Lease.of_this_process("mine")) is None


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "work").write_text("a file where the folder should be")
    file = lease_file(tmp_path / "work" / "lease.json")
    with pytest.raises(StorageError, match=r"work.* must be writable"):
        file.acquire(Lease.of_this_process("mine"))


def test_a_live_owner_keeps_its_lease_when_the_clock_jumps(
    place: LeaseFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a jump, the lease is renewed at once with the new time."""
    monkeypatch.setattr(lease_module, "LOOK_SECONDS", 0.1)
    # The regular renewal is due after 150 s.
    mine, day, jump = Lease.of_this_process("mine", 600.0), time.time, [0.0]
    place.acquire(mine)
    monkeypatch.setattr(time, "time", lambda: day() + jump[0])
    held = HeldLease(place, mine)
    for hours in (1, -1):
        time.sleep(0.5)  # the thread has noted the time before the jump
        jump[0] = 3600.0 * hours
        deadline = time.monotonic() + 30
        while (now := place.read()) is None or not 0 < now.seconds <= 600:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert now.holds(), "the clock does not change the process"
    held.check()
    held.release()


def test_a_lease_dated_in_the_future_is_valid_while_renewed(
    place: LeaseFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The owner's clock is fast, or this clock was set back after the owner died."""
    theirs, mine = elsewhere(seconds=3700.0), Lease.of_this_process("mine")
    steady, passed = time.monotonic, [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: steady() + passed[0])
    assert place.acquire(theirs) is None
    assert place.acquire(mine) == theirs
    passed[0] = 50.0
    assert place.acquire(mine) == theirs
    later = theirs.model_copy(update={"expires": theirs.expires + 15})
    assert place.renew(later)
    passed[0] = 70.0
    assert place.acquire(mine) == later, "it was renewed"
    passed[0] = 140.0
    assert place.acquire(mine) is None


def test_a_look_at_a_lease_from_a_fast_clock_takes_a_minute_at_most(
    place: LeaseFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = elsewhere(seconds=3600.0)
    later = theirs.model_copy(update={"expires": theirs.expires + 15})
    start, renewed_after = time.time(), math.inf
    passed = 0.0

    def sleep(seconds: float) -> None:
        nonlocal passed
        passed += seconds
        if passed >= renewed_after:
            assert place.renew(later)

    fake = SimpleNamespace(time=lambda: start + passed, monotonic=lambda: passed, sleep=sleep)
    monkeypatch.setattr(lease_module, "time", fake)
    assert place.acquire(theirs) is None
    assert place.holder() == theirs
    assert place.holder(watch=True) is None, "it is not renewed"
    assert passed == pytest.approx(60, abs=1)
    place.remove_invalid()
    assert place.read() is None, "others need not wait"
    assert place.acquire(theirs) is None
    renewed_after = passed + 15
    assert place.holder(watch=True) == later, "it is renewed"
    assert passed == pytest.approx(75, abs=1)


def test_an_owner_that_lost_its_lease_leaves_no_folder(tmp_path: Path) -> None:
    """Another sweep took over the run, finished it and deleted its folder."""
    path = tmp_path / "work" / "key" / "lease.json"
    file, mine = lease_file(path), Lease.of_this_process("m", 0.4)
    assert file.acquire(mine) is None
    held = HeldLease(file, mine)
    shutil.rmtree(path.parent)
    wait_until(lambda: held.lost, 30)
    with pytest.raises(LeaseLostError, match="it names nobody"):
        held.check()
    assert not file.renew(mine)
    held.release()
    assert not path.parent.exists()


def test_waiting_for_a_lease_writes_nothing(place: LeaseFile, tmp_path: Path) -> None:
    assert place.acquire(elsewhere()) is None
    before = sorted(tmp_path.rglob("*"))
    assert place.acquire(Lease.of_this_process("mine")) is not None
    assert sorted(tmp_path.rglob("*")) == before


def test_a_lease_is_acquired_while_its_folder_is_deleted(tmp_path: Path) -> None:
    folder, over = tmp_path / "work", threading.Event()

    def delete() -> None:
        while not over.wait(0.0005):
            with contextlib.suppress(OSError):
                folder.rmdir()

    deleting = threading.Thread(target=delete)
    deleting.start()
    file = lease_file(folder / "lease.json")
    try:
        for _ in range(50):
            mine = Lease.of_this_process("mine")
            assert file.acquire(mine) is None
            assert file.is_owned_by(mine.owner)
            file.release(mine.owner)
    finally:
        over.set()
        deleting.join()


def test_a_process_is_recognized_after_the_clock_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """psutil computes start times from the boot time, which jumps by an hour too."""
    mine = Lease.of_this_process("mine")
    boot = psutil.boot_time()
    for hours in (1, -1):
        monkeypatch.setattr(psutil._psplatform, "boot_time", lambda h=hours: boot + 3600 * h)
        assert mine.holds()
        assert runs_here(mine.pid, mine.process_started)
    assert not runs_here(mine.pid, mine.process_started + 5), "another process with the same id"


def test_the_last_of_two_writers_has_the_lease_of_a_bucket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bucket" / "work").mkdir(parents=True)
    filesystem = pafs.SubTreeFileSystem(str(tmp_path), pafs.LocalFileSystem())
    file = LeaseFile(StorageFolder(filesystem, "bucket/work"), "lease.json")
    theirs = elsewhere()
    # The other one writes between this one's write and its second look.
    monkeypatch.setattr(time, "sleep", lambda _: file._write(theirs))
    assert file.acquire(Lease.of_this_process("mine")) == theirs


def test_a_zombie_does_not_hold_a_lease() -> None:
    """A killed worker whose parent has not waited for it, as in a container without an init."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    started = process_start(child.pid)
    assert runs_here(child.pid, started)
    child.kill()
    wait_until(lambda: not runs_here(child.pid, started), 10)
    assert child.returncode is None, "nobody has waited for it"
    child.wait()


def test_an_owner_that_waited_for_the_lock_writes_nothing_any_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process took the lease over between the look and the lock."""
    file = LeaseFile(open_storage(str(tmp_path)), "lease.json")
    mine, theirs = Lease.of_this_process("mine"), elsewhere()
    assert file.acquire(mine) is None
    locked = LeaseFile._locked

    def late(self: LeaseFile, attempts: int = 1) -> Any:
        self._write(theirs)
        return locked(self, attempts)

    monkeypatch.setattr(LeaseFile, "_locked", late)
    assert not file.renew(mine)
    assert file.read() == theirs
    file.release(mine.owner)
    assert file.read() == theirs


def test_a_lease_that_was_acquired_while_this_process_waited_for_the_lock_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = LeaseFile(open_storage(str(tmp_path)), "lease.json")
    theirs, locked = elsewhere(), LeaseFile._locked

    def late(self: LeaseFile, attempts: int = 1) -> Any:
        self._write(theirs)
        return locked(self, attempts)

    monkeypatch.setattr(LeaseFile, "_locked", late)
    assert file.acquire(Lease.of_this_process("mine")) == theirs
    assert file.read() == theirs
