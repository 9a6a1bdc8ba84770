"""TAC's gradient updates without autograd: a module's networks as compiled code takes them.

The same numbers as autograd's to rounding, in about half of its time.

Shape legend: K updates, B batch, I network inputs, A action dimensions, C critics, S parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from ray.rllib.core.columns import Columns
from torch import Tensor, nn

from music_rllib import names
from music_rllib.optim.adam import Descent, FusedAdam
from music_rllib.optim.flat import FlatParameters
from music_rllib.tac.kernels.compiled import Averages, Batch, Networks, learn
from music_rllib.tac.kernels.distribution import Rule
from music_rllib.tac.kernels.perceptron import Network
from music_rllib.tac.networks import Critics, Perceptron
from music_rllib.tac.normaliser import RunningNormaliser
from music_rllib.tac.rl_module import TACModule

__all__ = ["DirectUpdate", "Learned"]


class Learned(NamedTuple):
    """What updates are measured by."""

    losses: dict[str, Tensor]
    """[K] each, by the metric's name."""
    observed: dict[str, Tensor]
    """As `diagnostics.of_updates` takes it."""
    ln_q_pi: Tensor
    """[K, B]"""


class DirectUpdate:
    """Updates of a module's networks from minibatches; gradients are left in `flat.gradients`.

    Args:
        module: on a CPU, of one type of floats. Its trained parameters, but for log alpha, become
            views of one tensor, and those of its averaged networks of another.
    """

    def __init__(self, module: TACModule) -> None:
        self._module = module
        named = module.named_parameters()
        trained = [p for name, p in named if p.requires_grad and name != "log_alpha"]
        self.flat = FlatParameters(trained)
        pairs = [
            (list(online.parameters()), list(target.parameters()))
            for online, target in module.get_target_network_pairs()
        ]
        self._averaged = FlatParameters([p for _, target in pairs for p in target])
        parts = [
            (self.flat.start(online[0]), *self._averaged.extent(target)) for online, target in pairs
        ]
        self._parts = np.array(parts, np.int64).reshape(-1, 3)
        self._networks: dict[int, Networks] = {}
        self._rule = self._rule_of(module)

    @property
    def is_in_use(self) -> bool:
        """Whether the parameters are still these; converting the module replaces them."""
        return self.flat.is_in_use and self._averaged.is_in_use

    def gradients(
        self, batch: Mapping[str, Tensor], entropic_index: float, alpha: float
    ) -> Learned:
        """Writes the gradients of all losses of one minibatch, and changes no network.

        Args:
            batch: documented at `TACLearner`.
            entropic_index: q.
            alpha: entropy coefficient.
        """
        empty = self.flat.values.numpy()[:0]
        no_step = Descent(empty, empty, empty, empty, empty, 0.0, 0.0, 0.0, 0.0)
        averages = Averages(empty, self._parts[:0], 0.0, 1, 0)
        return self._called(
            batch, no_step, averages, entropic_index, alpha, len(batch["discounts"])
        )

    def learn(
        self, batch: Mapping[str, Tensor], optimizer: FusedAdam, done: int, entropic_index: float,
        alpha: float,
    ) -> Learned:  # fmt: skip
        """K updates, with their steps of Adam and movements of the averaged networks.

        Args:
            batch: K minibatches behind each other, as documented at `TACLearner`.
            optimizer: of the trained parameters.
            done: updates before these.
            entropic_index: q.
            alpha: entropy coefficient.
        """
        settings = self._module.settings
        averages = Averages(
            self._averaged.values.numpy(), self._parts, settings.tau,
            settings.target_update_interval, done,
        )  # fmt: skip
        descent = optimizer.descent(self.flat)
        rows = settings.batch_size
        return self._called(batch, descent, averages, entropic_index, alpha, rows)

    def _called(
        self, batch: Mapping[str, Tensor], descent: Descent, averages: Averages, q: float,
        alpha: float, rows: int,
    ) -> Learned:  # fmt: skip
        actions = batch[Columns.ACTIONS]
        nothing, none = actions[:0], batch[Columns.REWARDS][:0]
        taken = (
            batch[Columns.OBS], actions, batch[Columns.REWARDS], batch["discounts"],
            batch[Columns.NEXT_OBS], batch.get("noise", nothing), batch.get("next_noise", nothing),
            batch.get("weights", none),
        )  # fmt: skip
        if rows not in self._networks:
            self._networks[rows] = self._networks_for(rows)
        arrays = Batch(*(values.numpy() for values in taken))
        networks, rule = self._networks[rows], self._rule
        found = learn(networks, arrays, rule, descent, averages, q, alpha, rows)
        return self._learned(*map(torch.from_numpy, found))

    def _learned(
        self, losses: Tensor, q_values: Tensor, targets: Tensor, log_density: Tensor,
        log_std: Tensor, ln_q_pi: Tensor,
    ) -> Learned:  # fmt: skip
        critics, policy, value = losses.unbind(1)
        named = {names.CRITIC_LOSS: critics, names.POLICY_LOSS: policy}
        if self._rule.has_value:
            named[names.VALUE_LOSS] = value
        observed = {"q_values": q_values, "targets": targets}
        if self._rule.stochastic:
            observed |= {"log_density": log_density, "log_std": log_std}
        return Learned(named, observed, ln_q_pi)

    # -- as compiled code takes it --------------------------------------------------------

    def _networks_for(self, rows: int) -> Networks:
        module = self._module
        policy = _perceptron(module.policy, self.flat, 2 * rows)
        critics = _critics(module.critics, self.flat, 2 * rows)
        value = value_target = policy_target = policy
        critics_target = critics
        if module.settings.bootstrap == "value":
            value = _perceptron(module.value, self.flat, rows)
            value_target = _perceptron(module.value_target, self._averaged, rows)
        else:
            critics_target = _critics(module.critics_target, self._averaged, rows)
        if module.deterministic:
            policy_target = _perceptron(module.policy_target, self._averaged, rows)
        widest = max(module.settings.hidden_sizes)
        scratch = self.flat.values.new_empty(2, 2 * rows * widest).numpy()
        return Networks(
            policy, critics, module.critics.count, value, value_target, critics_target,
            policy_target, scratch,
        )  # fmt: skip

    def _rule_of(self, module: TACModule) -> Rule:
        settings, normaliser = module.settings, module.normaliser
        mean, clip = self.flat.values.new_zeros(module.input_size), math.inf
        inverse_std = torch.ones_like(mean)
        if isinstance(normaliser, RunningNormaliser):  # it writes these in place
            mean, inverse_std, clip = normaliser.mean, normaliser.inverse_std, normaliser.clip
        low, high = settings.target_bounds or (-math.inf, math.inf)
        return Rule(
            mean=mean.numpy(),
            inverse_std=inverse_std.numpy(),
            clip=clip,
            gamma=settings.gamma,
            target_low=low,
            target_high=high,
            log_std_low=settings.log_std_bounds[0],
            log_std_high=settings.log_std_bounds[1],
            by_tanh=settings.log_std_form == "tanh",
            action_l2=settings.action_l2,
            joint=settings.entropy_form == "joint",
            first_critic=settings.policy_critic == "first",
            has_value=settings.bootstrap == "value",
            stochastic=not module.deterministic,
        )


def _perceptron(network: Perceptron, flat: FlatParameters, rows: int) -> Network:
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    weights = [flat.start(layer.weight) for layer in layers]
    biases = [flat.start(layer.bias) for layer in layers]
    sizes = [layers[0].in_features, *(layer.out_features for layer in layers)]
    return _network(flat, sizes, weights, biases, rows, by_outputs=True)


def _critics(network: Critics, flat: FlatParameters, rows: int) -> tuple[Network, Network]:
    """Each critic by itself, on the parameters of all; a single one twice."""
    sizes = [network.weights[0].shape[1], *(weight.shape[2] for weight in network.weights)]

    def critic(c: int) -> Network:
        weights = [flat.start(weight) + c * weight[c].numel() for weight in network.weights]
        biases = [flat.start(bias) + c * bias[c].numel() for bias in network.biases]
        return _network(flat, sizes, weights, biases, rows, by_outputs=False)

    return critic(0), critic(network.count - 1)


def _network(
    flat: FlatParameters, sizes: list[int], weights: list[int], biases: list[int], rows: int,
    *, by_outputs: bool,
) -> Network:  # fmt: skip
    return Network(
        values=flat.values.numpy(),
        gradients=flat.gradients.numpy(),
        sizes=np.array(sizes),
        weights=np.array(weights),
        biases=np.array(biases),
        by_outputs=by_outputs,
        kept=flat.values.new_empty(rows * sum(sizes[1:])).numpy(),
    )
