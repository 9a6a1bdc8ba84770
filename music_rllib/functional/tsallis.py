"""The Tsallis logarithm of numbers and of policies (paper II-C, eq. 4-5).

The paper's convention: ``ln_q x = (x^(q-1) - 1) / (q-1)``, which is ``ln x`` at q = 1. All is
computed from log-densities: in float32 the power form is wrong by 0.27 at q = 1 + 1e-7.

Shape legend: B batch, A action dimensions, `...` any shape.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_EXPONENT = 10.0
"""Largest (q-1) ln p at which the losses use ln_q itself; above, they use its tangent.

A peaked policy makes p^(q-1) explode for q > 1 (a density near 0 for q < 1). The tangent keeps
value and gradient finite without ever making the gradient zero. e^10 = 22,026: at q = 2 it acts
on densities above that, at q = 1.5 above 4.9e8.
"""

_SHANNON = 1e-9
"""|q - 1| below which ln is used: the difference is far below float64 resolution."""


def ln_q_of_log(log_x: Tensor, q: float, *, max_exponent: float = math.inf) -> Tensor:
    """(x^(q-1) - 1)/(q-1) (paper eq. 4), given ln x: [...] -> [...].

    Args:
        log_x: [...] natural logarithms, in nats.
        q: entropic index, any real number.
        max_exponent: where (q-1) ln x exceeds this, ln_q continues along its tangent.
    """
    order = q - 1.0
    if abs(order) < _SHANNON:
        return log_x
    exponent = order * log_x
    if math.isinf(max_exponent):
        return torch.expm1(exponent) / order
    # Not as `exponent - inside`: its gradient is e^10 - e^10 where nothing is beyond, which in
    # float32 is a rounding error of up to .7 % of the slope.
    beyond = torch.relu(exponent - max_exponent)
    value = torch.expm1(exponent.clamp(max=max_exponent)) + math.exp(max_exponent) * beyond
    return value / order


def bound_active(log_x: Tensor, q: float, *, max_exponent: float = MAX_EXPONENT) -> Tensor:
    """[...] booleans: where `ln_q_of_log` follows its tangent instead of the curve."""
    return (q - 1.0) * log_x > max_exponent


def ln_q(x: Tensor, q: float) -> Tensor:
    """The q-logarithm of x > 0 (paper eq. 4)."""
    return ln_q_of_log(torch.log(x), q)


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
    if form == "joint":
        return ln_q_of_log(log_density.sum(-1), q, max_exponent=MAX_EXPONENT)
    raise ValueError(f"entropy_form must be per_dimension or joint, got {form!r}")
