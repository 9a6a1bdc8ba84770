"""The random generators of a Learner in its checkpoints, and how RLlib seeds them."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping
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


@contextlib.contextmanager
def determinism_without_compiler() -> Iterator[None]:
    """Save a second per process: RLlib seeds torch by a call that loads torch's compiler.

    The call also sets the compiler's own flag, which matters only if the compiler is loaded.
    """
    if "torch._inductor" in sys.modules:
        yield
        return

    def use(mode: bool, *, warn_only: bool = False) -> None:
        torch.set_deterministic_debug_mode(
            ("warn" if warn_only else "error") if mode else "default"
        )

    original = torch.use_deterministic_algorithms
    torch.use_deterministic_algorithms = use
    try:
        yield
    finally:
        torch.use_deterministic_algorithms = original
