"""Claims: one condition against another, seed by seed, tested with those it is a family with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from music_rllib import names
from music_rllib.config.analysis import Hypothesis
from music_rllib.results import statistics as st
from music_rllib.results.claims.contrasts import Contrast, Verdict, contrast, decide
from music_rllib.results.claims.plan import MARGIN_OF_A_RATE
from music_rllib.results.claims.scores import Measure, Scores, scores_of
from music_rllib.results.comparison import ALL_TASKS
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array

Cells = Sequence[tuple[Condition, Condition]]
"""Pairs of conditions that are alike in the rest."""

FEWEST_SHARED = 2
"""Least number of shared seeds for a comparison in pairs."""


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
    p_value: float = 1.0
    """Adjusted p-value of no difference; it and the fields below are set by :func:`decided`."""
    p_equivalent: float | None = None
    """Adjusted p-value of no equivalence; None without a margin."""
    verdict: Verdict = Verdict.UNDECIDED
    planned: bool = False
    """Whether it was stated before the first of its runs had finished."""
    hypothesis: Hypothesis | None = None

    @property
    def subject(self) -> tuple[object, ...]:
        """What it is about: two claims on the same subject differ in nothing but the plan."""
        pairs = frozenset(frozenset(pair) for pair in self.pairs)
        return pairs, self.task, self.measure.kind, self.measure.metric

    @property
    def p_of_verdict(self) -> float:
        """The adjusted p-value of the test that the verdict comes from."""
        if self.verdict is Verdict.EQUIVALENT and self.p_equivalent is not None:
            return self.p_equivalent
        return self.p_value

    @property
    def confirmed(self) -> bool | None:
        """Whether its hypothesis holds; None where that is undecided or nothing was expected."""
        expected = {
            "better than": Verdict.SUPERIOR,
            "worse than": Verdict.WORSE,
            "equivalent to": Verdict.EQUIVALENT,
        }.get(self.hypothesis.relation if self.hypothesis else "against")
        if expected is None or self.verdict is Verdict.UNDECIDED:
            return None
        return self.verdict is expected


def claims_of(
    sweep: Sweep,
    comparisons: Sequence[tuple[str, str, Cells]],
    measures: Mapping[str, Measure],
    margin: float | None,
) -> Iterator[Claim]:
    """Undecided claims over all tasks, and on each, of two labels and the cells that they name."""
    for scope, own in _scopes(measures):
        measure, *others = own.values()
        if any(other.horizon != measure.horizon for other in others):
            measure = replace(measure, horizon=np.nan)
        is_success = measure.metric == names.EVAL_SUCCESS
        # One of 1 or more can only be meant for returns.
        not_for_rates = margin is None or margin >= 1
        own_margin = MARGIN_OF_A_RATE if is_success and not_for_rates else margin
        for first, second, cells in comparisons:
            columns = [
                [scores_of(sweep, pair[side], task, m) for pair in cells for task, m in own.items()]
                for side in (0, 1)
            ]
            tested = _contrast(*columns, is_rate=measure.is_rate, margin=own_margin)
            if tested is not None:
                yield Claim(
                    first=first,
                    second=second,
                    task=scope,
                    measure=measure,
                    margin=own_margin,
                    contrast=tested,
                    pairs=cells,
                )


def _scopes(measures: Mapping[str, Measure]) -> Iterator[tuple[str, Mapping[str, Measure]]]:
    """All tasks together, where they have a unit in common, and each by itself."""
    if len(measures) > 1 and all(one.is_rate for one in measures.values()):
        yield ALL_TASKS, measures
    for task, one in measures.items():
        yield task, {task: one}


def _contrast(
    first: Sequence[Scores], second: Sequence[Scores], *, is_rate: bool, margin: float | None
) -> Contrast | None:
    """The contrast of two sides; None where one has no seed that has finished everywhere.

    Args:
        first: scores on each task of each of several pairs that are alike in the rest.
        second: scores of the other side.
        is_rate: whether they are rates, whose episodes tell how sure seeds that tie are.
        margin: difference below which it does not matter.
    """
    sides = [_complete(first), _complete(second)]
    if not (sides[0] and sides[1]):
        return None
    shared = [seed for seed in sides[0] if seed in sides[1]]
    paired = len(shared) >= FEWEST_SHARED and 2 * len(shared) >= max(map(len, sides))
    if paired:
        sides = [{seed: side[seed] for seed in shared} for side in sides]
    matrices = [np.array(list(side.values())) for side in sides]
    apart = None
    if is_rate:
        episodes = [float(np.mean([one.episodes for one in side])) for side in (first, second)]
        apart = st.difference(*map(st.estimate, matrices, episodes))
    x, y = (matrix.mean(axis=1) for matrix in matrices)
    return contrast(x, y, paired=paired, margin=margin, apart=apart)


def _complete(columns: Sequence[Scores]) -> dict[str, Array]:
    """The scores of each seed that has finished in every column."""
    seeds = [seed for seed in columns[0].by_seed if all(seed in c.by_seed for c in columns)]
    return {seed: np.array([c.by_seed[seed] for c in columns]) for seed in seeds}


def decided(claims: Sequence[Claim], *, planned: bool, without_test: int = 0) -> tuple[Claim, ...]:
    """The claims with adjusted p-values and verdicts, as one family with those without a test."""
    opposite = {Verdict.SUPERIOR: Verdict.WORSE, Verdict.WORSE: Verdict.SUPERIOR}
    return tuple(
        replace(
            claim,
            p_value=p_value,
            p_equivalent=p_equivalent,
            verdict=verdict if claim.measure.maximised else opposite.get(verdict, verdict),
            planned=planned,
        )
        for claim, (p_value, p_equivalent, verdict) in zip(
            claims, decide([claim.contrast for claim in claims], without_test), strict=True
        )
    )
