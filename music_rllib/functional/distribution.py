"""The policy's distribution on [-1, 1]^A, and the Tsallis logarithm of its density.

The paper's convention (II-C, eq. 4-5): ``ln_q x = (x^(q-1) - 1) / (q-1)``, which is ``ln x`` at
q = 1. It is computed from log-densities: in float32 the power form has an error of 0.27 at
q = 1 + 1e-7. The distribution is a Gaussian squashed by tanh, with one density per dimension.

Shape legend: B batch, A action dimensions, `...` any shape.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

MAX_EXPONENT = 10.0
"""Largest (q-1) ln p at which the losses use ln_q itself; above, they use its tangent.

A peaked policy makes p^(q-1) explode for q > 1 (a density near 0 for q < 1). The tangent keeps
value and gradient finite, and the gradient never becomes 0. e^10 = 22,026: at q = 2 it affects
densities above that, at q = 1.5 above 4.9e8.
"""

HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
LOG_2 = math.log(2.0)
SHANNON = 1e-9
"""|q - 1| below which ln is used: the difference is far below float64 resolution."""


class PolicySample(NamedTuple):
    """An action by reparameterization and its log-density, both differentiable."""

    action: Tensor
    """[B, A] in (-1, 1)."""
    log_density: Tensor
    """[B, A] log pi of each dimension in nats, including the tanh Jacobian."""


def bounded_log_std(raw: Tensor, bounds: tuple[float, float], form: str) -> Tensor:
    """Log standard deviation [B, A] of the network's outputs [B, A], within `bounds`.

    A new network's output of 0 gives sigma = 1 with `clamp`, and the middle of the bounds with
    `tanh`: sigma = 1.2e-4 for [-20, 2].
    """
    low, high = bounds
    if form == "clamp":
        return raw.clamp(low, high)
    return low + 0.5 * (high - low) * (torch.tanh(raw) + 1.0)


def sample_squashed(mean: Tensor, log_std: Tensor, noise: Tensor) -> PolicySample:
    """tanh(mean + exp(log_std) * noise), with `noise` [B, A] standard normal.

    The Jacobian log(1 - tanh(u)^2) is computed as 2 (log 2 - u - softplus(-2u)), which keeps its
    digits if tanh saturates (Haarnoja et al. 2018, app. C; absent in paper eq. 11).
    """
    raw = _before_tanh(mean, log_std, noise)
    log_normal = -0.5 * noise.square() - log_std - HALF_LOG_2PI
    log_jacobian = 2.0 * (LOG_2 - raw - F.softplus(-2.0 * raw))
    return PolicySample(torch.tanh(raw), log_normal - log_jacobian)


def squashed_action(mean: Tensor, log_std: Tensor, noise: Tensor) -> Tensor:
    """The action of `sample_squashed` [B, A] without its density."""
    return torch.tanh(_before_tanh(mean, log_std, noise))


def _before_tanh(mean: Tensor, log_std: Tensor, noise: Tensor) -> Tensor:
    return mean + log_std.exp() * noise


def ln_q_of_log(log_x: Tensor, q: float, *, max_exponent: float = math.inf) -> Tensor:
    """(x^(q-1) - 1)/(q-1) (paper eq. 4), given ln x: [...] -> [...].

    Args:
        log_x: [...] natural logarithms, in nats.
        q: entropic index, any real number.
        max_exponent: where (q-1) ln x exceeds this, ln_q continues along its tangent.
    """
    order = q - 1.0
    if abs(order) < SHANNON:
        return log_x
    exponent = order * log_x
    if math.isinf(max_exponent):
        return torch.expm1(exponent) / order
    # Not as `exponent - inside`: its gradient is e^10 - e^10 where nothing is beyond, which in
    # float32 is a rounding error of up to 0.7% of the slope.
    beyond = torch.relu(exponent - max_exponent)
    value = torch.expm1(exponent.clamp(max=max_exponent)) + math.exp(max_exponent) * beyond
    return value / order


def bound_active(log_x: Tensor, q: float) -> Tensor:
    """[...] booleans: where (q-1) ln x exceeds `MAX_EXPONENT`, so that losses use the tangent."""
    return (q - 1.0) * log_x > MAX_EXPONENT


def ln_q_of_policy(log_density: Tensor, q: float, form: str) -> Tensor:
    """[B] ln_q of a factored policy's density, bounded by `MAX_EXPONENT`.

    Args:
        log_density: [B, A] log-density of each action dimension.
        q: entropic index > 0.
        form: "per_dimension" sums ln_q over dimensions (Lee et al. 2019's code);
            "joint" takes ln_q of the product of densities (the paper's equations).
    """
    if form == "per_dimension":
        return ln_q_of_log(log_density, q, max_exponent=MAX_EXPONENT).sum(-1)
    return ln_q_of_log(log_density.sum(-1), q, max_exponent=MAX_EXPONENT)
