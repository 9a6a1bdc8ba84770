"""Comparisons of conditions in numbers and in sentences.

`compare`, the report, its tables and the results page all go through :func:`scopes_of` and
:func:`verdict`, so that they say the same. A winner is named only on evidence.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, count
from math import comb
from typing import Generic, Protocol, TypeVar

import numpy as np

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.statistics import SIGNIFICANCE, Array, Estimate

ALL_TASKS = "all tasks"
GAP = 0.1
"""Default difference in a rate that a reader would want to be able to see."""
AVERAGED = {*names.EVAL_RATES, *names.ENTROPIES}
"""Metrics that have the same unit on every task, so that they can be averaged over tasks."""
SHOW_SEEDS_BELOW = 10
"""Number of seeds from which on they are not shown one by one."""
_MOST_RIVALS = 3
"""Number of rivals that a sentence names, where there are many."""


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
    estimate: Estimate
    """Probability that a run of `first` ends higher than one of `second`, ties half."""
    p_value: float
    """p-value of the exact permutation test, with Holm's correction over the scope."""

    @property
    def gap(self) -> Estimate:
        """Mean of `first` minus that of `second`."""
        return st.difference(self.first.estimate, self.second.estimate)

    @property
    def decided(self) -> bool:
        """Whether so large a difference seldom comes by chance."""
        return self.p_value < SIGNIFICANCE


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
    p_values = st.holm([st.improvement_p_value(a.scores, b.scores) for a, b in pairs])
    return Scope(
        name=name,
        metric=metric,
        tasks=conditions[0][1].shape[1] if conditions else 1,
        finals=tuple(finals),
        compared=compared,
        comparisons=tuple(
            Comparison(
                first=a,
                second=b,
                estimate=st.probability_of_improvement(a.scores, b.scores),
                p_value=p_value,
            )
            for (a, b), p_value in zip(pairs, p_values, strict=True)
        ),
    )


# Words ------------------------------------------------------------------------------------------


def verdict(scope: Scope[C], gap: float = GAP, *, maximised: bool = True) -> list[str]:
    """Sentences about one scope: the condition that is ahead, or why none is, and seeds needed.

    Args:
        scope: conditions and their comparisons.
        gap: difference in a rate that the reader would want to be able to see.
        maximised: whether more of the metric is better.
    """
    where = "over all tasks together" if scope.name == ALL_TASKS else f"on {scope.name}"
    if not scope.finals:
        return [f"No condition has finished {where}: there is nothing to compare yet."]
    if not scope.compared:
        return [
            f"Nothing is ranked {where}: no trial of the search has finished on fresh seeds. On "
            "those that they are chosen by, trials are not compared: the best is so by luck, too."
        ]
    if len(scope.compared) == 1:
        return [
            f"Nothing is compared {where}: only {_in_words(scope.compared[0])} has finished runs."
        ]
    single = [final for final in scope.compared if final.seeds < 2]
    if single:
        every = len(single) == len(scope.compared)
        which = "every condition" if every else _labels(single)
        have = "have" if len(single) > 1 and not every else "has"
        return [
            f"No winner {where}: {which} {have} a single seed, so there is no interval and no "
            f"evidence. {_direction(maximised).capitalize()} so far is "
            f"{_in_words(_best(scope.compared, maximised)[0])}."
        ]
    if len({float(score) for final in scope.compared for score in final.scores.ravel()}) == 1:
        return [
            f"All conditions are equal {where}: each of their runs ended at "
            f"{number(scope.compared[0].value)}."
        ]
    return [_ranking(scope, where, maximised), *_how_many_seeds(scope, gap)]


def _best(finals: Sequence[Final[C]], maximised: bool) -> list[Final[C]]:
    """The conditions with the best mean; several where they tie."""
    sign = 1.0 if maximised else -1.0
    best = max(sign * final.value for final in finals)
    return [final for final in finals if np.isclose(sign * final.value, best, atol=1e-9)]


def _ranking(scope: Scope[C], where: str, maximised: bool) -> str:
    best, *level = _best(scope.compared, maximised)
    pairs = [
        pair
        for pair in scope.comparisons
        if best in (pair.first, pair.second) and not {pair.first, pair.second} & set(level)
    ]
    # A mean may be better although most runs are worse: that is no evidence for it.
    undecided = [pair for pair in pairs if not (pair.decided and _agrees(pair, best, maximised))]
    if not undecided and not level:
        worst = max(pair.p_value for pair in pairs)
        return (
            f"{best.condition.label} is ahead {where}: {_in_words(best)}. So large a gap comes by "
            f"chance with {p_text(worst)} at most (permutation test, Holm's correction)."
        )
    gaps = []
    for pair in undecided:
        rival = pair.second if pair.first is best else pair.first
        gap = st.difference(best.estimate, rival.estimate)
        text = f"{rival.condition.label} ({number(gap.value)}, {interval_text(gap)}; "
        gaps.append((abs(float(gap.value)), f"{text}{p_text(pair.p_value)})"))
    lead = f"{_in_words(best)} is {_direction(maximised)}"
    if level:
        lead = f"{_labels([best, *level])} are level at {number(best.value)}"
    if not gaps:
        return f"No winner {where}: {lead}."
    most = sorted(final.seeds for final in scope.compared)[-2:]
    few = "from so few seeds " if _least_p(scope, *most) >= SIGNIFICANCE else ""
    return f"No winner {where}: {lead}, but {few}the gap to {_and(_nearest(gaps))} may be chance."


def _nearest(gaps: Sequence[tuple[float, str]]) -> list[str]:
    """Texts of all gaps, or of many those of the smallest ones and the number of the others."""
    if len(gaps) <= _MOST_RIVALS + 1:
        return [text for _, text in gaps]
    smallest = sorted(gaps, key=lambda gap: gap[0])[:_MOST_RIVALS]
    texts = [text for size, text in gaps if (size, text) in smallest]
    return [*texts, f"{len(gaps) - _MOST_RIVALS} others"]


def _agrees(pair: Comparison[C], best: Final[C], maximised: bool) -> bool:
    """Whether most runs of `best` are better than those of its rival."""
    higher = pair.estimate.value > 0.5
    return bool(higher == (pair.first is best) if maximised else higher == (pair.second is best))


def _least_p(scope: Scope[C], first: int, second: int) -> float:
    """The least adjusted p-value that these numbers of seeds can have."""
    relabellings: int = comb(first + second, first) ** scope.tasks
    return len(scope.comparisons) * 2 / relabellings


def _how_many_seeds(scope: Scope[C], gap: float) -> list[str]:
    """A sentence about the seeds that would likely decide what is undecided."""
    if all(pair.decided for pair in scope.comparisons):
        return []
    is_rate = scope.metric in names.EVAL_RATES
    columns = [
        column for final in scope.compared for column in np.split(final.scores, scope.tasks, 1)
    ]
    # Where a rate has no room for the gap, seeds differ less than they would elsewhere.
    clear = [c for c in columns if not is_rate or gap <= c.mean() <= 1 - gap]
    if not clear:
        ends = sorted({"ceiling" if column.mean() > 0.5 else "floor" for column in columns})
        return [
            f"All are within {gap:g} of the {' or '.join(ends)}, where seeds differ less than "
            "elsewhere: their spread does not tell how many would be needed."
        ]
    spread = st.pooled_spread(clear)
    if not spread:
        return ["Seeds ended alike: their spread does not tell how many would be needed."]
    differ = f"Seeds of the same condition differ by {number(spread)} (standard deviation)"
    seeds = min(final.seeds for final in scope.compared)
    if not is_rate:
        least = st.least_difference(seeds, spread, tasks=scope.tasks)
        return [
            f"{differ}. With {seeds} seeds per condition a difference of {number(least)} is seen "
            f"with {st.POWER * 100:.0f} % chance (t test, one comparison)."
        ]
    needed = st.seeds_to_decide(gap, spread, tasks=scope.tasks)
    # With fewer seeds no permutation test could decide anything.
    fewest = next(n for n in count(2) if _least_p(scope, n, n) < SIGNIFICANCE)
    if needed is None:
        outcome = "more than 1000 seeds per condition would be needed"
    elif (needed := max(needed, fewest)) <= seeds:
        outcome = f"the {seeds} seeds per condition that there are would mostly show it"
    else:
        outcome = (
            f"about {needed} seeds per condition would show it with {st.POWER * 100:.0f} % "
            f"chance, {needed - seeds} more than now"
        )
    return [f"{differ}. For a difference of {gap:.2f}, {outcome} (t test, one comparison)."]


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


def _direction(maximised: bool) -> str:
    return "highest" if maximised else "lowest"


def _in_words(final: Final[C]) -> str:
    seeds = "1 seed" if final.seeds == 1 else f"{final.seeds} seeds"
    return (
        f"{final.condition.label} with {number(final.value)} "
        f"({interval_text(final.estimate)}, {seeds})"
    )


def _labels(finals: Iterable[Final[C]]) -> str:
    return _and([final.condition.label for final in finals])


def _and(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
