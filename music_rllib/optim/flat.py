"""All parameters of some networks in one tensor, so that one call updates them all."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["FlatParameters"]

_ALIGNMENT = 16
"""Floats of a cache line: no parameter shares one with its neighbour."""


class FlatParameters:
    """Moves parameters into one tensor, of which they are views from then on.

    Args:
        parameters: of one type and device. Their values stay; their `.data` is replaced.
    """

    def __init__(self, parameters: Sequence[Tensor]) -> None:
        starts, size = [], 0
        for parameter in parameters:
            starts.append(size)
            size += -(-parameter.numel() // _ALIGNMENT) * _ALIGNMENT
        self._places = list(zip(starts, (p.shape for p in parameters), strict=True))
        self._indices = {id(parameter): i for i, parameter in enumerate(parameters)}
        self.values = parameters[0].new_zeros(size).detach()
        """[S] with zeros between the parameters."""
        self.gradients = torch.zeros_like(self.values)
        """[S]"""
        self.parameters = list(parameters)
        for parameter, view in zip(parameters, self.views(self.values), strict=True):
            view.copy_(parameter.detach())
            parameter.data = view

    def views(self, flat: Tensor) -> list[Tensor]:
        """What belongs to each parameter in a tensor [S]."""
        return [flat[start : start + shape.numel()].view(shape) for start, shape in self._places]

    def gradient(self, parameter: Tensor) -> Tensor:
        """The view of `gradients` that belongs to a parameter."""
        start, shape = self._places[self._indices[id(parameter)]]
        return self.gradients[start : start + shape.numel()].view(shape)

    def start(self, parameter: Tensor) -> int:
        """Where the values of a parameter begin."""
        return self._places[self._indices[id(parameter)]][0]

    def extent(self, parameters: Sequence[Tensor]) -> tuple[int, int]:
        """Where parameters that lie behind each other begin, and how many values they have.

        What is between them is counted.
        """
        first, last = self.start(parameters[0]), self.start(parameters[-1])
        return first, last + parameters[-1].numel() - first

    @property
    def is_in_use(self) -> bool:
        """Whether the parameters are still these views; converting the module replaces them."""
        return self.parameters[0].data_ptr() == self.values.data_ptr()
