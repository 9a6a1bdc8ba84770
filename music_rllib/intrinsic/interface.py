"""The interface between the Learner and an intrinsic reward.

Shape legend: K updates of a call, B transitions and N trajectories of one, T frames, D observation.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from music_rllib.kernels.adam import FusedAdam
from music_rllib.replay.trajectories import Trajectory


class IntrinsicReward(Protocol):
    """Relabels minibatches, learns from trajectories, and measures fresh episodes.

    Its networks belong to a module of the Learner. All random numbers come from the generator that
    is passed in, so that a resumed run draws the same ones.
    """

    @property
    def is_on(self) -> bool:
        """Whether there is a reward; without one, `draw` and `total` may still be called."""

    @property
    def learning_rate(self) -> float | None:
        """Learning rate of its networks; None if they are not trained."""

    def draw(
        self, updates: int, transitions: int, trajectories: dict[str, Tensor] | None,
        generator: torch.Generator, *, first: bool,
    ) -> Sequence[Hashable]:  # fmt: skip
        """Draw the random numbers of K updates, one value each, for `reward`.

        Updates with equal values are relabeled together, so there should be few values.

        Args:
            updates: K.
            transitions: K*B.
            trajectories: [K*N, T, D] training data, to which columns may be added; None if nothing
                is trained.
            generator: the Learner's.
            first: whether these are the run's first updates.
        """

    def reward(self, states: Tensor, followers: Tensor, drawn: Hashable) -> Tensor:
        """[B, D] states and next states -> [B]."""

    def total(self, task: Tensor, intrinsic: Tensor, weight: float) -> Tensor:
        """[B] task reward and intrinsic reward -> [B] reward in the critics' targets."""

    def loss(self, trajectories: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """[N, T, D] -> [] loss of its networks, and metrics by name."""

    def learn(
        self, states: Tensor, followers: Tensor, drawn: Sequence[Hashable],
        trajectories: Mapping[str, Tensor], optimizer: FusedAdam,
    ) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
        """Update its networks K times on a CPU, without autograd if possible.

        Takes states and next states [K, B, D], the K values of `draw`, and trajectories
        [K*N, T, D]. Returns [K, B] rewards, each minibatch's before its update, and metrics by
        name, [K] each.
        """

    def observe(
        self, episodes: Sequence[Trajectory], states: Tensor, followers: Tensor,
        generator: torch.Generator,
    ) -> Tensor:  # fmt: skip
        """[steps] reward of fresh episodes, before they are trained on.

        If `reward` depends on the drawn values, this is its mean over them.
        """

    def priorities(
        self, episodes: Sequence[Tensor], generator: torch.Generator
    ) -> NDArray[np.float64]:
        """[T, D] frames of episodes -> one priority each, for the replay."""

    def metrics(self) -> dict[str, float]:
        """Measures of the fresh episodes since the last call."""

    def state(self) -> Any:
        """The state for a checkpoint, without the networks."""

    def load_state(self, state: Any) -> None:
        """Continue from a result of `state`."""
