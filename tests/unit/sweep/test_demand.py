"""Memory of runs, by their settings."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from music_rllib.config.run_settings import RunSettings
from music_rllib.errors import BadInputError
from music_rllib.runtime.ray_cluster import Capacity
from music_rllib.sweep.preflight import check_demand, check_memory
from tests.sweep_files import loaded

GIB = 2**30


def run(tmp_path: Any, **defaults: Any) -> RunSettings:
    document = {
        "name": "s",
        "tasks": ["FetchPush"],
        "defaults": defaults,
        "stages": [{"name": "a", "variant": "music-u"}],
    }
    return loaded(tmp_path, document).stages[0].points[0].runs["FetchPush"]


@pytest.mark.parametrize(
    ("defaults", "setting"),
    [
        ({"tac": {"hidden_sizes": [10**9, 10**9]}}, "tac.hidden_sizes"),
        ({"tac": {"hidden_sizes": [100_000, 100_000]}}, "tac.hidden_sizes"),
        ({"tac": {"batch_size": 10**9}}, "tac.batch_size"),
        ({"replay": {"capacity": 10**18}}, "replay.capacity"),
        ({"replay": {"capacity": 10**9}, "env_steps": 10**9}, "replay.capacity"),
        ({"evaluation": {"episodes": 10**12}}, "evaluation.episodes"),
        ({"num_envs": 10**7, "replay": {"capacity": 10**9}}, "num_envs"),
        ({"tac": {"hidden_sizes": [10**99]}}, "tac.hidden_sizes"),
    ],
)
def test_a_run_that_does_not_fit_into_memory_is_refused(
    tmp_path: Any, defaults: dict[str, Any], setting: str
) -> None:
    asked = run(tmp_path, **defaults)
    with pytest.raises(
        BadInputError, match=f"^stage a: {setting} must fit into .* got "
    ) as refused:
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


def test_the_largest_node_of_a_cluster_must_hold_a_run(tmp_path: Any) -> None:
    """Unless an autoscaler may add larger ones."""
    asked = run(tmp_path, tac={"hidden_sizes": [20_000, 20_000]})  # 25 GiB
    node = SimpleNamespace(stage="a", key="k", run=asked)
    plan = SimpleNamespace(nodes=[node], searched=())
    sweep: Any = SimpleNamespace(plan=plan, is_finished=lambda _: False)
    with pytest.raises(BadInputError, match=r"of the cluster's largest node, 4\.0 GiB, got"):
        check_demand(sweep, Capacity(now=1, memory=4 * GIB).node_memory)
    check_demand(sweep, Capacity(now=0, grows=True, memory=4 * GIB).node_memory)
