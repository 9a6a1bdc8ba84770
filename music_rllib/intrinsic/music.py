"""MUSIC: the information between the agent's own state and its surroundings (paper III-A).

Shape legend: K updates of a call, B transitions and N trajectories of one, T frames, D observation.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from music_rllib import names
from music_rllib.functional.mutual_information import time_permutations
from music_rllib.intrinsic.held_out import HeldOutBound
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.optim.adam import FusedAdam
from music_rllib.replay.trajectories import Trajectory

__all__ = ["HELD_OUT_STEPS", "Music"]

HELD_OUT_STEPS = "held_out_steps"
"""Metric: steps behind the bound on fresh trajectories, which it is averaged by."""
PRIORITY_CLIP = 2e-4
"""MUSIC-p: largest bound (nats) of one step that counts for its trajectory's priority."""


class Estimator(Protocol):
    """The estimator on whole observations, of which it takes its two halves."""

    def adapt_to(self, observations: Tensor) -> None:
        """[..., D] before its first training."""

    def bound(self, observations: Tensor, permutations: Tensor, inside: Tensor | None) -> Tensor:
        """[N, T, D], [N, T] permutations and padding -> [N] nats."""

    def learn(
        self, states: Tensor, followers: Tensor, swapped: Sequence[bool],
        trajectories: Mapping[str, Tensor], optimizer: FusedAdam,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """K updates, and the [K, B] rewards before each; [K] mean bounds."""

    def transition_bounds(self, observations: Tensor) -> Tensor:
        """[T, D] -> [T - 1] nats."""

    def reward(self, states: Tensor, followers: Tensor, *, swapped: bool) -> Tensor:
        """[B, D], [B, D] -> [B] in [-1, 0]."""


class Music:
    """MUSIC's reward, an `IntrinsicReward`.

    Args:
        settings: say whether there is an estimator, and how time is shuffled.
        estimator: None where there is none.
    """

    def __init__(self, settings: MusicSettings, estimator: Estimator | None) -> None:
        self._settings, self._estimator = settings, estimator
        self._held_out = HeldOutBound()

    @property
    def is_on(self) -> bool:
        return self._estimator is not None

    @property
    def learning_rate(self) -> float | None:
        return self._settings.lr if self._settings.estimator == "trained" else None

    @property
    def trajectories(self) -> int:
        return self._settings.batch_trajectories

    def _present(self) -> Estimator:
        assert self._estimator is not None
        return self._estimator

    def draw(
        self,
        updates: int,
        trajectories: dict[str, Tensor] | None,
        generator: torch.Generator,
        *,
        first: bool,
    ) -> Sequence[Hashable]:
        """Whether each update pairs a frame with the other's surroundings, and the time shuffles.

        The original draws one shuffle for a whole minibatch (`shuffle: random`), which leaves two
        frames as they are half of the time.
        """
        swapped = [True] * updates
        if self._settings.shuffle == "random":
            coins = torch.rand(updates, generator=generator, device=generator.device) < 0.5
            swapped = coins.tolist()
        if trajectories is not None:
            observations, inside = trajectories["obs"], trajectories.get("inside")
            if first:
                self._present().adapt_to(observations)
            rows, frames = observations.shape[:2]
            sharing = 1 if self._settings.shuffle == "independent" else rows // updates
            trajectories["permutations"] = time_permutations(
                rows, frames, generator, sharing=sharing, inside=inside
            )
        return swapped

    def reward(self, states: Tensor, followers: Tensor, drawn: Hashable) -> Tensor:
        return self._present().reward(states, followers, swapped=bool(drawn))

    def total(self, task: Tensor, intrinsic: Tensor, weight: float) -> Tensor:
        weighted = weight * intrinsic
        return task + weighted if self._settings.task_reward else weighted

    def loss(self, trajectories: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Less the mean bound, in nats."""
        permutations, inside = trajectories["permutations"], trajectories.get("inside")
        bound = self._present().bound(trajectories["obs"], permutations, inside).mean()
        return -bound, {names.MI_BOUND: bound.detach()}

    def learn(
        self, states: Tensor, followers: Tensor, drawn: Sequence[Hashable],
        trajectories: Mapping[str, Tensor], optimizer: FusedAdam,
    ) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
        swapped = [bool(one) for one in drawn]
        rewards, bounds = self._present().learn(states, followers, swapped, trajectories, optimizer)
        return rewards, {names.MI_BOUND: bounds}

    def observe(
        self,
        episodes: Sequence[Trajectory],
        states: Tensor,
        followers: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        estimator = self._present()
        reward = estimator.reward(states, followers, swapped=True)
        self._held_out.add(episodes, estimator.bound, generator)
        return reward

    def priorities(self, episodes: Sequence[Tensor]) -> NDArray[np.float64]:
        """MUSIC-p: the sum of each episode's per-step bounds, each clipped to [0, 2e-4] nats."""
        bounds = self._present().transition_bounds
        sums = [bounds(frames).clamp(0.0, PRIORITY_CLIP).sum() for frames in episodes]
        return torch.stack(sums).cpu().numpy().astype(np.float64)

    def metrics(self) -> dict[str, float]:
        taken = self._held_out.take()
        return (
            dict(zip((names.HELD_OUT_BOUND, HELD_OUT_STEPS), taken, strict=True)) if taken else {}
        )

    def state(self) -> list[float]:
        return self._held_out.state()

    def load_state(self, state: Sequence[float]) -> None:
        self._held_out.load_state(state)
