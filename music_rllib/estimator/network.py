"""MUSIC's statistics network and what is computed from it (paper III-A, Fig. 1-2).

Shape legend: N trajectories, T frames, B transitions, X / Y features of the agent's and the
surrounding state. States are raw observations: the original does not normalise them either.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from music_rllib.mutual_information import donsker_varadhan, shuffle_time

__all__ = ["MutualInformationEstimator", "intrinsic_reward"]


class MutualInformationEstimator(nn.Module):
    """T(x, y) = tanh(w . relu(Wx x + Wy y + b) + c).

    tanh keeps T in [-1, 1] and thereby the bound below 2 nats.
    """

    def __init__(self, agent_size: int, surrounding_size: int, hidden_size: int = 128) -> None:
        super().__init__()
        self.agent = nn.Linear(agent_size, hidden_size)
        self.surrounding = nn.Linear(surrounding_size, hidden_size, bias=False)
        self.output = nn.Linear(hidden_size, 1)

    def forward(self, agent: Tensor, surrounding: Tensor) -> Tensor:
        """[..., X], [..., Y] -> [...] statistics."""
        return self._statistic(self.agent(agent) + self.surrounding(surrounding))

    def bound(self, agent: Tensor, surrounding: Tensor, permutations: Tensor) -> Tensor:
        """Bound on I(surrounding; agent) of each trajectory, in nats.

        Args:
            agent: [N, T, X]; surrounding: [N, T, Y]
            permutations: [N, T] of time, for the product of the marginals.

        Returns:
            [N]
        """
        from_surrounding = self.surrounding(surrounding)
        shuffled = shuffle_time(from_surrounding, permutations)
        return self._bound(self.agent(agent), from_surrounding, shuffled)

    def _bound(self, from_agent: Tensor, from_surrounding: Tensor, shuffled: Tensor) -> Tensor:
        """[N, T, H] each, what the first layer makes of the states -> [N]."""
        joint = self._statistic(from_agent + from_surrounding)
        return donsker_varadhan(joint, self._statistic(from_agent + shuffled))

    def _statistic(self, preactivation: Tensor) -> Tensor:
        """[..., H] -> [...]; takes over its argument."""
        return torch.tanh(self.output(torch.relu_(preactivation))).squeeze(-1)

    def transition_bound(
        self, agent: Tensor, surrounding: Tensor, *, swapped: bool = True
    ) -> Tensor:
        """The bound on the two-frame fragment of a transition, in nats.

        Args:
            agent: [B, 2, X]; surrounding: [B, 2, Y]
            swapped: pair each frame with the other one's surroundings. False is the identity
                permutation, which the original draws for half of its minibatches: <= 0.

        Returns:
            [B]
        """
        from_surrounding = self.surrounding(surrounding)
        other = from_surrounding.flip(1) if swapped else from_surrounding
        return self._bound(self.agent(agent), from_surrounding, other)


def intrinsic_reward(bound: Tensor, scale: float) -> Tensor:
    """clip(scale * bound, 0, 1) - 1, in [-1, 0] (Zhao et al. 2021's code; scale 5000)."""
    return (scale * bound).clamp(0.0, 1.0) - 1.0
