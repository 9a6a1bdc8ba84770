"""RLModules: TAC's networks, and MUSIC's estimator, which is on the Learner only."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, SelfSupervisedLossAPI, TargetNetworkAPI
from ray.rllib.core.rl_module.torch.torch_rl_module import TorchRLModule
from ray.rllib.utils.typing import StateDict
from torch import Tensor, nn

from music_rllib.config.tac_settings import LearnedAlpha, TACSettings
from music_rllib.envs.values import observation_sizes
from music_rllib.functional.squashed_gaussian import (
    bounded_log_std,
    deterministic_action,
    sample_squashed,
    squashed_action,
)
from music_rllib.intrinsic.estimator import MutualInformationEstimator
from music_rllib.tac.kernels.forward import Bootstrap, TACForward
from music_rllib.tac.networks import Critics, Floats, Perceptron
from music_rllib.tac.normaliser import RunningNormaliser

Actor = Callable[[Floats, Floats | None], Floats]
"""Inputs [B, I] and noise [B, A], or None -> actions [B, A]."""
ESTIMATOR_MODULE = "mi_estimator"
"""Module id of MUSIC's estimator in the Learner."""


class TACModule(TorchRLModule, InferenceOnlyAPI, TargetNetworkAPI):
    """The networks of TAC behind one observation normaliser.

    The paper has a policy, a value network, its average, and twin critics. `bootstrap: critics`
    replaces the value networks by averaged critics; a deterministic policy has one critic and an
    averaged policy (DDPG).

    Observations are a one-dimensional Box, or a goal dictionary, whose observation and desired goal
    are the networks' inputs. `model_config["tac"]` is a dumped `TACSettings`.

    All actions, of `act` and of RLlib's `forward_inference` and `forward_exploration`, are in
    [-1, 1], whatever the environment's bounds: a caller scales them to its action space by
    `low + (action + 1) / 2 * (high - low)`, as TAC's environment runner does.

    A subclass may have other networks. Its `setup` calls this one's, replaces `policy`, `critics`
    or `value` by modules with the same inputs and outputs, and then calls
    `make_target_networks()`; it is given by `rl_module(rl_module_spec=RLModuleSpec(...))`.
    """

    def setup(self) -> None:
        settings = self.settings = TACSettings.model_validate(self.model_config["tac"])
        observation, goal = observation_sizes(self.observation_space)
        inputs, actions = observation + goal, int(self.action_space.shape[0])
        sizes = settings.hidden_sizes
        self.input_size, self.action_size = inputs, actions
        self.deterministic = settings.policy == "deterministic"
        outputs = actions if self.deterministic else 2 * actions
        self.policy = Perceptron(inputs, sizes, outputs)
        count = 1 if self.deterministic else 2
        self.critics = Critics(inputs + actions, sizes, count)
        if settings.bootstrap == "value":
            self.value = Perceptron(inputs, sizes, 1)
        self.normaliser: nn.Module = nn.Identity()
        if settings.normalise_observations:
            self.normaliser = RunningNormaliser(
                inputs, epsilon=settings.normaliser_epsilon, clip=settings.observation_clip
            )
        if isinstance(settings.alpha, LearnedAlpha):
            self.log_alpha = nn.Parameter(torch.tensor(settings.alpha.initial).log())
        self.make_target_networks()

    def policy_parameters(self, normalised: Tensor) -> tuple[Tensor, Tensor | None]:
        """[B, I] -> mean [B, A] before tanh, log standard deviation [B, A] within its bounds."""
        return self.distribution(self.policy(normalised))

    def distribution(self, outputs: Tensor) -> tuple[Tensor, Tensor | None]:
        """Mean and log standard deviation from the outputs of the policy's network."""
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
        """`act` of arrays by the weights as they are now, on a CPU."""
        if type(self) is not TACModule:
            return self._actor_in_torch
        policy, normaliser = self.policy.in_numpy(), self.normaliser
        normalise = normaliser.in_numpy() if isinstance(normaliser, RunningNormaliser) else None

        @torch.no_grad()
        def act(inputs: Floats, noise: Floats | None) -> Floats:
            outputs = policy(inputs if normalise is None else normalise(inputs))
            drawn = None if noise is None else torch.from_numpy(noise)
            return self._action(torch.from_numpy(outputs), drawn).numpy()

        return act

    def _actor_in_torch(self, inputs: Floats, noise: Floats | None) -> Floats:
        drawn = None if noise is None else torch.from_numpy(noise)
        actions: Floats = self.act(torch.from_numpy(inputs), drawn).numpy()
        return actions

    def _action(self, outputs: Tensor, noise: Tensor | None) -> Tensor:
        mean, log_std = self.distribution(outputs)
        if noise is None or log_std is None:
            return deterministic_action(mean)
        return squashed_action(mean, log_std, noise)

    def _forward_inference(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        """Actions in [-1, 1], which the caller scales."""
        return {Columns.ACTIONS: self.act(_network_inputs(batch[Columns.OBS]))}

    def _forward_exploration(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        inputs = _network_inputs(batch[Columns.OBS])
        noise = torch.randn(inputs.shape[0], self.action_size, device=inputs.device)
        return {Columns.ACTIONS: self.act(inputs, noise)}

    def _forward_train(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        """All that the losses need; `batch` is documented at `TACLearner`."""
        inputs = self.normaliser(batch[Columns.OBS])
        mean, log_std = self.policy_parameters(inputs)
        action, log_density = choose_action(mean, log_std, batch.get("noise"))
        return {
            "tac": TACForward(
                action=action,
                log_density=log_density,
                log_std=log_std,
                q_values=self.critics(torch.cat([inputs, batch[Columns.ACTIONS]], -1)),
                q_of_policy=self.critics(torch.cat([inputs, action], -1), frozen=True),
                value=self.value(inputs).squeeze(-1) if self._has_value else None,
                next=self.forward_target(batch),
            )
        }

    def train(self, mode: bool = True) -> TACModule:
        """Skips a mode that is already set: RLlib sets it for each update, which took 3 % of it."""
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
            action, log_density = choose_action(
                *self.policy_parameters(inputs), batch["next_noise"]
            )
        return Bootstrap(self.critics_target(torch.cat([inputs, action], -1)).amin(0), log_density)

    def make_target_networks(self) -> None:
        for name in self._averaged:
            target = copy.deepcopy(getattr(self, name)).requires_grad_(False)
            setattr(self, f"{name}_target", target)

    @property
    def _averaged(self) -> tuple[str, ...]:
        if self._has_value:
            return ("value",)
        return ("critics", "policy") if self.deterministic else ("critics",)

    def get_target_network_pairs(self) -> list[tuple[nn.Module, nn.Module]]:
        return [(getattr(self, name), getattr(self, f"{name}_target")) for name in self._averaged]

    # RLlib's own get_state and set_state round the normaliser's float64 moments to float32.

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
        """Loads the tensors of `state` that this module has."""
        own = self.state_dict()
        known = {name: torch.tensor(state[name]) for name in own if name in state}
        if self.inference_only and (missing := own.keys() - known.keys()):
            raise ValueError(f"the state lacks {', '.join(sorted(missing))}")
        self.load_state_dict(known, strict=False)

    def get_non_inference_attributes(self) -> list[str]:
        """Networks that acting does not need."""
        targets = [f"{name}_target" for name in self._averaged]
        return ["critics", "value", "log_alpha", *targets]


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


def choose_action(
    mean: Tensor, log_std: Tensor | None, noise: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """Action [B, A] and its log-density [B, A]; None for a deterministic policy."""
    if log_std is None or noise is None:
        return deterministic_action(mean), None
    sample = sample_squashed(mean, log_std, noise)
    return sample.action, sample.log_density


def _network_inputs(observation: Any) -> Tensor:
    """The observation, or the observation and desired goal of a goal dictionary, as a tensor."""
    if isinstance(observation, dict):
        return torch.cat([observation["observation"], observation["desired_goal"]], dim=-1).float()
    return torch.as_tensor(observation).float()
