"""How much verdicts depend on single seeds and on the number of hypotheses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from docs.result_pages.summary import STUDIES, between_q, complete_studies
from music_rllib.results.answer import p_in_words
from music_rllib.results.claims import Claim, Contrast, Verdict, contrast, decided
from music_rllib.results.data import Sweep
from music_rllib.results.scores import counted, scores_of

MORE = {"claims-slide": 1}
"""Number of hypotheses dropped from a study before its first run."""


def robustness_list() -> Iterator[str]:
    """For each decided comparison of two q, how often its verdict stays the same."""
    for sweep, study in complete_studies():
        for at, claim in enumerate(study.planned):
            if claim in between_q(study.planned) and claim.verdict is not Verdict.UNDECIDED:
                yield f"- {_stability(counted(sweep, claim.measure.kind), study.planned, at)}."


def _stability(sweep: Sweep, planned: Sequence[Claim], at: int) -> str:
    claim = planned[at]
    seeds = claim.contrast.seeds[0]
    verdicts = [
        decided(
            [replace(one, contrast=_without(sweep, one, seed)) for one in planned], planned=True
        )[at].verdict
        for seed in range(seeds)
    ]
    text = (
        f"{claim.first} against {claim.second} on {claim.task} "
        f"({STUDIES[sweep.name]}): {claim.verdict} in "
        f"{verdicts.count(claim.verdict)} of {seeds} cases"
    )
    if cut := MORE.get(sweep.name, 0):
        more = decided(planned, planned=True, without_test=cut)[at]
        text += f"; with the dropped hypothesis in the family, {more.verdict} ({p_in_words(more)})"
    return text


def _without(sweep: Sweep, claim: Claim, left_out: int) -> Contrast:
    """The contrast of a claim without one of its paired seeds."""
    ((first, second),) = claim.pairs
    sides = [
        scores_of(sweep, condition, claim.task, claim.measure).by_seed
        for condition in (first, second)
    ]
    x, y = (np.delete([side[seed] for seed in sides[0]], left_out) for side in sides)
    return contrast(x, y, paired=True, margin=claim.margin)
