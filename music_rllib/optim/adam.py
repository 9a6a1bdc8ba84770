"""Adam that calls PyTorch's fused kernel directly, and Adam for compiled updates.

`torch.optim.Adam` sorts its tensors by device and type at each step, though these never change, and
counts the steps of each tensor by itself: 0.15 ms of an update that takes 7.
"""

from __future__ import annotations

from collections.abc import Iterable
from inspect import unwrap
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from music_rllib.compiling import compiled
from music_rllib.optim.flat import FlatParameters

Array = NDArray[Any]


class Descent(NamedTuple):
    """The arguments of one step of Adam: S flat parameters, their gradients and moments.

    All arrays are [S], or all empty for no step; `steps` is [1], the number of steps so far.
    """

    values: Array
    gradients: Array
    means: Array
    squares: Array
    steps: Array
    lr: float
    beta1: float
    beta2: float
    eps: float


@compiled
def descend(descent: Descent) -> None:
    """Takes one step of Adam (Kingma and Ba, algorithm 1), rounded as `torch.optim.Adam`."""
    if len(descent.values) == 0:
        return
    values, gradients = descent.values, descent.gradients
    means, squares = descent.means, descent.squares
    number = values.dtype.type
    descent.steps[0] += 1.0
    count = float(descent.steps[0])
    step_size = number(descent.lr / (1.0 - descent.beta1**count))
    correction = number(1.0 / np.sqrt(1.0 - descent.beta2**count))
    kept, fresh = number(descent.beta2), number(1.0 - descent.beta2)
    share, eps = number(1.0 - descent.beta1), number(descent.eps)
    for i in range(len(values)):
        gradient = gradients[i]
        means[i] += share * (gradient - means[i])
        squares[i] = kept * squares[i] + fresh * gradient * gradient
        values[i] -= step_size * means[i] / (np.sqrt(squares[i]) * correction + eps)


class _Moments(NamedTuple):
    """Adam's state, in the order of the P parameters."""

    means: list[Tensor]
    squares: list[Tensor]
    steps: list[Tensor]
    """Views of `counts`, one for each parameter, as the kernel takes them."""
    counts: Tensor
    """[P] steps so far; one addition counts them all."""


class _FlatMoments(NamedTuple):
    """Adam's state of flat parameters: means [S], squares [S], steps [1]."""

    means: Tensor
    squares: Tensor
    steps: Tensor


class FusedAdam(torch.optim.Adam):
    """`torch.optim.Adam(fused=True)` of parameters on one device: same state, same bits."""

    # Without torch's guard against its compiler, which loads that: a second in each process.
    add_param_group = unwrap(torch.optim.Adam.add_param_group)
    load_state_dict = unwrap(torch.optim.Adam.load_state_dict)
    state_dict = unwrap(torch.optim.Adam.state_dict)
    zero_grad = unwrap(torch.optim.Adam.zero_grad)

    def __init__(self, parameters: Iterable[Tensor], lr: float) -> None:
        parameters = list(parameters)
        self._on_cpu = parameters[0].device.type == "cpu"
        super().__init__(parameters, lr=lr, fused=True)
        self._cached_state: Any = None
        self._moments: _Moments | None = None
        self._flat: _FlatMoments | None = None

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Takes one step by the parameters' gradients."""
        group = self.param_groups[0]
        parameters = group["params"]
        gradients = [parameter.grad for parameter in parameters]
        # Torch's own step creates the state, skips parameters without gradients and serves GPUs.
        plain = len(self.state) < len(parameters) or any(gradient is None for gradient in gradients)
        if plain or not self._on_cpu or closure is not None:
            return super().step(closure)
        moments = self._ordered_moments()
        moments.counts.add_(1)
        beta1, beta2 = group["betas"]
        torch._fused_adam_(
            parameters, gradients, moments.means, moments.squares, [], moments.steps,
            lr=group["lr"], beta1=beta1, beta2=beta2, weight_decay=group["weight_decay"],
            eps=group["eps"], amsgrad=group["amsgrad"], maximize=group["maximize"],
        )  # fmt: skip
        return None

    def descent(self, flat: FlatParameters) -> Descent:
        """The arguments of `descend` for a step of all parameters by the gradients of `flat`.

        `flat` has this optimizer's parameters, in their order, on a CPU.
        """
        group, moments = self.param_groups[0], self._flat_moments(flat)
        beta1, beta2 = group["betas"]
        return Descent(
            values=flat.values.numpy(),
            gradients=flat.gradients.numpy(),
            means=moments.means.numpy(),
            squares=moments.squares.numpy(),
            steps=moments.steps.numpy(),
            lr=float(group["lr"]),
            beta1=beta1,
            beta2=beta2,
            eps=group["eps"],
        )

    @torch.no_grad()
    def _flat_moments(self, flat: FlatParameters) -> _FlatMoments:
        """Moves the state into flat tensors; each parameter's state becomes views of them."""
        if self._flat is None or self._cached_state is not self.state:  # a state was loaded
            moments = _FlatMoments(
                torch.zeros_like(flat.values), torch.zeros_like(flat.values), torch.zeros(1)
            )
            views = zip(flat.views(moments.means), flat.views(moments.squares), strict=True)
            for parameter, (mean, square) in zip(flat.parameters, views, strict=True):
                if old := self.state.get(parameter):
                    mean.copy_(old["exp_avg"])
                    square.copy_(old["exp_avg_sq"])
                    moments.steps.copy_(old["step"])
                self.state[parameter] = {
                    "step": moments.steps[0], "exp_avg": mean, "exp_avg_sq": square
                }  # fmt: skip
            self._flat, self._cached_state = moments, self.state
        return self._flat

    def _ordered_moments(self) -> _Moments:
        if self._moments is None or self._cached_state is not self.state:  # a state was loaded
            states = [self.state[parameter] for parameter in self.param_groups[0]["params"]]
            counts = torch.stack([state["step"] for state in states])
            for state, count in zip(states, counts.unbind(), strict=True):
                state["step"] = count
            means, squares, steps = (
                [state[key] for state in states] for key in ("exp_avg", "exp_avg_sq", "step")
            )
            self._moments = _Moments(means, squares, steps, counts)
            self._cached_state = self.state
        return self._moments
