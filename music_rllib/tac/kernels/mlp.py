"""A multi-layer perceptron on kept buffers, forwards and backwards.

Shape legend: R rows, I inputs, O outputs, H units of a layer.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from music_rllib.tac.kernels.flat import FlatParameters
from music_rllib.tac.kernels.products import Products
from music_rllib.tac.networks import Critics, Perceptron

__all__ = ["Network", "critics", "perceptron"]


class Network:
    """ReLU between its layers, a linear output.

    Args:
        weights: of each layer [I, O], views of the parameters.
        biases: of each layer [O].
        gradients: where the gradients of weights and biases go; None for what is not trained.
        products: by which library.
        scratch: buffers for gradients between layers, shared among networks.
    """

    def __init__(
        self,
        weights: Sequence[Tensor],
        biases: Sequence[Tensor],
        gradients: tuple[Sequence[Tensor], Sequence[Tensor]] | None,
        products: Products,
        scratch: Scratch,
    ) -> None:
        self.weights, self.biases = list(weights), list(biases)
        self._gradients = gradients
        self._products = products
        self._scratch = scratch
        self._kept: dict[int, list[Tensor]] = {}
        self._entered: list[Tensor] = []

    def forward(self, inputs: Tensor) -> Tensor:
        """[R, I] -> [R, O]; `backward` refers to the last call."""
        buffers = self._buffers(inputs)
        self._entered = [inputs]
        for weight, bias, out in zip(self.weights[:-1], self.biases, buffers, strict=False):
            self._entered.append(self._products.hidden(self._entered[-1], weight, bias, out))
        return torch.addmm(self.biases[-1], self._entered[-1], self.weights[-1])

    def _buffers(self, inputs: Tensor) -> list[Tensor]:
        rows = len(inputs)
        if rows not in self._kept:
            self._kept[rows] = [inputs.new_empty(rows, len(bias)) for bias in self.biases[:-1]]
        return self._kept[rows]

    def backward(self, gradient: Tensor, learned: int) -> Tensor:
        """Writes the parameters' gradients.

        Args:
            gradient: [R', O] of the outputs of the first R' rows of the last forward.
            learned: so many rows count for the parameters, the first ones.

        Returns:
            [R', H] of the first layer's outputs, for `of_inputs`; valid until another network's
            backward.
        """
        assert self._gradients is not None
        rows = len(gradient)
        for layer in reversed(range(len(self.weights))):
            below = self._entered[layer][:rows]
            of_weight, of_bias = (group[layer] for group in self._gradients)
            self._products.of_weight(below[:learned], gradient[:learned], of_weight)
            torch.sum(gradient[:learned], 0, out=of_bias)
            if layer > 0:
                out = self._scratch.take(below)
                gradient = self._products.through(gradient, self.weights[layer], below, out)
        return gradient

    def of_inputs(self, gradient: Tensor, columns: slice) -> Tensor:
        """[R, H] of the first layer's outputs -> of some columns of the inputs."""
        return gradient @ self.weights[0][columns].t()


class Scratch:
    """Two buffers of each shape in turn: a layer's gradient is made of the one above it only."""

    def __init__(self) -> None:
        self._pairs: dict[torch.Size, list[Tensor]] = {}

    def take(self, like: Tensor) -> Tensor:
        """A buffer of that shape, not the one that was taken last."""
        pair = self._pairs.get(like.shape)
        if pair is None:
            pair = self._pairs[like.shape] = [torch.empty_like(like) for _ in range(2)]
        pair.reverse()
        return pair[0]


def perceptron(
    network: Perceptron, flat: FlatParameters | None, products: Products, scratch: Scratch
) -> Network:
    """On the parameters of `network`; without `flat` it is not trained."""
    layers = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
    weights = [layer.weight.detach().t() for layer in layers]
    biases = [layer.bias.detach() for layer in layers]
    gradients = None
    if flat is not None:
        gradients = (
            [flat.gradient(layer.weight).t() for layer in layers],
            [flat.gradient(layer.bias) for layer in layers],
        )
    return Network(weights, biases, gradients, products, scratch)


def critics(
    network: Critics, flat: FlatParameters | None, products: Products, scratch: Scratch
) -> list[Network]:
    """Each critic by itself, on the parameters of all."""
    networks = []
    for c in range(network.count):
        weights = [weight.detach()[c] for weight in network.weights]
        biases = [bias.detach()[c, 0] for bias in network.biases]
        gradients = None
        if flat is not None:
            gradients = (
                [flat.gradient(weight)[c] for weight in network.weights],
                [flat.gradient(bias)[c, 0] for bias in network.biases],
            )
        networks.append(Network(weights, biases, gradients, products, scratch))
    return networks
