"""A multi-layer perceptron as one node of autograd's graph, its products by oneDNN.

PyTorch leaves float32 products on a CPU to MKL, which uses AVX-512 on Intel's CPUs only. oneDNN,
which PyTorch has too, uses it on any: on an AMD EPYC it is twice as fast (docs/performance.md).

Shape legend: B rows, I inputs, H units of a layer, O outputs, C networks.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from music_rllib.tac.precision import cpu_flags

__all__ = ["FEWEST_ROWS", "is_fused", "perceptron", "product"]

FEWEST_ROWS = 64
"""With fewer, as in acting, oneDNN takes longer to call than it saves."""
_NARROW = 16
"""Likewise matrices with fewer rows or columns."""

# Overloads, since to choose one at each call takes a tenth of a small product's time. The first has
# no public name; it is what torch.compile makes of a linear layer on a CPU.
try:
    _linear_pointwise: Any = torch.ops.mkldnn._linear_pointwise.default
except AttributeError:
    _linear_pointwise = None
_shuffle_channels = torch.ops.aten.native_channel_shuffle.default
_pass_where_positive = torch.ops.aten.threshold_backward.grad_input


def is_fused(inputs: Tensor) -> bool:
    """Whether `perceptron` takes these inputs, and gains by it."""
    return (
        inputs.device.type == "cpu"
        and inputs.dtype == torch.float32
        and inputs.ndim == 2
        and inputs.shape[0] >= FEWEST_ROWS
        and _has_onednn()
    )


@functools.cache
def _has_onednn() -> bool:
    """Decided by the machine and not by a measurement: a seed has to give the same numbers."""
    return (
        torch.backends.mkldnn.is_available()
        and _linear_pointwise is not None
        and "avx512f" in cpu_flags()
    )


def perceptron(inputs: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """ReLU between the layers, a linear output; can be differentiated once.

    Args:
        inputs: [B, I], for which `is_fused`.
        weights: of each layer [H, I], as `nn.Linear` has them; of C networks at once [C, I, H].
        biases: of each layer [H], or [C, 1, H].

    Returns:
        [B, O], or [C, B, O].
    """
    output: Tensor = _Perceptron.apply(inputs, None, *weights, *biases)  # type: ignore[no-untyped-call]
    return output


def learn_and_ask(
    learned: Tensor, asked: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """C networks on two minibatches at once: [B, I] -> [C, B, O] each.

    Args:
        learned: weights and biases get their gradients from these, which get none.
        asked: get gradients, and give none to weights and biases.
        weights: of each layer [C, I, H].
        biases: of each layer [C, 1, H].
    """
    outputs: tuple[Tensor, Tensor]
    outputs = _Perceptron.apply(asked, learned, *weights, *biases)  # type: ignore[no-untyped-call]
    return outputs


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, inputs: Tensor, learned: Tensor | None, *parameters: Tensor
    ) -> Tensor | tuple[Tensor, Tensor]:
        rows = inputs if learned is None else torch.cat([learned, inputs])
        networks = _networks(parameters)
        outputs: list[Tensor] = []
        entered: list[Tensor] = []
        for weights, biases in networks:
            hidden = _hidden(rows, weights[:-1], biases[:-1])
            outputs.append(torch.addmm(biases[-1], hidden[-1], weights[-1].t()))
            entered += hidden
        # The parameters only to be told of a change: what is used of them are the views.
        ctx.save_for_backward(*parameters, *entered)
        ctx.weights = [weights for weights, _ in networks]
        ctx.learned = None if learned is None else len(learned)
        if not _are_stacked(parameters):
            return outputs[0]
        if learned is None:
            return torch.stack(outputs)
        halves = [output.split([len(learned), len(inputs)]) for output in outputs]
        of_learned, of_inputs = zip(*halves, strict=True)
        return torch.stack(of_learned), torch.stack(of_inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *of_outputs: Tensor) -> tuple[Tensor | None, ...]:
        for_inputs, _, *for_parameters = ctx.needs_input_grad
        parameters = ctx.saved_tensors[: len(for_parameters)]
        entered = ctx.saved_tensors[len(for_parameters) :]
        layers, stacked = len(for_parameters) // 2, _are_stacked(parameters)
        gradient = of_outputs[0] if ctx.learned is None else torch.cat(of_outputs, 1)
        wanted = _Wanted(for_inputs, for_parameters[0], ctx.learned, stacked)
        starts = gradient.unbind() if stacked else [gradient]
        gradients = [
            _gradients(start, weights, entered[c * layers : (c + 1) * layers], wanted)
            for c, (start, weights) in enumerate(zip(starts, ctx.weights, strict=True))
        ]
        of_inputs, *of_parameters = gradients[0]
        if stacked:
            networks = list(zip(*gradients, strict=True))
            of_inputs = functools.reduce(torch.add, networks[0]) if for_inputs else None
            of_parameters = [torch.stack(n) if wanted.parameters else None for n in networks[1:]]
        return (of_inputs, None, *of_parameters)


class _Wanted(NamedTuple):
    inputs: bool
    parameters: bool
    learned: int | None
    """The first rows, which the parameters learn from and the inputs' gradients leave out."""
    stacked: bool
    """Whether weights are [I, H] and biases [1, H]: one of C networks."""


Network = tuple[Sequence[Tensor], Sequence[Tensor]]


def _are_stacked(parameters: Sequence[Tensor]) -> bool:
    return parameters[0].ndim == 3


def _networks(parameters: Sequence[Tensor]) -> list[Network]:
    """Weights [H, I] and biases [H] of each."""
    layers = len(parameters) // 2
    weights, biases = parameters[:layers], parameters[layers:]
    if not _are_stacked(parameters):
        return [(weights, biases)]
    return list(
        zip(
            zip(*(weight.mT.unbind() for weight in weights), strict=True),
            zip(*(bias.squeeze(1).unbind() for bias in biases), strict=True),
            strict=True,
        )
    )


def _hidden(inputs: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> list[Tensor]:
    """What enters each layer, that of the output included."""
    hidden = [inputs]
    for weight, bias in zip(weights, biases, strict=True):
        hidden.append(_linear(hidden[-1], weight, bias, "relu"))
    return hidden


def _gradients(
    gradient: Tensor, weights: Sequence[Tensor], entered: Sequence[Tensor], wanted: _Wanted
) -> tuple[Tensor | None, ...]:
    """From the output's gradient [B, O]: of the inputs, the weights and the biases of a network."""
    layers = len(weights)
    of_weights: list[Tensor | None] = [None] * layers
    of_biases: list[Tensor | None] = [None] * layers
    for layer in reversed(range(layers)):
        below = entered[layer]
        if wanted.parameters:
            of_output, of_input = gradient, below
            if wanted.learned is not None:
                of_output, of_input = gradient[: wanted.learned], below[: wanted.learned]
            left, right = (of_input, of_output) if wanted.stacked else (of_output, of_input)
            of_weights[layer] = _summed_outer(left, right)
            of_biases[layer] = of_output.sum(0, keepdim=wanted.stacked)
        if layer > 0:
            gradient = product(gradient, weights[layer].t())
            # Where ReLU gave 0 nothing passes. In place: the product is nobody else's.
            _pass_where_positive(gradient, below, 0, grad_input=gradient)
    of_inputs = product(gradient[wanted.learned :], weights[0].t()) if wanted.inputs else None
    return of_inputs, *of_weights, *of_biases


def _linear(inputs: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    """[B, I], [H, I], [H] -> [B, H]."""
    output: Tensor = _linear_pointwise(inputs, weight, bias, activation, [], "")
    return output


def product(left: Tensor, right: Tensor) -> Tensor:
    """[M, K], [N, K] -> [M, N], float32 on a CPU with oneDNN."""
    rows, inner = left.shape
    if rows < _NARROW or inner < _NARROW or right.shape[0] < _NARROW:
        return left @ right.t()
    return _linear(left, right, None, "none")


def _summed_outer(left: Tensor, right: Tensor) -> Tensor:
    """[B, M], [B, N] -> [M, N], the sum of the rows' outer products."""
    # oneDNN takes a copy of the first factor, which is transposed: cheaper of the narrower one.
    if _NARROW <= right.shape[1] < left.shape[1] // 2:
        return product(_transposed(right), left.t()).t().contiguous()
    if left.shape[1] < _NARROW or right.shape[1] < _NARROW:
        return left.t() @ right
    return product(_transposed(left), right.t())


def _transposed(matrix: Tensor) -> Tensor:
    """[M, N] -> [N, M], a copy, in two thirds of the time of `t().contiguous()`.

    With their channels last, M groups of N channels are shuffled by a transposition in AVX-512.
    """
    rows, columns = matrix.shape
    size = rows * columns
    channels = matrix.contiguous().as_strided((1, size, 1, 1), (size, 1, size, size))
    transposed: Tensor = _shuffle_channels(channels, rows).as_strided((columns, rows), (rows, 1))
    return transposed
