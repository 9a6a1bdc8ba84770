"""The minibatches of the updates of a call, all of them or one by one.

Shape legend: K updates, B transitions of a minibatch, N trajectories.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.utils.typing import ModuleID
from torch import Tensor

from music_rllib.intrinsic.interface import IntrinsicReward

__all__ = ["Minibatch", "Minibatches"]

Minibatch = dict[ModuleID, dict[str, Tensor]]
"""Columns by module."""


class Minibatches(NamedTuple):
    """Those of K updates, behind each other."""

    columns: Minibatch
    """[K*B, ...] transitions of the policy's module, [K*N, ...] of the estimator's."""
    drawn: Sequence[Hashable]
    """[K] by the intrinsic reward."""

    @property
    def updates(self) -> int:
        """K."""
        return len(self.drawn)

    def one_by_one(self) -> Iterator[Minibatches]:
        """Those of each update."""
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
        """States and the next ones, [K, B, I] each."""
        policy = self.columns[DEFAULT_MODULE_ID]
        shape = (self.updates, -1)
        return (
            policy[Columns.OBS].unflatten(0, shape), policy[Columns.NEXT_OBS].unflatten(0, shape)
        )  # fmt: skip

    def intrinsic_rewards(self, reward: IntrinsicReward) -> Tensor:
        """[K, B] of networks that stay as they are: those for which the same was drawn together."""
        states, followers = self.transitions
        rewards: Tensor = states.new_empty(states.shape[:2])
        kinds = dict.fromkeys(self.drawn)
        for drawn in kinds:
            alike: Any = slice(None)  # which copies nothing
            if len(kinds) > 1:
                alike = torch.tensor([k for k, other in enumerate(self.drawn) if other == drawn])
            before, after = (values[alike].flatten(0, 1) for values in (states, followers))
            found = reward.reward(before, after, drawn)
            rewards[alike] = found.unflatten(0, (-1, states.shape[1]))
        return rewards
