"""Rewards that every other reward must beat: displacement of the object, and noise."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from music_rllib.intrinsic.interface import Batch, IntrinsicReward, Sizes


class Displacement(IntrinsicReward):
    """Distance that the surrounding state moves in one step: b = |y' - y|."""

    smallest_scale = 1e-3
    """In meters on Fetch and the hand: a resting object jitters by less."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(sizes)
        if not sizes.surrounding_indices:
            raise ValueError(
                "intrinsic.reward must not be displacement on a task without surrounding_indices"
            )

    def bonus(self, batch: Batch) -> Tensor:
        change = (batch.followers - batch.states)[:, list(self.sizes.surrounding_indices)]
        distance: Tensor = torch.linalg.vector_norm(change, dim=-1)
        return distance


class RandomBonus(IntrinsicReward):
    """A uniform random number on [0, 1] for each sampled transition."""

    scale: ClassVar[float | None] = 1.0

    def bonus(self, batch: Batch) -> Tensor:
        states, generator = batch.states, batch.generator
        return torch.rand(len(states), generator=generator, device=states.device)
