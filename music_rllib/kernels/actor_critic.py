"""TAC's losses, each with its derivative (paper III-B). Formulas: `functional.actor_critic`.

A loss is a mean over the minibatch. A derivative is by the loss's own arguments; its caller passes
it on to the networks. Arithmetic of single numbers is in float64.

Shape legend: B batch, A action dimensions, C critics.
"""

from __future__ import annotations

from music_rllib.kernels.compiling import compiled
from music_rllib.kernels.layers import Array


@compiled
def critic_target(
    reward: Array, discount: Array, next_value: Array, gamma: float, low: float, high: float
) -> None:
    """Turn [B] values of next states into targets (paper eq. 9), within [low, high]."""
    for r in range(len(next_value)):
        target = reward[r] + gamma * discount[r] * next_value[r]
        next_value[r] = min(max(target, low), high)


@compiled
def critic_loss(values: Array, target: Array, weights: Array, gradient: Array) -> float:
    """1/2 mean w (Q - y)^2 (paper eq. 9), summed over critics.

    Args:
        values: [C, B] critics at the batch's actions.
        target: [B]
        weights: [B] importance weights, or empty for 1.
        gradient: [C, B] receives w (Q - y) / B.
    """
    rows, loss = len(target), 0.0
    for r in range(rows):
        weight = weights[r] if len(weights) > 0 else 1.0
        for c in range(len(values)):
            error = float(values[c, r]) - float(target[r])
            loss += 0.5 * weight * error * error / rows
            gradient[c, r] = weight * error / rows
    return loss


@compiled
def smallest_critic(values: Array) -> Array:
    """[C, R] -> [R] values of the smallest critic; NaN if any critic is NaN."""
    smallest: Array = values[0].copy()
    for c in range(1, len(values)):
        for r in range(len(smallest)):
            value = values[c, r]
            if value < smallest[r] or value != value:  # `min` would drop a NaN of a later critic
                smallest[r] = value
    return smallest


@compiled
def policy_value_backward(
    values: Array, smallest: Array, first_critic: bool, gradient: Array
) -> None:
    """Derivative of -mean Q (paper eq. 10), where Q is the first critic or the smallest one.

    As in `amin`, equal critics share the gradient, and NaN is passed on.

    Args:
        values: [C, B] critics at the policy's actions.
        smallest: [B] the smallest of them.
        first_critic: whether Q is the first critic.
        gradient: [C, B] receives the derivative by each critic.
    """
    count, rows = values.shape
    for r in range(rows):
        sharing = 0
        for c in range(count):
            sharing += values[c, r] == smallest[r]
        for c in range(count):
            if first_critic:
                gradient[c, r] = -1.0 / rows if c == 0 else 0.0
            elif values[c, r] == smallest[r]:
                gradient[c, r] = -1.0 / (rows * sharing)
            else:
                gradient[c, r] = smallest[r] if sharing == 0 else 0.0


@compiled
def policy_loss(
    action: Array, ln_q_pi: Array, improved: Array, alpha: float, action_l2: float
) -> float:
    """The mean of alpha ln_q pi - Q + w a^2 (paper eq. 10).

    Args:
        action: [B, A] of the policy.
        ln_q_pi: [B] ln_q of its density.
        improved: [B] Q at the action.
        alpha: entropy coefficient.
        action_l2: w.
    """
    rows, size = action.shape
    loss = 0.0
    for r in range(rows):
        loss += (alpha * ln_q_pi[r] - improved[r]) / rows
        for a in range(size):
            loss += action_l2 * action[r, a] ** 2 / (rows * size)
    return loss


@compiled
def policy_loss_backward(
    action: Array, of_action: Array, slopes: Array, alpha: float, action_l2: float
) -> None:
    """Complete the derivatives of `policy_loss` in place.

    Args:
        action: [B, A] of the policy.
        of_action: [B, A] derivative of -Q by the action, to which 2 w a / (B A) is added.
        slopes: [B, A] derivative of ln_q pi by ln p, which is multiplied by alpha / B.
        alpha: entropy coefficient.
        action_l2: w.
    """
    rows, size = of_action.shape
    for r in range(rows):
        for a in range(size):
            of_action[r, a] += 2.0 * action_l2 / (rows * size) * action[r, a]
    for r in range(len(slopes)):
        for a in range(slopes.shape[1]):
            slopes[r, a] *= alpha / rows


@compiled
def value_loss(
    values: Array, smallest: Array, ln_q_pi: Array, alpha: float, gradient: Array
) -> float:
    """1/2 mean (V - (min Q - alpha ln_q pi))^2 (paper eq. 8).

    Args:
        values: [B, 1] V of the states.
        smallest: [B] min Q at the policy's action.
        ln_q_pi: [B] ln_q of its density.
        alpha: entropy coefficient.
        gradient: [B, 1] receives the error / B.
    """
    rows, loss = len(values), 0.0
    for r in range(rows):
        error = values[r, 0] - (smallest[r] - alpha * ln_q_pi[r])
        loss += 0.5 * error * error / rows
        gradient[r, 0] = error / rows
    return loss
