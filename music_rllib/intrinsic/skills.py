"""Rewards for states that reveal the policy's skill or goal: DIAYN and DISCERN.

Shape legend: B transitions, D observation, G goal, Z skills, F features.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, normalize

from music_rllib.intrinsic.interface import (
    Batch,
    IntrinsicReward,
    Sizes,
    Standardized,
    perceptron,
)


class _OfGoals(IntrinsicReward):
    """A reward of information about the goal; 0 at chance, 1 for certainty."""

    scale: ClassVar[float | None] = 1.0

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(sizes)
        if sizes.goal == 0:
            name = type(self).__name__
            raise ValueError(f"intrinsic.reward must not be {name} in an environment without goals")
        self.inputs = Standardized(sizes.observation)
        self.goals = Standardized(sizes.goal)

    def update_scales(self, batch: Batch) -> None:
        """Add the transitions to the scales of inputs and goals."""
        self.inputs.update(batch.followers)
        self.goals.update(batch.goals)


class DIAYN(_OfGoals):
    """The information of the next state about the skill (Eysenbach et al. 2018).

    b = max(0, log q(z|s') + log Z) / log Z; https://arxiv.org/abs/1802.06070, eq. 3. The policy's
    skill is the direction, of Z random ones, that is closest to its standardized goal.
    """

    directions: Tensor

    def __init__(self, sizes: Sizes, *, skills: int = 8, hidden: int = 64) -> None:
        super().__init__(sizes)
        if sizes.goal == 1:
            raise ValueError(
                "intrinsic.reward must not be diayn with goals of one dimension, which have two "
                "directions"
            )
        if skills < 2:
            raise ValueError(f"intrinsic.settings.skills must be >= 2, got {skills}")
        directions = normalize(torch.randn(skills, sizes.goal), dim=-1)
        self.register_buffer("directions", directions)
        self.discriminator = perceptron([sizes.observation, hidden, skills])

    def skills(self, goals: Tensor) -> Tensor:
        """[B, G] -> [B] indices of skills."""
        along: Tensor = self.goals(goals) @ self.directions.T
        return along.argmax(-1)

    def _surprise(self, batch: Batch) -> Tensor:
        """[B] -log q(z|s')."""
        logits = self.discriminator(self.inputs(batch.followers))
        return cross_entropy(logits, self.skills(batch.goals), reduction="none")

    def bonus(self, batch: Batch) -> Tensor:
        chance = math.log(len(self.directions))
        return ((chance - self._surprise(batch)) / chance).clamp(min=0.0)

    def loss(self, batch: Batch) -> Tensor:
        self.update_scales(batch)
        return self._surprise(batch).mean()


class DISCERN(_OfGoals):
    """Recognition of the goal among those of the minibatch (Warde-Farley et al. 2018).

    b = max(0, log q(g|s') + log B) / log B, q = softmax_j(beta e(s') . h(g_j)) over its B goals;
    https://arxiv.org/abs/1811.11359, eq. 5
    """

    by_minibatch = True

    def __init__(
        self, sizes: Sizes, *, hidden: int = 64, features: int = 16, beta: float = 10.0
    ) -> None:
        super().__init__(sizes)
        self.beta = beta
        self.of_state = perceptron([sizes.observation, hidden, features])
        self.of_goal = perceptron([sizes.goal, hidden, features])

    def _surprise(self, batch: Batch) -> Tensor:
        """[B] -log q(g|s')."""
        states = normalize(self.of_state(self.inputs(batch.followers)), dim=-1)
        goals = normalize(self.of_goal(self.goals(batch.goals)), dim=-1)
        correct = torch.arange(len(states), device=states.device)
        return cross_entropy(self.beta * states @ goals.T, correct, reduction="none")

    def bonus(self, batch: Batch) -> Tensor:
        chance = math.log(max(len(batch.states), 2))
        return ((chance - self._surprise(batch)) / chance).clamp(min=0.0)

    def loss(self, batch: Batch) -> Tensor:
        self.update_scales(batch)
        return self._surprise(batch).mean()
