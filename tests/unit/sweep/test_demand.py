"""Memory and time that runs need, by their settings."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
import yaml

from music_rllib.config.load import load_config
from music_rllib.config.run_settings import RunSettings
from music_rllib.runtime.ray_cluster import Capacity
from music_rllib.sweep.preflight import (
    DemandError,
    _network_numbers,
    check_demand,
    check_memory,
    long_runs,
)
from music_rllib.tac.networks import Critics, Perceptron

GIB = 2**30


def run(tmp_path: Any, **defaults: Any) -> RunSettings:
    document = {
        "name": "s",
        "tasks": ["FetchPush"],
        "defaults": defaults,
        "stages": [{"name": "a", "variant": "music-u"}],
    }
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump(document))
    return load_config(path).stages[0].points[0].runs["FetchPush"]


@pytest.mark.parametrize(
    ("defaults", "setting"),
    [
        ({"tac": {"hidden_sizes": [10**9, 10**9]}}, "tac.hidden_sizes"),
        ({"tac": {"hidden_sizes": [100_000, 100_000]}}, "tac.hidden_sizes"),
        ({"tac": {"batch_size": 10**8}}, "tac.batch_size and tac.hidden_sizes"),
        ({"replay": {"capacity": 10**18}}, "replay.capacity"),
        ({"replay": {"capacity": 10**9}, "env_steps": 10**9}, "replay.capacity"),
        ({"evaluation": {"episodes": 10**12}}, "evaluation.episodes"),
        ({"music": {"hidden_size": 10**9}}, "music.batch_trajectories and music.hidden_size"),
        (
            {"music": {"batch_trajectories": 10**7}},
            "music.batch_trajectories and music.hidden_size",
        ),
        ({"num_envs": 10**7, "replay": {"capacity": 10**9}}, "num_envs"),
        ({"tac": {"hidden_sizes": [10**99]}}, "tac.batch_size and tac.hidden_sizes"),
    ],
)
def test_a_run_that_does_not_fit_into_memory_is_refused(
    tmp_path: Any, defaults: dict[str, Any], setting: str
) -> None:
    asked = run(tmp_path, **defaults)
    with pytest.raises(DemandError, match=f"^stage a: {setting} must fit into .* got ") as refused:
        check_memory([("a", asked)], "this machine", 8 * GIB)
    assert len(str(refused.value)) < 500


@pytest.mark.parametrize(
    "defaults",
    [
        {},
        {"replay": {"capacity": 10**7}},
        {"tac": {"hidden_sizes": [1024] * 3, "batch_size": 4096}, "env_steps": 10**7},
        {"evaluation": {"episodes": 1000}},
    ],
)
def test_usual_settings_are_accepted(tmp_path: Any, defaults: dict[str, Any]) -> None:
    asked = run(tmp_path, **defaults)
    check_memory([("a", asked)], "this machine", 8 * GIB)
    assert list(long_runs([("a", asked)])) == []


@pytest.mark.parametrize("hidden_sizes", [[7], [256, 256, 256], [3, 11]])
def test_network_sizes_match_the_networks(tmp_path: Any, hidden_sizes: list[int]) -> None:
    asked = run(tmp_path, tac={"hidden_sizes": hidden_sizes})
    made = [Perceptron(25, hidden_sizes, 1), Perceptron(25, hidden_sizes, 1)]
    numbers = sum(weight.numel() for network in made for weight in network.parameters())
    critics = sum(weight.numel() for weight in Critics(26, hidden_sizes).parameters())
    value = numbers // 2
    assert _network_numbers(asked, 25) == 4 * (numbers + critics) + value
    assert torch.finfo(torch.float32).bits == 32


@pytest.mark.parametrize(
    "defaults",
    [
        {"env_steps": 10**12},
        {"tac": {"replay_ratio": 1e12}},
        {"evaluation": {"interval": 1, "episodes": 10**5}},
    ],
)
def test_a_run_of_years_prints_one_warning(tmp_path: Any, defaults: dict[str, Any]) -> None:
    asked = run(tmp_path, **defaults)
    (line,) = long_runs([("a", asked), ("a", asked)])
    assert line.startswith("stage a: a run on FetchPush takes at least ")


def test_the_largest_node_of_a_cluster_must_hold_a_run(tmp_path: Any) -> None:
    """Unless an autoscaler may add larger ones."""
    asked = run(tmp_path, tac={"hidden_sizes": [20_000, 20_000]})  # 25 GiB
    node = SimpleNamespace(stage="a", key="k", run=asked)
    config, plan = SimpleNamespace(stages=()), SimpleNamespace(nodes=[node])
    sweep: Any = SimpleNamespace(plan=plan, config=config, finished=set())
    with pytest.raises(DemandError, match=r"of the cluster's largest node, 4\.0 GiB, got"):
        check_demand(sweep, Capacity(now=1, memory=4 * GIB).node_memory)
    assert check_demand(sweep, Capacity(now=0, grows=True, memory=4 * GIB).node_memory) == []
