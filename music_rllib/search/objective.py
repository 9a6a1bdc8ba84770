"""The value of a trial, made of its runs' scores, and whether the trial is stopped early.

Shapes: `scores` is `[seeds, tasks]`, one number per run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from music_rllib import names
from music_rllib.config.search import Objective, Pruning
from music_rllib.results import statistics as st
from music_rllib.results.statistics import Array, Estimate
from music_rllib.store.history import Report


def score(objective: Objective, history: Sequence[Report], budget: int) -> float:
    """The score of a run.

    Args:
        objective: The metric, and how it is read.
        history: The run's reports, as far as they count.
        budget: Environment steps of the whole run: the score where `steps_to` a threshold is read
            that is never reached.

    Raises:
        ValueError: The run never reported the metric, or reported NaN.
    """
    values = [
        (report.env_steps, report.metrics[objective.metric])
        for report in history
        if objective.metric in report.metrics
    ]
    if objective.metric == names.ENV_STEPS:
        values = [(report.env_steps, float(report.env_steps)) for report in history]
    if not values:
        raise ValueError(f"it never reported {objective.metric}")
    numbers = [value for _, value in values]
    if not math.isfinite(sum(numbers)):
        raise ValueError(f"its {objective.metric} is not a finite number")
    if objective.read == "last":
        return numbers[-1]
    if objective.read == "mean":
        return float(np.mean(numbers))
    if objective.read == "best":
        # The best of a metric, whichever way the objective counts it.
        return max(numbers) if objective.maximised else min(numbers)
    assert objective.threshold is not None
    reached = (steps for steps, value in values if value >= objective.threshold)
    # A last round may end behind the budget, which is no worse than never.
    return float(min(next(reached, budget), budget))


def aggregate(objective: Objective, scores: Array) -> float:
    """The value of a trial with the scores `[seeds, tasks]`."""
    match objective.aggregate:
        case "iqm":
            return float(scipy.stats.trim_mean(scores, 0.25, axis=None))
        case "mean":
            return float(np.mean(scores))
        case "median":
            return float(np.median(scores))
    by_task = scores.mean(axis=0)
    return float(by_task.min() if objective.maximised else by_task.max())


def aggregates(objectives: Sequence[Objective], scores: Sequence[Array]) -> list[float]:
    """The value of a trial by each objective, from its scores by each."""
    return [aggregate(*pair) for pair in zip(objectives, scores, strict=True)]


def interval(objective: Objective, scores: Array, episodes: int | None = None) -> Estimate:
    """The value of a trial with its 95 % interval; NaN ends for a single run.

    `episodes` are those of one evaluation, where they are known.
    """
    is_rate = objective.metric in names.EVAL_RATES and objective.read != "steps_to"
    if objective.aggregate == "worst_task":
        by_task = scores.mean(axis=0)
        scores = scores[:, [by_task.argmin() if objective.maximised else by_task.argmax()]]
    freedom = scores.size - scores.shape[1]
    squares = float(np.sum((scores - scores.mean(axis=0)) ** 2))
    variance = squares / max(freedom, 1) / _runs_behind(objective, scores)
    return st.interval_of_mean(
        aggregate(objective, scores),
        variance,
        freedom,
        (math.inf if episodes is None else episodes) * scores.size if is_rate else None,
    )


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Whether a trial goes on from a rung."""

    stop: bool
    reason: str
    """A sentence with the numbers that decided."""


def prune(
    objective: Objective,
    pruning: Pruning,
    *,
    scores: Array,
    others: Mapping[int, Array],
    whole: Mapping[int, Array] | None = None,
    place: str,
) -> Verdict:
    """Whether a trial that has reached a rung is stopped there.

    It goes on if it is in the best part of those that have reached the rung, and also if its
    interval reaches the value of the best one: then its rank may be bad luck. The interval is that
    of a mean over as many runs as the aggregate depends on, with the spread between seeds pooled
    over this and the earlier trials: a few runs of one trial tell little about it.

    Args:
        objective: The objective.
        pruning: The settings.
        scores: The trial's scores so far, `[seeds, tasks]`.
        others: Trial number to the scores at this rung of each earlier trial that reached it.
        whole: Trial number to the scores of each earlier trial that went to its end; they tell the
            spread of a trial with a single seed at this rung.
        place: The rung in words, for the reason.
    """
    sign = 1.0 if objective.maximised else -1.0
    own = sign * aggregate(objective, scores)
    earlier = {number: sign * aggregate(objective, values) for number, values in others.items()}
    if not earlier:
        return Verdict(stop=False, reason=f"{place}: the first to get there")
    ranked = sorted([*earlier.values(), own], reverse=True)
    kept = max(1, math.ceil(pruning.keep * len(ranked)))
    leader = max(earlier, key=lambda number: earlier[number])
    bar, best = ranked[kept - 1], earlier[leader]
    if own >= bar:
        return Verdict(stop=False, reason=f"{place}: among the best {kept} of {len(ranked)}")
    # A seed that is at this rung and at the end too must not count as two.
    known = [
        values if len(values) > 1 else (whole or {}).get(number, values)
        for number, values in others.items()
    ]
    half = _half_width(objective, scores, known, pruning.confidence)
    ends = f"[{sign * own - half:.4g}, {sign * own + half:.4g}]"
    if own + half >= best:
        return Verdict(
            stop=False,
            reason=f"{place}: its interval {ends} reaches the best trial's {sign * best:.4g}",
        )
    return Verdict(
        stop=True,
        reason=(
            f"{place}: {sign * own:.4g} is not among the best {kept} of {len(ranked)} (from "
            f"{sign * bar:.4g} on), and its {100 * pruning.confidence:.0f} % interval {ends} does "
            f"not reach the {sign * best:.4g} of trial {leader}"
        ),
    )


def _half_width(
    objective: Objective, scores: Array, others: Sequence[Array], confidence: float
) -> float:
    """Half the width of a trial's interval; infinite where no trial has two seeds."""
    squares, freedom = 0.0, 0
    for values in (scores, *others):
        squares += float(np.sum((values - values.mean(axis=0)) ** 2))
        freedom += values.size - values.shape[1]
    if freedom == 0:
        return math.inf
    spread = math.sqrt(squares / freedom)
    quantile = float(scipy.stats.t.ppf((1 + confidence) / 2, freedom))
    return quantile * spread / math.sqrt(_runs_behind(objective, scores))


def _runs_behind(objective: Objective, scores: Array) -> float:
    """Number of runs whose mean varies as much as the aggregate does, at least.

    The tasks are taken to be far apart, as success rates of easy and hard ones are: then the worst
    task is one of them, the median is that of one, and the middle half is half of them.
    """
    seeds, runs = len(scores), int(scores.size)
    match objective.aggregate:
        case "mean":
            return runs
        case "iqm":
            return runs - 2 * (runs // 4)  # what it does not cut off
        case "median":
            return seeds * 2 / math.pi  # its efficiency on normal numbers
    return seeds
