"""MUSIC: the information between the agent's own state and its surroundings (paper III-A).

Shape legend: K updates of a call, B transitions and N trajectories of one, T frames, D observation.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from music_rllib import names
from music_rllib.functional.mutual_information import time_permutations
from music_rllib.intrinsic.estimator import MutualInformationEstimator, intrinsic_reward, two_frames
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.optim.adam import FusedAdam
from music_rllib.replay.trajectories import Trajectory, WholeTrajectories, long_enough

HELD_OUT_STEPS = "held_out_steps"
"""Metric: the number of steps that the bound on fresh trajectories is averaged over."""
PRIORITY_CLIP = 2e-4
"""MUSIC-p: largest bound (nats) of one step that counts for its trajectory's priority."""


class Music:
    """MUSIC's reward, an `IntrinsicReward`; `estimator` is None where the settings have none."""

    def __init__(
        self, settings: MusicSettings, estimator: MutualInformationEstimator | None
    ) -> None:
        self._settings, self._estimator = settings, estimator
        self._held_out_sum = self._held_out_steps = 0.0

    @property
    def is_on(self) -> bool:
        return self._estimator is not None

    @property
    def learning_rate(self) -> float | None:
        return self._settings.lr if self._settings.estimator == "trained" else None

    @property
    def _network(self) -> MutualInformationEstimator:
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
                self._network.adapt_to(observations)
            rows, frames = observations.shape[:2]
            sharing = 1 if self._settings.shuffle == "independent" else rows // updates
            trajectories["permutations"] = time_permutations(
                rows, frames, generator, sharing=sharing, inside=inside
            )
        return swapped

    @torch.no_grad()
    def reward(self, states: Tensor, followers: Tensor, drawn: Hashable) -> Tensor:
        """[B] in [-1, 0]."""
        bounds = self._network.transition_bounds(states, followers, swapped=bool(drawn))
        return intrinsic_reward(bounds, self._settings.reward_scale)

    def total(self, task: Tensor, intrinsic: Tensor, weight: float) -> Tensor:
        weighted = weight * intrinsic
        return task + weighted if self._settings.task_reward else weighted

    def loss(self, trajectories: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """The negative mean bound, in nats."""
        permutations, inside = trajectories["permutations"], trajectories.get("inside")
        bound = self._network.bound(trajectories["obs"], permutations, inside).mean()
        return -bound, {names.MI_BOUND: bound.detach()}

    @torch.no_grad()
    def learn(
        self, states: Tensor, followers: Tensor, drawn: Sequence[Hashable],
        trajectories: Mapping[str, Tensor], optimizer: FusedAdam,
    ) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
        """K updates by compiled code."""
        updates, rows = states.shape[:2]
        network = self._network
        pairs = network.pairs(states, followers).flatten(0, 1)
        swaps = torch.cat([two_frames(rows, bool(swapped)) for swapped in drawn])
        permutations, inside = trajectories["permutations"], trajectories.get("inside")
        bounds, means = network.learn(
            network.data(pairs, swaps, None),
            network.data(trajectories["obs"], permutations, inside),
            optimizer,
            updates,
        )
        rewards = intrinsic_reward(bounds, self._settings.reward_scale)
        return rewards.view(updates, rows), {names.MI_BOUND: means}

    def observe(
        self,
        episodes: Sequence[Trajectory],
        states: Tensor,
        followers: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        reward = self.reward(states, followers, drawn=True)
        self._measure_held_out(episodes, generator)
        return reward

    @torch.no_grad()
    def _measure_held_out(self, episodes: Sequence[Trajectory], generator: torch.Generator) -> None:
        """Adds the bounds of fresh episodes, weighted by their steps, for `metrics`."""
        lengths = np.array([len(episode) for episode in episodes])
        chosen = np.flatnonzero(long_enough(lengths)).tolist()
        whole = WholeTrajectories.of([episodes[i].frames for i in chosen])
        device = generator.device
        observations = torch.as_tensor(whole.observations, device=device)
        inside = None if whole.inside is None else torch.as_tensor(whole.inside, device=device)
        count, frames = observations.shape[:2]
        permutations = time_permutations(count, frames, generator, inside=inside)
        bounds = self._network.bound(observations, permutations, inside).cpu().numpy()
        self._held_out_sum += float(bounds @ lengths[chosen])
        self._held_out_steps += float(lengths[chosen].sum())

    def priorities(self, episodes: Sequence[Tensor]) -> NDArray[np.float64]:
        """MUSIC-p: the sum of each episode's per-step bounds, each clipped to [0, 2e-4] nats."""
        bounds = [self._network.transition_bounds(each[:-1], each[1:]) for each in episodes]
        sums = torch.stack([steps.clamp(0.0, PRIORITY_CLIP).sum() for steps in bounds])
        return sums.cpu().numpy().astype(np.float64)

    def metrics(self) -> dict[str, float]:
        total, steps = self.state()
        self.load_state((0.0, 0.0))
        return {names.HELD_OUT_BOUND: total / steps, HELD_OUT_STEPS: steps} if steps else {}

    def state(self) -> list[float]:
        return [self._held_out_sum, self._held_out_steps]

    def load_state(self, state: Sequence[float]) -> None:
        self._held_out_sum, self._held_out_steps = state
