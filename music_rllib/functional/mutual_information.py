"""Bounds on mutual information, and MUSIC's time shuffles.

Shape legend: N trajectories, T frames in time, R permutations, D features of one half of the state.
Sources: paper III-A; Zhao et al. 2021, "Mutual Information State Intrinsic Control"; for the other
bounds Poole et al. 2019 and Song and Ermon 2020.
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


SMILE_CLIP = 5.0
"""SMILE's tau: statistics of the product of marginals are clipped to [-tau, tau]."""
AVERAGE_RATE = 0.01
"""Share of an update in the moving average of MINE."""


def other_bound(
    kind: str, joint: Tensor, marginals: Tensor, inside: Tensor | None = None
) -> Tensor:
    """Other bounds on I(X; Y) in nats, for statistics without a cap.

    - `moving_average`: Donsker-Varadhan; only its gradient differs (MINE, Belghazi et al. 2018)
    - `nwj`: mean T(x, y) - mean exp(T(x, y') - 1) (Nguyen et al. 2010; Poole et al. 2019, eq. 6)
    - `smile`: Donsker-Varadhan with T(x, y') in [-5, 5] (Song and Ermon 2020, eq. 15), no bound of
      its own unless T is near the log density ratio
    - `infonce`: mean of T(x, y) - log mean of exp T(x, y) and of R exp T(x, y'), at most ln(R + 1)
      (van den Oord et al. 2018; Poole et al. 2019, eq. 10)

    Args:
        kind: one of them.
        joint: [N, T] statistics of pairs that occurred together.
        marginals: [R, N, T] statistics of pairs from the product of marginals; R is 1 except for
            `infonce`.
        inside: [N, T] False for padding after the end of a trajectory; None: no padding.

    Returns:
        [N] bounds.
    """
    inside = torch.ones_like(joint, dtype=torch.bool) if inside is None else inside

    def mean(values: Tensor) -> Tensor:
        return values.masked_fill(~inside, 0.0).sum(-1) / inside.sum(-1)

    match kind:
        case "nwj":
            return mean(joint) - mean((marginals[0] - 1.0).exp())
        case "infonce":
            both = torch.cat([joint.unsqueeze(0), marginals])
            return mean(joint - both.logsumexp(0)) + math.log(len(both))
        case "smile":
            marginals = marginals.clamp(-SMILE_CLIP, SMILE_CLIP)
    return donsker_varadhan(joint, marginals[0], inside)


def shifted(permutations: Tensor, count: int, inside: Tensor | None = None) -> Tensor:
    """[N, T] permutations -> [R, N, T]: the same ones, each started R times one frame later.

    R is at most `count`, and T - 1.
    """
    rows, frames = permutations.shape
    time = torch.arange(frames, device=permutations.device)
    lengths = time.new_full((rows, 1), frames) if inside is None else inside.sum(-1, keepdim=True)
    starts = range(max(min(count, frames - 1), 1))
    places = [torch.where(time < lengths, (time + start) % lengths, time) for start in starts]
    return torch.stack([permutations.gather(1, each) for each in places])


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
