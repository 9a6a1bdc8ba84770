"""Searches: what a trial is worth, and mistakes in their settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from music_rllib.experiment.config import load_sweep
from music_rllib.experiment.problems import ConfigError
from music_rllib.experiment.result import Report
from music_rllib.experiment.space import Objective, Pruning, Rung
from music_rllib.search.judge import aggregate, prune, score
from music_rllib.tracking import names
from tests.played_search import Document, document


@pytest.mark.parametrize(
    ("how", "expected"),
    [("iqm", 4.0), ("mean", 14.0), ("median", 4.0), ("worst_task", 2.5)],
)
def test_aggregates(how: str, expected: float) -> None:
    # Two tasks in columns, four seeds: 1..4 and 4, 5, 6, 87; the middle half is 3, 4, 4, 5.
    scores = np.array([[1.0, 4.0], [2.0, 5.0], [3.0, 6.0], [4.0, 87.0]])
    assert aggregate(Objective(aggregate=how), scores) == pytest.approx(expected)


def test_the_worst_task_of_something_minimised_is_the_highest() -> None:
    objective = Objective(aggregate="worst_task", direction="minimize")
    assert aggregate(objective, np.array([[1.0, 9.0], [3.0, 11.0]])) == 10.0


@pytest.mark.parametrize(
    ("objective", "expected"),
    [
        ({}, 0.5),
        ({"read": "best"}, 0.8),
        ({"read": "mean"}, 0.5),
        ({"read": "steps_to", "threshold": 0.6}, 2000.0),
        ({"read": "steps_to", "threshold": 0.9}, 5000.0),
        ({"metric": "env_steps"}, 3000.0),
    ],
)
def test_a_runs_number(objective: Document, expected: float) -> None:
    history = [
        Report(env_steps=1000 * at, seconds=0, timestamp_ms=0, metrics={names.EVAL_SUCCESS: value})
        for at, value in ((1, 0.2), (2, 0.8), (3, 0.5))
    ]
    assert score(Objective(**objective), history, 5000) == pytest.approx(expected)


def test_a_trial_is_stopped_only_if_its_interval_says_so() -> None:
    pruning = Pruning(rungs=(Rung(seeds=2),), keep=0.3, confidence=0.9)
    others = {n: np.array([[0.7 + 0.01 * n], [0.72 + 0.01 * n]]) for n in range(6)}

    def verdict(values: list[float]) -> Any:
        scores = np.array(values)[:, None]
        return prune(Objective(), pruning, scores=scores, others=others, place="here")

    assert verdict([0.2, 0.22]).stop
    assert "[0.1" in verdict([0.2, 0.22]).reason
    assert not verdict([0.9, 0.9]).stop
    wide = verdict([0.2, 0.9])
    assert not wide.stop
    assert "its interval" in wide.reason
    lower = Objective(direction="minimize")
    worse = prune(lower, pruning, scores=np.array([[2.0], [2.1]]), others=others, place="here")
    assert worse.stop


@pytest.mark.parametrize("name", ["search", "compare"])
def test_the_shipped_examples_are_sound(name: str) -> None:
    config = load_sweep(Path(__file__).parents[2] / f"tune_configs/{name}.yaml")
    settings = config.stages[-1].search
    assert settings is not None
    assert settings.mode == name


# --- mistakes ----------------------------------------------------------------------------------

MISTAKES: list[tuple[Document, str]] = [
    ({"trials": None}, "search.trials must be given with sampler: tpe, got null"),
    (
        {"space": {"tac.alpha": {"float": [0.5, 0.1]}}},
        "search.space.tac.alpha must be [lowest, highest], got [0.5, 0.1]",
    ),
    (
        {"space": {"tac.alpha": {"float": [0.0, 0.1], "log": True}}},
        "search.space.tac.alpha must be above 0 to be searched in the logarithm",
    ),
    (
        {"space": {"tac.alpha": {"flaot": [0.0, 0.1]}}},
        "search.space.tac.alpha must have exactly one of float, int and choice",
    ),
    (
        {"space": {"tac.entropic_index": {"float": [0, 2]}}},
        "search.space.tac.entropic_index must be > 0, got 0",
    ),
    (
        {"space": {"tac.entropic_indx": {"float": [1, 2]}}},
        "is not a known setting (did you mean 'entropic_index'?)",
    ),
    (
        {"space": {"seed": {"int": [1, 2]}}},
        "seed is never a grid dimension",
    ),
    (
        {"space": {"tac.lr": {"float": [0.1, 1], "when": {"tac.tau": 1}}}},
        "space.tac.lr.when must name settings that stand above it, got 'tac.tau'",
    ),
    ({"sampler": "grid"}, "space.tac.alpha must have a step to be part of a grid"),
    (
        {"sampler": "cmaes", "space": {"tac.policy_critic": {"choice": ["min", "first"]}}},
        "space.tac.policy_critic must be a number without 'when' for sampler: cmaes",
    ),
    ({"mode": "compare"}, "compare must be given with mode: compare, and only there"),
    (
        {"objective": {"metric": "evaluation/succes_rate"}},
        "must be a metric that runs report",
    ),
    ({"objective": {"read": "steps_to"}}, "threshold must be given with read: steps_to"),
    (
        {"points_to_evaluate": [{"tac.alpha": 3}]},
        "points_to_evaluate[0].tac.alpha must be in [0.005, 0.5], got 3",
    ),
    (
        {"pruning": {"rungs": [{"seeds": 2}, {"seeds": 1}]}},
        "pruning.rungs must grow in seeds or env_steps and never shrink",
    ),
    (
        {"space": {"warmup:tac.lr": {"float": [0.1, 1]}}},
        "must name settings of this stage or of the one it starts from, which is 'pretrain'",
    ),
]


@pytest.mark.parametrize(("search", "message"), MISTAKES, ids=[text[:45] for _, text in MISTAKES])
def test_mistakes_in_a_search_are_named(search: Document, message: str, tmp_path: Path) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump(document(search)))
    with pytest.raises(ConfigError) as error:
        load_sweep(path)
    assert message in str(error.value)
    assert "sweep.yaml:" in str(error.value)
