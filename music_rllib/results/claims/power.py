"""How many seeds would decide what is not decided yet, from the spread of the primary metric."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from music_rllib.results.claims.contrasts import seeds_for_difference, seeds_for_equivalence
from music_rllib.results.claims.study import Claim, Mean
from music_rllib.results.comparison import number
from music_rllib.results.statistics import MAX_SEEDS, SIGNIFICANCE

FEWEST_SEEDS = 3
"""From two, the spread may be ten times too small."""


def seeds_needed(claims: Sequence[Claim], means: Sequence[Mean], family: int) -> str | None:
    """In a sentence; None without a margin or where no spread is known.

    Nothing is said from what is within the margin of a ceiling or floor, where seeds differ less
    than elsewhere.

    Args:
        claims: whose spread counts.
        means: of the conditions.
        family: comparisons that are tested together; the first of them has 5 % / family by Holm's
            method.
    """
    stated = [one for one in claims if one.margin is not None]
    if not stated:
        return None
    margin = max(one.margin for one in stated if one.margin is not None)
    if means and all(_at_a_bound(one, margin) for one in means):
        return (
            f"All are within {margin:g} of the ceiling or the floor, where seeds differ less than "
            "elsewhere: their spread does not tell how many would be needed."
        )
    bounded = {(one.condition.label, one.task) for one in means if _at_a_bound(one, margin)}
    clear = [
        one
        for one in stated
        if np.isfinite(one.contrast.spread)
        and min(one.contrast.seeds) >= FEWEST_SEEDS
        and not {(one.first, one.task), (one.second, one.task)} & bounded
    ]
    if not clear:
        return None
    paired = all(one.contrast.paired for one in clear)
    spread = float(np.sqrt(np.mean([float(one.contrast.spread) ** 2 for one in clear])))
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
