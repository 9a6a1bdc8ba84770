"""The networks of TAC: perceptrons, twin critics as one batched network, observation normalizer.

Shape legend: B batch, I input features, O outputs, C critics, M quantiles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

Floats = NDArray[np.float32]

_ROUNDING = float(np.finfo(np.float32).eps) / 2
"""Standard deviation relative to the mean up to which a feature counts as constant: it only
alternates between two adjacent float32 numbers."""


class Perceptron(nn.Sequential):
    """Linear layers with ReLU between them; [..., I] -> [..., O] in float32.

    With `layer_norm`, each hidden layer is normalized before ReLU, without affine parameters.
    """

    def __init__(
        self, inputs: int, hidden_sizes: Sequence[int], outputs: int, *, layer_norm: bool = False
    ) -> None:
        layers: list[nn.Module] = []
        for size in hidden_sizes:
            layers += [nn.Linear(inputs, size), nn.ReLU()]
            inputs = size
        super().__init__(*layers, nn.Linear(inputs, outputs))
        self.layer_norm = layer_norm
        self._linear = [layer for layer in self if isinstance(layer, nn.Linear)]

    def forward(self, inputs: Tensor) -> Tensor:
        *hidden_layers, last = self._linear
        hidden = inputs
        # Not as modules: with few rows, calls of modules take half of the products' time.
        for layer in hidden_layers:
            hidden = _relu(F.linear(hidden, layer.weight, layer.bias), self.layer_norm)
        return F.linear(hidden, last.weight, last.bias)

    def in_numpy(self) -> Callable[[Floats], Floats]:
        """`forward` on arrays with the current weights, in float32 on a CPU.

        With few rows, as in acting, PyTorch's calls take longer than the products.
        """
        *hidden_layers, (last, last_bias) = [
            (layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in self._linear
        ]

        def forward(hidden: Floats) -> Floats:
            for weight, bias in hidden_layers:
                hidden = hidden @ weight
                hidden += bias
                if self.layer_norm:
                    hidden = F.layer_norm(torch.from_numpy(hidden), hidden.shape[-1:]).numpy()
                np.maximum(hidden, 0.0, out=hidden)
            outputs: Floats = hidden @ last + last_bias
            return outputs

        return forward


def _relu(hidden: Tensor, layer_norm: bool) -> Tensor:
    """ReLU of [..., H], after layer normalization if requested.

    In place: another matrix of this size costs more than the operation.
    """
    return torch.relu_(F.layer_norm(hidden, hidden.shape[-1:]) if layer_norm else hidden)


class Critics(nn.Module):
    """C critics of equal shape, evaluated together: one batched matrix product per layer.

    All first layers read the same input, so they are a single product. With `quantiles`, a critic
    estimates M quantiles of the return instead of its mean.
    """

    def __init__(
        self, inputs: int, hidden_sizes: Sequence[int], count: int = 2, *, layer_norm: bool = False,
        quantiles: int = 0,
    ) -> None:  # fmt: skip
        super().__init__()
        self.count, self.layer_norm, self.quantiles = count, layer_norm, quantiles
        sizes = [inputs, *hidden_sizes, quantiles or 1]
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in pairwise(sizes):
            reach = 1.0 / math.sqrt(fan_in)  # the initialization of nn.Linear, for each critic
            self.weights.append(
                nn.Parameter(torch.empty(count, fan_in, fan_out).uniform_(-reach, reach))
            )
            self.biases.append(nn.Parameter(torch.empty(count, 1, fan_out).uniform_(-reach, reach)))

    def forward(self, inputs: Tensor, *, frozen: bool = False) -> Tensor:
        """[B, I] -> [C, B], or [C, B, M] with quantiles.

        With `frozen`, gradients reach only the inputs: enough for the policy's step, with a third
        less work.
        """
        *hidden_layers, (weight, bias) = self._layers(frozen)
        hidden = self._hidden(inputs, hidden_layers)
        outputs = torch.baddbmm(bias, hidden, weight)
        return outputs if self.quantiles else outputs.squeeze(-1)

    def _hidden(self, inputs: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
        """[B, I] -> [C, B, H]."""
        (first_weight, first_bias), *others = layers
        _, fan_in, width = first_weight.shape
        stacked = first_weight.transpose(0, 1).reshape(fan_in, self.count * width)
        hidden = (inputs @ stacked).view(-1, self.count, width).transpose(0, 1) + first_bias
        hidden = _relu(hidden, self.layer_norm)
        for weight, bias in others:
            hidden = _relu(torch.baddbmm(bias, hidden, weight), self.layer_norm)
        return hidden

    def _layers(self, frozen: bool) -> Iterator[tuple[Tensor, Tensor]]:
        for weight, bias in zip(self.weights, self.biases, strict=True):
            yield (weight.detach(), bias.detach()) if frozen else (weight, bias)


class RunningNormaliser(nn.Module):
    """Normalizes by running mean and standard deviation per feature, and clips the result.

    The moments are float64 buffers and thus part of the module's state: environment runners,
    checkpoints and handoffs get them with the weights. Each feature has its own count, because a
    run that starts from another one resets the counts of some (`for_another_run`).
    """

    count: Tensor
    """[I] number of observations."""
    centre: Tensor
    """[I] their mean."""
    squares: Tensor
    """[I] the sum of their squared distances from the mean."""
    mean: Tensor
    inverse_std: Tensor

    def __init__(self, features: int, *, epsilon: float, clip: float) -> None:
        super().__init__()
        self.epsilon, self.clip = epsilon, clip
        for moment in ("count", "centre", "squares"):
            self.register_buffer(moment, torch.zeros(features, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("inverse_std", torch.ones(features))

    def forward(self, values: Tensor) -> Tensor:
        """[..., I] -> [..., I]: (x - mean) / max(std, epsilon), clipped to plus/minus `clip`.

        0 for a feature that had the same value in all observations.
        """
        return ((values - self.mean) * self.inverse_std).clamp(-self.clip, self.clip)

    def in_numpy(self) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
        """`forward` on arrays with the current moments."""
        mean, inverse_std = self.mean.numpy(), self.inverse_std.numpy()

        def forward(values: NDArray[np.float32]) -> NDArray[np.float32]:
            normalised = (values - mean) * inverse_std
            clipped: NDArray[np.float32] = np.clip(normalised, -self.clip, self.clip)
            return clipped

        return forward

    @torch.no_grad()
    def update(self, values: Tensor) -> None:
        """Add [B, I] observations, B > 0, to the moments.

        Merges the batch's moments with the previous ones (Chan et al. 1983, "Algorithms for
        computing the sample variance", (2.1)), each computed from numbers near 0.
        """
        values = values.to(self.centre)
        # Relative to the first row, so that the mean of equal numbers is exactly that number.
        shifted = values - values[0]
        shifted_mean = shifted.mean(0)
        added = values.shape[0]
        total = self.count + added
        distance = values[0] + shifted_mean - self.centre
        self.squares += (shifted - shifted_mean).square().sum(0)
        self.squares += distance.square() * (self.count * added / total)
        self.centre += distance * (added / total)
        self.count.copy_(total)
        std = (self.squares / self.count).sqrt()
        # Networks have learned nothing about a constant feature, so it stays 0 even if its value
        # changes. MUSIC-u is trained on goals of 0 and evaluated with real ones, which would
        # otherwise enter untrained weights as -5 or 5.
        constant = std <= _ROUNDING * self.centre.abs()
        self.mean.copy_(self.centre)
        self.inverse_std.copy_(torch.where(constant, 0.0, 1.0 / std.clamp(min=self.epsilon)))


def for_another_run(moments: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Initial moments of a run that starts from the networks of another run.

    Features that were constant are reset: otherwise their count would keep the standard deviation
    small for as long as the source run lasted. MUSIC-u's goals are zeros; in MUSIC-f they vary.
    """
    varied = moments["inverse_std"] > 0
    fresh = {name: np.where(varied, moments[name], 0.0) for name in ("count", "centre", "squares")}
    return {**moments, **fresh}
