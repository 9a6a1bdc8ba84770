"""What runs need of memory and time, by their settings alone."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import yaml

from music_rllib.config.load import load_sweep
from music_rllib.config.run_settings import RunSettings
from music_rllib.experiment.demand import (
    DemandError,
    Machine,
    _network_numbers,
    check_memory,
    least_memory,
    long_runs,
)
from music_rllib.runtime.ray_cluster import Capacity
from music_rllib.tac.networks import Critics, Perceptron

GIB = 2**30
MACHINE = Machine("this machine", 8 * GIB, 10 * GIB)


def run(tmp_path: Any, **defaults: Any) -> RunSettings:
    document = {
        "name": "s",
        "tasks": ["FetchPush"],
        "defaults": defaults,
        "stages": [{"name": "a", "variant": "music-u"}],
    }
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump(document))
    return load_sweep(path).stages[0].points[0].runs["FetchPush"]


@pytest.mark.parametrize(
    ("defaults", "setting"),
    [
        ({"tac": {"hidden_sizes": [10**9, 10**9]}}, "tac.hidden_sizes"),
        ({"tac": {"hidden_sizes": [100_000, 100_000]}}, "tac.hidden_sizes"),
        ({"tac": {"batch_size": 10**8}}, "tac.batch_size"),
        ({"replay": {"capacity": 10**18}}, "replay.capacity"),
        ({"replay": {"capacity": 10**9}, "env_steps": 10**9}, "replay.capacity"),
        ({"evaluation": {"episodes": 10**12}}, "evaluation.episodes"),
        ({"music": {"hidden_size": 10**9}}, "music.hidden_size"),
        ({"music": {"batch_trajectories": 10**7}}, "music.batch_trajectories"),
        ({"num_envs": 10**7, "replay": {"capacity": 10**9}}, "num_envs"),
        ({"tac": {"hidden_sizes": [10**99]}}, "tac.hidden_sizes"),
    ],
)
def test_what_cannot_be_held_is_refused(
    tmp_path: Any, defaults: dict[str, Any], setting: str
) -> None:
    asked = run(tmp_path, **defaults)
    with pytest.raises(DemandError, match=f"^stage a: {setting} must fit into .* got ") as refused:
        check_memory([("a", asked)], MACHINE)
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
def test_what_can_be_held_is_not(tmp_path: Any, defaults: dict[str, Any]) -> None:
    asked = run(tmp_path, **defaults)
    check_memory([("a", asked)], MACHINE)
    assert list(long_runs([("a", asked)])) == []


@pytest.mark.parametrize("hidden_sizes", [[7], [256, 256, 256], [3, 11]])
def test_the_networks_are_those_that_are_made(tmp_path: Any, hidden_sizes: list[int]) -> None:
    """Below, by what the actions take, which the settings don't tell."""
    asked = run(tmp_path, tac={"hidden_sizes": hidden_sizes})
    made = [Perceptron(25, hidden_sizes, 1), Perceptron(25, hidden_sizes, 1)]
    numbers = sum(weight.numel() for network in made for weight in network.parameters())
    critics = sum(weight.numel() for weight in Critics(26, hidden_sizes).parameters())
    value = numbers // 2
    assert _network_numbers(asked, 25) == 4 * (numbers + critics) + value
    assert torch.finfo(torch.float32).bits == 32


def test_a_replay_costs_what_it_is_filled_with(tmp_path: Any) -> None:
    small = run(tmp_path, env_steps=20_000)
    large = run(tmp_path, env_steps=20_000, replay={"capacity": 50_000_000})
    assert least_memory(large) == least_memory(small)
    full = run(tmp_path, env_steps=50_000_000, replay={"capacity": 50_000_000})
    assert least_memory(full) - least_memory(small) == (50_000_000 - 20_000) * 4 * (6 + 3)


@pytest.mark.parametrize(
    ("defaults", "said"),
    [
        ({"env_steps": 10**12}, "with env_steps 1000000000000"),
        ({"tac": {"replay_ratio": 1e12}}, "with tac.replay_ratio 1000000000000.0"),
        ({"evaluation": {"interval": 1, "episodes": 10**5}}, "with evaluation.episodes 100000"),
    ],
)
def test_what_takes_years_is_said(tmp_path: Any, defaults: dict[str, Any], said: str) -> None:
    asked = run(tmp_path, **defaults)
    (line,) = long_runs([("a", asked), ("a", asked)])
    assert said in line
    assert "on FetchPush takes " in line


def test_a_cluster_is_asked_only_where_it_matters(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By what its largest node has; one that grows may get a larger one."""
    import contextlib
    from types import SimpleNamespace

    from music_rllib.experiment import demand

    asked: list[Any] = []
    room = Capacity(now=1, memory=4 * GIB)

    @contextlib.contextmanager
    def cluster(resources: Any) -> Any:
        asked.append(resources)
        yield room

    monkeypatch.setattr("music_rllib.runtime.ray_cluster.cluster", cluster)
    monkeypatch.setattr("music_rllib.runtime.machine.check_reachable", lambda _: None)
    monkeypatch.setenv("RAY_ADDRESS", "head:6379")

    def check(**defaults: Any) -> list[str]:
        node = SimpleNamespace(stage="a", key="k", run=run(tmp_path, **defaults))
        config = SimpleNamespace(stages=(), resources="those")
        plan = SimpleNamespace(nodes=[node])
        return demand.check_demand(SimpleNamespace(plan=plan, config=config, finished=set()))  # type: ignore[arg-type]

    assert (check(), asked) == ([], [])
    huge = {"tac": {"hidden_sizes": [20_000, 20_000]}}  # 25 GiB
    with pytest.raises(DemandError, match=r"of the cluster's largest node, 4\.0 GiB, got"):
        check(**huge)
    assert asked == ["those"]
    room = Capacity(now=0, grows=True, memory=4 * GIB)
    assert check(**huge) == []
