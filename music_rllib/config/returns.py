"""Which discounted returns a configuration can reach, and whether its targets are cut off there."""

from __future__ import annotations

from typing import NamedTuple

from music_rllib.config.tac_settings import (
    Alpha,
    LearnedAlpha,
    MatchedAlpha,
    NormalisedAlpha,
    TACSettings,
)
from music_rllib.functional.entropy_scale import largest_entropy
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.schedules import extremes

__all__ = ["CutOff", "Range", "cut_off", "reward_a_step"]

_ROUNDING = 1e-6
"""-1 / (1 - 0.98) is -49.99999999999996, which [-50, 0] does not cut off."""


class Range(NamedTuple):
    """Smallest and largest value."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.low:.4g} to {self.high:.4g}"


def reward_a_step(task: Range, music: MusicSettings) -> Range:
    """The reward that is learned from: the task's, and the intrinsic one in weight times [-1, 0].

    Args:
        task: The task's reward; without effect where MUSIC leaves it out.
        music: Says what counts, and how much. Of a schedule the largest weight.
    """
    low, high = task if music.task_reward else Range(0.0, 0.0)
    weight = extremes(music.mi_reward_weight)[1] if music.estimator != "none" else 0.0
    return Range(low - weight, high)


class CutOff(NamedTuple):
    """Targets that can be reached and are clipped; as text, what to say of it."""

    bounds: Range
    reached: Range
    reward: Range
    """Of a step."""
    gamma: float
    with_entropy: bool

    def __str__(self) -> str:
        entropy = " and the entropy of one action dimension" if self.with_entropy else ""
        return (
            f"target_bounds {self.bounds} cut off values that can be reached, {self.reached}: "
            f"rewards of {self.reward} a step at gamma {self.gamma:g}{entropy}"
        )


def cut_off(tac: TACSettings, music: MusicSettings, task: Range) -> CutOff | None:
    """Whether `target_bounds` cut off targets that can be reached; None: they don't.

    A return without end is a step's reward times 1/(1 - gamma); one that ends by termination is
    nearer to 0. The averaged value also holds the entropies of the later steps. Those have no
    lower end (a policy may be as narrow as it likes), so they count at the upper end only, and,
    since the number of actions is the environment's, with one action dimension.
    """
    if tac.target_bounds is None:
        return None
    bounds, reward = Range(*tac.target_bounds), reward_a_step(task, music)
    steps = 1.0 / (1.0 - tac.gamma)
    bonus = _entropy_bonus(tac) * tac.gamma * steps
    reached = Range(
        min(reward.low, reward.low * steps), max(reward.high, reward.high * steps) + bonus
    )
    slack = _ROUNDING * max(abs(reached.low), abs(reached.high))
    if bounds.low <= reached.low + slack and bounds.high >= reached.high - slack:
        return None
    return CutOff(bounds, reached, reward, tac.gamma, bonus > 0)


def _entropy_bonus(tac: TACSettings) -> float:
    """The most that one action dimension's entropy adds to a step: alpha times the uniform one's.

    A learned alpha counts as it begins.
    """
    if tac.policy == "deterministic":
        return 0.0
    qs = extremes(tac.entropic_index)
    return max(0.0, *(_largest_alpha(tac.alpha, q) * largest_entropy(q) for q in qs))


def _largest_alpha(alpha: Alpha, q: float) -> float:
    if isinstance(alpha, LearnedAlpha):
        return alpha.initial
    if isinstance(alpha, MatchedAlpha | NormalisedAlpha):
        return alpha.scaled(extremes(alpha.value)[1], q, 1, "per_dimension")
    return extremes(alpha)[1]
