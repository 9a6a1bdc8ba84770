"""The value of a trial, computed from the scores of its runs, and early stopping.

Shapes: `scores` is `[seeds, tasks]`, one number per run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import scipy

from music_rllib import names
from music_rllib.config.search import Objective, Pruning
from music_rllib.results import statistics as st
from music_rllib.results.statistics import Array, Estimate
from music_rllib.store.history import Report


def up_to(history: Sequence[Report], env_steps: int | None) -> list[Report]:
    """Reports up to the first evaluation from environment step `env_steps` on; None: all."""
    if env_steps is None:
        return list(history)
    ends = (
        count
        for count, report in enumerate(history, 1)
        if report.env_steps >= env_steps and names.EVAL_EPISODES in report.metrics
    )
    return list(history[: next(ends, None)])


def score(objective: Objective, history: Sequence[Report], budget: int) -> float:
    """The score of a run.

    Args:
        objective: The metric, and how it is read.
        history: The reports of the run that count.
        budget: Environment steps of the whole run: its score if `steps_to` reads a threshold that
            the run never reaches.

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
    match objective.read:
        case "last":
            return numbers[-1]
        case "mean":
            return float(np.mean(numbers))
        case "best":
            return max(numbers) if objective.maximised else min(numbers)
    assert objective.threshold is not None
    reached = (steps for steps, value in values if value >= objective.threshold)
    # The last round may end after the budget, which must not be worse than never.
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
    return float(scores.mean(axis=0)[_worst_task(objective, scores)])


def interval(objective: Objective, scores: Array, episodes: int | None = None) -> Estimate:
    """The value of a trial with its 95% interval; the ends are NaN for a single run.

    `episodes` is the number of episodes of one evaluation, if it is known.
    """
    is_rate = objective.metric in names.EVAL_RATES and objective.read != "steps_to"
    if objective.aggregate == "worst_task":
        scores = scores[:, [_worst_task(objective, scores)]]
    squares, freedom = _spread(scores)
    return st.interval_of_mean(
        aggregate(objective, scores),
        squares / max(freedom, 1) / _effective_runs(objective, scores),
        freedom,
        (math.inf if episodes is None else episodes) * scores.size if is_rate else None,
    )


def reason_to_prune(
    objective: Objective,
    pruning: Pruning,
    *,
    scores: Array,
    others: Mapping[int, Array],
    whole: Mapping[int, Array] | None = None,
    rung: str,
) -> str | None:
    """Why a trial that has reached a rung is stopped there; None if it continues.

    It continues if it is in the best share of the trials that have reached the rung, or if its
    interval reaches the value of the best one, because its rank may be bad luck. The interval is
    that of a mean over as many runs as determine the aggregate. The spread between seeds is pooled
    over this and the earlier trials, because a few runs of one trial are a poor estimate of it.

    Args:
        scores: The trial's scores so far, `[seeds, tasks]`.
        others: Trial number to the scores at this rung of each earlier trial that reached it.
        whole: Trial number to the final scores of each earlier complete trial; they give the
            spread of a trial with a single seed at this rung.
        rung: The rung in words, for the reason.
    """
    if not others:
        return None
    sign = 1.0 if objective.maximised else -1.0
    own = sign * aggregate(objective, scores)
    earlier = {number: sign * aggregate(objective, values) for number, values in others.items()}
    ranked = sorted([*earlier.values(), own], reverse=True)
    kept = max(1, math.ceil(pruning.keep * len(ranked)))
    # A seed that is both at this rung and at the end must not count twice.
    known = [
        values if len(values) > 1 else (whole or {}).get(number, values)
        for number, values in others.items()
    ]
    half = _half_width(objective, scores, known, pruning.confidence)
    best = max(earlier, key=lambda number: earlier[number])
    if own >= ranked[kept - 1] or own + half >= earlier[best]:
        return None
    ends = f"[{sign * own - half:.4g}, {sign * own + half:.4g}]"
    return (
        f"{rung}: {sign * own:.4g} is not among the best {kept} of {len(ranked)} (from "
        f"{sign * ranked[kept - 1]:.4g} on), and its {100 * pruning.confidence:.0f}% interval "
        f"{ends} does not reach the {sign * earlier[best]:.4g} of trial {best}"
    )


def _worst_task(objective: Objective, scores: Array) -> int:
    by_task = scores.mean(axis=0)
    return int(by_task.argmin() if objective.maximised else by_task.argmax())


def _spread(scores: Array) -> tuple[float, int]:
    """Sum of squares between the seeds of each task, and its degrees of freedom."""
    return float(np.sum((scores - scores.mean(axis=0)) ** 2)), scores.size - scores.shape[1]


def _half_width(
    objective: Objective, scores: Array, others: Sequence[Array], confidence: float
) -> float:
    """Half the width of a trial's interval; infinite if no trial has two seeds."""
    spreads = [_spread(values) for values in (scores, *others)]
    freedom = sum(of_one for _, of_one in spreads)
    if freedom == 0:
        return math.inf
    spread = math.sqrt(sum(squares for squares, _ in spreads) / freedom)
    quantile = float(scipy.special.stdtrit(freedom, (1 + confidence) / 2))
    return quantile * spread / math.sqrt(_effective_runs(objective, scores))


def _effective_runs(objective: Objective, scores: Array) -> float:
    """Lower bound on the number of runs whose mean varies as much as the aggregate.

    Tasks are assumed to be far apart, as success rates of easy and hard ones are: then the worst
    task is a single task, the median is that of one task, and the middle half has half of them.
    """
    seeds, runs = len(scores), int(scores.size)
    match objective.aggregate:
        case "mean":
            return runs
        case "iqm":
            return runs - 2 * (runs // 4)  # the runs that are not trimmed
        case "median":
            return seeds * 2 / math.pi  # efficiency of the median for a normal distribution
    return seeds
