"""Final values of conditions: means with intervals, and differences without a test.

`compare`, the report, its tables and the results page all go through :func:`scopes_of`, so that
they have the same numbers. Verdicts come from :mod:`music_rllib.results.claims` alone.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Generic, Protocol, TypeVar

import numpy as np

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.statistics import Array, Estimate

ALL_TASKS = "all tasks"
AVERAGED = {*names.EVAL_RATES, *names.ENTROPIES}
"""Metrics that have the same unit on every task, so that they can be averaged over tasks."""
SHOW_SEEDS_BELOW = 10
"""Number of seeds from which on they are not shown one by one."""


class Labelled(Protocol):
    """A condition with a label."""

    @property
    def label(self) -> str: ...


C = TypeVar("C", bound=Labelled)


@dataclass(frozen=True, kw_only=True, eq=False)
class Final(Generic[C]):
    """Final scores of a condition."""

    condition: C
    scores: Array = field(repr=False)
    """`[seeds, T]`, of the seeds that have finished on every task of the scope."""
    estimate: Estimate

    @property
    def value(self) -> float:
        return float(self.estimate.value)

    @property
    def runs(self) -> int:
        return int(self.scores.size)

    @property
    def seeds(self) -> int:
        return len(self.scores)


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison(Generic[C]):
    """Comparison of the final scores of two conditions."""

    first: Final[C]
    second: Final[C]
    improvement: float
    """Probability that a run of `first` ends higher than one of `second`, ties half."""

    @property
    def gap(self) -> Estimate:
        """Mean of `first` minus that of `second`."""
        return st.difference(self.first.estimate, self.second.estimate)


@dataclass(frozen=True, kw_only=True)
class Scope(Generic[C]):
    """Conditions on one task, or on all tasks together."""

    name: str
    """The task, or `ALL_TASKS`."""
    metric: str
    """Metric whose last value is the score."""
    tasks: int
    finals: tuple[Final[C], ...]
    """Scores of the conditions with a seed that has finished on every task of the scope."""
    compared: tuple[Final[C], ...]
    """Scores of those that may be compared: of a search, conditions on fresh seeds."""
    comparisons: tuple[Comparison[C], ...]
    """Comparison of each pair of `compared`, a later condition against an earlier one."""


def scopes_of(
    metrics: Mapping[str, str],
    conditions: Sequence[tuple[C, Array, float]],
    may_be_compared: Collection[C],
) -> tuple[Scope[C], ...]:
    """A scope for each task, after one over all tasks where these have a unit in common.

    Args:
        metrics: task to the metric of its scores, for T tasks.
        conditions: each with its scores `[seeds, T]`, NaN for what has not finished, and its
            evaluation episodes, infinite where they are not known. Seeds that have not finished on
            every task of a scope are left out of it: otherwise a task could weigh more in one
            condition than in another.
        may_be_compared: conditions that are compared with each other.
    """
    columns = [(task, metric, [column]) for column, (task, metric) in enumerate(metrics.items())]
    if len(columns) > 1 and len(set(metrics.values())) == 1 and columns[0][1] in AVERAGED:
        columns.insert(0, (ALL_TASKS, columns[0][1], list(range(len(columns)))))
    return tuple(
        _scope(name, metric, [(c, x[:, chosen], n) for c, x, n in conditions], may_be_compared)
        for name, metric, chosen in columns
    )


def _scope(
    name: str,
    metric: str,
    conditions: Sequence[tuple[C, Array, float]],
    may_be_compared: Collection[C],
) -> Scope[C]:
    is_rate = metric in names.EVAL_RATES
    finals = [
        Final(
            condition=condition,
            scores=complete,
            estimate=st.estimate(complete, episodes if is_rate else None),
        )
        for condition, scores, episodes in conditions
        if len(complete := scores[~np.isnan(scores).any(axis=1)])
    ]
    compared = tuple(final for final in finals if final.condition in may_be_compared)
    pairs = [(second, first) for first, second in combinations(compared, 2)]
    return Scope(
        name=name,
        metric=metric,
        tasks=conditions[0][1].shape[1] if conditions else 1,
        finals=tuple(finals),
        compared=compared,
        comparisons=tuple(
            Comparison(first=a, second=b, improvement=st.improvement(a.scores, b.scores))
            for a, b in pairs
        ),
    )


def number(value: float | Array) -> str:
    """A value in short: two decimals, or none from 100 on."""
    value = float(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2f}"


def with_interval(value: float | None, ends: Sequence[float | None] | None) -> str:
    """`0.45 [0.3, 0.6]`, or `0.45` without an interval."""
    if value is None:
        return "-"
    low, high = ends or (None, None)
    if low is None or high is None or low != low or high != high:
        return f"{value:.3g}"
    return f"{value:.3g} [{low:.3g}, {high:.3g}]"


def interval_text(estimate: Estimate) -> str:
    """`0.62 to 0.81`, or `no interval`."""
    if not estimate.has_interval:
        return "no interval"
    return f"{number(estimate.lower)} to {number(estimate.upper)}"


def p_text(p_value: float) -> str:
    """`p = 0.03`."""
    return "p < 0.001" if p_value < 0.001 else f"p = {p_value:.2g}"


def each_seed(final: Final[C]) -> list[float]:
    """Rising scores of the seeds, means over the tasks; empty where there are many seeds."""
    return sorted(final.scores.mean(axis=1).tolist()) if final.seeds < SHOW_SEEDS_BELOW else []
