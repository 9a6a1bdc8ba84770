"""The number of runs that a cluster can hold, and runs that it can never hold."""

from __future__ import annotations

import contextlib
import gc
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
import ray

from music_rllib.config.schema import Resources
from music_rllib.runtime import machine, ray_cluster
from music_rllib.runtime.machine import ClusterError, own_folder, ray_parent
from music_rllib.runtime.ray_cluster import WAITING, Capacity, _capacity, slots
from tests.processes import fresh

GIB = 2.0**30
SMALL = {"CPU": 4.0, "memory": 8 * GIB}
BIG = {"CPU": 16.0, "memory": 60 * GIB, "GPU": 2.0}


def test_a_local_ray_has_a_short_private_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Everybody may write to its sockets, so only this user may enter its parent folder."""
    long = tmp_path / "a-long-name-of-a-job's-folder" / ("x" * 60)
    long.mkdir(parents=True)
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    monkeypatch.setenv("RAY_TMPDIR", str(long))
    seen: list[tuple[Path, int, int]] = []

    def init(_temp_dir: str, **options: Any) -> None:
        parent = Path(_temp_dir).parent
        seen.append((parent, parent.stat().st_mode & 0o777, parent.stat().st_uid))
        socket = Path(_temp_dir, "session_2026-11-26_07-59-49_813210_4194304/sockets/plasma_store")
        assert len(os.fsencode(socket)) <= 107
        if options["num_cpus"] == 2:
            raise RuntimeError("busy")

    monkeypatch.setattr(ray, "init", init)
    ray_cluster.start_ray(num_cpus=1)
    ray_cluster.stop_ray()
    with pytest.raises(ClusterError, match="busy"):
        ray_cluster.start_ray(num_cpus=2)
    for parent, mode, owner in seen:
        assert (mode, owner, parent.exists()) == (0o700, os.getuid(), False)
    monkeypatch.setenv("RAY_TMPDIR", "/tmp/x")
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) == "/tmp/x")
    assert ray_parent() == Path("/tmp/x")
    monkeypatch.setattr(os, "access", lambda path, mode: path == long)
    with pytest.raises(ClusterError, match=r"RAY_TMPDIR must be a writable folder .* at most \d\d"):
        ray_parent()


KILLED = """
import os, signal, sys
from pathlib import Path
from music_rllib.runtime.machine import own_folder
with own_folder("music-tune-", Path(sys.argv[1])) as folder:
    Path(folder, "file").touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_folders_of_killed_processes_are_removed_at_the_next_start(tmp_path: Path) -> None:
    """It removes no other folders: of living processes, of other users, or without a lock."""
    subprocess.run([sys.executable, "-c", KILLED, tmp_path], check=False)
    (killed,) = tmp_path.iterdir()
    assert killed.name.startswith("music-tune-")
    kept = [tmp_path / name for name in ("music-tune-notes", "other-x", "music-tune-link")]
    for folder in kept[:2]:
        folder.mkdir()
    elsewhere = tmp_path.with_name(f"{tmp_path.name}-elsewhere")
    shutil.copytree(killed, elsewhere)
    kept[2].symlink_to(elsewhere)
    with (
        own_folder("music-tune-", tmp_path) as first,
        own_folder("music-tune-", tmp_path) as second,
    ):
        assert {*tmp_path.iterdir()} == {*kept, Path(first), Path(second)}
        assert Path(first).stat().st_mode & 0o777 == 0o700
    assert {*tmp_path.iterdir()} == {*kept}
    assert (elsewhere / "file").exists()


NEVER, ALWAYS = 4_194_304, 1
"""An id that no process has, one more than Linux's largest, and the id of the first process."""


@pytest.mark.parametrize(
    ("file", "process", "hours", "removed"),
    [
        ("logs/x", NEVER, 7, True),
        ("logs/x", NEVER, 5, False),
        ("logs/x", ALWAYS, 7, False),
        ("../../notes", NEVER, 7, False),
        ("../notes", NEVER, 7, False),
    ],
)
def test_a_folder_that_a_dying_ray_makes_again_is_removed_hours_later(
    file: str, process: int, hours: int, removed: bool, tmp_path: Path
) -> None:
    """It has no lock, its process has ended, and nothing else is in it."""
    session = tmp_path / "mr-0_a1b2c3" / "r" / f"session_2026-11-26_23-29-15_979549_{process}"
    (session / "logs").mkdir(parents=True)
    (session / file).touch()
    (session.parent / "session_latest").symlink_to(session)
    then = time.time() - 3600 * hours
    for path in (folder := session.parents[1]).rglob("*"):
        os.utime(path, (then, then), follow_symlinks=False)
    with own_folder("mr-", tmp_path):
        assert folder.exists() != removed


def test_a_folder_is_removed_without_a_warning_if_its_owner_is_collected(tmp_path: Path) -> None:
    owner: list[Any] = [contextlib.ExitStack()]
    owner[0].enter_context(own_folder("mr-", tmp_path))
    owner.append(owner)
    assert [*tmp_path.iterdir()]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        del owner
        gc.collect()
    assert (caught, [*tmp_path.iterdir()]) == ([], [])


NEVER_CLOSED = """
import sys
from contextlib import ExitStack
from pathlib import Path
from music_rllib.runtime.machine import own_folder
owner = ExitStack()
owner.enter_context(own_folder("mr-", Path(sys.argv[1])))
owner.itself = owner
"""


def test_a_folder_is_removed_silently_if_its_owner_is_never_closed(tmp_path: Path) -> None:
    """The process ends, and Python finalizes the owner after that."""
    ended = fresh("-c", NEVER_CLOSED, tmp_path)
    assert (ended.stderr, [*tmp_path.iterdir()]) == ("", [])


@pytest.mark.parametrize(
    ("settings", "nodes", "expected"),
    [
        ({}, [SMALL, BIG], 20),
        ({"cpus_per_run": 3}, [SMALL, BIG], 1 + 5),
        ({"cpus_per_run": 5}, [SMALL, BIG], 0 + 3),
        ({"gpus_per_run": 1}, [SMALL, BIG], 2),
        ({"gpus_per_run": 0.25}, [SMALL, BIG], 8),
        ({"gpus_per_run": 0.1}, [{"CPU": 64.0, "GPU": 1.0}], 10),
        ({"memory_per_run": 3}, [SMALL, BIG], 2 + 16),
        ({"memory_per_run": 10}, [SMALL, BIG], 0 + 6),
        ({"cpus_per_run": 2, "gpus_per_run": 0.5, "memory_per_run": 20}, [SMALL, BIG], 3),
    ],
)
def test_the_scarcest_resource_limits_the_number_of_runs(
    settings: dict[str, Any], nodes: list[dict[str, float]], expected: int
) -> None:
    assert slots(Resources(**settings), nodes, local=False) == expected


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cpus_per_run": 17}, "cpus_per_run must fit into one node .* has 16 CPUs, got 17"),
        ({"gpus_per_run": 3}, "gpus_per_run must fit into one node .* has 2 GPUs, got 3"),
        ({"memory_per_run": 61}, "memory_per_run must fit .* has 60 GiB of memory .*, got 61"),
    ],
)
def test_a_run_that_can_never_fit_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ClusterError, match=message):
        slots(Resources(**settings), [SMALL, BIG], local=False)


def put_limits(
    monkeypatch: pytest.MonkeyPatch, folder: Path, cpus: str, memory: str, job: str = ""
) -> None:
    """Replace this process's cgroup by one of version 2 with these limits."""
    (folder / "cgroup" / job).mkdir(parents=True, exist_ok=True)
    (folder / "cgroup" / job / "cpu.max").write_text(cpus)
    (folder / "cgroup" / job / "memory.max").write_text(memory)
    (folder / "own").write_text(f"0::/{job}\n")
    monkeypatch.setattr(machine, "CGROUPS", folder / "cgroup")
    monkeypatch.setattr(machine, "OWN_CGROUPS", folder / "own")


def test_a_run_that_needs_more_cpus_than_the_container_has_is_refused_before_it_is_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {*range(64)})
    put_limits(monkeypatch, tmp_path, "200000 100000", "max")
    for settings in ({"cpus_per_run": 4}, {"num_cpus": 4}):
        with pytest.raises(ClusterError, match="must be <= 2, the CPUs of this machine, got 4"):
            machine.check_cpus(Resources(**settings))
    assert machine.check_cpus(Resources(cpus_per_run=2, num_cpus=2)) == 2


def test_the_memory_is_that_of_a_batch_systems_job(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Also if the process is in a step of the job, which has no limit of its own."""
    put_limits(monkeypatch, tmp_path, "max 100000", str(2**30), "slurm/job_7")
    assert machine.memory() == 2**30
    put_limits(monkeypatch, tmp_path, "max 100000", "max", "slurm/job_7/step_0/task_0")
    assert machine.memory() == 2**30
    (tmp_path / "own").write_text("4:memory:/slurm/job_8\n0::/\n")
    (tmp_path / "cgroup/memory/slurm/job_8").mkdir(parents=True)
    (tmp_path / "cgroup/memory/slurm/job_8/memory.limit_in_bytes").write_text("4096\n")
    assert machine.memory() == 4096


def test_a_part_of_a_gpu_is_of_one_gpu() -> None:
    assert slots(Resources(gpus_per_run=0.4), [{"CPU": 64.0, "GPU": 2.0}], local=False) == 4
    assert slots(Resources(gpus_per_run=0.3), [{"CPU": 64.0, "GPU": 8.0}], local=False) == 24
    with pytest.raises(ValueError, match="gpus_per_run must be a whole number above 1"):
        Resources(gpus_per_run=1.5)


def test_a_local_ray_has_the_cpus_of_this_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Ray itself would count those that `taskset` or Slurm gives to others."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    started: list[int] = []
    monkeypatch.setattr(ray_cluster, "start_ray", lambda num_cpus, **_: started.append(num_cpus))
    monkeypatch.setattr(ray_cluster, "_wait_for_nodes", lambda *_: None)
    for affinity, share, asked in ((8, 128, None), (128, 2, None), (8, 128, 2)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, count=affinity: {*range(count)})
        put_limits(monkeypatch, tmp_path, f"{share}00000 100000", "max")
        with ray_cluster.cluster(Resources(num_cpus=asked)):
            pass
    assert started == [8, 2, 2]


def test_one_node_must_have_all_resources_of_a_run() -> None:
    nodes = [{"CPU": 8.0, "memory": 1 * GIB}, {"CPU": 1.0, "memory": 32 * GIB}]
    with pytest.raises(ClusterError, match=r"but all together .* on none"):
        slots(Resources(cpus_per_run=4, memory_per_run=16), nodes, local=False)


def test_a_machine_without_gpus_is_named() -> None:
    with pytest.raises(ClusterError, match="must fit into this machine, which has 0 GPUs, got 1"):
        slots(Resources(gpus_per_run=1), [SMALL], local=True)


HEAD = {"CPU": 1.0}


def put_cluster(
    monkeypatch: pytest.MonkeyPatch, *nodes: dict[str, float], group: str | None = "workers"
) -> None:
    """Replace Ray's list of nodes by these nodes of a group."""
    labels = {} if group is None else {"ray.io/node-group": group}
    alive = [{"Alive": True, "Resources": node, "Labels": labels} for node in nodes]
    dead = {"CPU": 1000.0, "GPU": 1000.0}
    monkeypatch.setenv("RAY_ADDRESS", "head:6379")
    monkeypatch.setattr("ray.nodes", lambda: [*alive, {"Alive": False, "Resources": dead}])


@pytest.mark.parametrize("settings", [{"cpus_per_run": 2}, {"gpus_per_run": 1}])
def test_a_run_waits_for_a_node_on_a_cluster_that_grows(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on AWS: a head with one CPU, and workers that start for waiting runs."""
    put_cluster(monkeypatch, HEAD)
    capacity = _capacity(Resources(**settings))
    assert capacity == Capacity(now=0, grows=True)
    assert capacity.remark is not None
    assert "waits until its autoscaler adds one" in capacity.remark
    assert (capacity.at_once, capacity.waiting) == (1, WAITING)


@pytest.mark.parametrize("group", [None, "local.cluster.node"])
def test_a_run_that_does_not_fit_is_refused_on_a_fixed_cluster(
    group: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_cluster(monkeypatch, HEAD, group=group)
    with pytest.raises(ClusterError, match=r"gpus_per_run must fit into one node .* 0 GPUs, got 1"):
        _capacity(Resources(gpus_per_run=1))


def test_a_sweep_waits_for_nodes_after_a_restart_of_the_head(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without a worker the largest node has 0 CPUs, which is not the fault of the sweep."""
    said: list[str] = []
    monkeypatch.setattr(ray_cluster, "start_ray", lambda **_: None)
    monkeypatch.setattr(ray_cluster, "LOOK_SECONDS", 0.01)
    put_cluster(monkeypatch, {}, group=None)

    def say(message: str) -> None:
        said.append(message)
        put_cluster(monkeypatch, {}, SMALL, group=None)

    with ray_cluster.cluster(Resources(), None, say) as capacity:
        assert (capacity.now, capacity.nodes) == (4, 2)
    assert said[0].endswith("; waiting up to 5 minutes for nodes (--wait-for-nodes)")
    put_cluster(monkeypatch, {}, group=None)
    for minutes in (0.0, 0.001):
        with (
            pytest.raises(ClusterError, match=r"no node with CPUs has joined its head yet"),
            ray_cluster.cluster(Resources(), minutes),
        ):
            pass
    put_cluster(monkeypatch, HEAD, group=None)
    with (
        pytest.raises(ClusterError, match=r"got 2$"),
        ray_cluster.cluster(Resources(cpus_per_run=2)),
    ):
        pass


def test_many_runs_wait_if_nodes_are_added_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """One run fits. If only one more waited, the cluster would add one node at a time."""
    put_cluster(monkeypatch, HEAD)
    capacity = _capacity(Resources())
    assert (capacity.now, capacity.waiting, capacity.remark) == (1, WAITING, None)


def test_only_as_many_runs_wait_as_fit_on_a_fixed_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    put_cluster(monkeypatch, SMALL, HEAD, group=None)
    capacity = _capacity(Resources())
    assert (capacity.now, capacity.at_once, capacity.waiting, capacity.remark) == (5, 5, 5, None)


@pytest.mark.parametrize("address", [None, "127.0.0.1:1"])
def test_a_ray_that_does_not_start_is_reported_in_one_line(
    address: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def not_in_time(**options: Any) -> None:
        raise Exception("The current node timed out during startup.\nMore of it.")  # as Ray does

    monkeypatch.setattr(ray, "init", not_in_time)
    monkeypatch.setattr(ray_cluster, "cluster_address", lambda: address)
    with pytest.raises(ClusterError) as caught, ray_cluster.cluster(Resources()):
        pass
    assert caught.value.exit_code == (1 if address is None else 2)
    said = str(caught.value)
    assert "timed out during startup" in said
    assert "\n" not in said
    assert (address or "did not start on this machine") in said
