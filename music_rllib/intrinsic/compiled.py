"""The bound of MUSIC's estimator and its gradients, compiled, for a CPU.

Of a frame's agent and surrounding state each half's part of the hidden units is computed once,
whichever halves are then paired, and no matrix of hidden units is kept. Sums are in float64: the
bound of two frames is small, and the intrinsic reward 5,000 times it.

Shape legend: N trajectories, T frames, X / Y features of the agent's and the surrounding state, I
both together, H hidden units.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from music_rllib.compiling import compiled, kept_on_disk

__all__ = ["bounds", "mean_bound"]

Array = NDArray[Any]

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
    """A half's part of the hidden units in a trajectory: [N, T, I], [I, H], [H] -> [T, H]."""
    for t in range(frames):
        for h in range(len(bias)):
            out[t, h] = bias[h]
        for i in range(len(columns)):
            value = states[n, t, i]
            for h in range(len(bias)):
                out[t, h] += value * columns[i, h]


@_inner
def _statistics(
    first: Array, second: Array, t: int, other: int, output: Array, offset: float
) -> tuple[float, float]:
    """tanh(w . relu(agent + surrounding) + c) of a frame, and with another's surroundings."""
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
    """Adds the slopes of both statistics to the gradients by the units that are on."""
    zero = first.dtype.type(0)
    slope, other_slope = first.dtype.type(together), first.dtype.type(apart)
    for h in range(of_output.shape[1]):
        unit, other_unit = first[t, h] + second[t, h], first[t, h] + second[other, h]
        passed = slope if unit > zero else zero
        other_passed = other_slope if other_unit > zero else zero
        of_first[t, h] = passed + other_passed
        of_second[t, h] += passed
        of_output[0, h] += passed * unit + other_passed * other_unit
        of_second[other, h] += other_passed


@_inner
def _add_products(states: Array, n: int, frames: int, of_units: Array, columns: Array) -> None:
    """Adds [T, I]' @ [T, H] of a trajectory to [I, H]."""
    for t in range(frames):
        for i in range(states.shape[2]):
            value = states[n, t, i]
            for h in range(of_units.shape[1]):
                columns[i, h] += value * of_units[t, h]


@kept_on_disk
def bounds(
    agent: Array, surrounding: Array, others: Array, frames: Array, agent_weight: Array,
    agent_bias: Array, surrounding_weight: Array, output: Array, offset: Array,
) -> Array:  # fmt: skip
    """Donsker-Varadhan bounds, as `functional.mutual_information` has them.

    Args:
        agent: [N, T, X]
        surrounding: [N, T, Y]
        others: [N, T] of which frame the surroundings are, in pairs from the marginals.
        frames: [N] of each trajectory; what is behind them is padding.
        agent_weight: [H, X], the first of the estimator's parameters, which follow in their order.
        agent_bias: [H]
        surrounding_weight: [H, Y]
        output: [1, H]
        offset: [1]

    Returns:
        [N] in nats.
    """
    count, length = others.shape
    found = np.empty(count, agent.dtype)
    first = np.empty((length, len(agent_bias)), agent.dtype)
    second, none = np.empty_like(first), np.zeros_like(agent_bias)
    agent_columns = _transposed(agent_weight)
    surrounding_columns = _transposed(surrounding_weight)
    for n in range(count):
        last = frames[n]
        _half(agent, n, last, agent_columns, agent_bias, first)
        _half(surrounding, n, last, surrounding_columns, none, second)
        joint, marginals = 0.0, 0.0
        for t in range(last):
            together, apart = _statistics(first, second, t, others[n, t], output, offset[0])
            joint += together
            marginals += math.exp(apart)
        found[n] = joint / last - math.log(marginals / last)
    return found


@kept_on_disk
def mean_bound(
    agent: Array, surrounding: Array, others: Array, frames: Array, agent_weight: Array,
    agent_bias: Array, surrounding_weight: Array, output: Array, offset: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """The mean of `bounds` [1], and its derivatives by the estimator's parameters.

    A bound's derivative by a joint statistic is 1/T, by one of the marginals -exp(s) / sum exp(s);
    a statistic's by its argument 1 - s^2.
    """
    count, length = others.shape
    first = np.empty((length, len(agent_bias)), agent.dtype)
    second, of_first, of_second = np.empty_like(first), np.empty_like(first), np.empty_like(first)
    joint, apart = np.empty(length), np.empty(length)
    agent_columns = _transposed(agent_weight)
    surrounding_columns = _transposed(surrounding_weight)
    of_agent, of_surrounding = np.zeros_like(agent_columns), np.zeros_like(surrounding_columns)
    of_bias, of_output, none = (
        np.zeros_like(agent_bias),
        np.zeros_like(output),
        np.zeros_like(agent_bias),
    )
    mean, of_offset = np.zeros_like(offset), np.zeros_like(offset)
    for n in range(count):
        last = frames[n]
        _half(agent, n, last, agent_columns, agent_bias, first)
        _half(surrounding, n, last, surrounding_columns, none, second)
        together, total = 0.0, 0.0
        for t in range(last):
            joint[t], apart[t] = _statistics(first, second, t, others[n, t], output, offset[0])
            together += joint[t]
            total += math.exp(apart[t])
            for h in range(len(agent_bias)):
                of_second[t, h] = 0
        mean[0] += (together / last - math.log(total / last)) / count
        for t in range(last):
            slope = (1.0 - joint[t] ** 2) / (last * count)
            other_slope = -math.exp(apart[t]) * (1.0 - apart[t] ** 2) / (total * count)
            _add_pairs(
                first, second, t, others[n, t], slope, other_slope, of_first, of_second, of_output
            )
            of_offset[0] += slope + other_slope
        _add_products(agent, n, last, of_first, of_agent)
        _add_products(surrounding, n, last, of_second, of_surrounding)
        for t in range(last):
            for h in range(len(of_bias)):
                of_bias[h] += of_first[t, h]
    for h in range(len(of_bias)):
        of_bias[h] *= output[0, h]
        for x in range(len(of_agent)):
            of_agent[x, h] *= output[0, h]
        for y in range(len(of_surrounding)):
            of_surrounding[y, h] *= output[0, h]
    return mean, of_agent.T.copy(), of_bias, of_surrounding.T.copy(), of_output, of_offset
