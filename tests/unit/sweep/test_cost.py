"""Cost of a plan: kinds of runs, and the arithmetic with their speeds."""

from pathlib import Path
from typing import Any

import pytest

from music_rllib.experiment.plan import make_plan
from music_rllib.runtime import machine
from music_rllib.sweep.views import cost
from music_rllib.sweep.views.cost import RunGroup, run_groups
from music_rllib.training.sample_run import RunSample
from tests.sweep_files import loaded


def kinds(folder: Path, finished: int = 0, **changes: Any) -> list[RunGroup]:
    document: dict[str, Any] = {
        "name": "s",
        "tasks": ["FetchPush", "FetchSlide"],
        "seeds": [0, 1],
        "defaults": {"env_steps": 10_000, "tac": {"random_steps": 1_000, "replay_ratio": 0.5}},
        "stages": [
            {
                "name": "t",
                "variant": "tac",
                "grid": {"tac.entropic_index": [1, 2], "tac.hidden_sizes": [[8], [64]]},
            },
        ],
    }
    config = loaded(folder, document | changes)
    plan = make_plan(config)
    return run_groups(config, plan, {node.key for node in plan.nodes[:finished]})


def test_runs_of_one_task_differ_in_cost_by_their_networks_and_not_by_q(tmp_path: Path) -> None:
    found = kinds(tmp_path)
    assert [(kind.label, kind.runs, kind.settings.tac.hidden_sizes) for kind in found] == [
        ("t/FetchPush", 4, (8,)),
        ("t/FetchSlide", 4, (8,)),
        ("t/FetchPush", 4, (64,)),
        ("t/FetchSlide", 4, (64,)),
    ]
    assert {kind.grad_updates for kind in found} == {4_500}
    assert sum(kind.runs for kind in kinds(tmp_path, finished=5)) == 16 - 5


def test_a_search_counts_with_its_largest_number_of_runs(tmp_path: Path) -> None:
    search = {
        "trials": 5,
        "space": {"tac.alpha": {"float": [0.01, 0.1], "log": True}},
        "final": {"trials": 2, "seeds": 3},
    }
    stages = [{"name": "t", "variant": "tac", "search": search}]
    (push, slide) = kinds(tmp_path, stages=stages)
    assert (push.label, push.runs, push.env_steps) == ("t/FetchPush", 5 * 2 + 2 * 3, 10_000)
    assert (slide.label, slide.runs) == ("t/FetchSlide", 16)


@pytest.mark.parametrize(
    ("space", "sources", "trials"),
    [
        ({"tac.alpha": {"float": [0.01, 0.1]}}, [2, 3], 5),
        # A space of three points ends after three trials.
        ({"u:tac.alpha": {"choice": [0.1, 0.2, 0.3]}}, [3 * 2 + 2 * 3], 3),
        ({"u:tac.alpha": {"float": [0.01, 0.1]}}, [5 * 2 + 2 * 3], 5),
    ],
)
def test_what_trials_start_from_counts(
    space: dict[str, Any], sources: list[int], trials: int, tmp_path: Path
) -> None:
    search = {"trials": 5, "space": space, "final": {"trials": 2, "seeds": 3}}
    stages = [
        {"name": "u", "variant": "music-u"},
        {"name": "r", "variant": "music-r", "init_from": "u", "search": search},
    ]
    found = [(one.label, one.runs) for one in kinds(tmp_path, tasks=["FetchPush"], stages=stages)]
    in_source = [("u/FetchPush", runs) for runs in sources]
    assert found == [*in_source, ("r/FetchPush", trials * 2 + 2 * 3)]


SAMPLE = RunSample(
    start_seconds=5.0, steps_per_second=100.0, evaluation_seconds=3.0, memory=3 * 2**29
)


def costs(folder: Path, slots: int) -> dict[str, Any]:
    return cost.cost_of([(group, SAMPLE) for group in kinds(folder)], slots)


def test_the_time_is_training_evaluations_and_start(tmp_path: Path) -> None:
    # 10,000 steps, an evaluation every 5,000 and one at the start.
    a_run = 100.0 + 3 * 3.0 + 5.0
    document = costs(tmp_path, slots=4)
    assert document["seconds"] == pytest.approx(16 * a_run / 4)
    assert document["kinds"][0]["seconds"] == pytest.approx(4 * a_run)
    assert costs(tmp_path, slots=100)["seconds"] == pytest.approx(a_run)
    assert cost.cost_of([], slots=2) == {"kinds": [], "runs_at_once": 2, "seconds": 0.0}


@pytest.mark.parametrize(
    ("here", "told"),
    [
        (16, "Together they need up to 6.0 of this machine's 16.0 GiB of memory."),
        (4, "this machine has 4.0. Set resources.memory_per_run to 1.5."),
    ],
)
def test_runs_that_no_memory_holds_side_by_side_are_told_of(
    here: int, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr(machine, "memory", lambda: here * 2**30)
    view = cost.cost_view(costs(tmp_path, slots=4))
    assert any(told in str(line) for line in view.renderables)


@pytest.mark.parametrize(
    ("search", "runs", "env_steps"),
    [
        (  # each compared value has its own points of a range
            {
                "mode": "compare",
                "compare": {"tac.entropic_index": [1.0, 1.5, 2.0]},
                "space": {"u:tac.alpha": {"float": [0.01, 0.1]}},
            },
            3 * 4 * 2,
            10_000,
        ),
        (  # without the setting, the stage has its own value
            {
                "space": {
                    "tac.bootstrap": {"choice": ["value", "critics"]},
                    "u:tac.alpha": {"choice": [0.1, 0.3], "when": {"tac.bootstrap": "critics"}},
                }
            },
            3 * 2,
            10_000,
        ),
        (
            {"space": {"tac.alpha": {"choice": [0.1, 0.3]}, "u:tac.alpha": {"choice": [0.3]}}},
            1 * 2,
            10_000,
        ),
        ({"space": {"u:env_steps": {"choice": [10_000, 20_000]}}}, 2 * 2, 20_000),
    ],
)
def test_no_more_sources_are_trained_than_the_plan_says(
    search: dict[str, Any], runs: int, env_steps: int, tmp_path: Path
) -> None:
    stages = [
        {"name": "u", "variant": "music-u"},
        {
            "name": "r",
            "variant": "music-r",
            "init_from": "u",
            "search": {"trials": 4, "final": None} | search,
        },
    ]
    found = kinds(tmp_path, tasks=["FetchPush"], stages=stages)
    assert [(one.runs, one.env_steps) for one in found if one.stage == "u"] == [(runs, env_steps)]
