"""Losses of the Tsallis actor-critic, paper III-B. Each is a mean over the minibatch.

Shape legend: B batch, A action dimensions, C critics, M quantiles of a critic, T atoms of a target.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor


def critic_target(
    reward: Tensor,
    discount: Tensor,
    next_value: Tensor,
    gamma: float,
    bounds: tuple[float, float] | None = None,
) -> Tensor:
    """The critics' target (paper eq. 9), with the terminal mask that the paper leaves out.

    [B] without gradient; [B, T] from atoms [B, T] with the other arguments [B, 1].

    Args:
        reward: [B]
        discount: [B] 0 if the episode terminated, 1 otherwise (truncation is not termination).
        next_value: [B] the target network's value of the next state.
        bounds: range of possible returns, to which targets are clipped.
    """
    target = (reward + gamma * discount * next_value).detach()
    return target if bounds is None else target.clamp(*bounds)


def critic_loss(q_values: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Paper eq. 9, summed over the critics.

    Args:
        q_values: [C, B] of the batch's actions.
        target: [B]
        weights: [B] importance weights of prioritized replay.
    """
    squares = (q_values - target).square()
    if weights is not None:
        squares = squares * weights
    return 0.5 * squares.mean(-1).sum()


def quantile_loss(
    quantiles: Tensor, fractions: Tensor, target: Tensor, weights: Tensor | None = None
) -> Tensor:
    """Quantile Huber loss, summed over the critics (TQC, Kuznetsov et al. 2020).

    Args:
        quantiles: [C, B, M] of the batch's actions.
        fractions: [M] of the return's distribution below each quantile.
        target: [B, T]
        weights: [B] importance weights of prioritized replay.
    """
    error = target[:, None] - quantiles.unsqueeze(-1)
    side = (fractions[:, None] - (error.detach() < 0).to(error)).abs()
    losses = side * F.huber_loss(error, error.new_zeros(()).expand_as(error), reduction="none")
    losses = losses.mean((-1, -2))
    return (losses if weights is None else losses * weights).mean(-1).sum()


def smallest_atoms(quantiles: Tensor, dropped: int) -> Tensor:
    """[C, B, M] -> [B, C (M - dropped)] all critics' quantiles without the largest (TQC)."""
    count, _, size = quantiles.shape
    atoms = quantiles.transpose(0, 1).flatten(1).sort(-1).values
    return atoms[:, : count * (size - dropped)]


def value_target(q_of_policy: Tensor, ln_q_pi: Tensor, alpha: Tensor | float) -> Tensor:
    """The value network's target (paper eq. 8): [B] without gradient.

    Args:
        q_of_policy: [C, B] critics at an action drawn from the policy, as in the paper's algorithm.
        ln_q_pi: [B] ln_q of the policy's density at that action.
    """
    return (q_of_policy.amin(0) - alpha * ln_q_pi).detach()


def value_loss(value: Tensor, target: Tensor) -> Tensor:
    """Paper eq. 8. Both inputs [B]."""
    return 0.5 * (value - target).square().mean()


def policy_value(q_of_policy: Tensor, policy_critic: str) -> Tensor:
    """[C, B] -> [B]: what the policy improves on: the `first` critic, or `min` or `mean` of all."""
    if policy_critic == "mean":
        return q_of_policy.mean(0)
    return q_of_policy[0] if policy_critic == "first" else q_of_policy.amin(0)


def policy_loss(value_of_policy: Tensor, ln_q_pi: Tensor, alpha: Tensor | float) -> Tensor:
    """Paper eq. 10: E[alpha ln_q pi(a|s) - Q(s, a)], a reparameterized. Both inputs [B]."""
    return (alpha * ln_q_pi - value_of_policy).mean()


def alpha_loss(log_alpha: Tensor, excess_entropy: Tensor) -> Tensor:
    """Moves S_q to its target by the excess entropy [] (Haarnoja et al. 2018b, eq. 18)."""
    return log_alpha * excess_entropy
