"""All parameters of some networks in one tensor, so that one call updates them all."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

_ALIGNMENT = 16
"""Floats of a cache line: no parameter shares one with its neighbour."""


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
        """[S] with zeros between the parameters."""
        self.gradients = torch.zeros_like(self.values)
        """[S]"""
        for parameter, view in zip(parameters, self.views(self.values), strict=True):
            view.copy_(parameter.detach())
            parameter.data = view

    def views(self, flat: Tensor) -> list[Tensor]:
        """The parts of a tensor [S] that belong to the parameters, one each."""
        return [self._view(flat, parameter) for parameter in self.parameters]

    def gradient(self, parameter: Tensor) -> Tensor:
        """The part of `gradients` that belongs to a parameter."""
        return self._view(self.gradients, parameter)

    def _view(self, flat: Tensor, parameter: Tensor) -> Tensor:
        start = self.start(parameter)
        return flat[start : start + parameter.numel()].view(parameter.shape)

    def start(self, parameter: Tensor) -> int:
        """The position in `values` at which a parameter begins."""
        return self._starts[id(parameter)]

    def extent(self, parameters: Sequence[Tensor]) -> tuple[int, int]:
        """The first position of neighbouring parameters, and the number of values to their end."""
        first, last = self.start(parameters[0]), self.start(parameters[-1])
        return first, last + parameters[-1].numel() - first

    @property
    def is_in_use(self) -> bool:
        """Whether the parameters are still these views; converting the module replaces them."""
        return self.parameters[0].data_ptr() == self.values.data_ptr()
