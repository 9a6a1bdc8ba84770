"""The seam between TAC's Learner and `music_rllib.kernels`: updates of a module without autograd.

The results equal autograd's to rounding, in about half of its time.

Shape legend: K updates, B batch, I network inputs, A action dimensions, C critics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from torch import Tensor, nn

from music_rllib import names
from music_rllib.kernels.adam import AdamStep, FlatParameters, FusedAdam, flushed_denormals
from music_rllib.kernels.blas import use_threads
from music_rllib.kernels.distribution import Distribution
from music_rllib.kernels.layers import Array, Network, Normalized
from music_rllib.kernels.update import AlphaStep, Averages, Batch, Networks, UpdateSettings, learn
from music_rllib.tac.networks import Critics, Perceptron, RunningNormaliser
from music_rllib.tac.rl_module import EstimatorModule, TACModule

__all__ = [
    "CompiledUpdate", "FusedAdam", "Learned", "flushed_denormals", "needs_autograd",
    "postprocesses_gradients", "use_threads",
]  # fmt: skip

HOOKS = (
    "configure_optimizers", "configure_optimizers_for_module", "compute_losses",
    "compute_loss_for_module", "loss_of_trajectories", "compute_gradients",
    "postprocess_gradients", "postprocess_gradients_for_module", "apply_gradients",
    "_update", "_uncompiled_update", "_step", "_losses_of", "_update_targets",
)  # fmt: skip
"""Methods that only updates by autograd call; a Learner that overrides one needs autograd."""


def needs_autograd(
    learner: type, base: type, config: AlgorithmConfig, module: nn.Module, estimator: Any
) -> bool:
    """Whether a Learner needs updates by autograd.

    It does if it overrides one of `HOOKS` of `base`, if its networks or the estimator's loss are
    not TAC's, or if RLlib clips, logs, checks or exchanges gradients or changes learning rates.
    """
    own_hooks = any(getattr(learner, hook) is not getattr(base, hook) for hook in HOOKS)
    own_loss = (
        isinstance(estimator, EstimatorModule)
        and type(estimator).compute_self_supervised_loss
        is not EstimatorModule.compute_self_supervised_loss
    )
    uses_gradients = (
        config.grad_clip is not None
        or config.log_gradients
        or not config.torch_skip_nan_gradients
        or config._torch_lr_scheduler_classes is not None
        or config.num_learners > 1
    )
    return own_hooks or own_loss or uses_gradients or type(module) is not TACModule


def postprocesses_gradients(learner: type[TorchLearner], config: AlgorithmConfig) -> bool:
    """Whether RLlib's part of `postprocess_gradients` has anything to do."""
    own = learner.postprocess_gradients_for_module
    is_own = own is not TorchLearner.postprocess_gradients_for_module
    return is_own or config.grad_clip is not None or config.log_gradients


class Learned(NamedTuple):
    """Results of K updates, for metrics."""

    losses: dict[str, Tensor]
    """[K] each, by the metric's name."""
    observed: dict[str, Tensor]
    """Arguments of `diagnostics.of_updates`."""


class CompiledUpdate:
    """Updates a module's networks from minibatches; gradients are left in `flat.gradients`.

    Args:
        module: on a CPU, of one type of floats. Its trained parameters except log alpha become
            views of one tensor, and the parameters of its target networks of another.
    """

    def __init__(self, module: TACModule) -> None:
        self._module = module
        named = list(module.named_parameters())
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
        policy = list(module.policy.parameters())
        self._of_policy = self.flat.start(next(iter(module.critics.parameters()))), len(policy)
        of_alpha = [p for name, p in named if name == "log_alpha"]
        self._log_alpha = FlatParameters(of_alpha) if of_alpha else None
        self._networks = self._arguments(module)
        self._settings = _settings_of(module)

    @property
    def is_in_use(self) -> bool:
        """Whether the parameters are still views; converting the module replaces them."""
        flat = (self.flat, self._averaged, self._log_alpha)
        return all(one is None or one.is_in_use for one in flat)

    def learn(
        self, batch: Mapping[str, Tensor], optimizer: FusedAdam | None, done: int,
        entropic_index: float, alpha: float, tuned: tuple[FusedAdam, int, float] | None = None,
    ) -> Learned:  # fmt: skip
        """K updates, with their steps of Adam, of the target networks and of a learned alpha.

        Args:
            batch: K concatenated minibatches, as documented in `minibatches`.
            optimizer: Adam of the trained parameters. None: only compute gradients.
            done: number of updates before these.
            tuned: Adam of ln alpha, and measure and target of `alpha_loss_backward`. None:
                alpha is fixed.
        """
        settings = self._module.settings
        empty = self.flat.values.numpy()[:0]
        nothing = AdamStep(empty, empty, empty, empty, empty, 0.0, 0.0, 0.0, 0.0)
        if optimizer is None:
            policy_step = step = nothing
            parts = self._parts[:0]
        else:
            policy_step, step = optimizer.step_of(self.flat).split(*self._of_policy)
            parts = self._parts
        averages = Averages(
            self._averaged.values.numpy(), parts, settings.tau, settings.target_update_interval,
            done,
        )  # fmt: skip
        actions, rewards = batch[Columns.ACTIONS], batch[Columns.REWARDS]
        columns = (
            batch[Columns.OBS], actions, rewards, batch["discounts"], batch[Columns.NEXT_OBS],
            batch.get("noise", actions[:0]), batch.get("next_noise", actions[:0]),
            batch.get("weights", rewards[:0]),
            batch.get("target_critics", self._all_critics(rewards)),
        )  # fmt: skip
        arrays = Batch(*(values.numpy() for values in columns))
        alpha_step = AlphaStep(nothing, 0, 0.0)
        if tuned is not None and self._log_alpha is not None:
            alpha_step = AlphaStep(tuned[0].step_of(self._log_alpha), *tuned[1:])
        found = learn(
            self._networks, arrays, self._settings, policy_step, step, averages, alpha_step,
            entropic_index, alpha, settings.batch_size,
        )  # fmt: skip
        losses, q_values, targets, log_density, log_std, _ = map(torch.from_numpy, found)
        critics, policy, value = losses.unbind(1)
        named = {names.CRITIC_LOSS: critics, names.POLICY_LOSS: policy}
        if self._settings.has_value:
            named[names.VALUE_LOSS] = value
        observed = {"q_values": q_values, "targets": targets}
        if self._settings.distribution.stochastic:
            observed |= {"log_density": log_density, "log_std": log_std}
        return Learned(named, observed)

    def _all_critics(self, rewards: Tensor) -> Tensor:
        """[K*C] every critic for each update of [K*B] rows."""
        updates = len(rewards) // self._module.settings.batch_size
        return torch.arange(self._module.critics.count).repeat(updates)

    def _arguments(self, module: TACModule) -> Networks:
        """The module's networks as kernels take them, for minibatches of its `batch_size`."""
        rows = module.settings.batch_size
        policy = _perceptron(module.policy, self.flat, 2 * rows)
        critics = _critics(module.critics, self.flat, 2 * rows, kept=module.critics.count)
        value = value_target = policy_target = policy
        critics_target = critics
        if module.settings.bootstrap == "value":
            value = _perceptron(module.value, self.flat, rows)
            value_target = _perceptron(module.value_target, self._averaged, rows)
        else:
            critics_target = _critics(module.critics_target, self._averaged, rows, kept=1)
        if module.deterministic:
            policy_target = _perceptron(module.policy_target, self._averaged, rows)
        widest = max(module.settings.hidden_sizes)
        scratch = self.flat.values.new_empty(2, 2 * rows * widest).numpy()
        return Networks(
            policy, critics, value, value_target, critics_target, policy_target, scratch,
        )  # fmt: skip


def _settings_of(module: TACModule) -> UpdateSettings:
    settings, normaliser = module.settings, module.normaliser
    count, fractions = module.critics.count, module.quantile_fractions
    mean, clip = next(module.policy.parameters()).new_zeros(module.input_size), math.inf
    inverse_std = torch.ones_like(mean)
    if isinstance(normaliser, RunningNormaliser):  # it writes these in place
        mean, inverse_std, clip = normaliser.mean, normaliser.inverse_std, normaliser.clip
    target_low, target_high = settings.target_bounds or (-math.inf, math.inf)
    log_std_low, log_std_high = settings.log_std_bounds
    return UpdateSettings(
        mean=mean.detach().numpy(),
        inverse_std=inverse_std.detach().numpy(),
        clip=clip,
        gamma=settings.gamma,
        target_low=target_low,
        target_high=target_high,
        distribution=Distribution(
            stochastic=not module.deterministic,
            log_std_low=log_std_low,
            log_std_high=log_std_high,
            by_tanh=settings.log_std_form == "tanh",
        ),
        action_l2=settings.action_l2,
        joint=settings.entropy_form == "joint",
        averaged_critics={"min": 0, "first": 1, "mean": count}[settings.policy_critic],
        has_value=settings.bootstrap == "value",
        fractions=mean.numpy()[:0] if fractions is None else fractions.to(mean).numpy(),
        dropped_quantiles=settings.dropped_quantiles,
        policy_delay=settings.policy_delay,
    )


def _perceptron(network: Perceptron, flat: FlatParameters, rows: int) -> Network:
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    weights = [flat.start(layer.weight) for layer in layers]
    biases = [flat.start(layer.bias) for layer in layers]
    sizes = [layers[0].in_features, *(layer.out_features for layer in layers)]
    return _network(
        flat, sizes, weights, biases, rows, by_outputs=True, layer_norm=network.layer_norm
    )


def _critics(network: Critics, flat: FlatParameters, rows: int, *, kept: int) -> Network:
    """All critics, with room for the outputs of `kept` of them."""
    sizes = [network.weights[0].shape[1], *(weight.shape[2] for weight in network.weights)]

    def starts(parameters: nn.ParameterList) -> list[list[int]]:
        return [
            [flat.start(parameter) + c * parameter[c].numel() for parameter in parameters]
            for c in range(network.count)
        ]

    return _network(
        flat, sizes, starts(network.weights), starts(network.biases), rows, kept, by_outputs=False,
        layer_norm=network.layer_norm,
    )  # fmt: skip


def _network(
    flat: FlatParameters, sizes: list[int], weights: Any, biases: Any, rows: int, *kept: int,
    by_outputs: bool, layer_norm: bool,
) -> Network:  # fmt: skip
    def room(numbers: int) -> Array:
        return flat.values.new_empty(*kept, rows * numbers).numpy()

    normalized = sizes[1:-1] if layer_norm else []
    return Network(
        values=flat.values.numpy(),
        gradients=flat.gradients.numpy(),
        sizes=np.array(sizes),
        weights=np.array(weights),
        biases=np.array(biases),
        by_outputs=by_outputs,
        kept=room(sum(sizes[1:])),
        normalized=Normalized(room(sum(normalized)), room(len(normalized))),
    )
