"""Searches: values of trials, early stopping, points, and mistakes in the settings."""

from __future__ import annotations

import json
import math
import tracemalloc
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from rich.console import Console
from scipy import stats

from music_rllib import names
from music_rllib.config.load import load_config, warnings_of
from music_rllib.config.problems import ConfigError
from music_rllib.config.search import Objective, Pruning, Rung, SearchSettings
from music_rllib.experiment.plan import make_plan
from music_rllib.results.data import LastValues
from music_rllib.search.best import best_so_far
from music_rllib.search.objective import aggregate, interval, reason_to_prune, score, up_to
from music_rllib.search.sampler import VALUES, Proposer, trial_at
from music_rllib.search.study import fits
from music_rllib.store.history import Report, RunResult
from music_rllib.sweep.views.plan import plan_view
from tests.played_search import SPACE, Document, document
from tests.sweep_files import loaded


@pytest.mark.parametrize(
    ("how", "expected"),
    [("iqm", 4.0), ("mean", 14.0), ("median", 4.0), ("worst_task", 2.5)],
)
def test_aggregates(how: str, expected: float) -> None:
    # Two tasks in columns, four seeds: 1..4 and 4, 5, 6, 87; the middle half is 3, 4, 4, 5.
    scores = np.array([[1.0, 4.0], [2.0, 5.0], [3.0, 6.0], [4.0, 87.0]])
    assert aggregate(Objective(aggregate=how), scores) == pytest.approx(expected)


def test_the_worst_task_of_a_minimized_objective_is_the_highest() -> None:
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
def test_scores_of_a_run(objective: Document, expected: float) -> None:
    history = [
        Report(env_steps=1000 * at, seconds=0, timestamp_ms=0, metrics={names.EVAL_SUCCESS: value})
        for at, value in ((1, 0.2), (2, 0.8), (3, 0.5))
    ]
    assert score(Objective(**objective), history, 5000) == pytest.approx(expected)


def test_a_threshold_after_the_budget_counts_as_the_budget() -> None:
    late = Report(env_steps=5200, seconds=0, timestamp_ms=0, metrics={names.EVAL_SUCCESS: 1.0})
    assert score(Objective(read="steps_to", threshold=0.9), [late], 5000) == 5000


def test_a_trial_is_stopped_only_if_its_interval_is_below_the_best() -> None:
    pruning = Pruning(rungs=(Rung(seeds=2),), keep=0.3, confidence=0.9)
    others = {n: np.array([[0.7 + 0.01 * n], [0.72 + 0.01 * n]]) for n in range(6)}

    def reason(values: list[float], **objective: Any) -> str | None:
        scores, one = np.array(values)[:, None], Objective(**objective)
        return reason_to_prune(one, pruning, scores=scores, others=others, rung="here")

    assert "90% interval [0.1" in str(reason([0.2, 0.22]))
    assert reason([0.9, 0.9]) is None
    assert reason([0.2, 0.9]) is None, "its interval is wide"
    assert reason([2.0, 2.1], direction="minimize") is not None


@pytest.mark.parametrize("how", ["iqm", "mean", "median", "worst_task"])
@pytest.mark.parametrize(("tasks", "apart"), [(1, 0.0), (8, 20.0)])
def test_a_trial_as_good_as_its_only_rival_is_rarely_stopped(
    how: str, tasks: int, apart: float
) -> None:
    """At most one in eight with 90% intervals, however far apart the tasks are."""
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(600, 2, 3, tasks)) + apart * np.arange(tasks)
    objective, pruning = Objective(aggregate=how), Pruning(rungs=(Rung(seeds=3),))
    stopped = [
        reason_to_prune(objective, pruning, scores=mine, others={0: rival}, rung="here") is not None
        for mine, rival in draws
    ]
    assert np.mean(stopped) < 0.125 + 2 * math.sqrt(0.125 * 0.875 / len(draws))


def test_the_spread_counts_each_seed_of_a_trial_once() -> None:
    rng = np.random.default_rng(0)
    whole = {number: rng.normal(size=(4, 1)) for number in range(3)}
    pruning = Pruning(rungs=(Rung(seeds=2),), keep=0.1)

    def reason(seeds: int, more: Mapping[int, Any]) -> str | None:
        others = {number: scores[:seeds] + 50 for number, scores in whole.items()}
        mine = np.zeros((seeds, 1))
        return reason_to_prune(
            Objective(), pruning, scores=mine, others=others, whole=more, rung="here"
        )

    assert reason(2, whole) == reason(2, {}) is not None, "their seeds here give the spread"
    assert reason(1, {}) is None, "one seed each has no spread"
    assert "does not reach" in str(reason(1, whole)), "their later seeds give it"


@pytest.mark.parametrize("name", ["search", "compare"])
def test_the_packaged_examples_are_valid(name: str) -> None:
    config = load_config(Path(__file__).parents[3] / f"tune_configs/{name}.yaml")
    settings = config.stages[-1].search
    assert settings is not None
    assert settings.mode == name


# --- the space ---------------------------------------------------------------------------------


def memory_of(call: Callable[[], Any]) -> int:
    """Peak bytes that `call` allocates."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("dimension", "inside", "outside"),
    [
        ({"float": [1, 2]}, [1, 1.3, 2.0], [0.9, 2.1, True, "1", {"learned": True}, None]),
        ({"float": [1, 2], "step": 0.3}, [1, 1.3, 1.9], [1.2, 2, 1.3001]),
        ({"int": [10, 20_000_000]}, [10, 20.0, 20_000_000], [9, 20.5, False, "20"]),
        ({"int": [64, 300], "step": 64}, [64, 256], [65, 300]),
        ({"choice": [1.0, {"a": [1]}]}, [1, {"a": [1.0]}], [True, {"a": [True]}, {"a": 1}, 2]),
    ],
)
def test_values_of_a_dimension(dimension: Document, inside: list[Any], outside: list[Any]) -> None:
    found = SearchSettings.model_validate({"space": {"x": dimension}, "trials": 1}).space["x"]
    assert [value for value in inside if not found.contains(value)] == []
    assert [value for value in outside if found.contains(value)] == []
    assert all(found.contains(end) for end in found.ends()), "a limit need not be a value"
    assert memory_of(lambda: found.contains(15)) < 100_000, "it must not create all values"


def test_a_grid_is_counted_before_its_points_are_created() -> None:
    numbers = {"int": [1, 1000]}
    space = {"x": {"choice": ["a", "b"]}, "y": numbers, "z": numbers | {"when": {"x": "a"}}}
    settings = {"space": space, "sampler": "grid"}

    def refused() -> None:
        with pytest.raises(ValidationError, match=r"at most 100,000 points .* got more"):
            SearchSettings.model_validate(settings)

    assert memory_of(refused) < 5_000_000
    space["y"] = {"int": [1, 90]}
    assert SearchSettings.model_validate(settings).count == 90 * 1000 + 90


# --- mistakes ----------------------------------------------------------------------------------

BRANCHES: Document = {
    "tac.bootstrap": {"choice": ["value", "critics"]},
    "tac.policy_critic": {"choice": ["first", "min"], "when": {"tac.bootstrap": "critics"}},
}
RAMP: Document = {"schedule": "linear", "start": 1.0, "end": 2.0}
COMPARED: Document = {"mode": "compare", "space": {"tac.alpha": {"float": [0.1, 0.2]}}}
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
        "search.space.tac.alpha must have exactly one of float, int and choice, like {float: ",
    ),
    (
        {"space": {"tac.entropic_index": {"float": [0, 2]}}},
        "search.space.tac.entropic_index must be > 0, got 0",
    ),
    (
        {"space": {"tac.entropic_indx": {"float": [1, 2]}}},
        "is not a known setting (did you mean 'tac.entropic_index'?)",
    ),
    (
        {"space": {"seed": {"int": [1, 2]}}},
        "space.seed is not a known setting",
    ),
    (
        {"space": {"tac.lr": {"float": [0.1, 1], "when": {"tac.tau": 1}}}},
        "space.tac.lr.when must name settings that stand above it, got 'tac.tau'",
    ),
    ({"sampler": "grid"}, "space.tac.alpha must have a step to be part of a grid"),
    (
        {"sampler": "cmaes", "space": {"tac.policy_critic": {"choice": ["min", "first"]}}},
        "sampler must not be cmaes for several objectives, choices and 'when', got cmaes",
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
        {
            "space": {"tac.entropic_index": {"float": [1, 2], "step": 0.5}},
            "points_to_evaluate": [{"tac.entropic_index": 1.3}],
        },
        "points_to_evaluate[0].tac.entropic_index must be in [1, 2] and whole steps of 0.5 from 1, "
        "got 1.3",
    ),
    (
        {
            "space": {"tac.batch_size": {"int": [10, 30]}},
            "points_to_evaluate": [{"tac.batch_size": 20.5}],
        },
        "points_to_evaluate[0].tac.batch_size must be a whole number in [10, 30], got 20.5",
    ),
    (
        {
            "space": {"tac.batch_size": {"int": [64, 256], "step": 64}},
            "points_to_evaluate": [{"tac.batch_size": 128}, {"tac.batch_size": 100}],
        },
        "points_to_evaluate[1].tac.batch_size must be a whole number in [64, 256] and whole steps "
        "of 64 from 64, got 100",
    ),
    (
        {"space": BRANCHES, "points_to_evaluate": [{"tac.bootstrap": "both"}]},
        'points_to_evaluate[0].tac.bootstrap must be one of ["value", "critics"], got "both"',
    ),
    (
        {
            "space": BRANCHES,
            "points_to_evaluate": [{"tac.bootstrap": "value", "tac.policy_critic": "min"}],
        },
        '[0].tac.policy_critic must only be given beside tac.bootstrap: "critics", got {"tac',
    ),
    (
        {"space": BRANCHES, "points_to_evaluate": [{"tac.policy_critic": "min"}]},
        '[0].tac.policy_critic must only be given beside tac.bootstrap: "critics", got {"tac',
    ),
    (
        {"trials": 2, "points_to_evaluate": [{"tac.alpha": 0.1}] * 3},
        "points_to_evaluate must not be more than the trials (2), got 3",
    ),
    (
        {
            "space": {
                "tac.batch_size": {"int": [64, 256]},
                "tac.lr": {"float": [0.1, 1], "when": {"tac.batch_size": 300}},
            }
        },
        "space.tac.lr.when must hold values of tac.batch_size, got 300",
    ),
    (
        {
            "space": BRANCHES
            | {
                "tac.tau": {
                    "float": [0.1, 0.2],
                    "when": {"tac.bootstrap": "value", "tac.policy_critic": "min"},
                }
            }
        },
        "space.tac.tau.when must be satisfiable, got {",
    ),
    (
        {"sampler": "grid", "space": {"tac.batch_size": {"int": [1, 50_000_000]}}},
        "space must have at most 100,000 points with sampler: grid, got more",
    ),
    (
        COMPARED | {"compare": {"tac.entropic_index": [1.0, 1]}},
        "search.compare.tac.entropic_index[1] must not repeat, got 1 again",
    ),
    (
        COMPARED | {"compare": {"tac.entropic_index": [RAMP, RAMP | {"begin": 0.1}]}},
        "search.compare.tac.entropic_index must not have two equal values, got {",
    ),
    (
        {"space": {"tac.batch_size": {"choice": [16, 32, 16]}}},
        "search.space.tac.batch_size.choice[2] must not repeat, got 16 again",
    ),
    (
        {"space": {"pretrain:tac.entropic_index": {"choice": [RAMP, RAMP | {"begin": 0.1}]}}},
        "search.space.pretrain:tac.entropic_index must not have two equal values, got {",
    ),
    (
        {"pruning": {"rungs": [{"seeds": 2}, {"seeds": 1}]}},
        "pruning.rungs must grow in seeds or env_steps and never shrink",
    ),
    (
        {"pruning": {"rungs": [{"seeds": 1}, {"seeds": 9}]}},
        "pruning.rungs[1].seeds must be <= 3, the number of the sweep's seeds, got 9",
    ),
    (
        {"pruning": {"rungs": [{"env_steps": 5000}]}},
        "pruning.rungs[0].env_steps must be <= 4000, the longest run's env steps, got 5000",
    ),
    (
        {
            "space": {"env_steps": {"int": [6000, 9000], "step": 1000}},
            "pruning": {"rungs": [{"env_steps": 9000}, {"env_steps": 9001}]},
        },
        "pruning.rungs[1].env_steps must be <= 9000, the longest run's env steps, got 9001",
    ),
    (
        COMPARED
        | {"compare": {"env_steps": [2000, 3000]}, "pruning": {"rungs": [{"env_steps": 4000}]}},
        "pruning.rungs[0].env_steps must be <= 3000, the longest run's env steps, got 4000",
    ),
    (
        {
            "space": BRANCHES
            | {"env_steps": {"int": [2000, 2500], "when": {"tac.bootstrap": "value"}}},
            "pruning": {"rungs": [{"env_steps": 4000}, {"env_steps": 4001}]},
        },
        "pruning.rungs[1].env_steps must be <= 4000, the longest run's env steps, got 4001",
    ),
    (
        {"final": {"env_steps": 500}},
        "search.final.env_steps must be > tac.random_steps (1000), or nothing is learned, got 500",
    ),
    (
        {
            "space": {"tac.random_steps": {"int": [100, 2000]}},
            "final": {"env_steps": 2000},
        },
        "search.final.env_steps must be > tac.random_steps (2000), or nothing is learned, got 2000",
    ),
    (
        {"space": {"warmup:tac.lr": {"float": [0.1, 1]}}},
        "must name settings of this stage or of the one it starts from, which is 'pretrain'",
    ),
]


@pytest.mark.parametrize(("search", "message"), MISTAKES, ids=[text[:45] for _, text in MISTAKES])
def test_mistakes_in_a_search_are_named(search: Document, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        loaded(tmp_path, document(search))
    assert message in str(error.value)
    assert "sweep.yaml:" in str(error.value)


@pytest.mark.parametrize(
    ("objective", "message"),
    [
        ({"aggregate": "bogus"}, "search.objective.aggregate must be 'iqm', 'mean', 'median' or"),
        ([{}, {"aggregate": "bogus"}], "search.objective[1].aggregate must be 'iqm', 'mean',"),
        ("evaluation/return", "search.objective must be a mapping of keys to values, got"),
    ],
)
def test_a_mistake_in_the_objective_is_one_error(
    objective: Any, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as error:
        loaded(tmp_path, document({"objective": objective}))
    (line,) = error.value.lines
    assert message in line


@pytest.mark.parametrize("objective", [{}, [{"metric": names.EVAL_RETURN}, {}]])
def test_success_needs_a_task_that_declares_it(objective: Any, tmp_path: Path) -> None:
    swing = {"env_id": "Pendulum-v1", "horizon": 50, "success_key": None}
    content = document({}, tasks=["FetchPush", "Swing"], environments={"Swing": swing})
    content["stages"] = [
        {"name": "a", "variant": "tac", "search": content["stages"][1]["search"]},
    ]
    content["stages"][0]["search"]["objective"] = objective
    with pytest.raises(ConfigError) as error:
        loaded(tmp_path, content)
    (line,) = error.value.lines
    assert "metric must be a metric that Swing has too, which declares no success" in line
    assert "write objective: {metric: evaluation/episode_return}, got" in line
    content["stages"][0]["search"]["objective"] = {"metric": names.EVAL_RETURN}
    loaded(tmp_path, content)


def test_a_rung_may_exceed_the_budget_of_shorter_tasks(tmp_path: Path) -> None:
    content = document({"pruning": {"rungs": [{"env_steps": 5000}]}})
    content["tasks"] = ["FetchPush", "FetchSlide"]
    content["stages"][1]["per_task"] = {"FetchSlide": {"env_steps": 6000}}
    loaded(tmp_path, content)
    content["stages"][1]["per_task"]["FetchSlide"]["env_steps"] = 4500
    with pytest.raises(ConfigError, match="must be <= 4500"):
        loaded(tmp_path, content)


Q = {"float": [1.0, 2.0], "step": 0.25}
CHOICES: Document = {
    "tac.alpha": {"choice": [0.1, {"learned": True}, 1]},
    "tac.bootstrap": {"choice": ["value", "critics"]},
    "tac.policy_critic": {"choice": ["first", "min"], "when": {"tac.bootstrap": "critics"}},
}
"""A grid of 9 points."""
ONE_OR_MANY: Document = {
    "tac.bootstrap": {"choice": ["value", "critics"]},
    "tac.alpha": {"float": [0.01, 1.0], "log": True, "when": {"tac.bootstrap": "critics"}},
}
"""One point, and a range for other settings."""
FEW_OR_MANY: Document = {
    "tac.batch_size": {"choice": [*range(1, 21)]},
    "tac.alpha": {"float": [0.01, 1.0], "log": True, "when": {"tac.batch_size": 20}},
}


@pytest.mark.parametrize(
    ("sampler", "space", "trials"),
    [
        ("tpe", {"tac.entropic_index": Q, "tac.batch_size": {"int": [1, 5]}}, 25),
        ("random", {"tac.entropic_index": Q, "tac.batch_size": {"int": [1, 5]}}, 25),
        ("cmaes", {"tac.entropic_index": Q, "tac.batch_size": {"int": [1, 5]}}, 25),
        ("nsga2", CHOICES, 9),
        ("tpe", CHOICES, 9),
        ("tpe", ONE_OR_MANY, 12),
        ("random", FEW_OR_MANY, 30),
    ],
)
def test_no_point_is_tried_twice(sampler: str, space: Document, trials: int) -> None:
    """A trial's point is a function of the earlier ones only."""
    settings = SearchSettings.model_validate(
        {"sampler": sampler, "space": space, "trials": 1000, "concurrent": 2}
    )
    name, dimension = next(iter(settings.space.items()))
    point = {name: dimension.ends()[0]}
    given = [point, {}, point]
    found: list[Document] = []
    for number in range(trials):
        ended = [trial_at(settings.space, point, [0.0]) for point in found[: max(0, number - 1)]]
        running = [trial_at(settings.space, point) for point in found[max(0, number - 1) :]]
        one, other = (
            Proposer(settings, given).propose(number, ended, running).user_attrs[VALUES]
            for _ in range(2)
        )
        assert one == other
        assert fits(one, settings)
        found.append(one)
    assert point.items() <= found[0].items()
    assert len({json.dumps(point, sort_keys=True) for point in found}) == trials
    assert settings.count == (1000 if space in (ONE_OR_MANY, FEW_OR_MANY) else trials)


def test_a_search_with_few_points_prints_its_last_trial(tmp_path: Path) -> None:
    (line,) = warnings_of(loaded(tmp_path, document({"space": CHOICES, "trials": 20})))
    assert line == (
        "finetune: search.trials is 20, and the space has 9 points: the search ends after 9 trials"
    )


def scores(*seeds: float) -> NDArray[np.float64]:
    return np.array(seeds, float)[:, None]


def reason(
    mine: NDArray[np.float64], others: Mapping[int, NDArray[np.float64]], **pruning: float
) -> str | None:
    rules = Pruning(rungs=(Rung(seeds=2),), **pruning)
    return reason_to_prune(Objective(), rules, scores=mine, others=others, rung="here")


def test_a_trial_in_the_best_share_continues_far_below_the_best() -> None:
    """Five trials: a share of 0.3 is rounded up to two of them."""
    others = {0: scores(0.9, 0.9), 1: scores(0.1, 0.1), 2: scores(0.2, 0.2), 3: scores(0.25, 0.25)}
    assert reason(scores(0.3, 0.3), others, keep=0.3) is None
    assert reason(scores(0.24, 0.24), others, keep=0.3) is not None
    assert reason(scores(0.3, 0.3), others, keep=0.2) is not None


@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_the_interval_that_is_compared_has_the_configured_confidence(confidence: float) -> None:
    others = {0: scores(9.0, 9.2), 1: scores(9.1, 9.4)}
    found = reason(scores(0.0, 0.1), others, keep=0.3, confidence=confidence)
    variance = (2 * 0.1**2 + 2 * 0.15**2 + 2 * 0.05**2) / 3
    half = stats.t.ppf((1 + confidence) / 2, 3) * np.sqrt(variance / 2)
    assert f"its {100 * confidence:.0f}% interval [{0.05 - half:.4g}, {0.05 + half:.4g}]" in str(
        found
    )


@pytest.mark.parametrize(
    ("how", "runs"), [("mean", 8), ("iqm", 4), ("median", 4 * 2 / np.pi), ("worst_task", 4)]
)
def test_the_interval_of_a_trial_is_students_over_its_effective_runs(how: str, runs: float) -> None:
    values = np.array([[0.0, 10.0], [1.0, 12.0], [2.0, 11.0], [3.0, 13.0]])
    found = interval(Objective(metric=names.EVAL_RETURN, aggregate=how), values)
    own = values[:, :1] if how == "worst_task" else values
    freedom = own.size - own.shape[1]
    variance = ((own - own.mean(0)) ** 2).sum() / freedom
    half = stats.t.ppf(0.975, freedom) * np.sqrt(variance / runs)
    assert float(found.upper - found.value) == pytest.approx(half)


def report(steps: int, **metrics: float) -> Report:
    return Report(env_steps=steps, seconds=0, timestamp_ms=0, metrics=metrics)


def test_a_rung_ends_with_the_first_evaluation_at_its_steps() -> None:
    evaluated = {names.EVAL_EPISODES: 5.0}
    history = [
        report(1000, **evaluated),
        report(2000),
        report(2500, **evaluated),
        report(3000, **evaluated),
    ]
    assert [one.env_steps for one in up_to(history, 2000)] == [1000, 2000, 2500]
    assert up_to(history, None) == history


def test_the_best_value_of_a_minimised_objective_is_the_smallest() -> None:
    history = [report(at, **{names.EVAL_SUCCESS: v}) for at, v in ((1, 0.5), (2, 0.2), (3, 0.4))]
    assert score(Objective(read="best", direction="minimize"), history, 3) == 0.2


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_run_without_a_finite_score_is_named(bad: float) -> None:
    history = [report(1, **{names.EVAL_SUCCESS: 0.5}), report(2, **{names.EVAL_SUCCESS: bad})]
    with pytest.raises(ValueError, match="is not a finite number"):
        score(Objective(), history, 3)
    with pytest.raises(ValueError, match="never reported evaluation/success_rate"):
        score(Objective(), [report(1)], 3)


def test_the_best_condition_of_a_task_is_that_of_its_own_metric(tmp_path: Path) -> None:
    swing = {"env_id": "Pendulum-v1", "success_key": None, "horizon": 200}
    stage = {"name": "train", "variant": "tac", "grid": {"tac.entropic_index": [1.0, 1.5]}}
    document = {
        "name": "s",
        "tasks": ["FetchReach", "Swing"],
        "seeds": [0],
        "environments": {"Swing": swing},
        "defaults": {"env_steps": 2000},
        "stages": [stage],
    }
    config = loaded(tmp_path, document)
    plan, results = make_plan(config), {}
    for node in plan.nodes:
        success = 0.9 if node.run.tac.entropic_index == 1.5 else 0.5
        metrics = {names.EVAL_RETURN: -30 * success}
        if node.run.task.name == "FetchReach":
            metrics[names.EVAL_SUCCESS] = success
        results[node.key] = RunResult(
            label=node.label, env_steps=2000, seconds=1.0, metrics=metrics
        )
    best = best_so_far(config.stages, plan, LastValues(plan).sweep(results), ())
    assert best is not None
    assert (best["task"], best["metric"]) == ("FetchReach", names.EVAL_SUCCESS)
    assert best["values"] == {"tac.entropic_index": 1.5}
    assert best["other_tasks"][0]["metric"] == names.EVAL_RETURN


def test_a_searched_source_keeps_its_one_grid_point(tmp_path: Path) -> None:
    space = {"tac.alpha": {"choice": [0.1, 0.2]}, "pretrain:music.lr": {"choice": [0.001, 0.01]}}
    content = document({"space": space})
    content["stages"][0]["grid"] = {"music.hidden_size": [64]}
    content["stages"][1]["music"] = {"hidden_size": 64}
    loaded(tmp_path, content)


def test_the_plan_counts_pretraining_that_a_search_varies(tmp_path: Path) -> None:
    space = SPACE | {"pretrain:music.lr": {"float": [0.0001, 0.01], "log": True}}
    content = document({"space": space, "trials": 10, "final": {"seeds": 5, "trials": 3}})
    content["stages"][0]["env_steps"] = 50_000
    config = loaded(tmp_path, content)
    console = Console(width=200)
    with console.capture() as capture:
        console.print(plan_view(config, make_plan(config), ()))
    runs = 10 * 3 + 3 * 5
    assert f"up to {2 * runs} more runs and {runs * (50_000 + 4_000):,} more" in capture.get()


@pytest.mark.parametrize("metric", ["entropy/shannon_dimension_0", "entropy/tsallis_dimension_12"])
def test_the_entropy_of_a_dimension_can_be_an_objective(metric: str, tmp_path: Path) -> None:
    loaded(tmp_path, document({"objective": {"metric": metric}}))


@pytest.mark.parametrize("metric", ["entropy/shannon_dimension_", "yes", "0"])
def test_names_that_no_run_reports_are_refused(metric: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="must be a metric that runs report"):
        loaded(tmp_path, document({"objective": {"metric": metric}}))
