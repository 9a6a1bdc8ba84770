"""The policy's distribution and its entropy, each with its derivative.

Formulas: `functional.distribution`. Arithmetic of single numbers is in float64 for any array type.

Shape legend: B batch, A action dimensions. u is the action before tanh, a = tanh(u), p the density
of one action dimension, e standard normal noise: u = mean + std e.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from music_rllib.functional.distribution import HALF_LOG_2PI, LOG_2, MAX_EXPONENT, SHANNON
from music_rllib.kernels.compiling import compiled
from music_rllib.kernels.layers import Array

_SLOPE_BEYOND = math.exp(MAX_EXPONENT)


class Distribution(NamedTuple):
    """How a policy's outputs give its actions."""

    stochastic: bool
    """Whether it is a squashed Gaussian; otherwise tanh of the outputs."""
    log_std_low: float
    log_std_high: float
    by_tanh: bool
    """Whether ln std is scaled between its bounds by tanh; otherwise it is clamped."""


class Sample(NamedTuple):
    """Actions of the policy, and what their derivatives need; empty arrays if deterministic."""

    action: Array
    """[B, A]"""
    log_density: Array
    """[B, A]"""
    log_std: Array
    """[B, A]"""
    std_noise: Array
    """[B, A] std e."""


@compiled
def sample(outputs: Array, noise: Array, distribution: Distribution) -> Sample:
    """[B, A or 2 A] outputs of the policy's network and [B, A] noise -> actions.

    tanh(u) and the softplus of its Jacobian are both computed from exp(-2 |u|).
    """
    rows, stochastic = len(outputs), distribution.stochastic
    low, high = distribution.log_std_low, distribution.log_std_high
    size = outputs.shape[1] // 2 if stochastic else outputs.shape[1]
    action = np.empty((rows, size), outputs.dtype)
    kept = size if stochastic else 0
    log_density = np.empty((rows, kept), outputs.dtype)
    log_std, std_noise = np.empty_like(log_density), np.empty_like(log_density)
    half_range = 0.5 * (high - low)
    for r in range(rows):
        for a in range(size):
            u = float(outputs[r, a])
            if stochastic:
                raw = float(outputs[r, size + a])
                if distribution.by_tanh:
                    spread = low + half_range * (math.tanh(raw) + 1.0)
                else:
                    spread = min(max(raw, low), high)
                e = float(noise[r, a])
                log_std[r, a] = spread
                std_noise[r, a] = math.exp(spread) * e
                u += math.exp(spread) * e
            shrunk = math.exp(-2.0 * abs(u))
            action[r, a] = math.copysign((1.0 - shrunk) / (1.0 + shrunk), u)
            if stochastic:
                softplus = math.log1p(shrunk) + max(-2.0 * u, 0.0)
                log_jacobian = 2.0 * (LOG_2 - u - softplus)
                log_density[r, a] = -0.5 * e * e - spread - HALF_LOG_2PI - log_jacobian
    return Sample(action, log_density, log_std, std_noise)


@compiled
def sample_backward(
    of_action: Array, of_log_density: Array, drawn: Sample, outputs: Array,
    distribution: Distribution,
) -> Array:  # fmt: skip
    """Derivatives by the outputs of the policy's network, given those by its actions and ln p.

    As ln p = -e^2/2 - ln std - ln sqrt(2 pi) - ln(1 - tanh(u)^2): da/du = 1 - a^2,
    d ln p/du = 2 a, du/d ln std = std e, and d ln p/d ln std = -1 at a given u.
    """
    rows, size = drawn.action.shape
    gradient = np.empty((rows, outputs.shape[1]), outputs.dtype)
    low, high = distribution.log_std_low, distribution.log_std_high
    for r in range(rows):
        for a in range(size):
            action = float(drawn.action[r, a])
            of_u = of_action[r, a] * (1.0 - action * action)
            if distribution.stochastic:
                of_density = float(of_log_density[r, a])
                of_u += 2.0 * action * of_density
                of_log_std = of_u * drawn.std_noise[r, a] - of_density
                if distribution.by_tanh:
                    # low + (high - low) / 2 (tanh + 1): both factors of 1 - tanh^2 follow from it.
                    at = float(drawn.log_std[r, a])
                    of_log_std *= (at - low) * (high - at) * (2.0 / (high - low))
                elif not low <= outputs[r, size + a] <= high:
                    of_log_std = 0.0
                gradient[r, size + a] = of_log_std
            gradient[r, a] = of_u
    return gradient


@compiled
def _ln_q(log_x: float, q: float) -> tuple[float, float]:
    """ln_q x, with its tangent beyond `MAX_EXPONENT`, and d ln_q x / d ln x = x^(q-1)."""
    order = q - 1.0
    if abs(order) < SHANNON:
        return log_x, 1.0
    exponent = order * log_x
    powered = math.expm1(min(exponent, MAX_EXPONENT))
    beyond = max(exponent - MAX_EXPONENT, 0.0)
    return (powered + _SLOPE_BEYOND * beyond) / order, powered + 1.0


@compiled
def ln_q_of_policy(log_density: Array, q: float, joint: bool) -> tuple[Array, Array]:
    """[B] ln_q of the policy's density, and [B, A] its derivatives by ln p of each dimension."""
    rows, size = log_density.shape
    values, slopes = np.empty(rows, log_density.dtype), np.empty_like(log_density)
    for r in range(rows):
        total = 0.0
        for a in range(size):
            if joint:
                total += log_density[r, a]
            else:
                value, slopes[r, a] = _ln_q(float(log_density[r, a]), q)
                total += value
        if joint and size > 0:
            values[r], slope = _ln_q(total, q)
            for a in range(size):
                slopes[r, a] = slope
        else:
            values[r] = total
    return values, slopes
