"""Discounted returns that a configuration can reach, and what cuts them off or is beyond them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib.config.tac_settings import (
    Alpha,
    LearnedAlpha,
    MatchedAlpha,
    NormalisedAlpha,
    TACSettings,
)
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
    """Range of a step's reward: the task's, plus an intrinsic one in weight times [-1, 0]."""
    low, high = task if music.task_reward else Range(0.0, 0.0)
    weight = extremes(music.mi_reward_weight)[1] if music.estimator != "none" else 0.0
    return Range(low - weight, high)


class CutOff(NamedTuple):
    """Reachable targets that are clipped, and the warning about them."""

    reached: Range
    warning: str

    def __str__(self) -> str:
        return self.warning


def cut_off(tac: TACSettings, music: MusicSettings, task: Range) -> CutOff | None:
    """The reachable targets, if `target_bounds` cut off some of them.

    The return of an endless episode is a step's reward times 1/(1 - gamma); that of a terminated
    one is nearer to 0. The target value network also holds the entropies of later steps. These have
    no lower bound (a policy may be arbitrarily narrow), so that they count at the upper end only.
    They count for one action dimension, because the environment decides on the number.
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
    warning = (
        f"target_bounds {bounds} cut off values that can be reached, {reached}: "
        f"rewards of {reward} a step at gamma {tac.gamma:g}{entropy}"
    )
    return CutOff(reached, warning)


def _entropy_bonus(tac: TACSettings) -> float:
    """Largest entropy bonus of a step: alpha times the entropy of one uniform action dimension."""
    if tac.policy == "deterministic":
        return 0.0
    from music_rllib.functional.entropy_scale import largest_entropy  # loads PyTorch

    qs = extremes(tac.entropic_index)
    return max(0.0, *(_largest_alpha(tac.alpha, q) * largest_entropy(q) for q in qs))


def _largest_alpha(alpha: Alpha, q: float) -> float:
    if isinstance(alpha, LearnedAlpha):
        return alpha.initial  # where it goes from there is not known
    if isinstance(alpha, MatchedAlpha | NormalisedAlpha):
        return alpha.scaled(extremes(alpha.value)[1], q, 1, "per_dimension")
    return extremes(alpha)[1]


def have_diverged(
    means: NDArray[np.float64], bonuses: NDArray[np.float64], reward: Range, gamma: float
) -> NDArray[np.bool_]:
    """Where critics are so far from all returns that they can't have learned them from rewards.

    Args:
        means: [N] means of the critics, in the order of time.
        bonuses: [N] α S_q of the policy at the same times. Its largest size so far counts, as
            it has no bound and critics follow it late.
        reward: That of a step.
        gamma: The discount.

    Returns:
        [N]; False where a mean is NaN, and before the first bonus that is not.
    """
    step = max(abs(reward.low), abs(reward.high))
    reached = (step + np.fmax.accumulate(np.abs(bonuses))) / (1.0 - gamma)
    return np.asarray(np.abs(means) > _DIVERGED * reached)
