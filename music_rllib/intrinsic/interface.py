"""What an intrinsic reward is to the Learner, which knows none of them by name.

Shape legend: K updates of a call, B transitions and N trajectories of one, T frames, D observation.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from music_rllib.optim.adam import FusedAdam
from music_rllib.replay.trajectories import Trajectory

__all__ = ["IntrinsicReward"]


class IntrinsicReward(Protocol):
    """Relabels minibatches, learns from trajectories, and says what it has measured.

    Its networks belong to a module of the Learner; here is what is done with them. Every random
    number comes from the generator that is passed in, so that a resumed run draws the same ones.
    """

    @property
    def is_on(self) -> bool:
        """Whether there is a reward; without one `draw` and `total` may still be called."""

    @property
    def learning_rate(self) -> float | None:
        """Of its networks; None where they stay as they are."""

    @property
    def trajectories(self) -> int:
        """N that one update learns from."""

    def draw(
        self,
        updates: int,
        trajectories: dict[str, Tensor] | None,
        generator: torch.Generator,
        *,
        first: bool,
    ) -> Sequence[Hashable]:
        """Random numbers of K updates, in one go.

        Args:
            updates: K.
            trajectories: [K*N, T, D] that are learned from, to which columns may be added; None
                where nothing is learned.
            generator: of the Learner.
            first: whether these are the run's first updates.

        Returns:
            K values, each for `reward` of one update. Captured as a CUDA graph, an update is
            recorded once for each value, so there should be few.
        """

    def reward(self, states: Tensor, followers: Tensor, drawn: Hashable) -> Tensor:
        """[B, D] states and the next ones -> [B]."""

    def total(self, task: Tensor, intrinsic: Tensor, weight: float) -> Tensor:
        """[B] the task's reward and the intrinsic one -> [B] that is learned from."""

    def loss(self, trajectories: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """[N, T, D] -> [] to be minimised by its networks, and metrics by name."""

    def learn(
        self, states: Tensor, followers: Tensor, drawn: Sequence[Hashable],
        trajectories: Mapping[str, Tensor], optimizer: FusedAdam,
    ) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
        """K updates of its networks on a CPU, without autograd where it can.

        Args:
            states: [K, B, D]
            followers: [K, B, D] the next ones.
            drawn: K, as `draw` gave them.
            trajectories: [K*N, T, D]
            optimizer: of its networks.

        Returns:
            [K, B] rewards, each minibatch's before its update, and metrics by name, [K] each.
        """

    def observe(
        self,
        episodes: Sequence[Trajectory],
        states: Tensor,
        followers: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """[steps] reward of fresh episodes, from which nothing has been learned yet."""

    def priorities(self, episodes: Sequence[Tensor]) -> NDArray[np.float64]:
        """[T, D] frames of episodes -> one number each, by which the replay draws them."""

    def metrics(self) -> dict[str, float]:
        """What was measured of fresh episodes since the last call."""

    def state(self) -> Any:
        """What a checkpoint needs beside the networks."""

    def load_state(self, state: Any) -> None:
        """Takes over what `state` gave."""
