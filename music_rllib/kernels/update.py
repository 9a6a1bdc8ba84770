"""TAC's updates as one compiled function: losses, their gradients, Adam, averaged networks.

It needs no autograd, allocates no matrices of parameters, and computes only gradients that are
used. Critics evaluate the minibatch's and the policy's actions in one pass.

Shape legend: K updates, B batch, R rows, I network inputs, A action dimensions, C critics,
N critics of a target, M quantiles of a critic (1: its mean), T atoms of a target (1: its mean).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib.functional import distribution as formulas
from music_rllib.kernels import actor_critic, adam, blas, compiling, distribution, layers
from music_rllib.kernels.actor_critic import (
    alpha_loss_backward,
    critic_loss,
    critic_target,
    mean_values,
    policy_loss,
    policy_loss_backward,
    policy_value,
    policy_value_backward,
    smallest_critic,
    target_atoms,
    value_loss,
)
from music_rllib.kernels.adam import AdamStep, adam_step
from music_rllib.kernels.blas import multiply
from music_rllib.kernels.compiling import compiled, kept_on_disk, sources_of
from music_rllib.kernels.distribution import (
    Distribution,
    Sample,
    ln_q_of_policy,
    sample,
    sample_backward,
)
from music_rllib.kernels.layers import (
    Array,
    Network,
    backward,
    forward,
    layer_outputs,
    layer_weights,
    member,
)


class UpdateSettings(NamedTuple):
    """Settings of an update that stay the same over a run."""

    mean: Array
    """[I] subtracted from observations."""
    inverse_std: Array
    """[I] factor of observations after that."""
    clip: float
    """Largest absolute value of a normalized observation."""
    gamma: float
    target_low: float
    target_high: float
    distribution: Distribution
    action_l2: float
    joint: bool
    """Whether the entropy is that of the joint density; otherwise it is summed over dimensions."""
    averaged_critics: int
    """Number of critics whose mean the policy improves on, the first ones; 0: the smallest one."""
    has_value: bool
    """Whether a value network evaluates next states; otherwise averaged critics do."""
    fractions: Array
    """[M] fractions of the critics' quantiles; empty: critics are means."""
    dropped_quantiles: int
    """Number of each critic's quantiles that targets leave out, the largest ones."""
    policy_delay: int
    """The policy is updated in every update whose number is a multiple of this."""


class Networks(NamedTuple):
    """A module's networks. A missing one is an unused placeholder, which keeps the signature."""

    policy: Network
    critics: Network
    """C networks."""
    value: Network
    value_target: Network
    critics_target: Network
    """C networks."""
    policy_target: Network
    scratch: Array
    """[2, R * O] gradients between layers, for the most rows and the widest layer."""


class Batch(NamedTuple):
    """Minibatches of several updates, concatenated; unused columns have zero rows."""

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
    target_critics: NDArray[np.int64]
    """[K*N] critics whose smallest value is used in targets."""


class Averages(NamedTuple):
    """Target networks: moving averages of trained networks."""

    values: Array
    """[S] their parameters."""
    parts: NDArray[np.int64]
    """[networks, 3] start in the trained parameters, start in `values`, size."""
    tau: float
    """Share of the distance that one step moves."""
    interval: int
    """Updates from one step to the next."""
    done: int
    """Updates before the first one of this call."""


class AlphaStep(NamedTuple):
    """Arguments of a step of a learned ln alpha, towards a target of the policy's randomness."""

    step: AdamStep
    """Of ln alpha, the first number; without any, alpha is fixed."""
    measure: int
    """As in `alpha_loss_backward`."""
    target: float


class Learned(NamedTuple):
    """Results of K updates, for metrics."""

    losses: Array
    """[K, 3] of critics, policy and value network; 0 if the policy's was not computed."""
    q_values: Array
    """[K, C, B] critics at the minibatch's actions, means of their quantiles."""
    target: Array
    """[K, B] the critics' targets, means of their atoms."""
    log_density: Array
    """[K, B, A] of the policy's actions; empty for a deterministic policy."""
    log_std: Array
    """[K, B, A] likewise."""
    ln_q_pi: Array
    """[K, B]"""


@compiled
def _normalized(observations: Array, following: Array, settings: UpdateSettings) -> Array:
    """(x - mean) / std, clipped: twice [B, I] -> [2 B, I]."""
    rows, size = observations.shape
    states = np.empty((2 * rows, size), observations.dtype)
    clip = observations.dtype.type(settings.clip)
    for r in range(2 * rows):
        row = observations[r] if r < rows else following[r - rows]
        for i in range(size):
            value = (row[i] - settings.mean[i]) * settings.inverse_std[i]
            states[r, i] = min(max(value, -clip), clip)
    return states


@compiled
def _pairs(states: Array, actions: Array, others: Array) -> Array:
    """States [B, I] beside actions [B, A], then beside other actions [B, A] or [0, A]."""
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
def _critic_outputs(critics: Network, which: Array, pairs: Array) -> Array:
    """[R, I + A] -> [N, R, M] outputs of some critics."""
    outputs = np.empty((len(which), len(pairs), critics.sizes[-1]), pairs.dtype)
    for n in range(len(which)):
        found = forward(member(critics, which[n]), pairs)
        for r in range(len(pairs)):
            for m in range(found.shape[1]):
                outputs[n, r, m] = found[r, m]
    return outputs


@compiled
def _next_values(
    networks: Networks, batch: Batch, settings: UpdateSettings, following: Array,
    next_outputs: Array, q: float, alpha: float,
) -> Array:  # fmt: skip
    """[B, T] values of the next states by the target networks."""
    if settings.has_value:
        values: Array = forward(networks.value_target, following).copy()
        return values
    if not settings.distribution.stochastic:
        next_outputs = forward(networks.policy_target, following)
    drawn = sample(next_outputs, batch.next_noise, settings.distribution)
    pairs = _pairs(following, drawn.action, drawn.action[:0])
    outputs = _critic_outputs(networks.critics_target, batch.target_critics, pairs)
    values = target_atoms(outputs, settings.fractions, settings.dropped_quantiles)
    ln_q_pi = ln_q_of_policy(drawn.log_density, q, settings.joint)[0]
    for r in range(len(ln_q_pi)):
        for t in range(values.shape[1]):
            values[r, t] -= alpha * ln_q_pi[r]
    return values


@compiled
def _critics_backward(
    networks: Networks, pairs: Array, of_outputs: Array, of_values: Array, action: Array
) -> Array:
    """Write the critics' gradients; return [B, A] the derivative by the policy's actions.

    Args:
        pairs: [R, I + A] inputs: the minibatch's actions, then the policy's, if they are evaluated.
        of_outputs: [C, B, M] derivatives by the critics' outputs at the minibatch's actions.
        of_values: [C, B] derivatives by the critics' values at the policy's actions, or [C, 0].
            Each action backpropagates only through critics with a derivative: half of the rows of
            two critics.
        action: [B, A] of the policy.
    """
    count, size = action.shape
    inputs, quantiles = pairs.shape[1] - size, of_outputs.shape[2]
    of_action, part = np.zeros_like(action), np.empty_like(action)
    rows, gradient = np.arange(2 * count), np.empty((2 * count, quantiles), action.dtype)
    for c in range(len(of_outputs)):
        critic = member(networks.critics, c)
        for r in range(count):
            for m in range(quantiles):
                gradient[r, m] = of_outputs[c, r, m]
        end = count
        for r in range(of_values.shape[1]):
            if of_values[c, r] != 0.0:
                rows[end] = count + r
                for m in range(quantiles):
                    gradient[end, m] = of_values[c, r] / quantiles
                end += 1
        of_hidden = backward(critic, pairs, rows[:end], gradient[:end], count, networks.scratch)
        if end == count:
            continue
        weights = layer_weights(critic, critic.values, 0)[inputs:]
        multiply(of_hidden[count:], False, weights, True, part[: end - count])
        for r in range(count, end):
            for a in range(size):
                of_action[rows[r] - count, a] += part[r - count, a]
    return of_action


@compiled
def _policy_backward(
    networks: Networks, settings: UpdateSettings, entered: Array, drawn: Sample,
    of_action: Array, slopes: Array,
) -> None:  # fmt: skip
    """Write the policy's gradients, given the loss's derivatives by its actions and ln p."""
    rows = len(of_action)
    outputs = layer_outputs(networks.policy, len(networks.policy.sizes) - 2, len(entered))[:rows]
    of_outputs = sample_backward(of_action, slopes, drawn, outputs, settings.distribution)
    backward(networks.policy, entered, np.arange(rows), of_outputs, rows, networks.scratch)


@compiled
def _minibatch(batch: Batch, k: int, rows: int) -> Batch:
    cut = slice(k * rows, (k + 1) * rows)
    size = len(batch.target_critics) * rows // len(batch.actions)
    return Batch(
        batch.observations[cut], batch.actions[cut], batch.rewards[cut], batch.discounts[cut],
        batch.next_observations[cut], batch.noise[cut], batch.next_noise[cut], batch.weights[cut],
        batch.target_critics[k * size : (k + 1) * size],
    )  # fmt: skip


@compiled
def _empty_results(batch: Batch, stochastic: bool, updates: int, rows: int, count: int) -> Learned:
    """Uninitialized results, except for losses of 0."""
    size = batch.actions.shape[1] if stochastic else 0
    dtype = batch.rewards.dtype
    return Learned(
        np.zeros((updates, 3), dtype),
        np.empty((updates, count, rows), dtype),
        np.empty((updates, rows), dtype),
        np.empty((updates, rows, size), dtype),
        np.empty((updates, rows, size), dtype),
        np.empty((updates, rows), dtype),
    )


@compiled
def _differentiate(
    networks: Networks, batch: Batch, settings: UpdateSettings, q: float, alpha: float,
    improves: bool, learned: Learned, k: int,
) -> None:  # fmt: skip
    """Write all losses of a minibatch (paper III-B) and their gradients by the networks.

    Unless it `improves`, the policy gets no gradient. Then its actions are only evaluated if a
    value network learns from them.
    """
    rows, action_l2 = len(batch.actions), settings.action_l2
    states = _normalized(batch.observations, batch.next_observations, settings)
    # With averaged critics, one pass of the policy also gives its next actions.
    both = settings.distribution.stochastic and not settings.has_value
    entered = states if both else states[:rows]
    outputs = forward(networks.policy, entered)
    drawn = sample(outputs[:rows], batch.noise, settings.distribution)
    ln_q_pi, slopes = ln_q_of_policy(drawn.log_density, q, settings.joint)
    target = _next_values(networks, batch, settings, states[rows:], outputs[rows:], q, alpha)
    critic_target(
        batch.rewards, batch.discounts, target, settings.gamma, settings.target_low,
        settings.target_high,
    )  # fmt: skip

    evaluated = drawn.action if improves or settings.has_value else drawn.action[:0]
    pairs = _pairs(states[:rows], batch.actions, evaluated)
    count = len(networks.critics.weights)
    outputs = _critic_outputs(networks.critics, np.arange(count), pairs)
    values, of_outputs = mean_values(outputs), np.empty_like(outputs[:, :rows])
    asked, losses, fractions = values[:, rows:], learned.losses[k], settings.fractions
    losses[0] = critic_loss(outputs[:, :rows], target, batch.weights, fractions, of_outputs)
    of_values = np.empty((count, rows if improves else 0), values.dtype)
    if improves:
        improved = policy_value(asked, settings.averaged_critics)
        policy_value_backward(asked, improved, settings.averaged_critics, of_values)
        losses[1] = policy_loss(drawn.action, ln_q_pi, improved, alpha, action_l2)
    of_action = _critics_backward(networks, pairs, of_outputs, of_values, drawn.action)
    if improves:
        policy_loss_backward(drawn.action, of_action, slopes, alpha, action_l2)
        _policy_backward(networks, settings, entered, drawn, of_action, slopes)
    if settings.has_value:
        of_states = forward(networks.value, states[:rows])
        gradient = np.empty_like(of_states)
        smallest = smallest_critic(asked, batch.target_critics)
        losses[2] = value_loss(of_states, smallest, ln_q_pi, alpha, gradient)
        backward(networks.value, states[:rows], np.arange(rows), gradient, rows, networks.scratch)
    targets = mean_values(target.reshape((1, rows, -1)))
    for r in range(rows):  # assigning whole slices takes seconds to compile
        for c in range(len(values)):
            learned.q_values[k, c, r] = values[c, r]
        for a in range(drawn.log_density.shape[1]):
            learned.log_density[k, r, a] = drawn.log_density[r, a]
            learned.log_std[k, r, a] = drawn.log_std[r, a]
        learned.target[k, r] = targets[0, r]
        learned.ln_q_pi[k, r] = ln_q_pi[r]


@compiled
def _average(averages: Averages, values: Array) -> None:
    """Move each target network by `tau` of the distance to its trained network."""
    tau = values.dtype.type(averages.tau)
    for begin, to, size in averages.parts:
        for i in range(size):
            averages.values[to + i] += tau * (values[begin + i] - averages.values[to + i])


@compiled
def _tune(tuned: AlphaStep, learned: Learned, k: int) -> float:
    """Take a step of ln alpha after update k, and return alpha."""
    step = tuned.step
    step.gradients[0] = alpha_loss_backward(
        learned.ln_q_pi[k], learned.log_density[k], learned.log_std[k], tuned.measure, tuned.target
    )
    adam_step(step)
    alpha: float = np.float64(np.exp(step.values[0]))
    return alpha


def _compiled_for(sources: str) -> Any:
    """`learn`, cached on disk: numba's key is this file's age and the values it encloses."""

    @kept_on_disk
    def learn(
        networks: Networks, batch: Batch, settings: UpdateSettings, policy_step: AdamStep,
        step: AdamStep, averages: Averages, tuned: AlphaStep, q: float, alpha: float, rows: int,
    ) -> Learned:  # fmt: skip
        """Do one update for each `rows` rows of the batch, in order.

        The gradients of the last update remain. Empty steps leave the networks unchanged.
        """
        sources  # noqa: B018
        updates = len(batch.actions) // rows
        learned: Learned = _empty_results(
            batch, settings.distribution.stochastic, updates, rows, len(networks.critics.weights)
        )
        for k in range(updates):
            number = averages.done + k + 1
            improves, some = number % settings.policy_delay == 0, _minibatch(batch, k, rows)
            _differentiate(networks, some, settings, q, alpha, improves, learned, k)
            if improves:
                adam_step(policy_step)
            adam_step(step)
            if improves and len(tuned.step.values) > 0:
                alpha = _tune(tuned, learned, k)
            if number % averages.interval == 0:
                _average(averages, networks.policy.values)
        return learned

    return learn


learn = _compiled_for(
    sources_of(actor_critic, adam, blas, compiling, distribution, formulas, layers)
)
