"""Compares the rewards that an environment gave with those that hindsight computes from goals.

Shape legend: n steps of an episode, G goal features, B rows of a batch.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib.replay.buffer import GoalReward

Goals = NDArray[np.floating[Any]]

TOLERANCE = 1e-5
"""Difference of two rewards that counts as rounding, relative to the range of the rewards."""
_NUDGES = 64
"""Goals tried around those of a step, as they may have been before they were rounded."""
_ROWS, _MOST_ROUNDED = 4096, 0.005
"""Goals tried for the effect of rounding, and the share of them that may change their reward."""


class Unlike(NamedTuple):
    """A step whose reward is not the one that its goals have."""

    step: int
    """Number of the step, from 1."""
    given: float
    priced: float

    @property
    def problem(self) -> str:
        """Both values in words."""
        return f"a step returned reward {self.given:g}, compute_reward gives {self.priced:g}"


def first_unlike(
    reward: GoalReward, goals: NDArray[np.float32], given: NDArray[np.float32]
) -> Unlike | None:
    """The first step whose reward differs from the one of its goals; None: there is none.

    A reward may belong to the desired goal before or after its step. It may also differ as far as
    it does for goals that round to the same float32, as at the edge of a threshold.

    Args:
        reward: the function that hindsight uses.
        goals: [n+1, 2G] desired and achieved goals of an episode.
        given: [n] rewards of its steps.
    """
    desired, achieved = np.split(goals.astype(np.float64), 2, axis=1)
    achieved = achieved[1:]
    priced = _prices(reward, achieved, desired[1:])
    # Of a sparse reward, an episode may show one value only: a reached goal has the other one.
    known = np.concatenate([priced, _prices(reward, achieved, achieved)])
    tolerance = TOLERANCE * np.maximum(np.ptp(known), np.abs(given))
    wrong = np.flatnonzero(~(np.abs(given - priced) <= tolerance))
    for i in wrong:
        near = [_near(reward, achieved[i], desired[j]) for j in (i + 1, i)]
        if not any(low - tolerance[i] <= given[i] <= high + tolerance[i] for low, high in near):
            return Unlike(int(i) + 1, float(given[i]) + 0.0, float(priced[i]) + 0.0)
    return None


def _prices(reward: GoalReward, achieved: Goals, desired: Goals) -> NDArray[np.float64]:
    rewards = np.asarray(reward(achieved, desired), np.float64)
    return rewards.reshape(len(achieved))


def _near(reward: GoalReward, achieved: Goals, desired: Goals) -> tuple[float, float]:
    """Smallest and largest reward of goals [G] that round to about the given ones."""
    grain = 2.0 * np.spacing(np.maximum(np.abs(achieved), np.abs(desired)).astype(np.float32))
    signs = np.random.default_rng(0).choice([-1.0, 0.0, 1.0], (2, _NUDGES, len(achieved)))
    signs[:, 0] = 0.0
    rewards = _prices(reward, achieved + grain * signs[0], desired + grain * signs[1])
    return float(rewards.min()), float(rewards.max())


def lost_by_rounding(reward: GoalReward, achieved: Goals, distance: float) -> str | None:
    """Why goals around `achieved` [G] can't be kept in float32; None: they can.

    Goals far from the origin, such as UTM coordinates, lose the digits on which rewards depend.

    Args:
        reward: the function that hindsight uses.
        achieved: an achieved goal as the environment gives it.
        distance: typical distance of achieved and desired goals.
    """
    around = np.broadcast_to(achieved.astype(np.float64), (_ROWS, len(achieved)))
    desired = around + distance * directions(_ROWS, len(achieved), 1e-3, 2.0)
    exact, reached = _prices(reward, around, desired), _prices(reward, around, around)
    kept = _prices(reward, around.astype(np.float32), desired.astype(np.float32))
    changed = np.abs(exact - kept) > 0.05 * np.abs(exact - reached) + 1e-6 * np.ptp(exact)
    if changed.mean() <= _MOST_ROUNDED:
        return None
    entry = int(np.argmax(np.abs(achieved)))
    value = float(achieved[entry])
    return (
        f"achieved_goal[{entry}] is {value:.10g}, which float32 keeps to "
        f"{float(np.spacing(np.float32(abs(value)))):.2g} only, and that changes "
        f"{changed.mean():.0%} of the rewards: give goals relative to an origin that is near them"
    )


def directions(rows: int, size: int, nearest: float, farthest: float) -> NDArray[np.float64]:
    """[rows, size] random offsets of growing length, in random subsets of the entries."""
    rng = np.random.default_rng(0)
    lengths = np.geomspace(nearest, farthest, rows)[:, None]
    offsets = lengths * rng.standard_normal((rows, size))
    return np.asarray(offsets * rng.integers(0, 2, (rows, size)))
