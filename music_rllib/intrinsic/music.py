"""MUSIC: the information between the agent's state and the surrounding state (paper III-A).

Shape legend: K updates of a call, B transitions and N trajectories of one, T frames, D observation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from music_rllib import names
from music_rllib.functional.mutual_information import time_permutations
from music_rllib.intrinsic.estimator import MutualInformationEstimator, intrinsic_reward, two_frames
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.kernels.adam import FusedAdam
from music_rllib.replay.trajectories import Trajectory, WholeTrajectories, long_enough

HELD_OUT_STEPS = "held_out_steps"
"""Metric: number of steps over which the bound on fresh trajectories is averaged."""
PRIORITY_CLIP = 2e-4
"""MUSIC-p: per-step bounds (nats) are clipped to this in a trajectory's priority."""
WORKER_ROWS = 256
"""Rows of a minibatch that share a time shuffle with `shuffle: random`: the rows of one worker of
the original, each of which draws its own."""


class Music:
    """MUSIC's reward; `estimator` is None if the settings have none.

    All random numbers come from the generator that is passed in, so that a resumed run draws the
    same ones.
    """

    def __init__(
        self, settings: MusicSettings, estimator: MutualInformationEstimator | None
    ) -> None:
        self._settings, self._estimator = settings, estimator
        self._held_out_sum = self._held_out_steps = 0.0

    @property
    def is_on(self) -> bool:
        """Whether there is a reward; without one, `draw` and `total` may still be called."""
        return self._estimator is not None

    @property
    def learning_rate(self) -> float | None:
        """Learning rate of the estimator; None if it is not trained."""
        return self._settings.lr if self._settings.estimator == "trained" else None

    @property
    def _network(self) -> MutualInformationEstimator:
        assert self._estimator is not None
        return self._estimator

    def draw(
        self, updates: int, transitions: int, trajectories: dict[str, Tensor] | None,
        generator: torch.Generator, *, first: bool,
    ) -> Sequence[tuple[bool, ...]]:  # fmt: skip
        """Whether each update swaps the two frames of transitions; also draws the time shuffles.

        With `shuffle: random` a minibatch of B rows has ceil(B / `WORKER_ROWS`) draws, each for an
        equal share of its rows, and half of the draws do not swap.

        Args:
            updates: K; each has one of the returned values, for `reward`. Updates with equal values
                are relabeled together.
            transitions: K*B.
            trajectories: [K*N, T, D] training data, to which columns are added; None if nothing is
                trained.
            generator: the Learner's.
            first: whether these are the run's first updates.
        """
        swapped: list[tuple[bool, ...]] = [(True,)] * updates
        if self._is_random and updates:
            coins = _coins(updates * _draws(transitions // updates), generator)
            swapped = list(map(tuple, coins.view(updates, -1).tolist()))
        if trajectories is not None:
            observations, inside = trajectories["obs"], trajectories.get("inside")
            if first:
                self._network.adapt_to(observations)
            rows, frames = observations.shape[:2]
            draws = updates * _draws(rows // updates) if self._is_random else None
            trajectories["permutations"] = time_permutations(
                rows, frames, generator, draws=draws, inside=inside
            )
        return swapped

    @property
    def _is_random(self) -> bool:
        return self._settings.shuffle == "random"

    @torch.no_grad()
    def reward(self, states: Tensor, followers: Tensor, drawn: Any) -> Tensor:
        """[B, D] states and next states -> [B] in [-1, 0]."""
        bounds = self._network.transition_bounds(states, followers, drawn)
        return intrinsic_reward(bounds, self._settings.reward_scale)

    def total(self, task: Tensor, intrinsic: Tensor, weight: float) -> Tensor:
        """[B] task reward and intrinsic reward -> [B] reward in the critics' targets."""
        weighted = weight * intrinsic
        return task + weighted if self._settings.task_reward else weighted

    def loss(self, trajectories: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """[N, T, D] trajectories -> [] negative mean bound in nats, and metrics by name."""
        permutations, inside = trajectories["permutations"], trajectories.get("inside")
        loss, bound = self._network.loss(trajectories["obs"], permutations, inside)
        return loss, {names.MI_BOUND: bound}

    @torch.no_grad()
    def learn(
        self, states: Tensor, followers: Tensor, drawn: Sequence[Any],
        trajectories: Mapping[str, Tensor], optimizer: FusedAdam,
    ) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
        """K updates by compiled code.

        Takes states and next states [K, B, D], the K values of `draw`, and trajectories
        [K*N, T, D]. Returns [K, B] rewards, each minibatch's before its update, and metrics [K].
        """
        updates, rows = states.shape[:2]
        network = self._network
        pairs = network.pairs(states, followers).flatten(0, 1)
        swaps = two_frames(len(pairs), sum(drawn, ()), pairs.device)
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
        self, episodes: Sequence[Trajectory], states: Tensor, followers: Tensor,
        generator: torch.Generator,
    ) -> Tensor:  # fmt: skip
        """[steps] reward of fresh episodes, before they are trained on.

        With `shuffle: random`, the mean of the rewards with and without swap.

        The critics learn this mean, because half of the draws swap.
        """
        rewards = [self.reward(states, followers, (True,))]
        if self._is_random:
            rewards.append(self.reward(states, followers, (False,)))
        self._measure_held_out(episodes, generator)
        return torch.stack(rewards).mean(0)

    @torch.no_grad()
    def _measure_held_out(self, episodes: Sequence[Trajectory], generator: torch.Generator) -> None:
        """Add the bounds of fresh episodes, weighted by their steps, to the sums for `metrics`."""
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

    @torch.no_grad()
    def priorities(
        self, episodes: Sequence[Tensor], generator: torch.Generator
    ) -> NDArray[np.float64]:
        """MUSIC-p: the sum of each episode's per-step bounds, each clipped to [0, 2e-4] nats.

        With `shuffle: random` each step has its own draw.
        """
        bounds = []
        for each in episodes:
            steps = len(each) - 1
            swapped = _coins(steps, generator).tolist() if self._is_random else (True,)
            bounds.append(self._network.transition_bounds(each[:-1], each[1:], swapped))
        sums = torch.stack([steps.clamp(0.0, PRIORITY_CLIP).sum() for steps in bounds])
        return sums.cpu().numpy().astype(np.float64)

    def metrics(self) -> dict[str, float]:
        """Measures of the fresh episodes since the last call."""
        total, steps = self.state()
        self.load_state((0.0, 0.0))
        return {names.HELD_OUT_BOUND: total / steps, HELD_OUT_STEPS: steps} if steps else {}

    def state(self) -> list[float]:
        """The state for a checkpoint, without the estimator."""
        return [self._held_out_sum, self._held_out_steps]

    def load_state(self, state: Sequence[float]) -> None:
        self._held_out_sum, self._held_out_steps = state


def _draws(rows: int) -> int:
    """Number of draws for B rows with `shuffle: random`."""
    return math.ceil(rows / WORKER_ROWS)


def _coins(count: int, generator: torch.Generator) -> Tensor:
    """[count] booleans, each with probability 1/2."""
    return torch.rand(count, generator=generator, device=generator.device) < 0.5
