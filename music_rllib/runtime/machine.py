"""Resources of this machine, and the address of a Ray cluster. Does not import Ray."""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import math
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from music_rllib.errors import FAILED, BadInputError

if TYPE_CHECKING:
    from music_rllib.config.schema import Resources
import platform
import subprocess
from functools import cache
from importlib import metadata

import music_rllib
from music_rllib import names

REACH_SECONDS = 5.0
SOCKET_BYTES = 107
"""Maximum length of a UNIX socket's path on Linux."""
LOCK = "lock"
"""File in a folder of `own_folder`, which its process has locked."""
LEFT_SECONDS = 6 * 3600
"""Age at which a local Ray's folder without a lock may be removed; a living Ray writes to it."""
RAY_FOLDER = "mr-"
"""Prefix of a local Ray's folder."""
LONGEST_SOCKET = len(
    f"/{RAY_FOLDER}12345678/r/session_2026-11-26_07-59-49_813210_4194304/sockets/plasma_store"
)
OWN_CGROUPS = Path("/proc/self/cgroup")
CGROUPS = Path("/sys/fs/cgroup")


class ClusterError(BadInputError, RuntimeError):
    """Ray cannot be reached, or cannot hold a run."""


class RayStartError(ClusterError):
    """A local Ray did not start."""

    exit_code = FAILED


def cluster_address() -> str | None:
    """RAY_ADDRESS, which Ray sets in submitted jobs too; None for a local Ray."""
    address = os.environ.get("RAY_ADDRESS")
    return None if address in {None, "", "local"} else address


def check_reachable(address: str) -> None:
    """Connect to a cluster's address once; Ray itself would retry for minutes.

    Raises:
        ClusterError: There is no answer, or it is not an address of a cluster.
    """
    if address == "auto":
        return
    if address.startswith(("http://", "https://")):
        raise ClusterError(
            f"RAY_ADDRESS must be HOST:PORT of a cluster's head, got {address!r}; an http "
            "address is for 'ray job submit'"
        )
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=REACH_SECONDS).close()
    except (OSError, ValueError, OverflowError) as error:
        raise ClusterError(
            f"RAY_ADDRESS must be HOST:PORT of a Ray cluster that answers, got {address!r}: {error}"
        ) from error


def ray_parent() -> Path:
    """Parent folder for a local Ray, short enough for the paths of its sockets.

    The first suitable one of RAY_TMPDIR, TMPDIR, /tmp and a few others. Batch systems often set a
    long TMPDIR.

    Raises:
        ClusterError: None is short enough and writable.
    """
    given, *last = map(os.environ.get, ("RAY_TMPDIR", "XDG_RUNTIME_DIR", "HOME"))
    common = ("/tmp", "/var/tmp")  # noqa: S108 - the folder in it gets a random name and mode 0700
    places = [Path(p).absolute() for p in (given, tempfile.gettempdir(), *common, *last) if p]
    for place in places:
        fits = len(os.fsencode(place)) + LONGEST_SOCKET <= SOCKET_BYTES
        if fits and os.access(place, os.W_OK | os.X_OK):
            return place
    most = SOCKET_BYTES - LONGEST_SOCKET
    raise ClusterError(
        f"RAY_TMPDIR must be a writable folder with a path of at most {most} bytes, for Ray's "
        f"sockets; got none among {', '.join(dict.fromkeys(map(str, places)))}"
    )


@contextlib.contextmanager
def own_folder(prefix: str, parent: Path | None = None) -> Iterator[str]:
    """A new private folder, which is removed at the end.

    If this process is killed, the next call of this user with the same arguments removes it.
    """
    parent = Path(tempfile.gettempdir()) if parent is None else parent
    for folder in parent.glob(f"{prefix}*"):
        _remove_if_left(folder)
    name = tempfile.mkdtemp(prefix=prefix, dir=parent)
    # Neither a file object nor a TemporaryDirectory: both warn if their owner is never closed.
    lock = os.open(Path(name, "new"), os.O_CREAT | os.O_WRONLY, 0o600)
    cleanup = contextlib.ExitStack()  # its second `close` does nothing
    cleanup.callback(os.close, lock)
    cleanup.callback(shutil.rmtree, name, ignore_errors=True)
    atexit.register(cleanup.close)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until this process ends
        Path(name, "new").rename(Path(name, LOCK))
        yield name
    finally:
        atexit.unregister(cleanup.close)
        cleanup.close()


def _remove_if_left(folder: Path) -> None:
    """Remove a folder of `own_folder` if its process has ended."""
    with contextlib.suppress(OSError, ValueError):  # another kind of folder, or its process lives
        if folder.is_symlink() or folder.stat().st_uid != os.getuid():
            return
        if _is_left_by_ray(folder):
            shutil.rmtree(folder, ignore_errors=True)
            return
        with (folder / LOCK).open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)


def _is_left_by_ray(folder: Path) -> bool:
    """Whether a dying Ray created its removed folder again, without a lock, hours ago.

    A session's name ends with the id of the driver's process.
    """
    sessions = {*folder.glob("r/session_*")}
    if not sessions or {*folder.glob("*"), *folder.glob("r/*")} != {folder / "r", *sessions}:
        return False
    changed = max(path.lstat().st_mtime for path in folder.rglob("*"))
    drivers = [int(path.name.rpartition("_")[2]) for path in sessions if not path.is_symlink()]
    return time.time() - changed > LEFT_SECONDS and not any(map(psutil.pid_exists, drivers))


def check_cpus(resources: Resources) -> int | None:
    """Number of CPUs for a local Ray; None if all are for it, or with a cluster.

    Raises:
        ClusterError: This machine has fewer CPUs than `resources` asks for.
    """
    if cluster_address() is not None:
        return None
    here = cpus_here()
    for name in ("num_cpus", "cpus_per_run"):
        asked = getattr(resources, name)
        if asked is not None and asked > here:
            raise ClusterError(
                f"resources.{name} must be <= {here}, the CPUs of this machine, got {asked}"
            )
    return resources.num_cpus


def check_memory_and_gpus(resources: Resources) -> None:
    """Check that this machine can hold a run; with a cluster, do nothing.

    Raises:
        ClusterError: This machine has less memory or fewer GPUs than a run reserves.
    """
    if cluster_address() is not None:
        return
    reserved, gpus = resources.memory_per_run, resources.gpus_per_run
    if reserved is not None and reserved > (here := free_memory() / 2**30):
        raise ClusterError(
            f"resources.memory_per_run must be <= {math.floor(here * 10) / 10:g}, the GiB of "
            f"memory of this machine that are free, got {reserved:g}"
        )
    if gpus and gpus > (count := _gpu_count()):
        raise ClusterError(
            f"resources.gpus_per_run must be <= {count}, the GPUs of this machine that PyTorch "
            f"can use, got {gpus:g}"
        )


def cpus_here() -> int:
    """Number of CPUs of this process for a local Ray.

    The share of a container counts, and that of `taskset` or of a job of Slurm.
    """
    shares = [float(len(os.sched_getaffinity(0)))]
    for text in _limits("cpu", "cpu.max"):
        quota, _, period = text.partition(" ")
        if quota.isdecimal():  # or "max"
            shares.append(int(quota) / int(period))
    quotas, periods = _limits("cpu", "cpu.cfs_quota_us"), _limits("cpu", "cpu.cfs_period_us")
    for quota, period in zip(quotas, periods, strict=True):
        if quota.isdecimal():  # or -1
            shares.append(int(quota) / int(period))
    return max(1, int(min(shares)))


def memory() -> int:
    """Bytes of memory of this machine, container, or job of a batch system."""
    limits = [int(psutil.virtual_memory().total)]
    for file in ("memory.limit_in_bytes", "memory.max"):
        limits += [int(text) for text in _limits("memory", file) if text.isdecimal()]  # or "max"
    return min(limits)


def _limits(controller: str, file: str) -> list[str]:
    """The limits of a kind for this process's cgroup and those above, of both versions of cgroups.

    A container often sees only its own, as the top one. Slurm and systemd have one for each job.
    """
    found = []
    for line in OWN_CGROUPS.read_text().splitlines() if OWN_CGROUPS.exists() else ():
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        top = CGROUPS / controller if controllers else CGROUPS
        group = top / path.strip("/")
        for folder in (group, *group.parents):
            if folder.is_relative_to(top):
                with contextlib.suppress(OSError):
                    found.append((folder / file).read_text().strip())
    return found


@cache
def free_memory() -> int:
    """Bytes of memory that other programs leave for runs; the first answer holds.

    A local Ray offers as much, so that it can hold the runs that `check_memory_and_gpus` accepted.
    """
    return min(memory(), int(psutil.virtual_memory().available))


def _gpu_count() -> int:
    import torch  # slow to load, and needed only if a sweep asks for GPUs

    return torch.cuda.device_count()


PACKAGES = (
    "music-rllib",
    "ray",
    "torch",
    "numpy",
    "gymnasium",
    "gymnasium-robotics",
    "mujoco",
    "optuna",
    "mlflow",
)
GIT_SECONDS = 5.0


@cache
def provenance_tags() -> dict[str, str]:
    """Versions of the packages that determine a result, and the git commit of a checkout."""
    tags = {names.TAG_VERSION_PREFIX + "python": platform.python_version()}
    for package in PACKAGES:
        try:
            tags[names.TAG_VERSION_PREFIX + package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    commit = git_commit(Path(music_rllib.__file__))
    return tags if commit is None else {**tags, names.TAG_GIT_COMMIT: commit}


def git_commit(file: Path) -> str | None:
    """Commit of the repository that tracks `file`, with `-dirty` if it has uncommitted changes.

    None if no repository tracks it. The virtual environment of an installed package may be inside
    the checkout of another project.
    """
    folder = file.resolve().parent
    if _git(folder, "ls-files", "--error-unmatch", file.name) is None:
        return None
    commit = _git(folder, "rev-parse", "HEAD")
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}-dirty" if commit and changed else commit


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(  # noqa: S603 - fixed commands, no shell
            ["git", "-C", str(folder), *arguments],  # noqa: S607 - the user's own git
            capture_output=True,
            text=True,
            timeout=GIT_SECONDS,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
