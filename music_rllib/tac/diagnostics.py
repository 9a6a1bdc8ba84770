"""What is measured of an update or of fresh episodes. Formulas: docs/algorithms.md.

Shape legend: B batch, A action dimensions, C critics, S steps of several episodes behind each
other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from music_rllib.tac.forward import TACForward
from music_rllib.tracking import names
from music_rllib.tsallis import MAX_EXPONENT, bound_active, ln_q_of_log, ln_q_of_policy

__all__ = ["discounted_returns", "of_intrinsic_reward", "of_policy", "of_targets"]


@torch.no_grad()
def of_policy(
    forward: TACForward, q: float, form: str, log_std_bounds: tuple[float, float]
) -> dict[str, Tensor]:
    """Entropies of the minibatch's policy, and which of its numerical bounds act."""
    density, log_std = forward.log_density, forward.log_std
    if density is None or log_std is None:
        return {}
    low, high = log_std_bounds
    # Bounded as in the losses: a metric that overflows would stop a run whose losses are finite.
    tsallis = -ln_q_of_log(density, q, max_exponent=MAX_EXPONENT).mean(0)
    shannon = -density.mean(0)
    per_dimension = {f"{names.ENTROPY_OF_DIMENSION}{i}": s for i, s in enumerate(tsallis)}
    per_dimension |= {f"{names.SHANNON_OF_DIMENSION}{i}": s for i, s in enumerate(shannon)}
    return per_dimension | {
        names.ENTROPY: -ln_q_of_policy(density, q, form).mean(),
        names.SHANNON_ENTROPY: shannon.sum(),
        names.CLIPPED_DENSITIES: bound_active(_bounded_densities(density, form), q).float().mean(),
        names.LOG_STD_AT_BOUND: ((log_std <= low) | (log_std >= high)).float().mean(),
    }


def _bounded_densities(log_density: Tensor, form: str) -> Tensor:
    """The densities that ln_q is taken of, [B, A] or [B]."""
    return log_density if form == "per_dimension" else log_density.sum(-1)


@torch.no_grad()
def of_targets(target: Tensor, bounds: tuple[float, float] | None) -> dict[str, Tensor]:
    """Share of critic targets [B] that lie on their bounds; nothing where there are none."""
    if bounds is None:
        return {}
    low, high = bounds
    return {names.CLIPPED_TARGETS: ((target <= low) | (target >= high)).float().mean()}


@torch.no_grad()
def of_intrinsic_reward(reward: Tensor) -> dict[str, Tensor]:
    """Mean of the intrinsic rewards [B], and the shares at the ends of their range [-1, 0]."""
    return {
        names.MI_REWARD: reward.mean(),
        names.MI_REWARD_LOWEST: (reward <= -1.0).float().mean(),
        names.MI_REWARD_HIGHEST: (reward >= 0.0).float().mean(),
    }


def discounted_returns(
    rewards: NDArray[np.float64], lengths: Sequence[int], gamma: float
) -> NDArray[np.float64]:
    """Discounted sum of each episode's rewards: [S] and the episodes' lengths -> one each."""
    episodes = np.split(rewards, np.cumsum(lengths)[:-1])
    return np.array([episode @ gamma ** np.arange(len(episode)) for episode in episodes])
