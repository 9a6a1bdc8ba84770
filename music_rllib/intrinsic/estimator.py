"""MUSIC's statistics network and the bounds computed from it (paper III-A, Fig. 1-2).

Shape legend: N trajectories, T frames, B transitions, D observation, X / Y features of the agent's
and the surrounding state. States are raw observations, as in the original, unless they are far
from 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from music_rllib.functional.mutual_information import (
    AVERAGE_RATE,
    donsker_varadhan,
    of_draw,
    other_bound,
    shifted,
    shuffle_time,
)
from music_rllib.kernels.adam import FlatParameters, FusedAdam
from music_rllib.kernels.layers import Array
from music_rllib.kernels.mutual_information import BOUNDS, Bound, Data, Weights, bounds, learn

FAR = 10.0
"""Mean or standard deviation of an input above which a new network's tanh saturates: all statistics
are then 1 or all are -1, and the bound stays 0. Fetch's inputs are below 2."""


NEGATIVES = 5
"""InfoNCE: shuffled pairs for each pair of one time."""


class MutualInformationEstimator(nn.Module):
    """T(x, y) = tanh(w . relu(Wx x + Wy y + b) + c); without tanh for other bounds than `capped`.

    tanh keeps T in [-1, 1] and thus the bound below 2 nats. Inputs that are far from 0 are shifted
    and scaled first (`adapt_to`), which does not change the information between them.

    Args:
        agent_indices: X positions of the agent's state in an observation.
        surrounding_indices: Y positions of the surrounding state.
        hidden_size: hidden units.
        bound: `capped`: Donsker-Varadhan; or a kind of `other_bound`.
    """

    agent_indices: Tensor
    surrounding_indices: Tensor
    offset: Tensor
    """[X + Y] subtracted from the inputs; 0 for raw inputs."""
    scale: Tensor
    """[X + Y] factor on the shifted inputs; 1 for raw inputs."""
    log_average: Tensor
    """[] logarithm of the moving average of exp T(x, y'), with the bound `moving_average`."""
    compiled = True
    """Whether compiled code computes bounds without gradient on a CPU."""

    def __init__(
        self,
        agent_indices: Sequence[int],
        surrounding_indices: Sequence[int],
        hidden_size: int = 128,
        bound: str = "capped",
    ) -> None:
        super().__init__()
        self.kind = bound
        if bound == "moving_average":
            self.register_buffer("log_average", torch.tensor(0.0))
        # Buffers move with the module's device; the indices are not part of its state.
        self.register_buffer("agent_indices", torch.tensor(agent_indices), persistent=False)
        surrounding = torch.tensor(surrounding_indices)
        self.register_buffer("surrounding_indices", surrounding, persistent=False)
        self.agent = nn.Linear(len(agent_indices), hidden_size)
        self.surrounding = nn.Linear(len(surrounding_indices), hidden_size, bias=False)
        self.output = nn.Linear(hidden_size, 1)
        inputs = len(agent_indices) + len(surrounding_indices)
        self.register_buffer("offset", torch.zeros(inputs))
        self.register_buffer("scale", torch.ones(inputs))
        self._width = 1 + max(*agent_indices, *surrounding_indices)
        self._raw = True
        self._flat: FlatParameters | None = None
        hook = MutualInformationEstimator._update_raw
        self.register_load_state_dict_post_hook(hook)  # type: ignore[no-untyped-call]

    def _update_raw(self, *_: object) -> None:
        """Cache whether inputs are raw: each update asks, and reading waits for the device."""
        self._raw = not bool(self.offset.any() or (self.scale != 1.0).any())

    def _halves(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """[..., D] -> [..., X] agent state and [..., Y] surrounding state."""
        return (
            observations.index_select(-1, self.agent_indices),
            observations.index_select(-1, self.surrounding_indices),
        )

    @torch.no_grad()
    def adapt_to(self, observations: Tensor) -> None:
        """Set offset and scale by [..., D] observations, those of the first updates."""
        inputs = torch.cat(self._halves(observations), -1).flatten(0, -2).double()
        mean, std = inputs.mean(0), inputs.std(0, correction=0)
        self.offset.copy_(torch.where(mean.abs() > FAR, mean, 0.0))
        self.scale.copy_(torch.where(std > FAR, 1.0 / std, 1.0))
        self._update_raw()

    def forward(self, agent: Tensor, surrounding: Tensor) -> Tensor:
        """[..., X], [..., Y] -> [...] statistics."""
        agent, surrounding = self._scaled(agent, surrounding)
        hidden = torch.relu(self.agent(agent) + self.surrounding(surrounding))
        statistics: Tensor = self.output(hidden).squeeze(-1)
        return torch.tanh(statistics) if self.kind == "capped" else statistics

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
        observations: Tensor,
        permutations: Tensor,
        inside: Tensor | None = None,
        *,
        of_pairs: bool = False,
    ) -> Tensor:
        """Bound on I(surrounding; agent) of each trajectory: [N] nats.

        Args:
            observations: [N, T, D]
            permutations: [N, T] of time, for the product of the marginals.
            inside: [N, T] False for padding after the end of trajectories; None: no padding.
            of_pairs: Do not clip statistics (`smile`). With the clip, which only the product of
                marginals has, surroundings at rest would have a positive bound.
        """
        kind = "moving_average" if of_pairs and self.kind == "smile" else self.kind
        if self.compiled and observations.device.type == "cpu" and not torch.is_grad_enabled():
            data = self.data(observations, permutations, inside)
            weights = Weights(*(parameter.detach().numpy() for parameter in self.parameters()))
            bound = self._bound(observations)._replace(kind=BOUNDS.index(kind))
            return torch.from_numpy(bounds(data, bound, weights))
        joint, marginals = self._statistics(observations, permutations, inside)
        if kind == "capped":
            return donsker_varadhan(joint, marginals[0], inside)
        return other_bound(kind, joint, marginals, inside)

    def _bound(self, trajectories: Tensor | Array) -> Bound:
        """The kind of bound for [N, T, ...] trajectories as compiled code takes it."""
        frames = trajectories.shape[1]
        negatives = max(min(NEGATIVES, frames - 1), 1) if self.kind == "infonce" else 1
        average = self.log_average if self.kind == "moving_average" else torch.tensor(0.0)
        return Bound(BOUNDS.index(self.kind), 1 + negatives, average.numpy())

    def _statistics(
        self, observations: Tensor, permutations: Tensor, inside: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """[N, T] statistics of pairs of one time, and [R, N, T] of shuffled pairs."""
        agent, surrounding = self._halves(observations)
        several = permutations.unsqueeze(0)
        if self.kind == "infonce":
            several = shifted(permutations, NEGATIVES, inside)
        shuffled = torch.stack([shuffle_time(surrounding, each) for each in several])
        return self(agent, surrounding), self(agent.expand(len(several), -1, -1, -1), shuffled)

    def loss(
        self, observations: Tensor, permutations: Tensor, inside: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """[] loss and [] mean bound of trajectories; arguments as for `bound`.

        The loss is the negative mean bound. With `moving_average` it has the gradient of MINE, in
        which a moving average over updates replaces the mean of exp T(x, y') in the denominator.
        With `smile` it is that of the Jensen-Shannon divergence, as in the authors' code: the
        clipped bound itself grows without limit.
        """
        if self.kind not in {"moving_average", "smile"}:
            mean = self.bound(observations, permutations, inside).mean()
            return -mean, mean.detach()
        joint, marginals = self._statistics(observations, permutations, inside)
        bound = other_bound(self.kind, joint, marginals, inside).mean().detach()
        rows = slice(None) if inside is None else inside
        joint, shuffled = joint[rows].flatten(), marginals[0][rows].flatten()
        if self.kind == "smile":
            return softplus(-joint).mean() + softplus(shuffled).mean(), bound
        log_mean = shuffled.logsumexp(0) - math.log(len(shuffled))
        with torch.no_grad():
            kept = self.log_average + math.log1p(-AVERAGE_RATE)
            self.log_average.copy_(torch.logaddexp(kept, log_mean + math.log(AVERAGE_RATE)))
        return (log_mean - self.log_average).exp() - joint.mean(), bound

    def transition_bounds(
        self, states: Tensor, followers: Tensor, swapped: Sequence[bool] = (True,)
    ) -> Tensor:
        """Bounds on transitions from states [B, D] to `followers` [B, D]: [B] nats.

        Each transition is a trajectory of two frames, shuffled in time by `two_frames`.
        """
        frames = self.pairs(states, followers)
        permutations = two_frames(len(frames), tuple(swapped), frames.device)
        return self.bound(frames, permutations, of_pairs=True)

    def pairs(self, states: Tensor, followers: Tensor) -> Tensor:
        """[..., B, D] states and next states -> [..., B, 2, d] the columns that are used."""
        return torch.stack([each[..., : self._width] for each in (states, followers)], dim=-2)

    def learn(
        self, pairs: Data, trajectories: Data, optimizer: FusedAdam, updates: int
    ) -> tuple[Tensor, Tensor]:
        """Train on a CPU by compiled code; each of the K updates decreases `loss`.

        Args:
            pairs: [K*B] pairs of frames, whose bounds are computed before their update.
            trajectories: [K*N] training data.
            optimizer: Adam of this module's parameters.
            updates: K.

        Returns:
            [K*B] bounds of the pairs, and [K] mean bounds of the trajectories, in nats.
        """
        if self._flat is None or not self._flat.is_in_use:
            self._flat = FlatParameters(list(self.parameters()))
        weights, gradients = (
            Weights(*(view.numpy() for view in self._flat.views(flat)))
            for flat in (self._flat.values, self._flat.gradients)
        )
        step = optimizer.step_of(self._flat)
        bound = self._bound(trajectories.agent)
        of_pairs, means = learn(pairs, trajectories, bound, weights, gradients, step, updates)
        return torch.from_numpy(of_pairs), torch.from_numpy(means)

    def data(self, observations: Tensor, permutations: Tensor, inside: Tensor | None) -> Data:
        """The arguments of `bound` as compiled code takes them."""
        agent, surrounding = self._scaled(*self._halves(observations))
        frames = np.full(*agent.shape[:2]) if inside is None else inside.sum(-1).numpy()
        tensors = (agent, surrounding, permutations)
        return Data._make((*(np.ascontiguousarray(each.numpy()) for each in tensors), frames))


def two_frames(rows: int, swapped: tuple[bool, ...], device: torch.device) -> Tensor:
    """[B, 2] permutations of two frames; each draw is for an equal share of the rows.

    True pairs each frame with the surroundings of the other one; False is the identity, whose bound
    is <= 0.
    """
    times = torch.arange(2, device=device)
    kinds = times.flip(0), times
    if len(swapped) == 1:
        return kinds[not swapped[0]].expand(rows, 2)
    return of_draw(torch.stack([kinds[not each] for each in swapped]), rows)


def intrinsic_reward(bound: Tensor, scale: float) -> Tensor:
    """clip(scale * bound, 0, 1) - 1, in [-1, 0] (Zhao et al. 2021's code; scale 5000)."""
    return (scale * bound).clamp(0.0, 1.0) - 1.0
