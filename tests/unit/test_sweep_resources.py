"""How many runs fit side by side, and what never fits."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from music_rllib.experiment.model import Resources
from music_rllib.sweep.cluster import slots
from music_rllib.sweep.local import ClusterError

GIB = 2.0**30
SMALL = {"CPU": 4.0, "memory": 8 * GIB}
BIG = {"CPU": 16.0, "memory": 60 * GIB, "GPU": 2.0}


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


@pytest.mark.parametrize("settings", [{"gpus_per_run": -1}, {"memory_per_run": 0}])
def test_impossible_amounts(settings: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Resources(**settings)


def test_a_trial_asks_ray_for_all_of_it() -> None:
    """The bundle of a trial is the one that was checked."""
    from music_rllib.experiment.config import load_sweep
    from music_rllib.experiment.plan import make_plan
    from music_rllib.sweep.driver import DEFAULT_CONFIG
    from music_rllib.sweep.trainable import NodeJob, RunTrainable

    node = make_plan(load_sweep(DEFAULT_CONFIG)).nodes[0]
    wanted = Resources(cpus_per_run=2, gpus_per_run=0.5, memory_per_run=1.5)
    memory = int(wanted.bundle["memory"])
    job = NodeJob.of(node, "results", wanted.cpus_per_run, gpus=0.5, memory=memory)
    assert RunTrainable.default_resource_request(job.to_tune()).bundles == [wanted.bundle]
    plain = NodeJob.of(node, "results", 1)
    assert RunTrainable.default_resource_request(plain.to_tune()).bundles == [{"CPU": 1}]
