"""Trains an intrinsic reward's networks beside the policy, and checks a user's class.

Shape legend: K updates of a call, B transitions of one.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from music_rllib import names
from music_rllib.errors import one_line
from music_rllib.intrinsic.interface import Batch, IntrinsicReward, check_result
from music_rllib.kernels.adam import FusedAdam
from music_rllib.replay.trajectories import Floats, Trajectory

PERIOD = 4
"""Updates of the policy for each step of a reward's networks: it learns from a quarter of the
minibatches, as RND does with many environments, and costs less than 40% of a small update."""

_RESERVED = (names.INTRINSIC_REWARD, names.INTRINSIC_BONUS)
_METRIC = re.compile(r"[\w .:/\-]{1,250}")
"""Names that MLflow takes, apart from empty parts. It refuses the whole run for another one."""


class RewardLearner:
    """Rewards of minibatches; every fourth one is followed by a step of the reward's networks.

    Args:
        reward: on its device.
        lr: Adam's step size.
        frozen: do not train the networks.
        again: makes the same reward again, for a check of a user's class before its first update;
            None: no check.
    """

    def __init__(
        self, reward: IntrinsicReward, lr: float, *, frozen: bool,
        again: Callable[[], IntrinsicReward] | None = None,
    ) -> None:  # fmt: skip
        self.reward, self._frozen, self._updates = reward, frozen, 0
        self._again: Callable[[], RewardLearner] | None = None
        if again is not None:
            self._again = lambda: RewardLearner(again(), lr, frozen=frozen)
        self._parameters = [each for each in reward.parameters() if each.requires_grad]
        self._loss = reward.sums.new_zeros((), dtype=torch.float32)
        """[] loss of the last step."""
        self._adam = FusedAdam(self._parameters, lr) if self._parameters and not frozen else None

    def batch(
        self, inputs: Tensor, actions: Tensor, next_inputs: Tensor, generator: torch.Generator,
        stored: Tensor | None = None, trajectories: Mapping[str, Tensor] | None = None,
    ) -> Batch:  # fmt: skip
        """The transitions of observations and goals [K*B, D + G], and of K*N trajectories."""
        width, whole = self.reward.sizes.observation, trajectories or {}
        return Batch(
            inputs[:, :width], actions, next_inputs[:, :width], inputs[:, width:], generator,
            stored, whole.get("obs"), whole.get("inside"),
        )  # fmt: skip

    def values_of(self, episodes: Sequence[Trajectory]) -> list[Floats]:
        """[n] numbers of each episode for the replay, if there are any."""
        width, device = self.reward.sizes.observation, self.reward.sums.device
        found = []
        for episode in episodes:
            arrays = (episode.frames[:, :width], episode.actions)
            with torch.no_grad():
                values = self.reward.of_episode(*(torch.tensor(a, device=device) for a in arrays))
            check_result(self.reward, "of_episode", values, (len(episode),))
            found.append(cast("Tensor", values).cpu().numpy())
        return found

    def observe(self, batch: Batch, values: Sequence[Floats] | None) -> Tensor:
        """[steps] reward of fresh episodes with these `values_of`, whose steps are the batch."""
        if values is not None:
            stored = torch.from_numpy(np.concatenate(values))
            batch = batch._replace(stored=stored.to(batch.states.device))
        return self.reward.reward(batch, learning=False)[0]

    def learn(self, batch: Batch, updates: int) -> tuple[Tensor, dict[str, Tensor]]:
        """K updates on K concatenated minibatches.

        Returns:
            [K, B] rewards in [-1, 0], each minibatch's before its update, and metrics [K] by name.

        Raises:
            ValueError: A method of the class returned or did something that it must not.
        """
        if self._again is not None and not self._updates:
            _check_own_class(_part(batch, 0, updates), self._again)
        rewards, bonuses, losses = [], [], []
        for k in range(updates):
            part = _part(batch, k, updates)
            reward, bonus = self.reward.reward(part, learning=not self._frozen)
            rewards.append(reward)
            bonuses.append(bonus)
            if self._adam is not None and self._updates % PERIOD == 0:
                self._step(part, self._adam)
            self._updates += 1
            losses.append(self._loss)
        found = torch.stack(rewards)
        metrics = {
            names.INTRINSIC_REWARD: found.mean(1),
            names.INTRINSIC_BONUS: torch.stack(bonuses).mean(1),
        }
        if self._adam is not None:
            metrics[names.INTRINSIC_LOSS] = torch.stack(losses)
        return found, metrics

    def metrics(self) -> dict[str, float]:
        """The reward's own measures since the last call.

        Raises:
            ValueError: They are no numbers by name, or a name is not one of an intrinsic reward, so
                that it could replace another.
        """
        found = self.reward.metrics()
        try:
            found = {name: float(value) for name, value in found.items()}
        except (AttributeError, TypeError, ValueError, RuntimeError) as error:
            rule = f"{type(self.reward).__name__}.metrics must return a dictionary of numbers"
            raise ValueError(f"{rule}: {one_line(error)}") from error
        for name in found:
            if not name.startswith("intrinsic/") or name in _RESERVED:
                rule = "must begin with intrinsic/ and not be " + " or ".join(_RESERVED)
                kind = type(self.reward).__name__
                raise ValueError(f"names in {kind}.metrics {rule}, got {name!r}")
            if not _METRIC.fullmatch(name) or posixpath.normpath(name) != name:
                rule = "must be letters, digits, spaces and _-.:/ (at most 250, no empty part)"
                kind = type(self.reward).__name__
                raise ValueError(f"names in {kind}.metrics {rule}, got {name!r}")
        return found

    def _step(self, batch: Batch, adam: FusedAdam) -> None:
        with torch.enable_grad():
            loss = self.reward.loss(batch)
        if loss is None:
            return
        check_result(self.reward, "loss", loss, ())
        if not loss.requires_grad:
            name = type(self.reward).__name__
            raise ValueError(f"{name}.loss must depend on the reward's parameters without detach()")
        gradients = torch.autograd.grad(loss, self._parameters, allow_unused=True)
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        adam.step()
        self._loss = loss.detach().float()

    # -- state ------------------------------------------------------------------------------------

    def weights(self) -> dict[str, NDArray[Any]]:
        """Copies of the parameters and buffers, by name."""
        return {
            name: tensor.detach().cpu().numpy().copy()
            for name, tensor in self.reward.state_dict().items()
        }

    def load_weights(self, weights: Mapping[str, NDArray[Any]]) -> None:
        """Set all parameters and buffers."""
        tensors = {name: torch.tensor(np.asarray(array)) for name, array in weights.items()}
        self.reward.load_state_dict(tensors)

    def state(self) -> dict[str, Any]:
        moments = self._adam.state_dict()["state"] if self._adam is not None else {}
        return {
            "weights": self.weights(),
            "updates": self._updates,
            "loss": self._loss.cpu().numpy(),
            "adam": {
                index: {name: value.cpu().numpy().copy() for name, value in of_one.items()}
                for index, of_one in moments.items()
            },
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.load_weights(state["weights"])
        self._updates = int(state["updates"])
        self._loss = torch.tensor(state["loss"], device=self.reward.sums.device)
        if self._adam is not None:
            moments = {
                int(index): {name: torch.tensor(value) for name, value in of_one.items()}
                for index, of_one in state["adam"].items()
            }
            groups = self._adam.state_dict()["param_groups"]
            self._adam.load_state_dict({"state": moments, "param_groups": groups})


def _check_own_class(batch: Batch, make: Callable[[], RewardLearner]) -> None:
    """Raise a ValueError unless a user's reward leaves a minibatch as it is, and resumes exactly.

    Otherwise the critics would learn from changed data, and a resumed run would differ, both
    without an error.
    """

    def learned(learner: RewardLearner) -> Tensor:
        """[PERIOD, B] rewards of updates, one of which is followed by a step of the networks."""
        given = {k: each for k, each in batch._asdict().items() if isinstance(each, Tensor)}
        copies = {name: each.clone() for name, each in given.items()}
        generator = torch.Generator(batch.states.device).manual_seed(0)
        own = batch._replace(generator=generator, **copies)
        rewards = torch.cat([learner.learn(own, 1)[0] for _ in range(PERIOD)])
        for name, each in given.items():
            if not torch.equal(each, copies[name]):
                raise ValueError(f"{kind} must not change the {name} of its batch in place")
        return rewards

    on_gpu = [batch.states.device] if batch.states.is_cuda else []
    with torch.random.fork_rng(devices=on_gpu):
        first, resumed = make(), make()
        kind = type(first.reward).__name__
        learned(first)
        try:
            resumed.load_state(first.state())
        except RuntimeError as error:
            rule = f"{kind} must keep the shapes of its parameters and buffers"
            raise ValueError(f"{rule}, a checkpoint raised {one_line(error)}") from error
        # Layers such as dropout draw from PyTorch's own generator, which checkpoints keep.
        begin = torch.get_rng_state(), [torch.cuda.get_rng_state(one) for one in on_gpu]
        rewards = learned(first)
        torch.set_rng_state(begin[0])
        for device, state in zip(on_gpu, begin[1], strict=True):
            torch.cuda.set_rng_state(state, device)
        if not torch.equal(rewards, learned(resumed)):
            raise ValueError(
                f"{kind} must keep everything that changes in parameters and buffers, and take "
                "random numbers from batch.generator: its rewards differ after a checkpoint is "
                "loaded"
            )


def _part(batch: Batch, k: int, updates: int) -> Batch:
    """The minibatch of update k of K."""

    def rows(values: Any) -> Any:
        if not isinstance(values, Tensor):
            return values
        count = len(values) // updates
        return values[k * count : (k + 1) * count]

    return Batch(*map(rows, batch))
