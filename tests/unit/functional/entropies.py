"""Closed forms that tests compare the package with. Shape legend: A dimensions, `...` any shape."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from music_rllib.functional.distribution import ln_q_of_log

_SHANNON = 1e-9
"""|q - 1| below which the limit at q = 1 is used."""


def ln_q(x: Tensor, q: float) -> Tensor:
    """The q-logarithm of x > 0 (paper eq. 4)."""
    return ln_q_of_log(torch.log(x), q)


def exp_q(y: Tensor, q: float) -> Tensor:
    """The q-exponential [1 + (q-1) y]_+ ^ (1/(q-1)) (paper eq. 4).

    Zero (q > 1) or infinite (q < 1) where 1 + (q-1) y <= 0.
    """
    order = q - 1.0
    if abs(order) < _SHANNON:
        return torch.exp(y)
    base = (order * y).clamp(min=-1.0)
    return torch.exp(torch.log1p(base) / order)


def gaussian_entropy(std: Tensor, q: float) -> Tensor:
    """S_q of a one-dimensional Gaussian, per standard deviation: [...] -> [...].

    (1 - q^(-1/2) (2 pi std^2)^((1-q)/2)) / (q-1); the Shannon entropy at q = 1.
    """
    log_width = 0.5 * torch.log(2.0 * math.pi * std**2)
    order = q - 1.0
    if abs(order) < _SHANNON:
        return log_width + 0.5
    return -torch.expm1(-order * log_width - 0.5 * math.log(q)) / order


def joint_entropy(per_dimension: Tensor, q: float) -> Tensor:
    """S_q of independent dimensions together: [..., A] -> [...].

    (1 - prod_i (1 - (q-1) S_i)) / (q-1); their sum at q = 1.
    """
    order = q - 1.0
    if abs(order) < _SHANNON:
        return per_dimension.sum(-1)
    return (1.0 - torch.prod(1.0 - order * per_dimension, dim=-1)) / order
