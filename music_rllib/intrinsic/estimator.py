"""MUSIC's statistics network and what is computed from it (paper III-A, Fig. 1-2).

Shape legend: N trajectories, T frames, B transitions, X / Y features of the agent's and the
surrounding state. States are raw observations, as in the original, unless they lie far from 0.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from music_rllib.functional.mutual_information import donsker_varadhan, shuffle_time
from music_rllib.intrinsic.compiled import Data, Weights, bounds, learn
from music_rllib.optim.adam import FusedAdam
from music_rllib.optim.flat import FlatParameters

__all__ = ["MutualInformationEstimator", "intrinsic_reward", "two_frames"]


FAR = 10.0
"""Mean or standard deviation of an input beyond which a fresh network's tanh is at its end: there
every statistic is 1 or every one -1, and the bound is 0 for ever. Fetch's are below 2."""


class MutualInformationEstimator(nn.Module):
    """T(x, y) = tanh(w . relu(Wx x + Wy y + b) + c).

    tanh keeps T in [-1, 1] and thereby the bound below 2 nats. Inputs that lie far from 0 are
    shifted and scaled first (`adapt_to`), which leaves the information between them as it is.
    """

    offset: Tensor
    """[X + Y] taken from the inputs; 0 for what is used raw."""
    scale: Tensor
    """[X + Y] multiplies what is left; 1 for what is used raw."""
    compiled = True
    """Whether bounds on a CPU that nobody differentiates are computed by compiled code."""

    def __init__(self, agent_size: int, surrounding_size: int, hidden_size: int = 128) -> None:
        super().__init__()
        self.agent = nn.Linear(agent_size, hidden_size)
        self.surrounding = nn.Linear(surrounding_size, hidden_size, bias=False)
        self.output = nn.Linear(hidden_size, 1)
        self.register_buffer("offset", torch.zeros(agent_size + surrounding_size))
        self.register_buffer("scale", torch.ones(agent_size + surrounding_size))
        self._raw = True
        self._flat: FlatParameters | None = None
        hook = MutualInformationEstimator._see_whether_raw
        self.register_load_state_dict_post_hook(hook)  # type: ignore[no-untyped-call]

    def _see_whether_raw(self, *_: object) -> None:
        """Looked up in every update, where a device would have to be waited for."""
        self._raw = not bool(self.offset.any() or (self.scale != 1.0).any())

    @torch.no_grad()
    def adapt_to(self, agent: Tensor, surrounding: Tensor) -> None:
        """Before the first training: [..., X], [..., Y] states like those it is to learn from."""
        inputs = torch.cat([agent, surrounding], -1).flatten(0, -2).double()
        mean, std = inputs.mean(0), inputs.std(0, correction=0)
        self.offset.copy_(torch.where(mean.abs() > FAR, mean, 0.0))
        self.scale.copy_(torch.where(std > FAR, 1.0 / std, 1.0))
        self._see_whether_raw()

    def forward(self, agent: Tensor, surrounding: Tensor) -> Tensor:
        """[..., X], [..., Y] -> [...] statistics."""
        agent, surrounding = self._scaled(agent, surrounding)
        hidden = torch.relu(self.agent(agent) + self.surrounding(surrounding))
        return torch.tanh(self.output(hidden)).squeeze(-1)

    def _scaled(self, agent: Tensor, surrounding: Tensor) -> tuple[Tensor, Tensor]:
        if self._raw:
            return agent, surrounding
        size = agent.shape[-1]
        return (
            (agent - self.offset[:size]) * self.scale[:size],
            (surrounding - self.offset[size:]) * self.scale[size:],
        )

    def bound(
        self,
        agent: Tensor,
        surrounding: Tensor,
        permutations: Tensor,
        inside: Tensor | None = None,
    ) -> Tensor:
        """Bound on I(surrounding; agent) of each trajectory, in nats.

        Args:
            agent: [N, T, X]; surrounding: [N, T, Y]
            permutations: [N, T] of time, for the product of the marginals.
            inside: [N, T] False for padding behind shorter trajectories; None: there is none.

        Returns:
            [N]
        """
        if self.compiled and agent.device.type == "cpu" and not torch.is_grad_enabled():
            data = self.data(agent, surrounding, permutations, inside)
            return torch.from_numpy(bounds(data, Weights(*self._arrays())))
        shuffled = shuffle_time(surrounding, permutations)
        return donsker_varadhan(self(agent, surrounding), self(agent, shuffled), inside)

    def learn(
        self, pairs: Data, trajectories: Data, optimizer: FusedAdam, updates: int
    ) -> tuple[Tensor, Tensor]:
        """Updates on a CPU, each by the mean bound of its trajectories.

        Args:
            pairs: [K*B] of frames, of which each update takes the bounds first.
            trajectories: [K*N]
            optimizer: of this module's parameters.
            updates: K.

        Returns:
            [K*B] bounds of the pairs, and [K] of the trajectories, in nats.
        """
        if self._flat is None or not self._flat.is_in_use:
            self._flat = FlatParameters(list(self.parameters()))
        weights, by = (
            Weights(*(view.numpy() for view in self._flat.views(flat)))
            for flat in (self._flat.values, self._flat.gradients)
        )
        descent = optimizer.descent(self._flat)
        found, means = learn(pairs, trajectories, weights, by, descent, updates)
        return torch.from_numpy(found), torch.from_numpy(means)

    def _arrays(self) -> Iterator[NDArray[Any]]:
        return (parameter.detach().numpy() for parameter in self.parameters())

    def data(
        self, agent: Tensor, surrounding: Tensor, others: Tensor, inside: Tensor | None
    ) -> Data:
        """What compiled code takes; as `bound` documents it."""
        agent, surrounding = self._scaled(agent, surrounding)
        frames = np.full(*agent.shape[:2]) if inside is None else inside.sum(-1).numpy()
        whole = (np.ascontiguousarray(one.numpy()) for one in (agent, surrounding, others))
        return Data._make((*whole, frames))

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
        others = two_frames(len(agent), swapped).to(agent.device)
        return self.bound(agent, surrounding, others)


@functools.lru_cache(maxsize=8)
def two_frames(rows: int, swapped: bool) -> Tensor:
    """[B, 2] of two frames each the other one, or itself."""
    return torch.tensor([1, 0] if swapped else [0, 1]).repeat(rows, 1)


def intrinsic_reward(bound: Tensor, scale: float) -> Tensor:
    """clip(scale * bound, 0, 1) - 1, in [-1, 0] (Zhao et al. 2021's code; scale 5000)."""
    return (scale * bound).clamp(0.0, 1.0) - 1.0
