"""The minibatches of the updates of a call: made by the algorithm, read by the Learner.

A call of K updates has K concatenated minibatches:

- module `default_policy`: OBS [K*B, I], ACTIONS [K*B, A], REWARDS [K*B] of the task, "discounts"
  [K*B], NEXT_OBS [K*B, I], and "weights" [K*B] with prioritized replay. The Learner adds the
  policy's "noise" [K*B, A], "next_noise" with averaged critics, and "target_critics" [K*N] with
  `target_critics`. An intrinsic reward by episode adds "stored" [K*B].
- module `mi_estimator`, if it is trained: OBS [K*N, T, D] whole trajectories, and "inside" [K*N, T]
  if they have unequal lengths
- `INTRINSIC`, if an intrinsic reward needs them: the same; no module of RLlib has this name

Shape legend: K updates, B transitions and N trajectories (or critics of targets) of one, T frames,
I network inputs, D observation, A actions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.policy.sample_batch import MultiAgentBatch, SampleBatch
from ray.rllib.utils.typing import ModuleID
from torch import Tensor

from music_rllib.intrinsic.music import Music
from music_rllib.replay.trajectories import Floats, Transitions, WholeTrajectories

Minibatch = dict[ModuleID, dict[str, Tensor]]
"""Columns by module."""

STORED = "stored"
"""Column of the numbers that the replay keeps for an intrinsic reward."""
INTRINSIC = "intrinsic"
"""The networks of an intrinsic reward, and the part of a batch with its trajectories."""


def batch_of(
    drawn: Transitions, whole: Mapping[ModuleID, WholeTrajectories], stored: Floats | None = None
) -> MultiAgentBatch:
    """The argument of `Learner.update`.

    Args:
        drawn: [K*B] transitions.
        whole: [K*N] trajectories, of the estimator and of an intrinsic reward.
        stored: [K*B] numbers that the replay keeps for an intrinsic reward.
    """
    columns: dict[str, Any] = {
        Columns.OBS: drawn.inputs,
        Columns.ACTIONS: drawn.actions,
        Columns.REWARDS: drawn.rewards,
        "discounts": drawn.discounts,
        Columns.NEXT_OBS: drawn.next_inputs,
    }
    if drawn.weights is not None:
        columns["weights"] = drawn.weights
    if stored is not None:
        columns[STORED] = stored
    batches = {DEFAULT_MODULE_ID: SampleBatch(columns)}
    for module, one in whole.items():
        trajectories: dict[str, Any] = {Columns.OBS: one.observations}
        if one.inside is not None:
            trajectories["inside"] = one.inside
        batches[module] = SampleBatch(trajectories)
    return MultiAgentBatch(batches, env_steps=len(drawn.rewards))


class Minibatches(NamedTuple):
    """Minibatches of K updates."""

    columns: Minibatch
    """[K*B, ...] transitions of the policy's module, [K*N, ...] of the estimator's."""
    drawn: Sequence[tuple[bool, ...]]
    """[K] values drawn by MUSIC."""

    @property
    def updates(self) -> int:
        """K."""
        return len(self.drawn)

    def one_by_one(self) -> Iterator[Minibatches]:
        """The minibatches of each update."""
        for k, drawn in enumerate(self.drawn):
            columns = {
                module: {name: self._of_update(k, values) for name, values in columns.items()}
                for module, columns in self.columns.items()
            }
            yield Minibatches(columns, (drawn,))

    def _of_update(self, k: int, values: Tensor) -> Tensor:
        rows = len(values) // self.updates
        return values[k * rows : (k + 1) * rows]

    @property
    def transitions(self) -> tuple[Tensor, Tensor]:
        """States and next states, [K, B, I] each."""
        policy = self.columns[DEFAULT_MODULE_ID]
        shape = (self.updates, -1)
        return (
            policy[Columns.OBS].unflatten(0, shape), policy[Columns.NEXT_OBS].unflatten(0, shape)
        )  # fmt: skip

    def music_rewards(self, music: Music) -> Tensor:
        """[K, B] rewards of fixed networks; equal drawn values are computed at once."""
        states, followers = self.transitions
        rewards: Tensor = states.new_empty(states.shape[:2])
        kinds = dict.fromkeys(self.drawn)
        for drawn in kinds:
            alike: Any = slice(None)  # copies nothing
            if len(kinds) > 1:
                alike = torch.tensor([k for k, other in enumerate(self.drawn) if other == drawn])
            before, after = (values[alike].flatten(0, 1) for values in (states, followers))
            # Each draw is for an equal share of the rows of one update.
            draws = drawn if len(drawn) == 1 else drawn * (len(before) // states.shape[1])
            found = music.reward(before, after, draws)
            rewards[alike] = found.unflatten(0, (-1, states.shape[1]))
        return rewards
