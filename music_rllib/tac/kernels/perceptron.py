"""A perceptron, forwards and backwards, compiled.

Shape legend: R rows, I inputs, O outputs, H units of the first layer, L layers, S parameters.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib.compiling import compiled
from music_rllib.tac.kernels.blas import multiply

__all__ = ["Array", "Network", "Rows", "backward", "forward", "layer_outputs", "layer_weights"]

Array = NDArray[Any]
Rows = NDArray[np.int64]
# Loops in place of expressions of arrays: those take longer to compile, and make new arrays.


class Network(NamedTuple):
    """A perceptron with ReLU between its layers and a linear output."""

    values: Array
    """[S] parameters, of this network and others."""
    gradients: Array
    """[S], or empty where nothing is trained."""
    sizes: Array
    """[L + 1] of the inputs, the hidden layers and the outputs."""
    weights: Array
    """[L] where those of a layer begin."""
    biases: Array
    """[L] likewise of the biases."""
    by_outputs: bool
    """Weights are [O, I], as `torch.nn.Linear` has them, and not [I, O]."""
    kept: Array
    """Outputs of all layers in the last forward."""


@compiled
def layer_weights(network: Network, flat: Array, layer: int) -> Array:
    """A layer's weights among the parameters or gradients, as they lie in memory."""
    inputs, outputs = network.sizes[layer], network.sizes[layer + 1]
    weights = flat[network.weights[layer] : network.weights[layer] + inputs * outputs]
    if network.by_outputs:
        return weights.reshape((outputs, inputs))
    return weights.reshape((inputs, outputs))


@compiled
def _bias(network: Network, flat: Array, layer: int) -> Array:
    """[O] of a layer, among the parameters or gradients."""
    return flat[network.biases[layer] : network.biases[layer] + network.sizes[layer + 1]]


@compiled
def layer_outputs(network: Network, layer: int, rows: int) -> Array:
    """[R, O] of a layer in a forward over so many rows."""
    start, size = 0, network.sizes[layer + 1]
    for below in range(1, layer + 1):
        start += rows * network.sizes[below]
    return network.kept[start : start + rows * size].reshape((rows, size))


@compiled
def forward(network: Network, inputs: Array) -> Array:
    """[R, I] -> [R, O], kept until the next call."""
    last = len(network.sizes) - 2
    rows = len(inputs)
    zero = network.values.dtype.type(0)
    for layer in range(last + 1):
        weights = layer_weights(network, network.values, layer)
        bias = _bias(network, network.values, layer)
        out = layer_outputs(network, layer, rows)
        multiply(inputs, False, weights, network.by_outputs, out)
        for r in range(rows):
            row = out[r]
            if layer == last:
                for o in range(len(bias)):
                    row[o] += bias[o]
            else:
                for o in range(len(bias)):
                    row[o] = max(row[o] + bias[o], zero)
        inputs = out
    return inputs


@compiled
def backward(
    network: Network, inputs: Array, rows: Rows, gradient: Array, learned: int, scratch: Array
) -> Array:
    """Writes the gradients of the parameters.

    Args:
        inputs: [R, I] of the last forward pass.
        rows: [R'] the rows of `inputs` that have a gradient.
        gradient: [R', O] of the outputs at these rows.
        learned: How many rows count for the parameters: the first ones of all, which come first.
        scratch: Is overwritten.

    Returns:
        [R', H] the gradient of the first layer's outputs before ReLU.
    """
    last = len(network.sizes) - 2
    zero = network.values.dtype.type(0)
    bias = _bias(network, network.gradients, last)
    for o in range(len(bias)):
        bias[o] = zero
        for r in range(learned):
            bias[o] += gradient[r, o]
    for layer in range(last, -1, -1):
        below = inputs if layer == 0 else layer_outputs(network, layer - 1, len(inputs))
        of_weights = layer_weights(network, network.gradients, layer)
        if network.by_outputs:
            multiply(gradient[:learned], True, below[:learned], False, of_weights)
        else:
            multiply(below[:learned], True, gradient[:learned], False, of_weights)
        if layer == 0:
            break
        weights = layer_weights(network, network.values, layer)
        out = scratch[layer % 2, : len(rows) * network.sizes[layer]].reshape(
            (len(rows), network.sizes[layer])
        )
        multiply(gradient, False, weights, not network.by_outputs, out)
        bias = _bias(network, network.gradients, layer - 1)
        for o in range(len(bias)):
            bias[o] = zero
        for r in range(len(rows)):
            row, passed = out[r], below[rows[r]]
            for o in range(len(bias)):
                row[o] = zero if passed[o] <= zero else row[o]  # NaN passes
            if r < learned:
                for o in range(len(bias)):
                    bias[o] += row[o]
        gradient = out
    return gradient
