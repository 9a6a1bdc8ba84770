"""What fresh episodes of the policy say of the critics, before anything is learned from them.

Shape legend: E episodes, S steps of all of them behind each other, I network inputs, A actions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from torch import Tensor

from music_rllib.replay.trajectories import Trajectory
from music_rllib.tac.diagnostics import discounted_returns
from music_rllib.tac.objective import Objective
from music_rllib.tac.rl_module import TACModule, choose_action

__all__ = ["FreshEpisodes", "critic_bias"]


@dataclass(frozen=True, kw_only=True)
class FreshEpisodes:
    """Episodes as tensors."""

    states: Tensor
    """[S, I]"""
    followers: Tensor
    """[S, I]"""
    actions: Tensor
    """[S, A]"""
    rewards: Tensor
    """[S] of the task."""
    lengths: list[int]
    """[E]"""
    terminated: NDArray[np.bool_]
    """[E]"""

    @classmethod
    def of(cls, episodes: Sequence[Trajectory], inputs: int, device: torch.device) -> FreshEpisodes:
        """The episodes on a device; the first `inputs` columns of a frame are a network's input."""

        def together(arrays: Sequence[NDArray[Any]]) -> Tensor:
            return torch.as_tensor(np.concatenate(arrays), device=device)

        return cls(
            states=together([episode.frames[:-1, :inputs] for episode in episodes]),
            followers=together([episode.frames[1:, :inputs] for episode in episodes]),
            actions=together([episode.actions for episode in episodes]),
            rewards=together([episode.rewards for episode in episodes]),
            lengths=[len(episode) for episode in episodes],
            terminated=np.array([episode.terminated for episode in episodes]),
        )


def critic_bias(
    fresh: FreshEpisodes,
    rewards: Tensor,
    module: TACModule,
    objective: Objective,
    noise: Mapping[str, Tensor],
) -> float:
    """Mean over episodes of what the critics expect at the first step, less what came.

    Args:
        fresh: the episodes.
        rewards: [S] that are learned from.
        module: TAC's networks.
        objective: what is earned for entropy, and the value beyond an episode that was cut off.
        noise: standard normal numbers [S, A] for the policy's actions, by name.
    """
    first = np.cumsum([0, *fresh.lengths[:-1]])
    last = np.cumsum(fresh.lengths) - 1
    mean, log_std = module.policy_parameters(module.normaliser(fresh.states))
    log_density = choose_action(mean, log_std, noise.get("noise"))[1]
    entropy = -objective.ln_q(log_density).expand(len(rewards))
    earned = (rewards + float(objective.alpha) * entropy).cpu().numpy().astype(float)
    # The first action is what the critic is asked about: its entropy is not in its value.
    earned[first] = rewards.cpu().numpy()[first]
    ends = {Columns.NEXT_OBS: fresh.followers[last]}
    ends |= {name: values[last] for name, values in noise.items()}
    tail = objective.soft_value(module.forward_target(ends)).cpu().numpy()
    gamma = objective.gamma
    realised = discounted_returns(earned, fresh.lengths, gamma)
    realised += ~fresh.terminated * gamma ** np.array(fresh.lengths) * tail
    asked = torch.cat([module.normaliser(fresh.states[first]), fresh.actions[first]], -1)
    predicted = module.critics(asked).amin(0).cpu().numpy()
    return float((predicted - realised).mean())
