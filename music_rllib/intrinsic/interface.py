"""The interface of an intrinsic reward: subclass `IntrinsicReward`, and name the class in YAML.

Shape legend: B transitions, N trajectories, T frames, D observation, G goal, A action, n steps.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn


class Sizes(NamedTuple):
    """Sizes of an environment's spaces, and its split into agent and surrounding state."""

    observation: int
    goal: int
    """0 without goals."""
    action: int
    agent_indices: tuple[int, ...] = ()
    surrounding_indices: tuple[int, ...] = ()
    """Positions in the observation; empty if the task has no split."""


class Batch(NamedTuple):
    """Transitions of one minibatch, and what the reward's class asks for."""

    states: Tensor
    """[B, D] observations."""
    actions: Tensor
    """[B, A] in [-1, 1]."""
    followers: Tensor
    """[B, D] next observations."""
    goals: Tensor
    """[B, G] desired goals, some of them relabeled by hindsight."""
    generator: torch.Generator
    """The source of all random numbers, so that a resumed run draws the same ones."""
    stored: Tensor | None = None
    """[B] results of `of_episode`, if it is overridden."""
    trajectories: Tensor | None = None
    """[N, T, D] observations of whole trajectories, with `trajectories`."""
    inside: Tensor | None = None
    """[N, T] False for padding at a trajectory's end; None: no padding."""


class IntrinsicReward(nn.Module, ABC):
    """A bonus for transitions, and the loss of its networks.

    Only `bonus` must be written. Parameters and buffers are saved in checkpoints, and handed over
    to variant `intrinsic-r`. Keep everything that changes in them, and take random numbers from
    `Batch.generator`.

    Args:
        sizes: sizes of the environment's spaces.
        **settings: a subclass has keyword arguments; they are `intrinsic.settings` in YAML.

    Raises:
        ValueError: The environment lacks something that the reward needs.
    """

    scale: ClassVar[float | None] = None
    """Bonus that earns the largest reward. None: twice the root mean square of all bonuses so far.
    """
    smallest_scale: ClassVar[float] = 0.0
    """Lower limit of that scale, so that noise earns nothing if there is nothing else."""
    by_minibatch: ClassVar[bool] = False
    """Whether a bonus depends on the other transitions of its minibatch.

    Fresh episodes are one batch and would have other rewards than in training, so there is no
    metric `critics/bias`.
    """
    by_episode: ClassVar[bool] = False
    """Whether the class overrides `of_episode`."""
    trajectories: ClassVar[int] = 0
    """Number of whole trajectories that the loss of each update needs."""
    sums: Tensor
    """[2] number of bonuses so far, and the sum of their squares."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.register_buffer("sums", torch.zeros(2, dtype=torch.float64))

    def __init_subclass__(cls) -> None:
        cls.by_episode = cls.of_episode is not IntrinsicReward.of_episode

    @abstractmethod
    def bonus(self, batch: Batch) -> Tensor:
        """[B] bonuses >= 0, of any scale; called without gradients."""

    def loss(self, batch: Batch) -> Tensor | None:
        """[] loss of the parameters, for a step of Adam at every fourth update; None: no step."""
        return None

    def of_episode(self, observations: Tensor, actions: Tensor) -> Tensor | None:
        """[n+1, D], [n, A] -> [n] numbers of a fresh episode, for `Batch.stored`; None: none.

        Override it if bonuses depend on the earlier steps of an episode. It is called once for each
        episode, without gradients, and the replay keeps the numbers.
        """
        return None

    def metrics(self) -> dict[str, float]:
        """Measures since the last call; their names begin with `intrinsic/`."""
        return {}

    @torch.no_grad()
    def reward(self, batch: Batch, *, learning: bool) -> tuple[Tensor, Tensor]:
        """[B] rewards in [-1, 0] as MUSIC's: clip(bonus / scale, 0, 1) - 1; and [B] bonuses.

        Args:
            learning: whether the bonuses count for the scale.

        Raises:
            ValueError: `bonus` returned something else, or numbers that are negative or not finite.
        """
        bonus = self.bonus(batch)
        check_result(self, "bonus", bonus, (len(batch.states),))
        bonus = bonus.to(batch.states.dtype)  # compiled updates take one type of numbers
        wrong = bonus[~((bonus >= 0.0) & (bonus < torch.inf))]
        if len(wrong):
            rule = f"{type(self).__name__}.bonus must return finite numbers >= 0"
            raise ValueError(f"{rule}, got {float(wrong[0])}")
        if self.scale is not None:
            return (bonus / self.scale).clamp(0.0, 1.0) - 1.0, bonus
        if learning:
            squares = bonus.double().square().sum()
            self.sums += torch.stack([torch.full_like(squares, len(bonus)), squares])
        scale = 2.0 * (self.sums[1] / self.sums[0].clamp(min=1.0)).sqrt()
        scale = scale.clamp(min=max(self.smallest_scale, 1e-12)).to(bonus)
        return (bonus / scale).clamp(0.0, 1.0) - 1.0, bonus


def check_result(
    reward: IntrinsicReward, method: str, found: object, shape: tuple[int, ...]
) -> None:
    """Raise ValueError if the result of a reward's method is no tensor of floats of this shape."""
    if isinstance(found, Tensor):
        if found.is_floating_point() and found.shape == shape:
            return
        kind = f"one of {found.dtype} and {tuple(found.shape)}"
    else:
        kind = type(found).__name__
    rule = f"{type(reward).__name__}.{method} must return a tensor of floats and of shape {shape}"
    raise ValueError(f"{rule}, got {kind}")


# -- parts of networks ---------------------------------------------------------------------------


class Standardized(nn.Module):
    """Inputs standardized by all that `update` has seen, and clipped to [-5, 5]."""

    moments: Tensor
    """[1 + 2 F] number of rows, sums and sums of squares of F features."""
    mean: Tensor
    factor: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("moments", torch.zeros(1 + 2 * features, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("factor", torch.ones(features))

    @torch.no_grad()
    def update(self, rows: Tensor) -> None:
        """Add rows [B, F]."""
        rows = rows.double()
        count = rows.new_tensor([len(rows)])
        self.moments += torch.cat([count, rows.sum(0), rows.square().sum(0)])
        mean, square = (self.moments[1:] / self.moments[0]).chunk(2)
        self.mean.copy_(mean)
        self.factor.copy_((square - mean.square()).clamp(min=1e-4).rsqrt())

    def forward(self, rows: Tensor) -> Tensor:
        """[..., F] -> standardized [..., F]."""
        return ((rows - self.mean) * self.factor).clamp(-5.0, 5.0)


def perceptron(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers of these sizes with ReLU between them."""
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers[:-1])
