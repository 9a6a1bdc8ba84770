"""Adam (Kingma and Ba 2015) of all parameters at once, for compiled updates and for autograd.

Shape legend: S flat numbers of P parameters.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from inspect import unwrap
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from music_rllib.kernels.compiling import compiled
from music_rllib.kernels.layers import Array

_ALIGNMENT = 16
"""Floats of a cache line: two parameters never share one."""


class FlatParameters:
    """Moves parameters of one type and device into one tensor, of which they become views.

    The parameters keep their values; their `.data` is replaced.
    """

    def __init__(self, parameters: Sequence[Tensor]) -> None:
        self.parameters = list(parameters)
        self._starts: dict[int, int] = {}
        size = 0
        for parameter in parameters:
            self._starts[id(parameter)] = size
            size += -(-parameter.numel() // _ALIGNMENT) * _ALIGNMENT
        self.values = parameters[0].new_zeros(size).detach()
        """[S], with zeros between the parameters."""
        self.gradients = torch.zeros_like(self.values)
        """[S]"""
        for parameter, view in zip(parameters, self.views(self.values), strict=True):
            view.copy_(parameter.detach())
            parameter.data = view

    def views(self, flat: Tensor) -> list[Tensor]:
        """Parts of a tensor [S], one for each parameter, in its shape."""
        return [self.view(flat, parameter) for parameter in self.parameters]

    def view(self, flat: Tensor, parameter: Tensor) -> Tensor:
        """The part of a tensor [S] that belongs to a parameter, in its shape."""
        start = self.start(parameter)
        return flat[start : start + parameter.numel()].view(parameter.shape)

    def start(self, parameter: Tensor) -> int:
        """Position of a parameter's first number in `values`."""
        return self._starts[id(parameter)]

    def extent(self, parameters: Sequence[Tensor]) -> tuple[int, int]:
        """First position of neighboring parameters, and the number of values to their end."""
        first, last = self.start(parameters[0]), self.start(parameters[-1])
        return first, last + parameters[-1].numel() - first

    @property
    def is_in_use(self) -> bool:
        """Whether the parameters are still views; converting a module replaces them."""
        return self.parameters[0].data_ptr() == self.values.data_ptr()


class AdamStep(NamedTuple):
    """Arguments of one step of Adam of neighboring parameters; without any, nothing is done."""

    values: Array
    """[S]"""
    gradients: Array
    """[S]"""
    means: Array
    """[S] first moments."""
    squares: Array
    """[S] second moments."""
    steps: Array
    """[P] number of steps so far, equal for all parameters."""
    lr: float
    beta1: float
    beta2: float
    eps: float

    def split(self, numbers: int, parameters: int) -> tuple[AdamStep, AdamStep]:
        """The step of the first parameters, which have that many numbers, and of all others."""
        first, others = (
            self._replace(
                **{name: getattr(self, name)[some] for name in self._fields[:4]},
                steps=self.steps[counters],
            )
            for some, counters in (
                (slice(numbers), slice(parameters)),
                (slice(numbers, None), slice(parameters, None)),
            )
        )
        return first, others


@compiled
def adam_step(step: AdamStep) -> None:
    """Take one step (algorithm 1), rounded as `torch.optim.Adam` does."""
    if len(step.values) == 0:
        return
    values, gradients, means, squares = step.values, step.gradients, step.means, step.squares
    number = values.dtype.type
    for p in range(len(step.steps)):
        step.steps[p] += 1.0
    count = float(step.steps[0])
    step_size = number(step.lr / (1.0 - step.beta1**count))
    correction = number(1.0 / np.sqrt(1.0 - step.beta2**count))
    kept, fresh = number(step.beta2), number(1.0 - step.beta2)
    share, eps = number(1.0 - step.beta1), number(step.eps)
    for i in range(len(values)):
        gradient = gradients[i]
        means[i] += share * (gradient - means[i])
        squares[i] = kept * squares[i] + fresh * gradient * gradient
        values[i] -= step_size * means[i] / (np.sqrt(squares[i]) * correction + eps)


@contextmanager
def flushed_denormals() -> Iterator[None]:
    """Round results below the smallest normal number to 0, in this thread.

    The moments of a parameter whose gradient stays 0, as of a dead unit, decay to such numbers.
    Intel's CPUs take 30 times as long for a step of Adam if a tenth of all moments are denormal.
    """
    was_on = sys.float_info.min / 2 == 0.0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(was_on)


class FusedAdam(torch.optim.Adam):
    """`torch.optim.Adam(fused=True)`, whose steps compiled code can take.

    Torch's decorators are removed: they load its compiler, which costs each process a second.
    """

    add_param_group = unwrap(torch.optim.Adam.add_param_group)
    state_dict = unwrap(torch.optim.Adam.state_dict)
    zero_grad = unwrap(torch.optim.Adam.zero_grad)

    def __init__(self, parameters: Iterable[Tensor], lr: float) -> None:
        super().__init__(list(parameters), lr=lr, fused=True)
        self._moments: tuple[Tensor, Tensor, Tensor] | None = None
        """Flat first and second moments [S] and the numbers of steps [P], of which the state's
        tensors are views; None before the first compiled step and after a loaded state."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Take one step by the parameters' gradients, without compiled code."""
        return unwrap(torch.optim.Adam.step)(self, closure)

    def load_state_dict(self, state_dict: Any) -> None:
        unwrap(torch.optim.Adam.load_state_dict)(self, state_dict)
        self._moments = None

    def step_of(self, flat: FlatParameters) -> AdamStep:
        """The arguments of `adam_step` for a step of all parameters by the gradients of `flat`.

        `flat` has this optimizer's parameters, in their order, on a CPU.
        """
        group = self.param_groups[0]
        if self._moments is None:
            self._moments = self._flattened(flat)
        means, squares, steps = (moments.numpy() for moments in self._moments)
        beta1, beta2 = group["betas"]
        return AdamStep(
            flat.values.numpy(), flat.gradients.numpy(), means, squares, steps,
            float(group["lr"]), beta1, beta2, group["eps"],
        )  # fmt: skip

    @torch.no_grad()
    def _flattened(self, flat: FlatParameters) -> tuple[Tensor, Tensor, Tensor]:
        """Move the state into flat tensors; each parameter's state becomes views of them."""
        means, squares = torch.zeros_like(flat.values), torch.zeros_like(flat.values)
        steps = torch.zeros(len(flat.parameters))
        views = zip(flat.views(means), flat.views(squares), strict=True)
        for p, (parameter, (mean, square)) in enumerate(zip(flat.parameters, views, strict=True)):
            if old := self.state.get(parameter):
                mean.copy_(old["exp_avg"])
                square.copy_(old["exp_avg_sq"])
                steps[p] = old["step"]
            new = {"step": steps[p], "exp_avg": mean, "exp_avg_sq": square}
            self.state[parameter] = new
        return means, squares, steps
