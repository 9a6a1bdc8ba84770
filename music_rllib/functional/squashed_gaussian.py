"""Gaussian squashed by tanh: the policy's distribution on [-1, 1]^A, one density per dimension.

Shape legend: B batch, A action dimensions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
_LOG_2 = math.log(2.0)


class PolicySample(NamedTuple):
    """An action by reparameterisation and its log-density, both differentiable."""

    action: Tensor
    """[B, A] in (-1, 1)."""
    log_density: Tensor
    """[B, A] log pi of each dimension, in nats, the tanh Jacobian included."""


def bounded_log_std(raw: Tensor, bounds: tuple[float, float], form: str) -> Tensor:
    """Log standard deviation [B, A] of the network's outputs [B, A], within `bounds`.

    A fresh network's output of 0 gives sigma = 1 with `clamp`, and with `tanh` the middle of the
    bounds: sigma = 1.2e-4 for [-20, 2].
    """
    low, high = bounds
    if form == "clamp":
        return raw.clamp(low, high)
    return low + 0.5 * (high - low) * (torch.tanh(raw) + 1.0)


def sample_squashed(mean: Tensor, log_std: Tensor, noise: Tensor) -> PolicySample:
    """tanh(mean + exp(log_std) * noise), with `noise` [B, A] standard normal.

    The Jacobian log(1 - tanh(u)^2) is taken as 2 (log 2 - u - softplus(-2u)), which does not
    lose its digits where tanh saturates (Haarnoja et al. 2018, app. C; absent in paper eq. 11).
    """
    raw = _before_tanh(mean, log_std, noise)
    log_normal = -0.5 * noise.square() - log_std - _HALF_LOG_2PI
    log_jacobian = 2.0 * (_LOG_2 - raw - F.softplus(-2.0 * raw))
    return PolicySample(torch.tanh(raw), log_normal - log_jacobian)


def squashed_action(mean: Tensor, log_std: Tensor, noise: Tensor) -> Tensor:
    """The action of `sample_squashed` [B, A] without its density."""
    return torch.tanh(_before_tanh(mean, log_std, noise))


def _before_tanh(mean: Tensor, log_std: Tensor, noise: Tensor) -> Tensor:
    return mean + log_std.exp() * noise


def deterministic_action(mean: Tensor) -> Tensor:
    """[B, A] the action of evaluation: tanh of the mean."""
    return torch.tanh(mean)
