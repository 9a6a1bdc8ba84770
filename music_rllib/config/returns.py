"""Discounted returns that a configuration can reach, bounds that cut them off, and divergence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib.config.tac_settings import LearnedAlpha, MatchedAlpha, NormalisedAlpha, TACSettings
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.schedules import extremes

_ROUNDING = 1e-6
"""-1 / (1 - 0.98) is -49.99999999999996, which [-50, 0] does not cut off."""
_DIVERGED = 2.0
"""Critic means above this multiple of the reachable return count as diverged. Of 446 runs on Fetch,
one reached 13.9; all others stayed below 0.97."""


class Range(NamedTuple):
    """Smallest and largest value."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.low:.4g} to {self.high:.4g}"


def reward_of_step(task: Range, music: MusicSettings) -> Range:
    """Range of a step's reward: the task's, plus an intrinsic reward in weight times [-1, 0]."""
    low, high = task if music.task_reward else Range(0.0, 0.0)
    weight = extremes(music.mi_reward_weight)[1] if music.estimator != "none" else 0.0
    return Range(low - weight, high)


def cut_off(tac: TACSettings, music: MusicSettings, task: Range) -> str | None:
    """A warning if `target_bounds` cut off reachable targets.

    The return of an endless episode is a step's reward times 1/(1 - gamma); that of a terminated
    one is nearer to 0. The target value network also holds the entropies of later steps. These have
    no lower bound (a policy may be arbitrarily narrow), so they count at the upper end only. They
    count for one action dimension, because the environment decides on the number.
    """
    if tac.target_bounds is None:
        return None
    bounds, reward = Range(*tac.target_bounds), reward_of_step(task, music)
    steps = 1.0 / (1.0 - tac.gamma)
    bonus = _entropy_bonus(tac) * tac.gamma * steps
    reached = Range(
        min(reward.low, reward.low * steps), max(reward.high, reward.high * steps) + bonus
    )
    slack = _ROUNDING * max(abs(reached.low), abs(reached.high))
    if bounds.low <= reached.low + slack and bounds.high >= reached.high - slack:
        return None
    entropy = " and the entropy of one action dimension" if bonus > 0 else ""
    return (
        f"target_bounds {bounds} cut off reachable values, {reached}: "
        f"rewards of {reward} a step at gamma {tac.gamma:g}{entropy}"
    )


def _entropy_bonus(tac: TACSettings) -> float:
    """Largest entropy bonus of a step: alpha times the entropy of one uniform action dimension."""
    if tac.policy == "deterministic":
        return 0.0
    from music_rllib.functional.entropy_scale import largest_entropy  # loads PyTorch

    alpha = tac.alpha
    bonuses = [0.0]
    for q in extremes(tac.entropic_index):
        match alpha:
            case LearnedAlpha():
                largest = alpha.initial  # later values are unknown
            case MatchedAlpha() | NormalisedAlpha():
                largest = alpha.scaled(extremes(alpha.value)[1], q, 1, "per_dimension")
            case _:
                largest = extremes(alpha)[1]
        bonuses.append(largest * largest_entropy(q))
    return max(bonuses)


def have_diverged(
    means: NDArray[np.float64], bonuses: NDArray[np.float64], reward: Range, gamma: float
) -> NDArray[np.bool_]:
    """Whether critics are above `_DIVERGED` times every reachable return.

    Args:
        means: [N] means of the critics, in the order of time.
        bonuses: [N] α S_q of the policy at the same times. Its largest absolute value so far
            counts, because it has no bound and critics follow it late.
        reward: Range of a step's reward.
        gamma: Discount.

    Returns:
        [N]; False where a mean is NaN, and before the first bonus that is not NaN.
    """
    step = max(abs(reward.low), abs(reward.high))
    reached = (step + np.fmax.accumulate(np.abs(bonuses))) / (1.0 - gamma)
    return np.asarray(np.abs(means) > _DIVERGED * reached)
