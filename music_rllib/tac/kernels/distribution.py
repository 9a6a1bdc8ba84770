"""The policy's distribution and its entropy, and the derivatives of both, compiled.

Each derivative stands beside the formula that it is of. Arithmetic of single numbers is in float64,
whatever the arrays have. The same for autograd: `music_rllib.functional`.

Shape legend: B batch, A action dimensions. u is the action before tanh, a = tanh(u), p the density
of one action dimension, e the standard normal noise: u = mean + std e.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from music_rllib.compiling import compiled
from music_rllib.functional.tsallis import MAX_EXPONENT
from music_rllib.tac.kernels.perceptron import Array

__all__ = ["Rule", "Sample", "ln_q_of_policy", "sampled", "through_distribution"]

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
_LOG_2 = math.log(2.0)
_SHANNON = 1e-9
"""|q - 1| below which ln_q is ln."""
_SLOPE_BEYOND = math.exp(MAX_EXPONENT)


class Rule(NamedTuple):
    """The settings of an update."""

    mean: Array
    """[I] by which observations are normalised."""
    inverse_std: Array
    """[I]"""
    clip: float
    gamma: float
    target_low: float
    target_high: float
    log_std_low: float
    log_std_high: float
    by_tanh: bool
    """How ln std is kept within its bounds; else it is cut off."""
    action_l2: float
    joint: bool
    """The entropy is of the joint density, and not summed over dimensions."""
    first_critic: bool
    """The policy improves on the first critic, and not on the smaller one."""
    has_value: bool
    """Values of next states are the averaged value network's, and not averaged critics'."""
    stochastic: bool


class Sample(NamedTuple):
    """Actions of the policy, and what their derivatives take."""

    action: Array
    """[B, A]"""
    log_density: Array
    """[B, A]"""
    log_std: Array
    """[B, A]"""
    std_noise: Array
    """[B, A] std e."""


@compiled
def sampled(outputs: Array, noise: Array, rule: Rule) -> Sample:
    """Actions by reparameterisation (`functional.squashed_gaussian`), or tanh of the outputs.

    tanh(u) and the softplus of its Jacobian are both made of exp(-2 |u|).
    """
    rows = len(outputs)
    size = outputs.shape[1] // 2 if rule.stochastic else outputs.shape[1]
    action = np.empty((rows, size), outputs.dtype)
    kept = size if rule.stochastic else 0
    log_density = np.empty((rows, kept), outputs.dtype)
    log_std, std_noise = np.empty_like(log_density), np.empty_like(log_density)
    half_range = 0.5 * (rule.log_std_high - rule.log_std_low)
    for r in range(rows):
        for a in range(size):
            u = float(outputs[r, a])
            if rule.stochastic:
                raw = float(outputs[r, size + a])
                if rule.by_tanh:
                    spread = rule.log_std_low + half_range * (math.tanh(raw) + 1.0)
                else:
                    spread = min(max(raw, rule.log_std_low), rule.log_std_high)
                e = float(noise[r, a])
                log_std[r, a] = spread
                std_noise[r, a] = math.exp(spread) * e
                u += math.exp(spread) * e
            shrunk = math.exp(-2.0 * abs(u))
            action[r, a] = math.copysign((1.0 - shrunk) / (1.0 + shrunk), u)
            if rule.stochastic:
                softplus = math.log1p(shrunk) + max(-2.0 * u, 0.0)
                log_jacobian = 2.0 * (_LOG_2 - u - softplus)
                log_density[r, a] = -0.5 * e * e - spread - _HALF_LOG_2PI - log_jacobian
    return Sample(action, log_density, log_std, std_noise)


@compiled
def _ln_q(log_x: float, q: float) -> tuple[float, float]:
    """ln_q x, with its tangent beyond `MAX_EXPONENT`, and d ln_q x / d ln x = x^(q-1)."""
    order = q - 1.0
    if abs(order) < _SHANNON:
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


@compiled
def through_distribution(
    of_action: Array, of_log_density: Array, sample: Sample, outputs: Array, rule: Rule
) -> Array:
    """[B, A or 2 A]: by the outputs of the policy's network, given those by its actions.

    As ln p = -e^2/2 - ln std - ln sqrt(2 pi) - ln(1 - tanh(u)^2): da/du = 1 - a^2,
    d ln p/du = 2 a, du/d ln std = std e, and d ln p/d ln std = -1 at a given u.
    """
    rows, size = sample.action.shape
    gradient = np.empty((rows, outputs.shape[1]), outputs.dtype)
    low, high = rule.log_std_low, rule.log_std_high
    for r in range(rows):
        for a in range(size):
            action = float(sample.action[r, a])
            of_u = of_action[r, a] * (1.0 - action * action)
            if rule.stochastic:
                of_density = float(of_log_density[r, a])
                of_u += 2.0 * action * of_density
                of_log_std = of_u * sample.std_noise[r, a] - of_density
                if rule.by_tanh:
                    # low + (high - low) / 2 (tanh + 1): both factors of 1 - tanh^2 are read off it.
                    at = float(sample.log_std[r, a])
                    of_log_std *= (at - low) * (high - at) * (2.0 / (high - low))
                elif not low <= outputs[r, size + a] <= high:
                    of_log_std = 0.0
                gradient[r, size + a] = of_log_std
            gradient[r, a] = of_u
    return gradient
