"""The networks of TAC: multi-layer perceptrons, twin critics as one batched network.

Shape legend: B batch, I input features, O outputs, C critics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

Floats = NDArray[np.float32]


class Perceptron(nn.Sequential):
    """ReLU between its layers, a linear output; [..., I] -> [..., O] in float32."""

    def __init__(self, inputs: int, hidden_sizes: Sequence[int], outputs: int) -> None:
        layers: list[nn.Module] = []
        for size in hidden_sizes:
            layers += [nn.Linear(inputs, size), nn.ReLU()]
            inputs = size
        super().__init__(*layers, nn.Linear(inputs, outputs))
        self._linear = [layer for layer in self if isinstance(layer, nn.Linear)]

    def forward(self, inputs: Tensor) -> Tensor:
        *hidden_layers, last = self._linear
        hidden = inputs
        # Not as modules: for acting's few rows, calls take half of the products' time.
        for layer in hidden_layers:
            hidden = torch.relu_(F.linear(hidden, layer.weight, layer.bias))
        return F.linear(hidden, last.weight, last.bias)

    def in_numpy(self) -> Callable[[Floats], Floats]:
        """`forward` of the weights as they are now, in float32 on a CPU.

        With an acting policy's few rows PyTorch's calls take longer than the products.
        """
        *hidden_layers, (last, last_bias) = [
            (layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in self._linear
        ]

        def forward(hidden: Floats) -> Floats:
            for weight, bias in hidden_layers:
                hidden = hidden @ weight
                hidden += bias
                np.maximum(hidden, 0.0, out=hidden)
            outputs: Floats = hidden @ last + last_bias
            return outputs

        return forward


class Critics(nn.Module):
    """C critics of equal shape, evaluated together: one batched matrix product a layer.

    C is 2, or 1 for DDPG. The first layer of both reads the same input, so it is a single product.
    """

    def __init__(self, inputs: int, hidden_sizes: Sequence[int], count: int = 2) -> None:
        super().__init__()
        self.count = count
        sizes = [inputs, *hidden_sizes, 1]
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in pairwise(sizes):
            reach = 1.0 / math.sqrt(fan_in)  # nn.Linear's own initialisation, once per critic
            self.weights.append(
                nn.Parameter(torch.empty(count, fan_in, fan_out).uniform_(-reach, reach))
            )
            self.biases.append(nn.Parameter(torch.empty(count, 1, fan_out).uniform_(-reach, reach)))

    def forward(self, inputs: Tensor, *, frozen: bool = False) -> Tensor:
        """[B, I] -> [C, B].

        With `frozen`, gradients reach the inputs only: enough for the policy's step, and a third
        less work.
        """
        *hidden_layers, (weight, bias) = self._layers(frozen)
        hidden = self._hidden(inputs, hidden_layers)
        return torch.baddbmm(bias, hidden, weight).squeeze(-1)

    def _hidden(self, inputs: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
        """[B, I] -> [C, B, H]."""
        (first_weight, first_bias), *others = layers
        _, fan_in, width = first_weight.shape
        stacked = first_weight.transpose(0, 1).reshape(fan_in, self.count * width)
        hidden = (inputs @ stacked).view(-1, self.count, width).transpose(0, 1) + first_bias
        # ReLU in place: another matrix of this size costs more than the operation.
        hidden = torch.relu_(hidden)
        for weight, bias in others:
            hidden = torch.relu_(torch.baddbmm(bias, hidden, weight))
        return hidden

    def _layers(self, frozen: bool) -> Iterator[tuple[Tensor, Tensor]]:
        for weight, bias in zip(self.weights, self.biases, strict=True):
            yield (weight.detach(), bias.detach()) if frozen else (weight, bias)
