"""Layers of a perceptron, each with its derivative, and the perceptron's two passes.

A layer that works on rows is a pair `layer(row, ...)`, `layer_backward(row, ...)`: it changes a row
of outputs, or of their gradient, in place. Loops are used instead of array expressions, which take
longer to compile and allocate new arrays.

Shape legend: R rows, I inputs, O outputs, H units of the first layer, L layers, S parameters.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib.kernels.blas import multiply
from music_rllib.kernels.compiling import compiled

Array = NDArray[Any]
Rows = NDArray[np.int64]


LAYER_NORM_EPSILON = 1e-5
"""Added to the variance in layer normalization, as in PyTorch."""


class Normalized(NamedTuple):
    """Results of layer normalization in the last forward pass, needed by its derivative."""

    outputs: Array
    """Normalized outputs of all hidden layers, before ReLU; or [R, O] those of one layer."""
    inverse_std: Array
    """One number for each row of each hidden layer; or [R] those of one layer."""


class Network(NamedTuple):
    """A perceptron with ReLU between its layers and a linear output.

    C networks of equal shape are one `Network` whose positions and kept outputs have a leading axis
    C; `member` takes one of them.
    """

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
    normalized: Normalized
    """Empty if hidden layers have no layer normalization."""


# -- layers ---------------------------------------------------------------------------------


@compiled
def linear_backward_weights(inputs: Array, gradient: Array, by_outputs: bool, out: Array) -> None:
    """Gradient of the weights, summed over rows: [R, I], [R, O] -> shape of the weights."""
    if by_outputs:
        multiply(gradient, True, inputs, False, out)
    else:
        multiply(inputs, True, gradient, False, out)


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


@partial(compiled, any_order=True)
def layer_norm_relu(row: Array, normalized: Array) -> float:
    """Layer normalization without affine parameters (Ba et al. 2016, 1607.06450), then ReLU.

    Args:
        row: [O] outputs of a linear layer, changed in place.
        normalized: [O] receives the values before ReLU.

    Returns:
        The factor of the row: 1 / its standard deviation.
    """
    zero, share = row.dtype.type(0), row.dtype.type(1.0 / len(row))
    mean = squares = zero
    for o in range(len(row)):
        mean += row[o]
    mean *= share
    for o in range(len(row)):
        row[o] -= mean
        squares += row[o] * row[o]
    factor: float = row.dtype.type(1.0 / np.sqrt(squares * share + LAYER_NORM_EPSILON))
    for o in range(len(row)):
        normalized[o] = row[o] * factor
        row[o] = max(normalized[o], zero)
    return factor


@partial(compiled, any_order=True)
def layer_norm_backward(gradient: Array, normalized: Array, factor: float) -> None:
    """Turn the gradient [O] of normalized outputs into that of the outputs of the linear layer."""
    share = gradient.dtype.type(1.0 / len(gradient))
    mean = along = gradient.dtype.type(0)
    for o in range(len(gradient)):
        mean += gradient[o]
        along += gradient[o] * normalized[o]
    mean *= share
    along *= share
    for o in range(len(gradient)):
        gradient[o] = (gradient[o] - mean - normalized[o] * along) * factor


# -- the perceptron -------------------------------------------------------------------------


@compiled
def member(networks: Network, c: int) -> Network:
    """Network c of C. Those that are not trained may share the room for their outputs."""
    at = c % len(networks.kept)
    return Network(
        networks.values, networks.gradients, networks.sizes, networks.weights[c],
        networks.biases[c], networks.by_outputs, networks.kept[at],
        Normalized(networks.normalized.outputs[at], networks.normalized.inverse_std[at]),
    )  # fmt: skip


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
    outputs: Array = _outputs_in(network.kept, network.sizes, layer, rows)
    return outputs


@compiled
def _outputs_in(flat: Array, sizes: Array, layer: int, rows: int) -> Array:
    """[R, O] a layer's part of concatenated outputs."""
    start, size = 0, sizes[layer + 1]
    for below in range(1, layer + 1):
        start += rows * sizes[below]
    outputs: Array = flat[start : start + rows * size].reshape((rows, size))
    return outputs


@compiled
def _of_layer(network: Network, layer: int, rows: int) -> Normalized:
    """`Normalized` of one hidden layer; without rows if there is no layer normalization."""
    outputs, inverse_std = network.normalized
    rows = rows if len(inverse_std) > 0 else 0
    some = inverse_std[layer * rows : (layer + 1) * rows]
    return Normalized(_outputs_in(outputs, network.sizes, layer, rows), some)


@compiled
def _hidden(out: Array, bias: Array, normalized: Normalized) -> None:
    """Bias, layer normalization and ReLU of [R, O]."""
    for r in range(len(out)):
        if len(normalized.inverse_std) == 0:
            add_bias_relu(out[r], bias)
        else:
            add_bias(out[r], bias)
            normalized.inverse_std[r] = layer_norm_relu(out[r], normalized.outputs[r])


@compiled
def _hidden_backward(
    gradient: Array, outputs: Array, normalized: Normalized, rows: Rows, learned: int, bias: Array
) -> None:
    """Derivative of `_hidden` at some rows; the bias receives that of the first ones."""
    bias[:] = 0
    for r in range(len(rows)):
        relu_backward(gradient[r], outputs[rows[r]])
        if len(normalized.inverse_std) > 0:
            kept, factor = normalized.outputs[rows[r]], normalized.inverse_std[rows[r]]
            layer_norm_backward(gradient[r], kept, factor)
        if r < learned:
            add_bias(bias, gradient[r])


@compiled
def forward(network: Network, inputs: Array) -> Array:
    """[R, I] -> [R, O], overwritten by the next call."""
    last = len(network.sizes) - 2
    rows = len(inputs)
    for layer in range(last + 1):
        bias = _bias(network, network.values, layer)
        out = layer_outputs(network, layer, rows)
        weights = layer_weights(network, network.values, layer)
        multiply(inputs, False, weights, network.by_outputs, out)
        if layer < last:
            _hidden(out, bias, _of_layer(network, layer, rows))
        else:
            for r in range(rows):
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
        [R', H] gradient of the first layer's outputs before layer normalization and ReLU.
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
        multiply(gradient, False, weights, not network.by_outputs, out)
        normalized = _of_layer(network, layer - 1, len(inputs))
        bias = _bias(network, network.gradients, layer - 1)
        _hidden_backward(out, below, normalized, rows, learned, bias)
        gradient = out
    return gradient
