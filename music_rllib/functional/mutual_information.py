"""Donsker-Varadhan bound on mutual information, and MUSIC's time shuffles.

Shape legend: N trajectories, T frames in time, D features of one half of the state.
Source: paper III-A; Zhao et al. 2021, "Mutual Information State Intrinsic Control".
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor


def donsker_varadhan(joint: Tensor, marginals: Tensor, inside: Tensor | None = None) -> Tensor:
    """mean_t T(x, y) - log mean_t exp T(x, y'), a lower bound on I(X; Y) in nats.

    Args:
        joint: [N, T] statistics of pairs that occurred together.
        marginals: [N, T] statistics of pairs from the product of marginals.
        inside: [N, T] False for padding after the end of a trajectory; None: no padding.

    Returns:
        [N] bounds; adding a constant to the statistic does not change them. With few frames, a
        single bound is noisy and on average slightly too high.
    """
    if inside is None:
        log_mean_exp = torch.logsumexp(marginals, dim=-1) - math.log(marginals.shape[-1])
        return joint.mean(dim=-1) - log_mean_exp
    frames, padding = inside.sum(dim=-1), ~inside
    log_sum_exp = torch.logsumexp(marginals.masked_fill(padding, -math.inf), dim=-1)
    mean = joint.masked_fill(padding, 0.0).sum(dim=-1) / frames
    return mean - (log_sum_exp - frames.to(mean).log())


def time_permutations(
    trajectories: int,
    frames: int,
    generator: torch.Generator,
    *,
    draws: int | None = None,
    inside: Tensor | None = None,
) -> Tensor:
    """Random permutations of time, [N, T] integers.

    Args:
        generator: source of randomness, on the device of the result.
        draws: number of permutations, each for an equal share of neighboring trajectories
            (`of_draw`). None: one for each trajectory.
        inside: [N, T] False for padding, which keeps its place: only a trajectory's own frames are
            permuted. None: no padding.
    """
    rows = trajectories if draws is None else draws
    keys = torch.rand(rows, frames, generator=generator, device=generator.device)
    if inside is None:
        permutations = _order(keys)
        return permutations if draws is None else of_draw(permutations, trajectories)
    keys = keys if draws is None else of_draw(keys, trajectories)
    return keys.masked_fill(~inside, 1.0).argsort(dim=-1, stable=True)


def of_draw(drawn: Tensor, rows: int) -> Tensor:
    """[draws, ...] -> [rows, ...]: each draw repeated for an equal share of the rows, in order."""
    owners = torch.arange(rows, device=drawn.device) * len(drawn) // rows
    return drawn[owners]


def _order(keys: Tensor) -> Tensor:
    """Positions of each row's keys in rising order; NumPy needs a quarter of PyTorch's time."""
    if keys.device.type == "cpu":
        return torch.from_numpy(np.argsort(keys.numpy(), axis=-1))
    return keys.argsort(dim=-1)


def shuffle_time(values: Tensor, permutations: Tensor) -> Tensor:
    """[N, T, D] with the frames of each trajectory rearranged by its [N, T] permutation."""
    return values.gather(1, permutations.unsqueeze(-1).expand_as(values))
