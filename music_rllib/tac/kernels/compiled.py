"""TAC's updates as one compiled function: losses, their gradients, Adam, averaged networks.

No autograd, no new matrices, both minibatches of the critics in one pass, no gradients that nothing
needs. Each derivative stands beside the formula that it is of; the losses that autograd has are in
`music_rllib.functional`, and a test holds both against each other.

Shape legend: K updates, B batch, R rows, I network inputs, A action dimensions, C critics.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib import compiling
from music_rllib.compiling import compiled, kept_on_disk, sources_of
from music_rllib.functional import tsallis
from music_rllib.optim import adam
from music_rllib.optim.adam import Descent, descend
from music_rllib.tac.kernels import blas, distribution, perceptron
from music_rllib.tac.kernels.blas import multiply
from music_rllib.tac.kernels.distribution import (
    Rule,
    Sample,
    ln_q_of_policy,
    sampled,
    through_distribution,
)
from music_rllib.tac.kernels.perceptron import (
    Array,
    Network,
    backward,
    forward,
    layer_outputs,
    layer_weights,
)

__all__ = ["Averages", "Batch", "Learned", "Networks", "learn"]


class Networks(NamedTuple):
    """Those of a module; where it lacks one, another stands in its place, unused.

    So a module with one critic and one with two have the same compiled code.
    """

    policy: Network
    critics: tuple[Network, Network]
    critic_count: int
    value: Network
    value_target: Network
    critics_target: tuple[Network, Network]
    policy_target: Network
    scratch: Array
    """[2, R * O] for the gradients between layers, by the most rows and the widest layer."""


class Batch(NamedTuple):
    """What is learned from, the minibatches of several updates behind each other.

    What there is none of has no rows.
    """

    observations: Array
    """[K*B, I]"""
    actions: Array
    """[K*B, A]"""
    rewards: Array
    """[K*B]"""
    discounts: Array
    """[K*B]"""
    next_observations: Array
    """[K*B, I]"""
    noise: Array
    """[K*B, A]"""
    next_noise: Array
    """[K*B, A]"""
    weights: Array
    """[K*B]"""


class Averages(NamedTuple):
    """Networks that follow those that are trained."""

    values: Array
    """[S] of them all."""
    parts: NDArray[np.int64]
    """[networks, 3]: where each begins among the trained parameters and in `values`, its size."""
    tau: float
    """The share that they move by."""
    interval: int
    """Updates from one movement to the next."""
    done: int
    """Updates before these."""


class Learned(NamedTuple):
    """What updates are measured by."""

    losses: Array
    """[K, 3] of critics, policy and value network."""
    q_values: Array
    """[K, C, B] at the minibatch's actions."""
    target: Array
    """[K, B] of the critics."""
    log_density: Array
    """[K, B, A] of the policy's actions; empty for a deterministic one."""
    log_std: Array
    """[K, B, A]; likewise."""
    ln_q_pi: Array
    """[K, B]"""


@compiled
def _normalised(observations: Array, following: Array, rule: Rule) -> Array:
    """(x - mean) / std, clipped: twice [B, I] -> [2 B, I]."""
    rows, size = observations.shape
    states = np.empty((2 * rows, size), observations.dtype)
    clip = observations.dtype.type(rule.clip)
    for r in range(2 * rows):
        row = observations[r] if r < rows else following[r - rows]
        for i in range(size):
            value = (row[i] - rule.mean[i]) * rule.inverse_std[i]
            states[r, i] = min(max(value, -clip), clip)
    return states


@compiled
def _pairs(states: Array, actions: Array, others: Array) -> Array:
    """States [B, I] beside actions [B, A], and again beside others, if there are any."""
    rows, size = states.shape
    pairs = np.empty((len(actions) + len(others), size + actions.shape[1]), states.dtype)
    for r in range(len(pairs)):
        state = states[r % rows]
        action = actions[r] if r < rows else others[r - rows]
        for i in range(size):
            pairs[r, i] = state[i]
        for a in range(len(action)):
            pairs[r, size + a] = action[a]
    return pairs


@compiled
def _ask_critics(critics: tuple[Network, Network], count: int, pairs: Array) -> Array:
    """[R, I + A] -> [C, R]."""
    values = np.empty((count, len(pairs)), pairs.dtype)
    for c in range(count):
        outputs = forward(critics[c], pairs)
        for r in range(len(pairs)):
            values[c, r] = outputs[r, 0]
    return values


@compiled
def _smallest(values: Array, first: int) -> Array:
    """[C, R] -> [R - first] the smallest critic's, from a row on; NaN if any critic's is NaN."""
    smallest = values[0, first:].copy()
    for c in range(1, len(values)):
        for r in range(len(smallest)):
            value = values[c, first + r]
            if value < smallest[r] or value != value:  # `min` would drop a NaN of a later critic
                smallest[r] = value
    return smallest


@compiled
def _critic_target(
    networks: Networks, batch: Batch, rule: Rule, following: Array, next_outputs: Array,
    q: float, alpha: float,
) -> Array:  # fmt: skip
    """[B] r + gamma d V(s'), clipped (paper eq. 9, with the mask that it leaves out)."""
    rows = len(following)
    if rule.has_value:
        values: Array = forward(networks.value_target, following).copy().reshape(rows)
    else:
        if not rule.stochastic:
            next_outputs = forward(networks.policy_target, following)
        sample = sampled(next_outputs, batch.next_noise, rule)
        pairs = _pairs(following, sample.action, sample.action[:0])
        values = _smallest(_ask_critics(networks.critics_target, networks.critic_count, pairs), 0)
        ln_q_pi = ln_q_of_policy(sample.log_density, q, rule.joint)[0]
        for r in range(len(ln_q_pi)):
            values[r] -= alpha * ln_q_pi[r]
    for r in range(rows):
        target = batch.rewards[r] + rule.gamma * batch.discounts[r] * values[r]
        values[r] = min(max(target, rule.target_low), rule.target_high)
    return values


@compiled
def _of_critics(
    values: Array, target: Array, smallest: Array, weights: Array, first_critic: bool
) -> tuple[Array, float]:
    """Derivatives by the critics' values [C, 2 B] of critic and policy losses; the critics' loss.

    Of 1/2 mean w (Q - y)^2 it is w (Q - y) / B (paper eq. 9); of mean -Q, -1/B (eq. 10). Of `min`
    the smallest critic has it all; equal ones share it, and NaN is passed on, as in `amin`.
    """
    count, rows = len(values), len(target)
    gradient, loss = np.zeros_like(values), 0.0
    for r in range(rows):
        weight = weights[r] if len(weights) > 0 else 1.0
        sharing = 0
        for c in range(count):
            error = float(values[c, r]) - float(target[r])
            loss += 0.5 * weight * error * error / rows
            gradient[c, r] = weight * error / rows
            sharing += values[c, rows + r] == smallest[r]
        for c in range(count):
            if first_critic:
                gradient[c, rows + r] = -1.0 / rows if c == 0 else 0.0
            elif values[c, rows + r] == smallest[r]:
                gradient[c, rows + r] = -1.0 / (rows * sharing)
            elif sharing == 0:
                gradient[c, rows + r] = smallest[r]
    return gradient, loss


@compiled
def _asked(networks: Networks, pairs: Array, of_values: Array, action: Array) -> Array:
    """[B, A]: by the policy's actions, through the critics, whose gradients are written.

    An action whose smallest critic is another one has no gradient through this one, which is half
    of the rows of two critics.
    """
    count, size = action.shape
    inputs = pairs.shape[1] - size
    of_action, part = np.zeros_like(action), np.empty_like(action)
    rows, of_value = np.arange(2 * count), np.empty((2 * count, 1), action.dtype)
    for c in range(networks.critic_count):
        critic = networks.critics[c]
        for r in range(count):
            of_value[r, 0] = of_values[c, r]
        end = count  # of the minibatch, and then of what the policy improves on
        for r in range(count, 2 * count):
            if of_values[c, r] != 0.0:
                rows[end], of_value[end, 0] = r, of_values[c, r]
                end += 1
        of_hidden = backward(critic, pairs, rows[:end], of_value[:end], count, networks.scratch)
        weights = layer_weights(critic, critic.values, 0)[inputs:]
        multiply(of_hidden[count:], False, weights, True, part[: end - count])
        for r in range(count, end):
            for a in range(size):
                of_action[rows[r] - count, a] += part[r - count, a]
    return of_action


@compiled
def _learn_policy(
    networks: Networks, rule: Rule, entered: Array, sample: Sample, of_action: Array,
    slopes: Array, alpha: float,
) -> None:  # fmt: skip
    """Gradients of mean (alpha ln_q pi - Q) + w mean a^2 (paper eq. 10), -Q's given.

    alpha slope / B by ln p, and 2 w a / (B A) by the actions.
    """
    rows, size = of_action.shape
    for r in range(rows):
        for a in range(size):
            of_action[r, a] += 2.0 * rule.action_l2 / (rows * size) * sample.action[r, a]
    for r in range(len(slopes)):
        for a in range(slopes.shape[1]):
            slopes[r, a] *= alpha / rows
    outputs = layer_outputs(networks.policy, len(networks.policy.sizes) - 2, len(entered))[:rows]
    of_outputs = through_distribution(of_action, slopes, sample, outputs, rule)
    backward(networks.policy, entered, np.arange(rows), of_outputs, rows, networks.scratch)


@compiled
def _policy_loss(
    sample: Sample, ln_q_pi: Array, improved: Array, rule: Rule, alpha: float
) -> float:
    """The mean of alpha ln_q pi - Q + w a^2 (paper eq. 10)."""
    rows, size = sample.action.shape
    loss = 0.0
    for r in range(rows):
        loss += (alpha * ln_q_pi[r] - improved[r]) / rows
        for a in range(size):
            loss += rule.action_l2 * sample.action[r, a] ** 2 / (rows * size)
    return loss


@compiled
def _learn_value(
    networks: Networks, states: Array, smallest: Array, ln_q_pi: Array, alpha: float
) -> float:
    """1/2 mean (V - (min Q - alpha ln_q pi))^2 (paper eq. 8), whose derivative is the error / B."""
    rows, loss = len(states), 0.0
    values = forward(networks.value, states)
    gradient = np.empty_like(values)
    for r in range(rows):
        error = values[r, 0] - (smallest[r] - alpha * ln_q_pi[r])
        loss += 0.5 * error * error / rows
        gradient[r, 0] = error / rows
    backward(networks.value, states, np.arange(rows), gradient, rows, networks.scratch)
    return loss


@compiled
def _minibatch(batch: Batch, k: int, rows: int) -> Batch:
    """Of update k."""
    cut = slice(k * rows, (k + 1) * rows)
    return Batch(
        batch.observations[cut], batch.actions[cut], batch.rewards[cut], batch.discounts[cut],
        batch.next_observations[cut], batch.noise[cut], batch.next_noise[cut], batch.weights[cut],
    )  # fmt: skip


@compiled
def _nothing_learned(batch: Batch, rule: Rule, updates: int, rows: int, critics: int) -> Learned:
    """What is to be filled in."""
    size = batch.actions.shape[1] if rule.stochastic else 0
    dtype = batch.rewards.dtype
    return Learned(
        np.zeros((updates, 3), dtype),
        np.empty((updates, critics, rows), dtype),
        np.empty((updates, rows), dtype),
        np.empty((updates, rows, size), dtype),
        np.empty((updates, rows, size), dtype),
        np.empty((updates, rows), dtype),
    )


@compiled
def _differentiate(
    networks: Networks, batch: Batch, rule: Rule, q: float, alpha: float, learned: Learned, k: int
) -> None:
    """All losses of a minibatch (paper III-B), their gradients into the networks'."""
    rows = len(batch.actions)
    states = _normalised(batch.observations, batch.next_observations, rule)
    # Both in one pass, where the policy is asked for its next actions.
    entered = states if rule.stochastic and not rule.has_value else states[:rows]
    outputs = forward(networks.policy, entered)
    sample = sampled(outputs[:rows], batch.noise, rule)
    ln_q_pi, slopes = ln_q_of_policy(sample.log_density, q, rule.joint)
    target = _critic_target(networks, batch, rule, states[rows:], outputs[rows:], q, alpha)

    pairs = _pairs(states[:rows], batch.actions, sample.action)
    values = _ask_critics(networks.critics, networks.critic_count, pairs)
    smallest = _smallest(values, rows)
    losses = learned.losses[k]
    of_values, losses[0] = _of_critics(values, target, smallest, batch.weights, rule.first_critic)
    of_action = _asked(networks, pairs, of_values, sample.action)

    improved = values[0, rows:] if rule.first_critic else smallest
    losses[1] = _policy_loss(sample, ln_q_pi, improved, rule, alpha)
    _learn_policy(networks, rule, entered, sample, of_action, slopes, alpha)
    if rule.has_value:
        losses[2] = _learn_value(networks, states[:rows], smallest, ln_q_pi, alpha)
    for r in range(rows):  # assigning whole slices takes seconds to compile
        for c in range(len(values)):
            learned.q_values[k, c, r] = values[c, r]
        for a in range(sample.log_density.shape[1]):
            learned.log_density[k, r, a] = sample.log_density[r, a]
            learned.log_std[k, r, a] = sample.log_std[r, a]
        learned.target[k, r] = target[r]
        learned.ln_q_pi[k, r] = ln_q_pi[r]


@compiled
def _average(averages: Averages, values: Array) -> None:
    """Each followed network's parameters by `tau` of the way."""
    tau = values.dtype.type(averages.tau)
    for begin, to, size in averages.parts:
        for i in range(size):
            averages.values[to + i] += tau * (values[begin + i] - averages.values[to + i])


def _compiled_for(sources: str) -> Any:
    """`learn`, kept on disk: numba looks it up by this file's age and by what it encloses."""

    @kept_on_disk
    def learn(
        networks: Networks, batch: Batch, rule: Rule, descent: Descent, averages: Averages,
        q: float, alpha: float, rows: int,
    ) -> Learned:  # fmt: skip
        """Updates one after the other, one for each `rows` of the batch.

        The gradients of the last one stay; without parameters in `descent` nothing else happens.
        """
        sources  # noqa: B018
        updates = len(batch.actions) // rows
        learned: Learned = _nothing_learned(batch, rule, updates, rows, networks.critic_count)
        for k in range(updates):
            _differentiate(networks, _minibatch(batch, k, rows), rule, q, alpha, learned, k)
            descend(descent)
            if (averages.done + k + 1) % averages.interval == 0:
                _average(averages, descent.values)
        return learned

    return learn


learn = _compiled_for(sources_of(adam, blas, compiling, distribution, perceptron, tsallis))
