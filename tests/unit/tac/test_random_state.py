"""A checkpoint's generators, also those of another device or of an older version."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from music_rllib.tac.random_state import OWN, generator_states, set_generators


def test_generators_continue_or_begin_numbers_of_their_own() -> None:
    def restored(states: Mapping[str, Any], updates: int) -> list[float]:
        own = torch.Generator().manual_seed(3)
        torch.manual_seed(5)
        set_generators(own, states, updates)
        return [*torch.rand(2, generator=own).tolist(), *torch.rand(2).tolist()]

    source = torch.Generator().manual_seed(9)
    torch.manual_seed(11)
    states = {name: array.copy() for name, array in generator_states(source).items()}
    expected = torch.rand(2, generator=source).tolist() + torch.rand(2).tolist()
    assert restored(states, 7) == expected
    torch.manual_seed(5)
    of_layers = torch.rand(2).tolist()
    # An older checkpoint has only the Learner's own generator.
    assert restored({OWN: states[OWN]}, 7) == expected[:2] + of_layers
    # The state of a GPU's generator has another size: other numbers at each checkpoint.
    on_gpu = {OWN: np.zeros(16, np.uint8)}
    assert restored(on_gpu, 7) == restored(on_gpu, 7) != restored(on_gpu, 8)
