"""A score for each seed: what the runs of a condition are compared by.

A study's primary metric is the area under the learning curve: the mean of a metric over the budget.
It counts how soon and how high alike. Steps to a threshold are biased early where an evaluation is
noisy (an agent at 85 % passes "90 % of 50 episodes" in 22 % of its evaluations), and final values
say nothing where all runs end at the ceiling.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from music_rllib import names
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array


@dataclass(frozen=True, kw_only=True)
class Measure:
    """The number that a run is compared by."""

    kind: str
    """`auc`: the area under the curve of `metric` over the budget, its mean; `final`: its last
    value."""
    metric: str
    horizon: float
    """Environment steps of the area, the smallest budget of what is compared; NaN for several
    tasks with a horizon each."""
    maximised: bool = True

    @property
    def is_rate(self) -> bool:
        """Whether it is a share of episodes, between 0 and 1."""
        return self.metric in names.EVAL_RATES

    @property
    def kind_in_words(self) -> str:
        """`area under the curve`, or `final value`."""
        return "final value" if self.kind == "final" else "area under the curve"

    @property
    def words(self) -> str:
        """`mean success over 100,000 steps`."""
        word = names.word_of(self.metric)
        if self.kind == "final":
            return f"final {word}"
        budget = "the budget" if np.isnan(self.horizon) else f"{self.horizon:,.0f} steps"
        return f"mean {word} over {budget}"


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of one condition on one task."""

    by_seed: Mapping[str, float]
    """Scores of the finished runs."""
    episodes: float
    """Evaluation episodes behind a score, mean of the runs; infinite where they are not known."""


def measure_on(
    sweep: Sweep, task: str, runs: Sequence[int], kind: str, metric: str | None = None
) -> Measure:
    """The measure of the runs on a task, over a budget that each of them has."""
    metric = metric or sweep.primary_metric(task)
    return Measure(kind=kind, metric=metric, horizon=sweep.least_budget(task, runs))


def scores_of(sweep: Sweep, condition: Condition, task: str, measure: Measure) -> Scores:
    """The scores of a condition's finished runs on a task; an unfinished run has none.

    What a run would have come to is not known before its end, even where its curve is there as far
    as another's: those that fail early are not like the others.
    """
    by_seed, episodes = {}, []
    for run in condition.runs:
        record = sweep.runs[run]
        if record.task != task or not record.is_finished:
            continue
        steps, values = sweep.finite(run, measure.metric)
        score, evaluations = values[-1] if len(values) else np.nan, 1
        if measure.kind == "auc" and measure.horizon > 0:
            score = area_under_curve(steps, values, measure.horizon)
            evaluations = int(np.sum(steps <= measure.horizon))
        if not np.isnan(score):
            by_seed[record.seed] = float(score)
            of_one = sweep.final(run, names.EVAL_EPISODES)
            episodes.append(np.inf if of_one is None else of_one * evaluations)
    return Scores(by_seed=by_seed, episodes=float(np.mean(episodes)) if episodes else np.inf)


def area_under_curve(steps: Array, values: Array, horizon: float) -> float:
    """Mean of a learning curve over environment steps 0 to `horizon`, by the trapezoid rule.

    Before the first evaluation the curve has that one's value; a budget of 100 steps that ends
    between two evaluations is cut there.

    Args:
        steps: `[points]` of the evaluations, rising.
        values: `[points]`, finite.
        horizon: environment steps, > 0.

    Returns:
        The mean in the metric's unit; NaN for a run without an evaluation at `horizon` or later,
        as the rest of its curve is not known.
    """
    if not len(steps) or steps[-1] < horizon:
        return float("nan")
    inside = steps[(steps > 0) & (steps < horizon)]
    at = np.concatenate([[0.0], inside, [horizon]])
    return float(np.trapezoid(np.interp(at, steps, values), at) / horizon)


def ended_first(sweep: Sweep, runs: Sequence[int]) -> float:
    """Time of the earliest last evaluation among finished runs, in ms since the epoch.

    The time is infinite before any run has finished. A run that was taken over from another sweep
    counts when that sweep computed it.
    """
    ends = []
    for run in runs:
        record = sweep.runs[run]
        times = sweep.column(run, sweep.primary_metric(record.task)).time
        if record.is_finished and len(times):
            ends.append(float(times[-1]))
    return min(ends, default=np.inf)
