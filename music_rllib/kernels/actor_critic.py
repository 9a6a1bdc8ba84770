"""TAC's losses, each with its derivative (paper III-B). Formulas: `functional.actor_critic`.

A loss is a mean over the minibatch. A derivative is by the loss's own arguments; its caller passes
it on to the networks. Arithmetic of single numbers is in float64.

Shape legend: B batch, A action dimensions, C critics, M quantiles of a critic (1: its mean),
T atoms of a target (1: its mean). `action` [B, A] is the policy's, `ln_q_pi` [B] is ln_q of its
density, `smallest` [B] the smallest critic there, `alpha` the entropy coefficient; `gradient`
receives the derivative.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from music_rllib.kernels.compiling import compiled
from music_rllib.kernels.layers import Array


@compiled
def critic_target(
    reward: Array, discount: Array, next_value: Array, gamma: float, low: float, high: float
) -> None:
    """Turn [B, T] values of next states into targets (paper eq. 9), within [low, high]."""
    rows, size = next_value.shape
    for r in range(rows):
        for t in range(size):
            target = reward[r] + gamma * discount[r] * next_value[r, t]
            next_value[r, t] = min(max(target, low), high)


@compiled
def critic_loss(
    outputs: Array, target: Array, weights: Array, fractions: Array, gradient: Array
) -> float:
    """The loss of critics, summed over them, and its derivative.

    Args:
        outputs: [C, B, M] critics at the batch's actions.
        target: [B, T]
        weights: [B] importance weights, or empty for 1.
        fractions: [M] of quantiles, for `_quantile_loss`; empty: `_squared_loss`.
        gradient: [C, B, M]
    """
    if len(fractions) == 0:
        loss: float = _squared_loss(outputs, target, weights, gradient)
    else:
        loss = _quantile_loss(outputs, target, weights, fractions, gradient)
    return loss


@compiled
def _squared_loss(outputs: Array, target: Array, weights: Array, gradient: Array) -> float:
    """1/2 mean w (Q - y)^2 (paper eq. 9), with the derivative w (Q - y) / B."""
    rows, loss = len(target), 0.0
    for r in range(rows):
        weight = weights[r] if len(weights) > 0 else 1.0
        for c in range(len(outputs)):
            error = float(outputs[c, r, 0]) - float(target[r, 0])
            loss += 0.5 * weight * error * error / rows
            gradient[c, r, 0] = weight * error / rows
    return loss


@compiled
def _quantile_loss(
    outputs: Array, target: Array, weights: Array, fractions: Array, gradient: Array
) -> float:
    """Mean of w |f_m - [y < z_m]| huber(y - z_m) over B, M and T (TQC)."""
    count, rows, size = outputs.shape
    loss = 0.0
    for r in range(rows):
        weight = weights[r] if len(weights) > 0 else 1.0
        share = weight / (rows * size * target.shape[1])
        for c in range(count):
            for m in range(size):
                cost, slope = _quantile_huber(outputs[c, r, m], target[r], fractions[m])
                loss += share * cost
                gradient[c, r, m] = share * slope
    return loss


@partial(compiled, any_order=True)
def _quantile_huber(quantile: float, target: Array, fraction: float) -> tuple[float, float]:
    """Sum of |f - [y < z]| huber(y - z) over targets y [T], and its derivative by z."""
    zero, one, half = target.dtype.type(0), target.dtype.type(1), target.dtype.type(0.5)
    below, above = target.dtype.type(1.0 - fraction), target.dtype.type(fraction)
    cost = slope = zero
    for t in range(len(target)):
        error = target[t] - quantile
        bounded = min(max(error, -one), one) * (below if error < zero else above)
        slope -= bounded
        cost += bounded * (error - half * min(max(error, -one), one))
    return cost, slope


@compiled
def target_atoms(outputs: Array, fractions: Array, dropped: int) -> Array:
    """[C, B, M] -> [B, T] the value of the smallest critic, or the smallest quantiles of all."""
    if len(fractions) == 0:
        atoms: Array = smallest_critic(outputs[:, :, 0], np.arange(len(outputs))).reshape((-1, 1))
    else:
        atoms = smallest_atoms(outputs, dropped)
    return atoms


@compiled
def smallest_atoms(outputs: Array, dropped: int) -> Array:
    """[C, B, M] -> [B, C (M - dropped)] all quantiles of all critics without the largest (TQC).

    NaN counts as the largest number, as in `torch.sort`.
    """
    count, rows, size = outputs.shape
    kept = count * (size - dropped)
    atoms, pool = np.empty((rows, kept), outputs.dtype), np.empty(count * size, outputs.dtype)
    for r in range(rows):
        for c in range(count):
            for m in range(size):
                pool[c * size + m] = outputs[c, r, m]
        for last in range(count * size - 1, kept - 1, -1):
            at = 0
            for i in range(1, last + 1):
                if pool[i] > pool[at] or pool[i] != pool[i]:
                    at = i
            pool[at] = pool[last]
        for t in range(kept):
            atoms[r, t] = pool[t]
    return atoms


@compiled
def mean_values(outputs: Array) -> Array:
    """[C, R, M] -> [C, R]."""
    count, rows, size = outputs.shape
    means = np.empty((count, rows), outputs.dtype)
    for c in range(count):
        for r in range(rows):
            total = outputs[c, r, 0]
            for m in range(1, size):
                total += outputs[c, r, m]
            means[c, r] = total / size
    return means


@compiled
def smallest_critic(values: Array, which: Array) -> Array:
    """[C, R] -> [R] values of the smallest of some critics; NaN if any of them is NaN."""
    smallest: Array = values[which[0]].copy()
    for n in range(1, len(which)):
        for r in range(len(smallest)):
            value = values[which[n], r]
            if value < smallest[r] or value != value:  # `min` would drop a NaN of a later critic
                smallest[r] = value
    return smallest


@compiled
def policy_value(values: Array, averaged: int) -> Array:
    """[C, B] -> [B] Q of the policy's loss: the mean of the first critics; 0: the smallest one."""
    if averaged == 0:
        smallest: Array = smallest_critic(values, np.arange(len(values)))
        return smallest
    mean: Array = values[0].copy()
    for r in range(len(mean)):
        for c in range(1, averaged):
            mean[r] += values[c, r]
        mean[r] /= averaged
    return mean


@compiled
def policy_value_backward(values: Array, smallest: Array, averaged: int, gradient: Array) -> None:
    """Derivative of -mean Q (paper eq. 10), where Q is `policy_value`.

    As in `amin`, equal critics share the gradient, and NaN is passed on.

    Args:
        values: [C, B] critics at the policy's actions.
        smallest: unused if critics are averaged.
        averaged: number of critics whose mean is Q, the first ones; 0: Q is the smallest one.
        gradient: [C, B]
    """
    count, rows = values.shape
    for r in range(rows):
        sharing = 0
        for c in range(count):
            sharing += values[c, r] == smallest[r]
        for c in range(count):
            if averaged > 0:
                gradient[c, r] = -1.0 / (rows * averaged) if c < averaged else 0.0
            elif values[c, r] == smallest[r]:
                gradient[c, r] = -1.0 / (rows * sharing)
            else:
                gradient[c, r] = smallest[r] if sharing == 0 else 0.0


@compiled
def policy_loss(
    action: Array, ln_q_pi: Array, improved: Array, alpha: float, action_l2: float
) -> float:
    """The mean of alpha ln_q pi - Q + w a^2 (paper eq. 10); Q is `improved` [B], w `action_l2`."""
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
        of_action: [B, A] derivative of -Q by the action, to which 2 w a / (B A) is added.
        slopes: [B, A] derivative of ln_q pi by ln p, which is multiplied by alpha / B.
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
    """1/2 mean (V - (min Q - alpha ln_q pi))^2 (paper eq. 8), with V `values` [B, 1].

    `gradient` [B, 1] receives the error / B.
    """
    rows, loss = len(values), 0.0
    for r in range(rows):
        error = values[r, 0] - (smallest[r] - alpha * ln_q_pi[r])
        loss += 0.5 * error * error / rows
        gradient[r, 0] = error / rows
    return loss


@compiled
def alpha_loss_backward(
    ln_q_pi: Array, log_density: Array, log_std: Array, measure: int, target: float
) -> float:
    """Derivative of a learned alpha's loss by ln alpha: a mean of the policy minus its target.

    Args:
        log_density: [B, A] ln of the density.
        log_std: [B, A] ln of the standard deviation.
        measure: 0: the entropy S_q; 1: the Shannon entropy; 2: the mean of `log_std`.
        target: value that the mean is to reach.
    """
    rows, size = log_density.shape
    total: float = 0.0
    for r in range(rows):
        if measure == 0:
            total -= ln_q_pi[r]
            continue
        for a in range(size):
            if measure == 1:
                total -= log_density[r, a]
            else:
                total += log_std[r, a] / size
    excess: float = total / rows - target
    return excess
