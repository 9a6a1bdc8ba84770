"""Derivatives of TAC's losses in closed form; the losses are `music_rllib.functional.actor_critic`.

Each is the gradient of a loss that is a mean over the minibatch, hence the factors 1/B.

Shape legend: B batch, A action dimensions, C critics. u is the action before tanh, a = tanh(u),
p the density of one action dimension, e the standard normal noise: u = mean + std e.
"""

from __future__ import annotations

import torch
from torch import Tensor

from music_rllib.functional.tsallis import ln_q_slope

__all__ = [
    "of_critic_loss",
    "of_ln_q",
    "of_mean_square",
    "of_policy_value",
    "of_squashed_sample",
    "of_value_loss",
    "through_clamp",
    "through_scaled_tanh",
    "through_tanh",
]


def of_critic_loss(q_values: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
    """[C, B]: d/dQ 1/2 mean w (Q - y)^2 = w (Q - y) / B (paper eq. 9)."""
    errors = (q_values - target).div_(len(target))
    return errors if weights is None else errors.mul_(weights)


def of_value_loss(value: Tensor, target: Tensor) -> Tensor:
    """[B]: d/dV 1/2 mean (V - y)^2 = (V - y) / B (paper eq. 8)."""
    return (value - target).div_(len(value))


def of_policy_value(q_of_policy: Tensor, policy_critic: str) -> Tensor:
    """[C, B]: what each critic counts in the value that the policy improves on (paper eq. 10).

    Of `min` the smallest one has it all; equal ones share it, as autograd's `amin` has it.
    """
    if policy_critic == "first":
        counts = torch.zeros_like(q_of_policy)
        counts[0] = 1.0
        return counts
    smallest = (q_of_policy == q_of_policy.amin(0)).to(q_of_policy.dtype)
    return smallest.div_(smallest.sum(0))


def of_ln_q(log_density: Tensor, q: float, form: str) -> Tensor:
    """[B, A]: d ln_q pi / d ln p of each dimension, pi as `ln_q_of_policy` has it."""
    if form == "joint":
        return ln_q_slope(log_density.sum(-1, keepdim=True), q).expand_as(log_density)
    return ln_q_slope(log_density, q)


def of_squashed_sample(
    of_action: Tensor, of_log_density: Tensor, action: Tensor, std_noise: Tensor
) -> tuple[Tensor, Tensor]:
    """From an action and its log-densities to the distribution that they are sampled from.

    As ln p = -e^2/2 - ln std - ln sqrt(2 pi) - ln(1 - tanh(u)^2): da/du = 1 - a^2,
    d ln p/du = 2 a, du/d ln std = std e, and d ln p/d ln std = -1 at a given u.

    Args:
        of_action: [B, A] derivatives of the loss.
        of_log_density: [B, A] derivatives of the loss.
        action: [B, A]
        std_noise: [B, A] std e.

    Returns:
        [B, A] of the mean and [B, A] of ln std.
    """
    of_raw = through_tanh(of_action, action).addcmul_(of_log_density, action, value=2.0)
    return of_raw, (of_raw * std_noise).sub_(of_log_density)


def through_tanh(of_action: Tensor, action: Tensor) -> Tensor:
    """[B, A]: da/du = 1 - a^2."""
    return torch.addcmul(of_action, of_action * action, action, value=-1.0)


def through_clamp(gradient: Tensor, raw: Tensor, clamped: Tensor) -> Tensor:
    """[B, A]: what lies within the bounds, or on them, has it all, what lies outside nothing."""
    return torch.where(raw == clamped, gradient, 0.0)


def through_scaled_tanh(gradient: Tensor, output: Tensor, bounds: tuple[float, float]) -> Tensor:
    """[B, A]: through `low + (high - low) / 2 (tanh + 1)`, given its output.

    Its slope is (high - low) / 2 (1 - tanh^2), of which both factors are read off the output.
    """
    low, high = bounds
    return gradient * (output - low) * (high - output) * (2.0 / (high - low))


def of_mean_square(values: Tensor, weight: float) -> Tensor:
    """[B, A]: d/dx w mean x^2 = 2 w x / (B A)."""
    return values * (2.0 * weight / values.numel())
