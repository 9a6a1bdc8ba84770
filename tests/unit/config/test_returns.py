"""Bounds of targets, and divergence, compared with the reachable returns."""

from __future__ import annotations

import math

import numpy as np
import pytest

from music_rllib.config.tac_settings import Range, have_diverged

SPARSE = Range(-1.0, 0.0)


@pytest.mark.parametrize(
    ("means", "bonuses", "expected"),
    [
        ([0, -25, -39, 39], [0, 0, 0, 0], [False] * 4),
        ([0, -41, 41], [0, 0, 0], [False, True, True]),
        # At first the policy is so narrow that its entropies weigh as much as ten rewards.
        ([-41, -300, -300, -500], [0, -10, 0, 0], [True, False, False, True]),
        ([math.nan, -math.inf, -41], [0, 0, math.nan], [False, True, True]),
        # An unknown entropy does not hide a later divergence.
        ([0, -41, -41], [math.nan, 0, 0], [False, True, True]),
    ],
)
def test_critics_beyond_reachable_returns_have_diverged(
    means: list[float], bonuses: list[float], expected: list[bool]
) -> None:
    found = have_diverged(np.array(means), np.array(bonuses, float), SPARSE, 0.95)
    assert found.tolist() == expected
