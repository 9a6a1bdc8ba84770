"""Rewards for new or unpredictable transitions: RND, ICM, disagreement and E3B.

Shape legend: B transitions, D observation, A action, F features, M models, n steps.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from music_rllib.intrinsic.interface import (
    Batch,
    IntrinsicReward,
    Sizes,
    Standardized,
    perceptron,
)


class RND(IntrinsicReward):
    """Random network distillation: the error of predicting a random network (Burda et al. 2018).

    b = mean_f (g(s') - g*(s'))^2 with a fixed random network g*; https://arxiv.org/abs/1810.12894
    """

    def __init__(self, sizes: Sizes, *, hidden: int = 64, features: int = 32) -> None:
        super().__init__(sizes)
        self.inputs = Standardized(sizes.observation)
        self.target = perceptron([sizes.observation, hidden, features]).requires_grad_(False)
        self.predictor = perceptron([sizes.observation, hidden, features])

    def bonus(self, batch: Batch) -> Tensor:
        inputs = self.inputs(batch.followers)
        errors: Tensor = self.predictor(inputs) - self.target(inputs)
        return errors.square().mean(-1)

    def loss(self, batch: Batch) -> Tensor:
        self.inputs.update(batch.followers)
        return self.bonus(batch).mean()


class _InverseModel(IntrinsicReward):
    """Features from which the action between two states can be predicted (Pathak et al. 2017)."""

    def __init__(self, sizes: Sizes, *, hidden: int = 64, features: int = 16) -> None:
        super().__init__(sizes)
        self.inputs = Standardized(sizes.observation)
        self.encoder = perceptron([sizes.observation, hidden, features])
        self.inverse = perceptron([2 * features, hidden, sizes.action])

    def encode(self, observations: Tensor) -> Tensor:
        """[..., D] -> features [..., F]."""
        features: Tensor = self.encoder(self.inputs(observations))
        return features

    def inverse_loss(self, states: Tensor, followers: Tensor, batch: Batch) -> Tensor:
        """[] error of the predicted actions from features [B, F] of both states."""
        error: Tensor = self.inverse(torch.cat([states, followers], -1)) - batch.actions
        return error.square().mean()

    def both(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Features [B, F] of states and of next states, after adding the states to the scale."""
        self.inputs.update(batch.states)
        states, followers = self.encode(torch.cat([batch.states, batch.followers])).chunk(2)
        return states, followers


class ICM(_InverseModel):
    """Curiosity: the error of predicting the next features (Pathak et al. 2017).

    b = 1/2 |f(phi(s), a) - phi(s')|^2; https://arxiv.org/abs/1705.05363, eq. 6
    """

    def __init__(self, sizes: Sizes, *, hidden: int = 64, features: int = 16) -> None:
        super().__init__(sizes, hidden=hidden, features=features)
        self.model = perceptron([features + sizes.action, hidden, features])

    def _errors(self, states: Tensor, followers: Tensor, actions: Tensor) -> Tensor:
        predicted: Tensor = self.model(torch.cat([states, actions], -1))
        return 0.5 * (predicted - followers).square().sum(-1)

    def bonus(self, batch: Batch) -> Tensor:
        states, followers = self.encode(torch.stack([batch.states, batch.followers]))
        return self._errors(states, followers, batch.actions)

    def loss(self, batch: Batch) -> Tensor:
        """Inverse loss and forward loss; the features learn from the inverse loss only."""
        states, followers = self.both(batch)
        forward = self._errors(states.detach(), followers.detach(), batch.actions).mean()
        return self.inverse_loss(states, followers, batch) + forward


class Disagreement(IntrinsicReward):
    """The variance of M models' predictions of the next state (Pathak et al. 2019).

    b = mean_d Var_m f_m(s, a)_d; https://arxiv.org/abs/1906.04161, eq. 1
    """

    def __init__(self, sizes: Sizes, *, models: int = 5, hidden: int = 32) -> None:
        super().__init__(sizes)
        if models < 2:
            raise ValueError(f"intrinsic.settings.models must be >= 2, got {models}")
        self.inputs, self.changes = (Standardized(sizes.observation) for _ in range(2))
        layers = [sizes.observation + sizes.action, hidden, sizes.observation]
        first, second = (
            [nn.Linear(a, b) for _ in range(models)] for a, b in itertools.pairwise(layers)
        )
        self.first = nn.Parameter(torch.stack([each.weight.detach().T for each in first]))
        self.second = nn.Parameter(torch.stack([each.weight.detach().T for each in second]))
        self.bias = nn.Parameter(torch.stack([each.bias.detach() for each in first]).unsqueeze(1))

    def _predictions(self, batch: Batch) -> Tensor:
        """[M, B, D] predicted standardized changes of the state."""
        inputs = torch.cat([self.inputs(batch.states), batch.actions], -1)
        hidden = torch.relu(inputs @ self.first + self.bias)
        return hidden @ self.second

    def bonus(self, batch: Batch) -> Tensor:
        predicted = self._predictions(batch)
        apart = predicted - predicted.mean(0)  # a third of the time of `var`
        return apart.square().sum(0).mean(-1) / (len(predicted) - 1)

    def loss(self, batch: Batch) -> Tensor:
        change = batch.followers - batch.states
        self.inputs.update(batch.states)
        self.changes.update(change)
        error: Tensor = self._predictions(batch) - self.changes(change)
        return error.square().mean()


class E3B(_InverseModel):
    """Elliptical bonus of the states of an episode so far (Henaff et al. 2022).

    b_t = phi(s_t)^T C^-1 phi(s_t), C = sum_(i < t) phi(s_i) phi(s_i)^T + ridge I;
    https://arxiv.org/abs/2210.05805, eq. 1. Bonuses are computed when an episode ends.
    """

    def __init__(
        self, sizes: Sizes, *, hidden: int = 64, features: int = 16, ridge: float = 0.1
    ) -> None:
        super().__init__(sizes, hidden=hidden, features=features)
        self.ridge = ridge

    @torch.no_grad()
    def of_episode(self, observations: Tensor, actions: Tensor) -> Tensor:
        # On the CPU: a GPU's sums differ from run to run. In float64: in float32, rounding hides a
        # small ridge behind the sums of a long episode, and bonuses become negative.
        encoded = self.encode(observations).cpu().double()
        outer = torch.einsum("ni,nj->nij", encoded, encoded).cumsum(0)[:-1]
        matrices = outer + self.ridge * torch.eye(encoded.shape[1], dtype=encoded.dtype)
        solved: Tensor = torch.linalg.solve(matrices, encoded[1:])
        return (encoded[1:] * solved).sum(-1).float()

    def bonus(self, batch: Batch) -> Tensor:
        assert batch.stored is not None
        return batch.stored

    def loss(self, batch: Batch) -> Tensor:
        return self.inverse_loss(*self.both(batch), batch)
