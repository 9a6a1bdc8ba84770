"""Full and read-only disks: a message names the path, and nothing is lost."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from music_rllib.store.node_store import NodeStore
from music_rllib.store.storage import StorageError
from tests.faults import comparison, sweeps
from tests.faults.sweeps import resume
from tests.integration.conftest import Program

KEY = "a" * 20
MakeDisk = Callable[[str], Path]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[MakeDisk]:
    """`small_disk("2m")` mounts a disk of that size; skips the test without the right to mount."""
    mounted: list[Path] = []

    def make(size: str) -> Path:
        folder = tmp_path / f"disk{len(mounted)}"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            pytest.skip(f"a small disk can't be mounted: {error}")
        if done.returncode != 0:
            pytest.skip(f"a small disk can't be mounted: {done.stderr.strip()}")
        mounted.append(folder)
        return folder

    yield make
    for folder in mounted:
        subprocess.run(["umount", "--lazy", str(folder)], check=False)


def fill(disk: Path) -> Path:
    """Fill the disk with one file."""
    ballast = disk / "ballast"
    deadline = time.monotonic() + 30
    while True:
        try:
            handle = os.open(ballast, os.O_CREAT | os.O_WRONLY)
            break
        except OSError:  # recently deleted space may not be free yet
            assert time.monotonic() < deadline
            time.sleep(0.1)
    try:
        while os.write(handle, b"0" * 4096):
            pass
    except OSError:
        return ballast
    finally:
        os.close(handle)
    raise AssertionError("the disk has no end")


def save(disk: Path, steps: int, size: int = 1000) -> None:
    with NodeStore(str(disk)).work_folder(KEY).new_checkpoint(steps) as draft:
        with draft.new_part("p") as (_, part):
            (part / "data").write_bytes(os.urandom(size))
        (draft.folder / "state").write_bytes(b"%d" % steps)


def newest(disk: Path) -> bytes:
    with NodeStore(str(disk)).work_folder(KEY).newest(lambda text: pytest.fail(text)) as saved:
        assert saved is not None
        return (saved.folder / "state").read_bytes()


def test_a_checkpoint_on_a_full_disk_names_the_path_and_leaves_the_older_one(
    small_disk: MakeDisk,
) -> None:
    disk = small_disk("1m")
    save(disk, 1000)
    with pytest.raises(StorageError, match=rf"{disk}/work/{KEY}/.* must be writable: No space"):
        save(disk, 2000, size=2_000_000)
    assert newest(disk) == b"1000"
    ballast = fill(disk)
    with pytest.raises(StorageError, match=rf"{disk}/work/{KEY}.* must be writable: No space"):
        save(disk, 2000)
    assert newest(disk) == b"1000"
    ballast.unlink()
    save(disk, 2000)
    assert newest(disk) == b"2000"


def test_a_read_only_disk_is_named(small_disk: MakeDisk) -> None:
    disk = small_disk("1m")
    save(disk, 1000)
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    match = rf"{disk}/work/{KEY}.* must be writable: Read-only file system"
    with pytest.raises(StorageError, match=match):
        save(disk, 2000)
    assert newest(disk) == b"1000"


@pytest.mark.thorough
def test_a_disk_that_fills_up_during_a_sweep(
    program: Program, unbroken: Path, small_disk: MakeDisk
) -> None:
    """The runs fail with the reason; with free space, the command gives the same numbers."""
    disk = small_disk("64m")
    program.write(sweeps.document(storage=str(disk / "results")))
    process = sweeps.start_until(program, "pretrain/seed0: 4", "pretrain/seed0: 8")
    ballast = fill(disk)
    output = sweeps.ended(process, 1)
    assert "pretrain/seed0: FAILED: StorageError: " in output
    assert f"{disk}/results" in output
    assert "must be writable: No space left on device" in output
    ballast.unlink()
    sweeps.finish(program)
    comparison.same(unbroken, disk / "results")


@pytest.mark.thorough
def test_a_full_disk_below_mlflow(program: Program, unbroken: Path, small_disk: MakeDisk) -> None:
    """Training continues; the sweep prints what is missing and the command that sends it."""
    disk = small_disk("8m")
    uri = f"sqlite:///{disk}/mlflow.db"
    program.write(sweeps.document(mlflow={"tracking_uri": uri}))
    process = sweeps.start_until(program, "pretrain/seed0: started")
    ballast = fill(disk)
    output = sweeps.ended(process)
    assert "did not reach MLflow" in output
    assert "music-rllib resume" in output
    ballast.unlink()
    time.sleep(1.0)
    resume(program)
    results = program.folder / "results"
    assert comparison.nodes(results) == comparison.nodes(unbroken)
    assert comparison.logged(uri) == comparison.logged(f"sqlite:///{unbroken}/mlflow.db")
