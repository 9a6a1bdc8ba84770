"""How much verdicts depend on single seeds and on the number of hypotheses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from docs.result_pages.summary import STUDIES, between_q, complete_studies
from music_rllib.results.answer import p_in_words
from music_rllib.results.claims import Claim, Verdict, contrast, decided
from music_rllib.results.data import Sweep
from music_rllib.results.scores import counted, scores_of
from music_rllib.results.statistics import Array

MORE = {"claims-slide": 1}
"""Number of hypotheses dropped from a study before its first run."""


@dataclass(frozen=True)
class Stability:
    """A decided comparison of two q, and how often its verdict stays without one seed."""

    study: str
    claim: Claim
    same: int
    more: Claim | None
    """The claim with the dropped hypotheses in its family; None if none were dropped."""

    @property
    def seeds(self) -> int:
        return self.claim.contrast.seeds[0]

    def in_words(self) -> str:
        """`q = 2 against q = 1 on FetchPush (joint entropy, MUSIC-r): worse in 16 of 20 cases`."""
        claim = self.claim
        return (
            f"{claim.first} against {claim.second} on {claim.task} ({STUDIES[self.study]}): "
            f"{claim.verdict} in {self.same} of {self.seeds} cases"
        )


def robustness_list() -> Iterator[str]:
    """For each decided comparison of two q, how often its verdict stays the same."""
    for found in _stabilities():
        more = ""
        if found.more:
            more = (
                f"; with the dropped hypothesis in the family, {found.more.verdict} "
                f"({p_in_words(found.more)})"
            )
        yield f"- {found.in_words()}{more}."


def least_stable() -> str:
    """The verdicts that more than one seed decides."""
    stabilities = _stabilities()
    few = [found for found in stabilities if found.same < found.seeds - 1]
    return (
        f"{len(stabilities) - len(few)} of {len(stabilities)} stay in all or all but one of the "
        f"cases. The others: {'; '.join(found.in_words() for found in few)}."
    )


@cache
def _stabilities() -> tuple[Stability, ...]:
    return tuple(
        _stability(counted(sweep, claim.measure.kind), study.planned, at)
        for sweep, study in complete_studies()
        for at, claim in enumerate(study.planned)
        if claim in between_q(study.planned) and claim.verdict is not Verdict.UNDECIDED
    )


def _stability(sweep: Sweep, planned: Sequence[Claim], at: int) -> Stability:
    claim, cut = planned[at], MORE.get(sweep.name, 0)
    scores = [_scores(sweep, one) for one in planned]
    verdicts = [
        decided(
            [_without(seed, one, own) for one, own in zip(planned, scores, strict=True)],
            planned=True,
        )[at].verdict
        for seed in range(claim.contrast.seeds[0])
    ]
    more = decided(planned, planned=True, without_test=cut)[at] if cut else None
    return Stability(sweep.name, claim, verdicts.count(claim.verdict), more)


def _scores(sweep: Sweep, claim: Claim) -> Array:
    """The scores of both sides of a claim by paired seed, `[2, seeds]`."""
    ((first, second),) = claim.pairs
    sides = [
        scores_of(sweep, condition, claim.task, claim.measure).by_seed
        for condition in (first, second)
    ]
    return np.array([[side[seed] for seed in sides[0]] for side in sides])


def _without(left_out: int, claim: Claim, scores: Array) -> Claim:
    """The claim without one of its paired seeds."""
    x, y = np.delete(scores, left_out, axis=1)
    return replace(claim, contrast=contrast(x, y, paired=True, margin=claim.margin))
