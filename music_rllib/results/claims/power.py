"""Number of seeds that would decide what is undecided, from the spread of the primary metric."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from music_rllib.results.claims.contrasts import seeds_for_difference, seeds_for_equivalence
from music_rllib.results.claims.study import Claim, Mean
from music_rllib.results.comparison import number
from music_rllib.results.statistics import MAX_SEEDS, SIGNIFICANCE

FEWEST_SEEDS = 3
"""Least number of seeds whose spread counts; that of two may be ten times too small."""


def seeds_needed(claims: Sequence[Claim], means: Sequence[Mean], family: int) -> str | None:
    """A sentence about the seeds; None without a margin or where no spread is known.

    Conditions within the margin of a ceiling or floor are left out: their seeds differ less than
    those of others.

    Args:
        claims: claims whose spread counts.
        means: primary metric of the conditions.
        family: number of comparisons that are tested together; by Holm's method the first of them
            has a level of 5 % / family.
    """
    margin = max((claim.margin for claim in claims if claim.margin is not None), default=None)
    if margin is None:
        return None
    if means and all(_at_a_bound(mean, margin) for mean in means):
        return (
            f"All are within {margin:g} of the ceiling or the floor, where seeds differ less than "
            "elsewhere: their spread does not tell how many would be needed."
        )
    bounded = {(mean.condition.label, mean.task) for mean in means if _at_a_bound(mean, margin)}
    clear = [
        claim.contrast
        for claim in claims
        if claim.margin is not None
        and np.isfinite(claim.contrast.spread)
        and min(claim.contrast.seeds) >= FEWEST_SEEDS
        and not {(claim.first, claim.task), (claim.second, claim.task)} & bounded
    ]
    if not clear:
        return None
    paired = all(contrast.paired for contrast in clear)
    spread = float(np.sqrt(np.mean([float(contrast.spread) ** 2 for contrast in clear])))
    level = SIGNIFICANCE / family
    shown = seeds_for_difference(margin, spread, paired=paired, level=level)
    alike = seeds_for_equivalence(margin, spread, paired=paired, level=level)
    pairs = "paired seeds" if paired else "single seeds"
    return (
        f"Differences of {pairs} spread by {number(spread)} (standard deviation): a difference of "
        f"{margin:g} shows with 80 % chance from {_seeds(shown)} on, equivalence within it from "
        f"{_seeds(alike)} on where there is none."
    )


def _at_a_bound(mean: Mean, margin: float) -> bool:
    value = float(mean.estimate.value)
    return mean.measure.is_rate and not margin <= value <= 1 - margin


def _seeds(needed: int | None) -> str:
    return f"more than {MAX_SEEDS} seeds" if needed is None else f"{needed} seeds"
