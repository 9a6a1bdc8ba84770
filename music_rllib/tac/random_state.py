"""The random generators of a Learner in its checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray

OWN, OF_LAYERS = "generator", "layers_generator"


def generator_states(own: torch.Generator) -> dict[str, NDArray[Any]]:
    """States of a Learner's generator, and of PyTorch's own one on its device, by name.

    Layers of a user's networks, such as dropout, draw from PyTorch's.
    """
    generators = {OWN: own, OF_LAYERS: _of_layers(own.device)}
    return {name: each.get_state().numpy() for name, each in generators.items()}


def set_generators(own: torch.Generator, states: Mapping[str, NDArray[Any]], updates: int) -> None:
    """Continue the random numbers of `states`, or begin others if a GPU and a CPU are mixed.

    Args:
        own: the Learner's generator.
        states: result of `generator_states`; those of older checkpoints have only the first.
        updates: number of updates so far; other random numbers depend on it.
    """
    for name, generator in ((OWN, own), (OF_LAYERS, _of_layers(own.device))):
        if name not in states:
            continue
        state = torch.tensor(states[name])
        if len(state) == len(generator.get_state()):
            generator.set_state(state)
        else:
            generator.manual_seed(own.initial_seed() + updates)


def _of_layers(device: torch.device) -> torch.Generator:
    if device.type == "cuda":
        return torch.cuda.default_generators[device.index or 0]
    return torch.default_generator
