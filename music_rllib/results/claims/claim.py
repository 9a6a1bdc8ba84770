"""Claims: one condition against another, seed by seed, tested with those it is a family with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from music_rllib import names
from music_rllib.config.analysis import Hypothesis
from music_rllib.results.claims.contrasts import (
    COLLAPSES,
    FEWEST_SEEDS,
    Contrast,
    Verdict,
    adjusted,
    contrast,
    verdict_of,
)
from music_rllib.results.claims.plan import MARGIN_OF_A_RATE
from music_rllib.results.claims.scores import Measure, Scores, scores_of
from music_rllib.results.comparison import ALL_TASKS
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array

Cells = Sequence[tuple[Condition, Condition]]
"""Pairs of conditions that are alike in the rest."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """One condition against another on a task, tested."""

    first: str
    second: str
    task: str
    """The task, or `ALL_TASKS` for their mean."""
    measure: Measure
    margin: float | None
    """Difference below which it does not matter; None where none was stated."""
    contrast: Contrast
    pairs: Cells = field(repr=False)
    """Pairs of conditions, alike in the rest, over which it is the mean."""
    waiting: int = 0
    """Number of planned runs of both sides that are neither finished nor failed."""
    failed: int = 0
    """Number of failed runs, which count with the worst value."""
    p_value: float | None = None
    """Adjusted p-value of no difference, set by :func:`decided`; None outside of a family."""
    p_equivalent: float | None = None
    """Adjusted p-value of no equivalence; None without a margin or outside of a family."""
    verdict: Verdict = Verdict.NONE
    why: str = ""
    """Reason why there is no verdict."""
    planned: bool = False
    """Whether it was stated before the first of its runs had finished."""
    hypothesis: Hypothesis | None = None

    @property
    def subject(self) -> tuple[object, ...]:
        """What it is about: two claims on the same subject differ in nothing but the plan."""
        pairs = frozenset(frozenset(pair) for pair in self.pairs)
        return pairs, self.task, self.measure.kind, self.measure.metric

    @property
    def collapses(self) -> float | None:
        """Rate of collapses per seed that the verdict does not exclude; None if it is small."""
        rate = float(self.contrast.collapses)
        undecided = self.verdict in (Verdict.UNDECIDED, Verdict.NONE)
        return None if undecided or rate < COLLAPSES else rate

    @property
    def confirmed(self) -> bool | None:
        """Whether its hypothesis holds; None where that is undecided or nothing was expected."""
        expected = {
            "better than": Verdict.SUPERIOR,
            "worse than": Verdict.WORSE,
            "equivalent to": Verdict.EQUIVALENT,
        }.get(self.hypothesis.relation if self.hypothesis else "against")
        if expected is None or self.verdict in (Verdict.UNDECIDED, Verdict.NONE):
            return None
        return self.verdict is expected


def claims_of(
    sweep: Sweep,
    comparisons: Sequence[tuple[str, str, Cells]],
    measures: Mapping[str, Measure],
    margin: float | None,
    seeds: int = 0,
) -> Iterator[Claim]:
    """Claims without a verdict, over all tasks and on each.

    Args:
        sweep: the runs.
        comparisons: two labels each, and the cells that they name.
        measures: task to measure.
        margin: difference below which it does not matter; None: the default for success rates.
        seeds: number of seeds that were planned for each condition; 0 if unknown.
    """
    for scope, own in _scopes(measures):
        measure, *others = own.values()
        if any(other.horizon != measure.horizon for other in others):
            measure = replace(measure, horizon=np.nan)
        is_success = measure.metric == names.EVAL_SUCCESS
        # One of 1 or more can only be meant for returns.
        not_for_rates = margin is None or margin >= 1
        own_margin = MARGIN_OF_A_RATE if is_success and not_for_rates else margin
        for first, second, cells in comparisons:
            sides = [
                [scores_of(sweep, pair[side], task, m) for pair in cells for task, m in own.items()]
                for side in (0, 1)
            ]
            tested = _contrast(*sides, margin=own_margin)
            every = [scores for side in sides for scores in side]
            if tested is not None:
                yield Claim(
                    first=first,
                    second=second,
                    task=scope,
                    measure=measure,
                    margin=own_margin,
                    contrast=tested,
                    pairs=cells,
                    waiting=sum(max(one.waiting, seeds - len(one.by_seed)) for one in every),
                    failed=sum(one.failed for one in every),
                )


def _scopes(measures: Mapping[str, Measure]) -> Iterator[tuple[str, Mapping[str, Measure]]]:
    """All tasks together, where they have a unit in common, and each by itself."""
    if len(measures) > 1 and all(one.is_rate for one in measures.values()):
        yield ALL_TASKS, measures
    for task, one in measures.items():
        yield task, {task: one}


def _contrast(
    first: Sequence[Scores], second: Sequence[Scores], *, margin: float | None
) -> Contrast | None:
    """The contrast of two sides; None where one has no seed with a score everywhere.

    Args:
        first: scores on each task of each of several pairs that are alike in the rest.
        second: scores of the other side.
        margin: difference below which it does not matter.
    """
    sides = [_complete(first), _complete(second)]
    if not (sides[0] and sides[1]):
        return None
    paired = sides[0].keys() == sides[1].keys()
    if paired:
        sides[1] = {seed: sides[1][seed] for seed in sides[0]}
    x, y = (np.array([row.mean() for row in side.values()]) for side in sides)
    variances = (
        sum(one.noise for one in columns) / len(columns) ** 2 / len(side)
        for columns, side in zip((first, second), sides, strict=True)
    )
    return contrast(x, y, paired=paired, margin=margin, noise=float(np.sqrt(sum(variances))))


def _complete(columns: Sequence[Scores]) -> dict[str, Array]:
    """The scores of each seed that has finished in every column."""
    seeds = [seed for seed in columns[0].by_seed if all(seed in c.by_seed for c in columns)]
    return {seed: np.array([c.by_seed[seed] for c in columns]) for seed in seeds}


def decided(claims: Sequence[Claim], *, planned: bool, without_test: int = 0) -> tuple[Claim, ...]:
    """The claims with adjusted p-values and verdicts, as one family with those without a test."""
    p_values = adjusted([claim.contrast.p_values for claim in claims], without_test)
    return tuple(
        _decided(replace(claim, p_value=p_value, p_equivalent=p_equivalent, planned=planned))
        for claim, (p_value, p_equivalent) in zip(claims, p_values, strict=True)
    )


def exploratory(claims: Sequence[Claim]) -> tuple[Claim, ...]:
    """Claims that were not planned beside others that were: no verdict, no adjusted p-value."""
    return tuple(replace(claim, why="exploratory: not in the plan") for claim in claims)


def _decided(claim: Claim) -> Claim:
    """The claim with its verdict, or with the reason why it has none."""
    seeds = min(claim.contrast.seeds)
    if claim.waiting:
        runs = "1 run is" if claim.waiting == 1 else f"{claim.waiting} runs are"
        return replace(claim, why=f"{runs} not finished")
    if seeds < FEWEST_SEEDS:
        count = "1 seed" if seeds == 1 else f"{seeds} seeds"
        return replace(claim, why=f"{count}: no verdict below {FEWEST_SEEDS}")
    if not claim.contrast.difference.has_interval:
        return replace(claim, why="all seeds tie: no spread to go by")
    assert claim.p_value is not None
    value = float(claim.contrast.difference.value)
    sign = 1 if claim.measure.maximised else -1
    return replace(claim, verdict=verdict_of(sign * value, claim.p_value, claim.p_equivalent))
