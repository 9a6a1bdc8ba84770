"""What a trial is worth: one number from its runs, and whether it may be stopped early.

Shapes: `scores` is `[seeds, tasks]`, one number per run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from music_rllib import names
from music_rllib.config.search.settings import Objective, Pruning
from music_rllib.imports import imported_on_use
from music_rllib.results import statistics as st
from music_rllib.results.statistics import Array, Estimate
from music_rllib.store.run_record import Report

__all__ = ["Verdict", "aggregate", "interval", "prune", "score"]

stats = imported_on_use("scipy.stats")


def score(objective: Objective, history: Sequence[Report], budget: int) -> float:
    """A run's number.

    Args:
        objective: What to read.
        history: The run's reports, as far as they count.
        budget: Environment steps of the whole run, for a threshold that is never reached.

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
    return float(next(reached, budget))


def aggregate(objective: Objective, scores: Array) -> float:
    """A trial's number from those of its runs, `[seeds, tasks]`."""
    match objective.aggregate:
        case "iqm":
            return float(stats.trim_mean(scores, 0.25, axis=None))
        case "mean":
            return float(np.mean(scores))
        case "median":
            return float(np.median(scores))
    by_task = scores.mean(axis=0)
    return float(by_task.min() if objective.maximised else by_task.max())


def interval(objective: Objective, scores: Array, episodes: int | None = None) -> Estimate:
    """A trial's number with its 95 % interval; NaN ends for a single run.

    Args:
        objective: What counts.
        scores: Of the trial's runs, `[seeds, tasks]`.
        episodes: Of an evaluation, where it is known.
    """
    is_rate = objective.metric in names.EVAL_RATES and objective.read != "steps_to"
    if objective.aggregate == "worst_task":
        by_task = scores.mean(axis=0)
        scores = scores[:, [by_task.argmin() if objective.maximised else by_task.argmax()]]
    freedom = scores.size - scores.shape[1]
    squares = float(np.sum((scores - scores.mean(axis=0)) ** 2))
    variance = squares / max(freedom, 1) / _runs_behind(objective, scores)
    return st.interval(
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
    """In words, with the numbers that decided."""


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

    It goes on if it is in the best part of those that have reached the rung, and it goes on too if
    its interval reaches the best of them: then its place may be bad luck. The interval is that of a
    mean over as many runs as the aggregate hangs on, with the spread between seeds that earlier
    trials have in common: a few runs of one trial tell little about theirs.

    Args:
        objective: What counts.
        pruning: The rules.
        scores: The trial's runs so far, `[seeds, tasks]`.
        others: Trial number to the same of each earlier trial that reached this rung.
        whole: Trial number to all runs of each earlier trial that went to its end; they tell the
            spread of those with a single seed at this rung.
        place: The rung in words.
    """
    sign = 1.0 if objective.maximised else -1.0
    mine = sign * aggregate(objective, scores)
    theirs = {number: sign * aggregate(objective, values) for number, values in others.items()}
    if not theirs:
        return Verdict(stop=False, reason=f"{place}: the first to get there")
    ranked = sorted([*theirs.values(), mine], reverse=True)
    kept = max(1, math.ceil(pruning.keep * len(ranked)))
    bar, best = ranked[kept - 1], max(theirs.values())
    if mine >= bar:
        return Verdict(stop=False, reason=f"{place}: among the best {kept} of {len(ranked)}")
    # A seed that is at this rung and at the end too must not count as two.
    known = [
        values if len(values) > 1 else (whole or {}).get(number, values)
        for number, values in others.items()
    ]
    half = _half_width(objective, scores, known, pruning.confidence)
    ends = f"[{sign * mine - half:.4g}, {sign * mine + half:.4g}]"
    if mine + half >= best:
        return Verdict(
            stop=False,
            reason=f"{place}: its interval {ends} reaches the best trial's {sign * best:.4g}",
        )
    number = max(theirs, key=lambda other: theirs[other])
    return Verdict(
        stop=True,
        reason=(
            f"{place}: {sign * mine:.4g} is not among the best {kept} of {len(ranked)} (from "
            f"{sign * bar:.4g} on), and its {100 * pruning.confidence:.0f} % interval {ends} does "
            f"not reach the {sign * best:.4g} of trial {number}"
        ),
    )


def _half_width(
    objective: Objective, scores: Array, others: Sequence[Array], confidence: float
) -> float:
    """Of the interval around a trial's number; infinite where no two seeds tell the spread."""
    squares, freedom = 0.0, 0
    for values in (scores, *others):
        squares += float(np.sum((values - values.mean(axis=0)) ** 2))
        freedom += values.size - values.shape[1]
    if freedom == 0:
        return math.inf
    spread = math.sqrt(squares / freedom)
    quantile = float(stats.t.ppf((1 + confidence) / 2, freedom))
    return quantile * spread / math.sqrt(_runs_behind(objective, scores))


def _runs_behind(objective: Objective, scores: Array) -> float:
    """How many runs a mean must have to vary as much as the aggregate does, at the least.

    It is as if the tasks were far apart, as success rates of easy and hard ones are: then the worst
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
