"""MUSIC's statistics network and what is computed from it (paper III-A, Fig. 1-2).

Shape legend: N trajectories, T frames, B transitions, X / Y features of the agent's and the
surrounding state. States are raw observations, as in the original, unless they lie far from 0.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from music_rllib.functional.mutual_information import donsker_varadhan, shuffle_time

__all__ = ["MutualInformationEstimator", "intrinsic_reward"]


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

    def __init__(self, agent_size: int, surrounding_size: int, hidden_size: int = 128) -> None:
        super().__init__()
        self.agent = nn.Linear(agent_size, hidden_size)
        self.surrounding = nn.Linear(surrounding_size, hidden_size, bias=False)
        self.output = nn.Linear(hidden_size, 1)
        self.register_buffer("offset", torch.zeros(agent_size + surrounding_size))
        self.register_buffer("scale", torch.ones(agent_size + surrounding_size))
        self._raw = True
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
        pairs = torch.cat([agent, surrounding], -1)
        if not self._raw:
            pairs = (pairs - self.offset) * self.scale
        weight = torch.cat([self.agent.weight, self.surrounding.weight], 1)
        statistics: Tensor = _Statistic.apply(  # type: ignore[no-untyped-call]
            pairs.flatten(0, -2), weight, self.agent.bias, self.output.weight, self.output.bias
        )
        return statistics.view(pairs.shape[:-1])

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
        return self._bound(agent, surrounding, shuffle_time(surrounding, permutations), inside)

    def _bound(
        self, agent: Tensor, surrounding: Tensor, shuffled: Tensor, inside: Tensor | None = None
    ) -> Tensor:
        """[N, T, X], [N, T, Y] twice -> [N]."""
        both = torch.stack([surrounding, shuffled])
        joint, marginals = self(agent.expand(2, *agent.shape), both)
        return donsker_varadhan(joint, marginals, inside)

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
        other = surrounding.flip(1) if swapped else surrounding
        return self._bound(agent, surrounding, other)


class _Statistic(torch.autograd.Function):
    """tanh(w . relu(W i + b) + c) of rows i; can be differentiated once.

    With one output the gradient of W is, by the slope g of a row's statistic and the units m that
    are on, w * sum(m x g i): of [R, H] matrices only m is made, where layer by layer it took five.

    Shape legend: R rows, I inputs, H hidden units.
    """

    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor, output: Tensor, offset: Tensor
    ) -> Tensor:
        """[R, I], [H, I], [H], [1, H], [1] -> [R]."""
        hidden = torch.relu_(F.linear(rows, weight, bias))
        statistics = torch.tanh(torch.addmv(offset, hidden, output[0]))
        ctx.save_for_backward(rows, weight, output, hidden, statistics)
        return statistics

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, weight, output, hidden, statistics = ctx.saved_tensors
        slope = gradient * (1.0 - statistics.square())
        on = hidden.sign()
        weighted = torch.cat([rows * slope.unsqueeze(1), slope.unsqueeze(1)], 1)
        of_first = (weighted.t() @ on) * output
        of_rows = (slope.unsqueeze(1) * on * output) @ weight if ctx.needs_input_grad[0] else None
        of_output = slope.unsqueeze(0) @ hidden
        return of_rows, of_first[:-1].t(), of_first[-1], of_output, slope.sum().unsqueeze(0)


def intrinsic_reward(bound: Tensor, scale: float) -> Tensor:
    """clip(scale * bound, 0, 1) - 1, in [-1, 0] (Zhao et al. 2021's code; scale 5000)."""
    return (scale * bound).clamp(0.0, 1.0) - 1.0
