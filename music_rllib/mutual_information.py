"""Donsker-Varadhan bound on mutual information, and the time shuffles that MUSIC feeds it.

Shape legend: N trajectories, T frames in time, D features of one half of the state.
Source: paper III-A; Zhao et al. 2021, "Mutual Information State Intrinsic Control".
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["donsker_varadhan", "shuffle_time", "time_permutations"]


def donsker_varadhan(joint: Tensor, marginals: Tensor) -> Tensor:
    """mean_t T(x, y) - log mean_t exp T(x, y'), a lower bound on I(X; Y) in nats.

    Args:
        joint: [N, T] statistics of pairs that occurred together.
        marginals: [N, T] statistics of pairs from the product of marginals.

    Returns:
        [N] bounds; unchanged when a constant is added to the statistic. The mean over few
        frames of exp T makes a single bound noisy and, in expectation, slightly too high.
    """
    log_mean_exp = torch.logsumexp(marginals, dim=-1) - math.log(marginals.shape[-1])
    return joint.mean(dim=-1) - log_mean_exp


def time_permutations(
    trajectories: int, frames: int, generator: torch.Generator, *, shared: bool = False
) -> Tensor:
    """Random permutations of time, [N, T] integers.

    Args:
        generator: source of randomness; its device is the result's.
        shared: one permutation for all trajectories, as in the original, which draws it once
            per minibatch (on two frames it is the identity half the time).
    """
    rows = 1 if shared else trajectories
    keys = torch.rand(rows, frames, generator=generator, device=generator.device)
    return keys.argsort(dim=-1).expand(trajectories, frames)


def shuffle_time(values: Tensor, permutations: Tensor) -> Tensor:
    """[N, T, D] with the frames of each trajectory rearranged by its [N, T] permutation."""
    return values.gather(1, permutations.unsqueeze(-1).expand_as(values))
