"""How many runs a cluster can hold at once, and which it can never hold."""

from __future__ import annotations

import itertools
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import ray
from pydantic import ValidationError

from music_rllib.config.schema import Resources
from music_rllib.runtime import autoscaler, ray_cluster
from music_rllib.runtime.machine import ClusterError, ray_parent
from music_rllib.runtime.ray_cluster import WAITING, Room, _room, slots

GIB = 2.0**30
SMALL = {"CPU": 4.0, "memory": 8 * GIB}
BIG = {"CPU": 16.0, "memory": 60 * GIB, "GPU": 2.0}


def test_a_local_ray_has_a_short_folder_of_its_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its sockets are writable by all in a folder that only we may enter, and it is removed."""
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
def test_runs_are_packed_by_what_is_scarce(
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
def test_what_can_never_fit_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ClusterError, match=message):
        slots(Resources(**settings), [SMALL, BIG], local=False)


def test_cpus_here_and_memory_there_are_no_place_for_a_run() -> None:
    nodes = [{"CPU": 8.0, "memory": 1 * GIB}, {"CPU": 1.0, "memory": 32 * GIB}]
    with pytest.raises(ClusterError, match=r"but all together .* on none"):
        slots(Resources(cpus_per_run=4, memory_per_run=16), nodes, local=False)


def test_a_machine_without_gpus() -> None:
    with pytest.raises(ClusterError, match="must fit into this machine, which has 0 GPUs, got 1"):
        slots(Resources(gpus_per_run=1), [SMALL], local=True)


@dataclass
class FakeCluster:
    """Replaces Ray's answers about a cluster."""

    nodes: list[dict[str, float]]
    by_type: bool = True
    """Whether the nodes have an autoscaler's types."""
    could_add: dict[str, float] = field(default_factory=dict)
    """The largest node that the autoscaler may start."""
    asked: list[Mapping[str, float]] = field(default_factory=list)

    def put_in_place(self, monkeypatch: pytest.MonkeyPatch) -> None:
        nodes = [{"Alive": True, "Resources": node} for node in self.nodes]
        dead = {"Alive": False, "Resources": {"CPU": 1000.0, "GPU": 1000.0}}
        monkeypatch.setenv("RAY_ADDRESS", "head:6379")
        monkeypatch.setattr("ray.nodes", lambda: [*nodes, dead])
        monkeypatch.setattr(autoscaler, "is_there", lambda: self.by_type)
        monkeypatch.setattr(autoscaler, "adds_nodes", self.adds_nodes)

    def adds_nodes(self, bundle: Mapping[str, float]) -> bool:
        self.asked.append(bundle)
        return all(self.could_add.get(name, 0) >= amount for name, amount in bundle.items())


HEAD = {"CPU": 1.0}


@pytest.mark.parametrize("settings", [{"cpus_per_run": 2}, {"gpus_per_run": 1}])
def test_a_run_that_a_node_is_added_for_is_not_refused(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on AWS: a head with one CPU, and workers that are started for waiting runs."""
    fake = FakeCluster([HEAD], could_add=BIG)
    fake.put_in_place(monkeypatch)
    room = _room(Resources(**settings))
    assert room == Room(now=0, grows=True)
    assert fake.asked == [Resources(**settings).bundle]
    assert room.remark is not None
    assert "autoscaler is asked for one" in room.remark
    assert (room.at_once, room.waiting) == (1, WAITING)


def test_what_no_node_that_may_be_added_could_hold_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    FakeCluster([HEAD], could_add=SMALL).put_in_place(monkeypatch)
    with pytest.raises(ClusterError, match=r"gpus_per_run must fit into one node .* 0 GPUs, got 1"):
        _room(Resources(gpus_per_run=1))


def test_runs_wait_where_nodes_are_added_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """One run fits. If only one more waited, the cluster would grow by one node at a time."""
    fake = FakeCluster([HEAD])
    fake.put_in_place(monkeypatch)
    room = _room(Resources())
    assert (room.now, room.waiting, room.remark, fake.asked) == (1, WAITING, None, [])


def test_no_more_runs_wait_than_fit_where_nothing_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeCluster([SMALL, HEAD], by_type=False).put_in_place(monkeypatch)
    room = _room(Resources())
    assert (room.now, room.at_once, room.waiting, room.remark) == (5, 5, 5, None)


@pytest.mark.parametrize(
    ("version", "by_report", "by_first", "expected"),
    [
        (3, {"cpu", "head"}, set(), True),
        (3, {""}, {"head"}, False),
        (0, {"head"}, {"head", "cpu"}, True),
        # Types of nodes that were started by `ray start`.
        (0, {""}, {"node_abc"}, False),
        (0, {""}, {"local.cluster.node"}, False),
        (0, set(), set(), False),
    ],
)
def test_an_autoscaler_is_known_by_the_types_of_its_nodes(
    version: int,
    by_report: set[str],
    by_first: set[str],
    expected: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state = autoscaler.State(version, frozenset(by_report), frozenset())
    monkeypatch.setattr("ray.nodes", lambda: [{"NodeID": "abc"}])
    monkeypatch.setattr(autoscaler, "_state", lambda: state)
    monkeypatch.setattr(autoscaler, "_types_of_the_first", lambda: frozenset(by_first))
    assert autoscaler.is_there() is expected


@pytest.mark.parametrize(
    ("infeasible", "placed_after", "expected"),
    [
        (["other:PACK|PENDING", "mine:PACK|PENDING"], 99, False),
        (["other:PACK|PENDING"], 99, True),
        ([], 1, True),
    ],
)
def test_the_autoscalers_answer_is_waited_for(
    infeasible: list[str], placed_after: int, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It reports nothing at first, and never reports a feasible request."""
    looks = itertools.count(7)

    def state() -> autoscaler.State:
        version = next(looks)
        said = frozenset(infeasible) if version > 8 else frozenset()
        return autoscaler.State(version, frozenset({"cpu"}), said)

    monkeypatch.setattr(autoscaler, "_state", state)
    waits = itertools.count(1)
    ready = lambda _: next(waits) > placed_after  # noqa: E731
    assert autoscaler._feasible("mine", ready) is expected


@pytest.mark.parametrize("settings", [{"gpus_per_run": -1}, {"memory_per_run": 0}])
def test_impossible_amounts(settings: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Resources(**settings)


def test_a_trial_asks_ray_for_all_of_it() -> None:
    """A trial reserves the bundle that was checked."""
    from music_rllib.config.load import load_sweep
    from music_rllib.experiment.plan import make_plan
    from music_rllib.sweep.driver import DEFAULT_CONFIG
    from music_rllib.training.job import NodeJob
    from music_rllib.training.worker import RunTrainable

    node = make_plan(load_sweep(DEFAULT_CONFIG)).nodes[0]
    wanted = Resources(cpus_per_run=2, gpus_per_run=0.5, memory_per_run=1.5)
    memory = int(wanted.bundle["memory"])
    job = NodeJob.of(node, "results", wanted.cpus_per_run, gpus=0.5, memory=memory)
    assert RunTrainable.default_resource_request(job.to_tune()).bundles == [wanted.bundle]
    plain = NodeJob.of(node, "results", 1)
    assert RunTrainable.default_resource_request(plain.to_tune()).bundles == [{"CPU": 1}]


@pytest.mark.parametrize("address", [None, "127.0.0.1:1"])
def test_a_ray_that_does_not_start_is_said_in_a_line(
    address: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def not_in_time(**options: Any) -> None:
        raise Exception("The current node timed out during startup.\nMore of it.")  # as Ray does

    monkeypatch.setattr(ray, "init", not_in_time)
    monkeypatch.setattr(ray_cluster, "cluster_address", lambda: address)
    with pytest.raises(ClusterError) as caught, ray_cluster.cluster(Resources()):
        pass
    said = str(caught.value)
    assert "timed out during startup" in said
    assert "\n" not in said
    assert (address or "did not start on this machine") in said
