"""A score for each seed: what the runs of a condition are compared by.

A study's primary metric is the area under the learning curve: the mean of a metric over the budget.
It counts how soon and how high alike. Steps to a threshold are biased early where an evaluation is
noisy (an agent at 85 % passes "90 % of 50 episodes" in 22 % of its evaluations), and final values
say nothing where all runs end at the ceiling.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

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
    worst: float = float("nan")
    """Score of a failed run: 0 for a rate, the floor of a return where the reward's range is known,
    else the worst score of the compared runs; NaN if unknown."""

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
    """Scores of the finished runs, and the worst score for each failed one."""
    episodes: float
    """Evaluation episodes behind a score, mean of the runs; infinite where they are not known."""
    noise: float = 0.0
    """Variance of a rate's score from its evaluation episodes alone, mean of the runs; 0 where
    episodes are unknown."""
    failed: int = 0
    """Number of failed runs."""
    waiting: int = 0
    """Number of runs that are neither finished nor failed."""

    @property
    def finished(self) -> int:
        """Number of finished runs with a score."""
        return len(self.by_seed) - self.failed


def measure_on(
    sweep: Sweep,
    task: str,
    runs: Sequence[int],
    kind: str,
    metric: str | None = None,
    *,
    maximised: bool = True,
    horizon: float = np.inf,
) -> Measure:
    """The measure of the runs on a task, over a budget that each of them has.

    Args:
        sweep: the runs.
        task: the task.
        runs: positions of all runs that are compared.
        kind: `auc` or `final`.
        metric: None for the task's primary one.
        maximised: whether more of it is better.
        horizon: largest number of environment steps.
    """
    own = [run for run in runs if sweep.runs[run].task == task]
    measure = Measure(
        kind=kind,
        metric=metric or sweep.primary_metric(task),
        horizon=min(horizon, sweep.least_budget(task, own)),
        maximised=maximised,
    )
    if not any(has_failed(sweep, run, measure.metric) for run in own):
        return measure
    return replace(measure, worst=_worst(sweep, own, measure))


def has_failed(sweep: Sweep, run: int, metric: str) -> bool:
    """Whether a run ended with an error, or diverged to a score that is no number."""
    record, values = sweep.runs[run], sweep.column(run, metric).value
    diverged = record.is_finished and len(values) > 0 and not np.isfinite(values[-1])
    return record.status == "FAILED" or diverged


def _worst(sweep: Sweep, runs: Sequence[int], measure: Measure) -> float:
    """The worst value of a measure, for runs that failed."""
    if measure.is_rate:
        return 0.0 if measure.maximised else 1.0
    params = sweep.runs[runs[0]].params
    if measure.metric == names.EVAL_RETURN and measure.maximised:
        with suppress(KeyError, ValueError):
            low = float(params["task.reward_range"].strip("[]").split(",")[0])
            return min(low, low * int(params["task.horizon"]))
    scores = [_score(sweep, run, measure) for run in runs]
    known = [score for score in scores if np.isfinite(score)]
    worst = min if measure.maximised else max
    return worst(known, default=float("nan"))


def _score(sweep: Sweep, run: int, measure: Measure) -> float:
    """The score of a run; NaN for one that has not finished or was not evaluated to the end."""
    if not sweep.runs[run].is_finished or has_failed(sweep, run, measure.metric):
        return float("nan")
    steps, values = sweep.finite(run, measure.metric)
    if measure.kind == "auc" and measure.horizon > 0:
        return area_under_curve(steps, values, measure.horizon)
    return float(values[-1]) if len(values) else float("nan")


def scores_of(sweep: Sweep, condition: Condition, task: str, measure: Measure) -> Scores:
    """The scores of a condition's runs on a task.

    A failed run has the measure's worst value: leaving it out would make a condition look better
    the more of its runs crash. An unfinished run has no score: its result is not known.
    """
    by_seed: dict[str, float] = {}
    episodes, noise, failed, waiting = [], [], 0, 0
    for run in condition.runs:
        record = sweep.runs[run]
        if record.task != task:
            continue
        if has_failed(sweep, run, measure.metric):
            if np.isfinite(measure.worst):
                by_seed[record.seed] = measure.worst
                failed += 1
            continue
        waiting += not record.is_finished
        score = _score(sweep, run, measure)
        if np.isnan(score):
            continue
        by_seed[record.seed] = score
        steps, values = sweep.finite(run, measure.metric)
        whole = measure.kind == "auc" and measure.horizon > 0
        used = values[steps <= measure.horizon] if whole else values[-1:]
        of_one = sweep.final(run, names.EVAL_EPISODES)
        if of_one is None:
            episodes.append(np.inf)
        else:
            episodes.append(of_one * len(used))
            # A rate of 0 or 1 in few episodes is not certain: half an episode is added to both.
            rates = (used * of_one + 0.5) / (of_one + 1)
            noise.append(float(np.mean(rates * (1 - rates))) / max(of_one * len(used), 1))
    return Scores(
        by_seed=by_seed,
        episodes=float(np.mean(episodes)) if episodes else np.inf,
        noise=float(np.mean(noise)) if noise and measure.is_rate else 0.0,
        failed=failed,
        waiting=waiting,
    )


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
