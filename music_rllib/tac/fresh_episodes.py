"""The critics' bias on fresh episodes of the policy, before they are trained on.

Shape legend: E episodes, S steps of all episodes, I network inputs, A action dimensions.
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
from music_rllib.tac.objective import Objective
from music_rllib.tac.rl_module import TACModule, choose_action


@dataclass(frozen=True, kw_only=True)
class FreshEpisodes:
    """Concatenated episodes: states and next states [S, I], actions [S, A], task rewards [S]."""

    states: Tensor
    followers: Tensor
    actions: Tensor
    rewards: Tensor
    lengths: list[int]
    """[E] steps of each episode."""
    terminated: NDArray[np.bool_]
    """[E]"""

    @classmethod
    def of(cls, episodes: Sequence[Trajectory], inputs: int, device: torch.device) -> FreshEpisodes:
        """The episodes on a device; the first `inputs` columns of a frame are a network's input."""

        def concatenated(arrays: Sequence[NDArray[Any]]) -> Tensor:
            return torch.as_tensor(np.concatenate(arrays), device=device)

        return cls(
            states=concatenated([episode.frames[:-1, :inputs] for episode in episodes]),
            followers=concatenated([episode.frames[1:, :inputs] for episode in episodes]),
            actions=concatenated([episode.actions for episode in episodes]),
            rewards=concatenated([episode.rewards for episode in episodes]),
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
    """Mean over episodes of the critics' value of the first step minus the realised return.

    Args:
        fresh: the episodes.
        rewards: [S] with the intrinsic reward.
        module: TAC's networks.
        objective: gives the entropy's part of the return, and the value after a truncation.
        noise: standard normal noise [S, A] for the policy's actions, by name.
    """
    first = np.cumsum([0, *fresh.lengths[:-1]])
    last = np.cumsum(fresh.lengths) - 1
    mean, log_std = module.policy_parameters(module.normaliser(fresh.states))
    log_density = choose_action(mean, log_std, noise.get("noise"))[1]
    entropy = -objective.ln_q(log_density).expand(len(rewards))
    earned = (rewards + float(objective.alpha) * entropy).cpu().numpy().astype(float)
    # A critic's value does not have the entropy of the action that it is given.
    earned[first] = rewards.cpu().numpy()[first]
    ends = {Columns.NEXT_OBS: fresh.followers[last]}
    ends |= {name: values[last] for name, values in noise.items()}
    tail = objective.soft_value(module.forward_target(ends)).cpu().numpy()
    gamma = objective.gamma
    episodes = np.split(earned, first[1:])
    realised = np.array([episode @ gamma ** np.arange(len(episode)) for episode in episodes])
    realised += ~fresh.terminated * gamma ** np.array(fresh.lengths) * tail
    inputs = torch.cat([module.normaliser(fresh.states[first]), fresh.actions[first]], -1)
    predicted = module.critics(inputs).amin(0).cpu().numpy()
    return float((predicted - realised).mean())
