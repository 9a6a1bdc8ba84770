"""RLModules: TAC's networks, MUSIC's estimator, and the weights of both as arrays.

Shape legend: B batch, I network inputs, A action dimensions, C critics, M quantiles of a critic,
T atoms of a target.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, SelfSupervisedLossAPI, TargetNetworkAPI
from ray.rllib.core.rl_module.torch.torch_rl_module import TorchRLModule
from ray.rllib.utils.typing import StateDict
from torch import Tensor, nn

from music_rllib.config.tac_settings import LearnedAlpha, TACSettings
from music_rllib.envs.values import observation_sizes
from music_rllib.functional.actor_critic import smallest_atoms
from music_rllib.functional.distribution import bounded_log_std, sample_squashed, squashed_action
from music_rllib.intrinsic.estimator import MutualInformationEstimator
from music_rllib.tac.networks import Critics, Floats, Perceptron, RunningNormaliser

Actor = Callable[[Floats, Floats | None], Floats]
"""Inputs [B, I] and noise [B, A], or None -> actions [B, A]."""
ESTIMATOR_MODULE = "mi_estimator"
"""Module id of MUSIC's estimator in the Learner."""
NetworkWeights = dict[str, dict[str, NDArray[Any]]]
"""Arrays by network name (policy, critics, value, normaliser, mi_estimator, ...) and array name."""


class Bootstrap(NamedTuple):
    """Values of the next states by the target networks."""

    value: Tensor
    """[B] V of the averaged value network, or the smallest averaged critic at the next action; with
    quantiles [B, T] the smallest ones of all averaged critics."""
    log_density: Tensor | None = None
    """[B, A] of the next action, whose entropy is not in a critic's value; None if V includes it
    or the policy is deterministic."""


class TACForward(NamedTuple):
    """Outputs of the networks for one minibatch, from which the losses are computed."""

    action: Tensor
    """[B, A] of the current policy at the batch's states."""
    log_density: Tensor | None
    """[B, A] of that action; None for a deterministic policy."""
    log_std: Tensor | None
    """[B, A]; None for a deterministic policy."""
    q_values: Tensor
    """[C, B] critics at the batch's actions, or [C, B, M] their quantiles."""
    q_of_policy: Tensor
    """[C, B] critics with frozen weights at the policy's actions, means of quantiles."""
    value: Tensor | None
    """[B]; None without a value network."""
    next: Bootstrap


class TACModule(TorchRLModule, InferenceOnlyAPI, TargetNetworkAPI):
    """The networks of TAC behind one observation normalizer.

    The paper has a policy, a value network, its moving average, and twin critics. With
    `bootstrap: critics`, averaged critics replace the value networks; a deterministic policy has
    one critic and an averaged policy (DDPG).

    Observations are a one-dimensional Box, or a goal dictionary, whose observation and desired goal
    are the networks' inputs. `model_config["tac"]` is a `TACSettings`.

    All actions, of `act` and of RLlib's `forward_inference` and `forward_exploration`, are in
    [-1, 1] for any bounds of the environment. The caller scales them to its action space by
    `low + (action + 1) / 2 * (high - low)`, as TAC's environment runner does.

    A subclass may have other networks. Its `setup` calls this one's, replaces `policy`, `critics`
    or `value` by modules with the same inputs and outputs, and then calls
    `make_target_networks()`, which checks them. Set it by
    `rl_module(rl_module_spec=RLModuleSpec(...))`.

    - `policy`: [B, I] -> [B, 2A] means and raw log standard deviations, or [B, A] if it is
      deterministic.
    - `value`: [B, I] -> [B, 1], with `bootstrap: value`.
    - `critics`: [B, I + A] -> [C, B], with quantiles [C, B, M]. With the argument `frozen=True`,
      gradients reach only the inputs.
    """

    def setup(self) -> None:
        settings: TACSettings = self.model_config["tac"]
        self.settings = settings
        observation, goal = observation_sizes(self.observation_space)
        inputs, actions = observation + goal, int(self.action_space.shape[0])
        sizes = settings.hidden_sizes
        self.input_size, self.action_size = inputs, actions
        self.deterministic = settings.policy == "deterministic"
        outputs = actions if self.deterministic else 2 * actions
        every = settings.layer_norm == "all"
        self.policy = Perceptron(inputs, sizes, outputs, layer_norm=every)
        of_critics = settings.layer_norm != "none"
        self.critics = Critics(
            inputs + actions, sizes, settings.critic_count, layer_norm=of_critics,
            quantiles=settings.quantiles,
        )  # fmt: skip
        if settings.bootstrap == "value":
            self.value = Perceptron(inputs, sizes, 1, layer_norm=every)
        self.normaliser: nn.Module = nn.Identity()
        if settings.normalise_observations:
            self.normaliser = RunningNormaliser(
                inputs, epsilon=settings.normaliser_epsilon, clip=settings.observation_clip
            )
        if isinstance(settings.alpha, LearnedAlpha):
            self.log_alpha = nn.Parameter(torch.tensor(settings.alpha.initial).log())
        self.make_target_networks()

    # -- acting -------------------------------------------------------------------------------

    def policy_parameters(self, normalised: Tensor) -> tuple[Tensor, Tensor | None]:
        """[B, I] -> mean [B, A] before tanh, log standard deviation [B, A] within its bounds."""
        return self._parameters_of(self.policy(normalised))

    def _parameters_of(self, outputs: Tensor) -> tuple[Tensor, Tensor | None]:
        if self.deterministic:
            return outputs, None
        mean, raw = outputs.chunk(2, dim=-1)
        settings = self.settings
        return mean, bounded_log_std(raw, settings.log_std_bounds, settings.log_std_form)

    @torch.no_grad()
    def act(self, inputs: Tensor, noise: Tensor | None = None) -> Tensor:
        """[B, I] -> [B, A] in [-1, 1]: a sample for standard normal noise [B, A], or tanh(mean)."""
        return self._action(self.policy(self.normaliser(inputs)), noise)

    def actor(self) -> Actor:
        """`act` on arrays with the current weights, on a CPU."""
        if type(self) is not TACModule:
            return lambda inputs, noise: self.act(torch.from_numpy(inputs), _tensor(noise)).numpy()
        policy, normaliser = self.policy.in_numpy(), self.normaliser
        normalise = normaliser.in_numpy() if isinstance(normaliser, RunningNormaliser) else None

        @torch.no_grad()
        def act(inputs: Floats, noise: Floats | None) -> Floats:
            outputs = policy(inputs if normalise is None else normalise(inputs))
            return self._action(torch.from_numpy(outputs), _tensor(noise)).numpy()

        return act

    def _action(self, outputs: Tensor, noise: Tensor | None) -> Tensor:
        mean, log_std = self._parameters_of(outputs)
        if noise is None or log_std is None:
            return torch.tanh(mean)
        return squashed_action(mean, log_std, noise)

    def _forward_inference(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTIONS: self.act(_network_inputs(batch[Columns.OBS]))}

    def _forward_exploration(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        inputs = _network_inputs(batch[Columns.OBS])
        noise = torch.randn(inputs.shape[0], self.action_size, device=inputs.device)
        return {Columns.ACTIONS: self.act(inputs, noise)}

    # -- learning -----------------------------------------------------------------------------

    def sample_with_density(
        self, normalised: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """[B, I] -> [B, A] actions, their log-densities, ln std; the last two None for DDPG."""
        mean, log_std = self.policy_parameters(normalised)
        if log_std is None or noise is None:
            return torch.tanh(mean), None, None
        return *sample_squashed(mean, log_std, noise), log_std

    def _forward_train(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        """The `TACForward` of a minibatch with the columns documented in `minibatches`."""
        inputs = self.normaliser(batch[Columns.OBS])
        action, log_density, log_std = self.sample_with_density(inputs, batch.get("noise"))
        return {
            "tac": TACForward(
                action=action,
                log_density=log_density,
                log_std=log_std,
                q_values=self.critics(torch.cat([inputs, batch[Columns.ACTIONS]], -1)),
                q_of_policy=mean_values(self.critics(torch.cat([inputs, action], -1), frozen=True)),
                value=self.value(inputs).squeeze(-1) if self._has_value else None,
                next=self.forward_target(batch),
            )
        }

    def train(self, mode: bool = True) -> TACModule:
        """Skip a mode that is already set: RLlib sets it for each update, 3% of an update."""
        return self if self.training == mode else super().train(mode)

    @property
    def _has_value(self) -> bool:
        return self.settings.bootstrap == "value"

    @torch.no_grad()
    def forward_target(self, batch: dict[str, Any]) -> Bootstrap:
        """The target networks' values of the next states."""
        inputs = self.normaliser(batch[Columns.NEXT_OBS])
        if self._has_value:
            return Bootstrap(self.value_target(inputs).squeeze(-1))
        if self.deterministic:
            action, log_density = torch.tanh(self.policy_target(inputs)), None
        else:
            action, log_density, _ = self.sample_with_density(inputs, batch["next_noise"])
        outputs = self.critics_target(torch.cat([inputs, action], -1))
        if (which := batch.get("target_critics")) is not None:
            outputs = outputs[which]
        if self.settings.quantiles:
            values = smallest_atoms(outputs, self.settings.dropped_quantiles)
        else:
            values = outputs.amin(0)
        return Bootstrap(values, log_density)

    @property
    def quantile_fractions(self) -> Tensor | None:
        """[M] middles of M equal parts of [0, 1]; None if critics have no quantiles."""
        count = self.settings.quantiles
        if not count:
            return None
        like = next(self.critics.parameters())
        return (torch.arange(count, dtype=like.dtype, device=like.device) + 0.5) / count

    def make_target_networks(self) -> None:
        """Copy the networks whose averages are bootstrapped from; ValueError for unfit networks."""
        if type(self) is not TACModule:
            self._check_networks()
        for name in self._averaged:
            target = copy.deepcopy(getattr(self, name)).requires_grad_(False)
            setattr(self, f"{name}_target", target)

    def _check_networks(self) -> None:
        """Raise ValueError for networks of other shapes, which would broadcast in the losses."""
        rows, settings = 3, self.settings
        quantiles = (settings.quantiles,) if settings.quantiles else ()
        inputs = torch.zeros(rows, self.input_size)
        pairs = torch.zeros(rows, self.input_size + self.action_size, requires_grad=True)
        # In evaluation mode, batch normalization keeps its statistics.
        critics = copy.deepcopy(self.critics).eval()
        outputs = self.action_size if self.deterministic else 2 * self.action_size
        # A network may draw from the generator; a user's module may have disabled gradients.
        with torch.random.fork_rng(devices=[]), torch.enable_grad():
            self._check("policy", copy.deepcopy(self.policy).eval()(inputs), rows, outputs)
            if self._has_value:
                self._check("value", copy.deepcopy(self.value).eval()(inputs), rows, 1)
            self._check("critics", critics(pairs), settings.critic_count, rows, *quantiles)
            frozen = critics(pairs, frozen=True)
            self._check("critics", frozen, settings.critic_count, rows, *quantiles)
            total = frozen.sum()
        trained = [each for each in critics.parameters() if each.requires_grad]
        reached = [False]
        if total.requires_grad:
            found = torch.autograd.grad(total, [pairs, *trained], allow_unused=True)
            reached = [each is not None for each in found]
        if not reached[0] or any(reached[1:]):
            raise ValueError(
                f"{type(self).__name__}.critics with frozen=True must give gradients to its inputs "
                "and not to its parameters"
            )

    def _check(self, name: str, found: Tensor, *shape: int) -> None:
        if found.shape != shape:
            raise ValueError(
                f"{type(self).__name__}.{name} must return the shape {list(shape)} for 3 rows of "
                f"inputs, got {list(found.shape)}"
            )

    @property
    def _averaged(self) -> tuple[str, ...]:
        if self._has_value:
            return ("value",)
        return ("critics", "policy") if self.deterministic else ("critics",)

    def get_target_network_pairs(self) -> list[tuple[nn.Module, nn.Module]]:
        return [(getattr(self, name), getattr(self, f"{name}_target")) for name in self._averaged]

    # -- state: RLlib's own methods round the normalizer's float64 moments to float32 ------------

    def get_state(
        self, components: Any = None, *, inference_only: bool = False, **kwargs: Any
    ) -> StateDict:
        """Copies of all tensors as arrays; with `inference_only`, of those that acting needs."""
        excluded = self.get_non_inference_attributes() if inference_only else []
        return {
            name: tensor.detach().cpu().numpy().copy()
            for name, tensor in self.state_dict().items()
            if name.partition(".")[0] not in excluded
        }

    def set_state(self, state: StateDict) -> None:
        """Load the tensors of `state` that this module has."""
        own = self.state_dict()
        known = {name: torch.tensor(state[name]) for name in own if name in state}
        if self.inference_only and (missing := own.keys() - known.keys()):
            raise ValueError(f"the state lacks {', '.join(sorted(missing))}")
        self.load_state_dict(known, strict=False)

    def get_non_inference_attributes(self) -> list[str]:
        """Networks that acting does not need."""
        targets = [f"{name}_target" for name in self._averaged]
        return ["critics", "value", "log_alpha", *targets]


def mean_values(outputs: Tensor) -> Tensor:
    """[C, B] values of critics from their outputs, [C, B] or quantiles [C, B, M]."""
    return outputs.mean(-1) if outputs.ndim == 3 else outputs


class EstimatorModule(TorchRLModule, SelfSupervisedLossAPI):
    """MUSIC's estimator; lives on the Learner only and is trained on whole trajectories.

    `model_config` has the arguments of `MutualInformationEstimator`.
    """

    def setup(self) -> None:
        self.estimator = MutualInformationEstimator(**self.model_config)

    def _forward_train(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {}  # the intrinsic reward computes the bound in its loss

    def compute_self_supervised_loss(
        self, *, learner: Any, module_id: str, config: Any, batch: Any, fwd_out: dict[str, Tensor]
    ) -> Tensor:
        loss: Tensor = learner.loss_of_trajectories(batch)
        return loss


def _network_inputs(observation: Any) -> Tensor:
    """The observation, or the observation and desired goal of a goal dictionary, as a tensor."""
    if isinstance(observation, dict):
        return torch.cat([observation["observation"], observation["desired_goal"]], dim=-1).float()
    return torch.as_tensor(observation).float()


def _tensor(array: Floats | None) -> Tensor | None:
    return None if array is None else torch.from_numpy(array)


# -- network weights ------------------------------------------------------------------------------


def weights_by_network(state: Mapping[str, Mapping[str, Any]]) -> NetworkWeights:
    """The network weights in the states of the Learner's modules."""
    weights: NetworkWeights = {}
    for name, array in state[DEFAULT_MODULE_ID].items():
        network, _, rest = name.partition(".")
        weights.setdefault(network, {})[rest or network] = np.asarray(array)
    if ESTIMATOR_MODULE in state:
        weights[ESTIMATOR_MODULE] = {
            name.removeprefix("estimator."): np.asarray(array)
            for name, array in state[ESTIMATOR_MODULE].items()
        }
    return weights


def states_by_module(
    weights: Mapping[str, Mapping[str, NDArray[Any]]], own: NetworkWeights
) -> dict[str, dict[str, NDArray[Any]]]:
    """The states of the Learner's modules with the weights of some networks.

    `own` has the current weights of all networks. Raises ValueError for an unknown network, and for
    missing, unknown or misshapen tensors.
    """
    modules: dict[str, dict[str, NDArray[Any]]] = {}
    for network, arrays in weights.items():
        _check_same_tensors(network, own.get(network), arrays)
        module = ESTIMATOR_MODULE if network == ESTIMATOR_MODULE else DEFAULT_MODULE_ID
        prefix = "estimator" if network == ESTIMATOR_MODULE else network
        for name, array in arrays.items():
            # A tensor of the module itself, as a learned alpha, is named as its network.
            key = name if name == network else f"{prefix}.{name}"
            modules.setdefault(module, {})[key] = array
    return modules


def _check_same_tensors(
    network: str,
    own: Mapping[str, NDArray[Any]] | None,
    given: Mapping[str, NDArray[Any]],
) -> None:
    if own is None:
        raise ValueError(f"{network}: this algorithm has no such network")
    if own.keys() != given.keys():
        missing, unknown = sorted(own.keys() - given.keys()), sorted(given.keys() - own.keys())
        raise ValueError(
            f"{network}: tensors missing: {missing or 'none'}, unknown: {unknown or 'none'}"
        )
    for name, array in given.items():
        if array.shape != own[name].shape:
            raise ValueError(
                f"{network}.{name}: shape must be {own[name].shape}, got {array.shape}"
            )
