"""The bounds of MUSIC's estimator, their derivatives, and its training.

Formulas: `functional.mutual_information`; losses: `MutualInformationEstimator.loss`. The agent's
and the surrounding state of a frame each contribute to the hidden units; each contribution is
computed once, for all pairs. No matrix of hidden units is stored. Sums are in float64: the bound of
two frames is small, and the intrinsic reward is 5,000 times as large.

Shape legend: K updates, N trajectories and B transitions of one, T frames, X / Y features of the
agent's and the surrounding state, I both together, H hidden units, S statistics of a frame: its own
pair, and one shuffled pair (several for `infonce`).
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from music_rllib.functional import mutual_information as formulas
from music_rllib.functional.mutual_information import AVERAGE_RATE, SMILE_CLIP
from music_rllib.kernels import adam, compiling
from music_rllib.kernels.adam import AdamStep, adam_step
from music_rllib.kernels.compiling import compiled, kept_on_disk, sources_of
from music_rllib.kernels.layers import Array

BOUNDS = ("capped", "moving_average", "nwj", "smile", "infonce")
"""Kinds of bounds; compiled code takes the position."""
_CAPPED, _MOVING_AVERAGE, _NWJ, _SMILE, _INFONCE = range(5)


class Bound(NamedTuple):
    """Kind of a bound, and what its kind needs."""

    kind: int
    """Position in `BOUNDS`."""
    statistics: int
    """S"""
    log_average: Array
    """[] logarithm of the moving average of exp T(x, y'); updated in place."""


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
    first: Array, second: Array, t: int, one: int, other: int, output: Array, offset: float
) -> tuple[float, float]:
    """Of a frame with the surroundings of two frames: w . relu(agent + surrounding) + c."""
    zero = first.dtype.type(0)
    of_one, of_other = zero, zero
    for h in range(output.shape[1]):
        of_one += output[0, h] * max(first[t, h] + second[one, h], zero)
        of_other += output[0, h] * max(first[t, h] + second[other, h], zero)
    return of_one + offset, of_other + offset


@_inner
def _tanh(x: float) -> float:
    shrunk = math.exp(-2.0 * abs(x))
    return math.copysign((1.0 - shrunk) / (1.0 + shrunk), x)


@_inner
def _add_pairs(
    first: Array, second: Array, t: int, one: int, other: int, of_one: float, of_other: float,
    of_first: Array, of_second: Array, of_output: Array,
) -> None:  # fmt: skip
    """Add the derivatives of both statistics to the gradients, through units that are on."""
    zero = first.dtype.type(0)
    slope, other_slope = first.dtype.type(of_one), first.dtype.type(of_other)
    for h in range(of_output.shape[1]):
        unit, other_unit = first[t, h] + second[one, h], first[t, h] + second[other, h]
        passed = zero if unit <= zero else slope  # a NaN passes, as in autograd
        other_passed = zero if other_unit <= zero else other_slope
        of_first[t, h] += passed + other_passed
        of_second[one, h] += passed
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
def _place(data: Data, n: int, t: int, s: int) -> int:
    """Frame of the surrounding state in a frame's pair number s; shuffled ones as in `shifted`."""
    return t if s == 0 else data.others[n, (t + s - 1) % data.frames[n]]


@_inner
def _forward(
    data: Data, n: int, bound: Bound, weights: Weights, columns: tuple[Array, Array],
    first: Array, second: Array, statistics: Array,
) -> None:  # fmt: skip
    """A trajectory: write its halves' contributions to the hidden units, and [S, T] statistics."""
    last, end = data.frames[n], bound.statistics - 1
    _half(data.agent, n, last, columns[0], weights.bias, first)
    _half(data.surrounding, n, last, columns[1], np.zeros_like(weights.bias), second)
    for t in range(last):
        for s in range(0, end + 1, 2):
            other = min(s + 1, end)
            one, two = _place(data, n, t, s), _place(data, n, t, other)
            found, found_two = _statistics(
                first, second, t, one, two, weights.output, weights.offset[0]
            )
            statistics[s, t] = _tanh(found) if bound.kind == _CAPPED else found
            statistics[other, t] = _tanh(found_two) if bound.kind == _CAPPED else found_two


@_inner
def _shares(statistics: Array, t: int) -> float:
    """Replace a frame's statistics by their shares of the sum of exp; the log of the own pair's."""
    own, top, total = statistics[0, t], statistics[0, t], 0.0
    for s in range(len(statistics)):
        top = max(top, statistics[s, t])
    for s in range(len(statistics)):
        statistics[s, t] = math.exp(statistics[s, t] - top)
        total += statistics[s, t]
    for s in range(len(statistics)):
        statistics[s, t] /= total
    log_share: float = own - top - math.log(total)
    return log_share


@_inner
def _value(kind: int, statistics: Array, last: int) -> tuple[float, float, float]:
    """The bound in nats, and a and b with sum exp T(x, y') = exp(a) b; for `infonce`, shares."""
    mean, top, total = 0.0, 0.0, 0.0
    for t in range(last):
        mean += _shares(statistics, t) if kind == _INFONCE else statistics[0, t]
    if kind == _INFONCE:
        return mean / last + math.log(len(statistics)), top, total
    if kind in (_MOVING_AVERAGE, _NWJ):
        top = statistics[1, 0]
        for t in range(last):
            top = max(top, statistics[1, t])
    for t in range(last):
        value = statistics[1, t]
        if kind == _SMILE:
            value = min(max(value, -SMILE_CLIP), SMILE_CLIP)
        total += math.exp(value - top)
    if kind == _NWJ:
        return mean / last - math.exp(top - 1.0) * total / last, top, total
    return mean / last - (top + math.log(total / last)), top, total


@_inner
def _slopes(
    bound: Bound, statistics: Array, last: int, total: float, count: int, frames: int
) -> None:
    """Replace a trajectory's statistics by the loss's derivatives by each, before any tanh.

    The loss has N trajectories of `frames` in all. The derivative of the capped bound by a
    statistic of a frame's own pair is 1/T, and by another one -exp(s) / sum exp(s); that of a
    capped statistic s by its argument is 1 - s^2.
    """
    kind = bound.kind
    for t in range(last):
        own, other = statistics[0, t], statistics[1, t]
        if kind == _CAPPED:
            statistics[0, t] = -(1.0 - own**2) / (last * count)
            statistics[1, t] = math.exp(other) * (1.0 - other**2) / (total * count)
        elif kind == _MOVING_AVERAGE:
            statistics[0, t] = -1.0 / frames
            statistics[1, t] = math.exp(other - bound.log_average[()]) / frames
        elif kind == _NWJ:
            statistics[0, t] = -1.0 / (last * count)
            statistics[1, t] = math.exp(other - 1.0) / (last * count)
        elif kind == _SMILE:
            statistics[0, t] = -1.0 / ((1.0 + math.exp(own)) * frames)
            statistics[1, t] = 1.0 / ((1.0 + math.exp(-other)) * frames)
        else:
            for s in range(len(statistics)):
                statistics[s, t] = (statistics[s, t] - (s == 0)) / (last * count)


@_inner
def _room(data: Data, bound: Bound, weights: Weights) -> tuple[Array, Array, Array]:
    """Memory for `_forward`."""
    length = data.others.shape[1]
    first = np.empty((length, len(weights.bias)), data.agent.dtype)
    return first, np.empty_like(first), np.empty((bound.statistics, length))


@_inner
def _bounds(data: Data, bound: Bound, weights: Weights, found: Array) -> None:
    first, second, statistics = _room(data, bound, weights)
    columns = _transposed(weights.agent), _transposed(weights.surrounding)
    for n in range(len(found)):
        _forward(data, n, bound, weights, columns, first, second, statistics)
        found[n], _, _ = _value(bound.kind, statistics, data.frames[n])


@_inner
def _update_average(
    data: Data, bound: Bound, weights: Weights, columns: tuple[Array, Array]
) -> None:
    """Move the average of exp T(x, y') toward the mean over all frames."""
    first, second, statistics = _room(data, bound, weights)
    log_sum = -np.inf
    for n in range(len(data.others)):
        _forward(data, n, bound, weights, columns, first, second, statistics)
        _, top, total = _value(bound.kind, statistics, data.frames[n])
        log_sum = np.logaddexp(log_sum, top + math.log(total))
    kept = bound.log_average[()] + math.log1p(-AVERAGE_RATE)
    log_mean = log_sum - math.log(data.frames.sum())
    bound.log_average[()] = np.logaddexp(kept, log_mean + math.log(AVERAGE_RATE))


@_inner
def _differentiate(data: Data, bound: Bound, weights: Weights, by: Weights) -> float:
    """The mean of `bounds`; write the loss's derivatives by each parameter to `by`."""
    first, second, statistics = _room(data, bound, weights)
    of_first, of_second = np.empty_like(first), np.empty_like(second)
    columns = _transposed(weights.agent), _transposed(weights.surrounding)
    of_agent, of_surrounding = np.zeros_like(columns[0]), np.zeros_like(columns[1])
    count, end, output = len(data.others), bound.statistics - 1, weights.output
    by.bias[:], by.output[:], by.offset[:] = 0, 0, 0
    if bound.kind == _MOVING_AVERAGE:
        _update_average(data, bound, weights, columns)
    frames, mean = data.frames.sum(), 0.0
    for n in range(count):
        last = data.frames[n]
        _forward(data, n, bound, weights, columns, first, second, statistics)
        value, _, total = _value(bound.kind, statistics, last)
        mean += value / count
        _slopes(bound, statistics, last, total, count, frames)
        of_first[:last], of_second[:last] = 0, 0
        for t in range(last):
            for s in range(0, end + 1, 2):
                other = min(s + 1, end)
                one, two = _place(data, n, t, s), _place(data, n, t, other)
                slope, slope_two = statistics[s, t], statistics[other, t] if other > s else 0.0
                _add_pairs(
                    first, second, t, one, two, slope, slope_two, of_first, of_second, by.output
                )
                by.offset[0] += slope + slope_two
        _add_products(data.agent, n, last, of_first, of_agent)
        _add_products(data.surrounding, n, last, of_second, of_surrounding)
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


@_inner
def _rows(data: Data, start: int, count: int) -> Data:
    rows = slice(start, start + count)
    return Data(data.agent[rows], data.surrounding[rows], data.others[rows], data.frames[rows])


def _compiled_for(sources: str) -> Any:
    """`bounds` and `learn`, cached on disk until a file that they are compiled from changes."""

    @kept_on_disk
    def bounds(data: Data, bound: Bound, weights: Weights) -> Array:
        """[N] bounds in nats."""
        sources  # noqa: B018
        found = np.empty(len(data.others), data.agent.dtype)
        _bounds(data, bound, weights, found)
        return found

    @kept_on_disk
    def learn(
        transitions: Data, trajectories: Data, bound: Bound, weights: Weights, by: Weights,
        step: AdamStep, updates: int,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Do K updates in order, each on its part of the data.

        Args:
            transitions: [K*B] pairs of frames, whose bounds are computed before their update.
            trajectories: [K*N] training data, concatenated minibatches.
            weights: views of `step.values`.
            by: views of `step.gradients`.
            updates: K.

        Returns:
            [K*B] bounds of the transitions, and [K] mean bounds of the trajectories.
        """
        sources  # noqa: B018
        found = np.empty(len(transitions.others), transitions.agent.dtype)
        means = np.empty(updates, transitions.agent.dtype)
        rows, count = len(found) // updates, len(trajectories.others) // updates
        # Unclipped, as in `MutualInformationEstimator.bound` with `of_pairs`.
        kind = _MOVING_AVERAGE if bound.kind == _SMILE else bound.kind
        of_pairs = Bound(kind, 2, bound.log_average)
        for k in range(updates):
            some = found[k * rows : (k + 1) * rows]
            _bounds(_rows(transitions, k * rows, rows), of_pairs, weights, some)
            means[k] = _differentiate(_rows(trajectories, k * count, count), bound, weights, by)
            adam_step(step)
        return found, means

    return bounds, learn


bounds, learn = _compiled_for(sources_of(adam, compiling, formulas))
