"""Layers of a perceptron, each with its derivative, and the perceptron's two passes.

A layer that works on rows is a pair `layer(row, ...)`, `layer_backward(row, ...)`: it changes a row
of outputs, or of their gradient, in place. Loops are used instead of array expressions, which take
longer to compile and allocate new arrays.

Shape legend: R rows, I inputs, O outputs, H units of the first layer, L layers, S parameters.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib.kernels.blas import multiply
from music_rllib.kernels.compiling import compiled

Array = NDArray[Any]
Rows = NDArray[np.int64]


class Network(NamedTuple):
    """A perceptron with ReLU between its layers and a linear output."""

    values: Array
    """[S] parameters of this network and of others."""
    gradients: Array
    """[S], or empty if nothing is trained."""
    sizes: Array
    """[L + 1] sizes of the inputs, the hidden layers and the outputs."""
    weights: Array
    """[L] position of each layer's weights in `values`."""
    biases: Array
    """[L] position of each layer's biases in `values`."""
    by_outputs: bool
    """Whether weights are [O, I], as in `torch.nn.Linear`; otherwise [I, O]."""
    kept: Array
    """Outputs of all layers in the last forward pass."""


# -- layers ---------------------------------------------------------------------------------


@compiled
def linear(inputs: Array, weights: Array, by_outputs: bool, out: Array) -> None:
    """[R, I] -> [R, O] without the bias."""
    multiply(inputs, False, weights, by_outputs, out)


@compiled
def linear_backward_weights(inputs: Array, gradient: Array, by_outputs: bool, out: Array) -> None:
    """Gradient of the weights, summed over rows: [R, I], [R, O] -> shape of the weights."""
    if by_outputs:
        multiply(gradient, True, inputs, False, out)
    else:
        multiply(inputs, True, gradient, False, out)


@compiled
def linear_backward_inputs(gradient: Array, weights: Array, by_outputs: bool, out: Array) -> None:
    """Gradient of the inputs: [R, O] -> [R, I]."""
    multiply(gradient, False, weights, not by_outputs, out)


@compiled
def add_bias(row: Array, bias: Array) -> None:
    """[O] outputs plus bias. The bias has the gradient of the outputs, summed over rows."""
    for o in range(len(bias)):
        row[o] += bias[o]


@compiled
def add_bias_relu(row: Array, bias: Array) -> None:
    """max(0, outputs plus bias), in one pass over the row."""
    zero = row.dtype.type(0)
    for o in range(len(bias)):
        row[o] = max(row[o] + bias[o], zero)


@compiled
def relu_backward(gradient: Array, outputs: Array) -> None:
    """The gradient of units that are on, 0 for the others; NaN outputs pass it, as in autograd."""
    zero = gradient.dtype.type(0)
    for o in range(len(gradient)):
        gradient[o] = zero if outputs[o] <= zero else gradient[o]


# -- the perceptron -------------------------------------------------------------------------


@compiled
def layer_weights(network: Network, flat: Array, layer: int) -> Array:
    """A view of a layer's weights in the flat parameters or gradients."""
    inputs, outputs = network.sizes[layer], network.sizes[layer + 1]
    weights = flat[network.weights[layer] : network.weights[layer] + inputs * outputs]
    if network.by_outputs:
        return weights.reshape((outputs, inputs))
    return weights.reshape((inputs, outputs))


@compiled
def _bias(network: Network, flat: Array, layer: int) -> Array:
    """[O] a view of a layer's biases in the flat parameters or gradients."""
    return flat[network.biases[layer] : network.biases[layer] + network.sizes[layer + 1]]


@compiled
def layer_outputs(network: Network, layer: int, rows: int) -> Array:
    """[R, O] a view of a layer's outputs in the last forward pass, which had R rows."""
    start, size = 0, network.sizes[layer + 1]
    for below in range(1, layer + 1):
        start += rows * network.sizes[below]
    return network.kept[start : start + rows * size].reshape((rows, size))


@compiled
def forward(network: Network, inputs: Array) -> Array:
    """[R, I] -> [R, O], overwritten by the next call."""
    last = len(network.sizes) - 2
    rows = len(inputs)
    for layer in range(last + 1):
        bias = _bias(network, network.values, layer)
        out = layer_outputs(network, layer, rows)
        weights = layer_weights(network, network.values, layer)
        linear(inputs, weights, network.by_outputs, out)
        for r in range(rows):
            if layer < last:
                add_bias_relu(out[r], bias)
            else:
                add_bias(out[r], bias)
        inputs = out
    return inputs


@compiled
def backward(
    network: Network, inputs: Array, rows: Rows, gradient: Array, learned: int, scratch: Array
) -> Array:
    """Write the gradients of the parameters.

    Args:
        inputs: [R, I] inputs of the last forward pass.
        rows: [R'] rows of `inputs` that have a gradient.
        gradient: [R', O] gradient of the outputs at these rows.
        learned: number of rows that count for the parameters; they are the first of `inputs` and
            of `rows`.
        scratch: overwritten.

    Returns:
        [R', H] gradient of the first layer's outputs before ReLU.
    """
    last = len(network.sizes) - 2
    bias = _bias(network, network.gradients, last)
    bias[:] = 0
    for r in range(learned):
        add_bias(bias, gradient[r])
    for layer in range(last, -1, -1):
        below = inputs if layer == 0 else layer_outputs(network, layer - 1, len(inputs))
        of_weights = layer_weights(network, network.gradients, layer)
        linear_backward_weights(below[:learned], gradient[:learned], network.by_outputs, of_weights)
        if layer == 0:
            break
        weights = layer_weights(network, network.values, layer)
        size = network.sizes[layer]
        out = scratch[layer % 2, : len(rows) * size].reshape((len(rows), size))
        linear_backward_inputs(gradient, weights, network.by_outputs, out)
        bias = _bias(network, network.gradients, layer - 1)
        bias[:] = 0
        for r in range(len(rows)):
            relu_backward(out[r], below[rows[r]])
            if r < learned:
                add_bias(bias, out[r])
        gradient = out
    return gradient
