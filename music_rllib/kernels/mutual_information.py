"""The bound of MUSIC's estimator, its derivatives, and its training.

Formulas: `functional.mutual_information`. The agent's and the surrounding state of a frame each
contribute to the hidden units; each contribution is computed once, for all pairs. No matrix of
hidden units is stored. Sums are in float64: the bound of two frames is small, and the intrinsic
reward is 5,000 times as large.

Shape legend: K updates, N trajectories and B transitions of one, T frames, X / Y features of the
agent's and the surrounding state, I both together, H hidden units.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from music_rllib.kernels import adam, compiling
from music_rllib.kernels.adam import AdamStep, adam_step
from music_rllib.kernels.compiling import compiled, kept_on_disk, sources_of
from music_rllib.kernels.layers import Array


class Data(NamedTuple):
    """Trajectories, with a time permutation of each."""

    agent: Array
    """[N, T, X]"""
    surrounding: Array
    """[N, T, Y]"""
    others: Array
    """[N, T] frame of the surrounding state, in pairs from the product of the marginals."""
    frames: Array
    """[N] number of frames of each trajectory; later ones are padding."""


class Weights(NamedTuple):
    """The estimator's parameters or their gradients, in their order."""

    agent: Array
    """[H, X]"""
    bias: Array
    """[H]"""
    surrounding: Array
    """[H, Y]"""
    output: Array
    """[1, H]"""
    offset: Array
    """[1]"""


_inner = functools.partial(compiled, any_order=True)


@_inner
def _transposed(weight: Array) -> Array:
    """[H, I] -> [I, H]."""
    units, features = weight.shape
    columns = np.empty((features, units), weight.dtype)
    for i in range(features):
        for h in range(units):
            columns[i, h] = weight[h, i]
    return columns


@_inner
def _half(states: Array, n: int, frames: int, columns: Array, bias: Array, out: Array) -> None:
    """A half's contribution to the hidden units of a trajectory: [N, T, I], [I, H], [H] -> [T, H].

    A pass handles three features, as many as a position has, and reads and writes `out` once.
    """
    features = len(columns)
    threes = features - features % 3
    for t in range(frames):
        for h in range(len(bias)):
            out[t, h] = bias[h]
        for i in range(0, threes, 3):
            x, y, z = states[n, t, i], states[n, t, i + 1], states[n, t, i + 2]
            for h in range(len(bias)):
                out[t, h] += x * columns[i, h] + y * columns[i + 1, h] + z * columns[i + 2, h]
        for i in range(threes, features):
            value = states[n, t, i]
            for h in range(len(bias)):
                out[t, h] += value * columns[i, h]


@_inner
def _statistics(
    first: Array, second: Array, t: int, other: int, output: Array, offset: float
) -> tuple[float, float]:
    """tanh(w . relu(agent + surrounding) + c) of a frame, and with another frame's surroundings."""
    zero = first.dtype.type(0)
    together, apart = zero, zero
    for h in range(output.shape[1]):
        together += output[0, h] * max(first[t, h] + second[t, h], zero)
        apart += output[0, h] * max(first[t, h] + second[other, h], zero)
    return _tanh(together + offset), _tanh(apart + offset)


@_inner
def _tanh(x: float) -> float:
    shrunk = math.exp(-2.0 * abs(x))
    return math.copysign((1.0 - shrunk) / (1.0 + shrunk), x)


@_inner
def _add_pairs(
    first: Array, second: Array, t: int, other: int, together: float, apart: float,
    of_first: Array, of_second: Array, of_output: Array,
) -> None:  # fmt: skip
    """Add the derivatives of both statistics to the gradients, through units that are on."""
    zero = first.dtype.type(0)
    slope, other_slope = first.dtype.type(together), first.dtype.type(apart)
    for h in range(of_output.shape[1]):
        unit, other_unit = first[t, h] + second[t, h], first[t, h] + second[other, h]
        passed = zero if unit <= zero else slope  # a NaN passes, as in autograd
        other_passed = zero if other_unit <= zero else other_slope
        of_first[t, h] = passed + other_passed
        of_second[t, h] += passed
        of_output[0, h] += passed * unit + other_passed * other_unit
        of_second[other, h] += other_passed


@_inner
def _add_products(states: Array, n: int, frames: int, of_units: Array, columns: Array) -> None:
    """Add [T, I]' @ [T, H] of a trajectory to [I, H]."""
    for t in range(frames):
        for i in range(states.shape[2]):
            value = states[n, t, i]
            for h in range(of_units.shape[1]):
                columns[i, h] += value * of_units[t, h]


@_inner
def _bounds(
    agent: Array, surrounding: Array, others: Array, frames: Array, weights: Weights, found: Array
) -> None:
    length = others.shape[1]
    first = np.empty((length, len(weights.bias)), agent.dtype)
    second, none = np.empty_like(first), np.zeros_like(weights.bias)
    agent_columns = _transposed(weights.agent)
    surrounding_columns = _transposed(weights.surrounding)
    for n in range(len(others)):
        last = frames[n]
        _half(agent, n, last, agent_columns, weights.bias, first)
        _half(surrounding, n, last, surrounding_columns, none, second)
        joint, marginals = 0.0, 0.0
        for t in range(last):
            together, apart = _statistics(
                first, second, t, others[n, t], weights.output, weights.offset[0]
            )
            joint += together
            marginals += math.exp(apart)
        found[n] = joint / last - math.log(marginals / last)


@_inner
def _differentiate(
    agent: Array, surrounding: Array, others: Array, frames: Array, weights: Weights, by: Weights
) -> float:
    """The mean of `bounds`; write the derivatives of its negative by each parameter to `by`.

    A bound's derivative by a joint statistic is 1/T, and by one of the marginals
    -exp(s) / sum exp(s); the derivative of a statistic s by its argument is 1 - s^2.
    """
    count, length = others.shape
    first = np.empty((length, len(weights.bias)), agent.dtype)
    second, of_first, of_second = np.empty_like(first), np.empty_like(first), np.empty_like(first)
    joint, apart = np.empty(length), np.empty(length)
    agent_columns = _transposed(weights.agent)
    surrounding_columns = _transposed(weights.surrounding)
    of_agent, of_surrounding = np.zeros_like(agent_columns), np.zeros_like(surrounding_columns)
    none, output = np.zeros_like(weights.bias), weights.output
    by.bias[:], by.output[:], by.offset[:] = 0, 0, 0
    mean = 0.0
    for n in range(count):
        last = frames[n]
        _half(agent, n, last, agent_columns, weights.bias, first)
        _half(surrounding, n, last, surrounding_columns, none, second)
        together, total = 0.0, 0.0
        for t in range(last):
            joint[t], apart[t] = _statistics(
                first, second, t, others[n, t], output, weights.offset[0]
            )
            together += joint[t]
            total += math.exp(apart[t])
            for h in range(len(by.bias)):
                of_second[t, h] = 0
        mean += (together / last - math.log(total / last)) / count
        for t in range(last):
            slope = -(1.0 - joint[t] ** 2) / (last * count)
            other_slope = math.exp(apart[t]) * (1.0 - apart[t] ** 2) / (total * count)
            _add_pairs(
                first, second, t, others[n, t], slope, other_slope, of_first, of_second, by.output
            )
            by.offset[0] += slope + other_slope
        _add_products(agent, n, last, of_first, of_agent)
        _add_products(surrounding, n, last, of_second, of_surrounding)
        for t in range(last):
            for h in range(len(by.bias)):
                by.bias[h] += of_first[t, h]
    for h in range(len(by.bias)):
        by.bias[h] *= output[0, h]
        for x in range(len(of_agent)):
            by.agent[h, x] = of_agent[x, h] * output[0, h]
        for y in range(len(of_surrounding)):
            by.surrounding[h, y] = of_surrounding[y, h] * output[0, h]
    return mean


@kept_on_disk
def bounds(data: Data, weights: Weights) -> Array:
    """[N] Donsker-Varadhan bounds in nats."""
    found = np.empty(len(data.others), data.agent.dtype)
    _bounds(data.agent, data.surrounding, data.others, data.frames, weights, found)
    return found


def _compiled_for(sources: str) -> Any:
    """`learn`, cached on disk until a file that it is compiled from changes."""

    @kept_on_disk
    def learn(
        transitions: Data, trajectories: Data, weights: Weights, by: Weights, step: AdamStep,
        updates: int,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Do K updates in order, each on its part of the data.

        Args:
            transitions: [K*B] pairs of frames, whose bounds are computed before their update.
            trajectories: [K*N] training data, concatenated minibatches.
            weights: views of `step.values`.
            by: views of `step.gradients`.
            step: arguments of Adam.
            updates: K.

        Returns:
            [K*B] bounds of the transitions, and [K] mean bounds of the trajectories.
        """
        sources  # noqa: B018
        found = np.empty(len(transitions.others), transitions.agent.dtype)
        means = np.empty(updates, transitions.agent.dtype)
        rows, count = len(found) // updates, len(trajectories.others) // updates
        for k in range(updates):
            some = slice(k * rows, (k + 1) * rows)
            _bounds(
                transitions.agent[some], transitions.surrounding[some], transitions.others[some],
                transitions.frames[some], weights, found[some],
            )  # fmt: skip
            some = slice(k * count, (k + 1) * count)
            means[k] = _differentiate(
                trajectories.agent[some], trajectories.surrounding[some],
                trajectories.others[some], trajectories.frames[some], weights, by,
            )  # fmt: skip
            adam_step(step)
        return found, means

    return learn


learn = _compiled_for(sources_of(adam, compiling))
