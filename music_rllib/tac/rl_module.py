"""RLModules: TAC's five networks, and MUSIC's estimator beside them on the Learner."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, SelfSupervisedLossAPI, TargetNetworkAPI
from ray.rllib.core.rl_module.torch.torch_rl_module import TorchRLModule
from ray.rllib.utils.typing import StateDict
from torch import Tensor, nn

from music_rllib.config.tac_settings import LearnedAlpha, TACSettings
from music_rllib.envs.make import observation_sizes
from music_rllib.functional.squashed_gaussian import (
    bounded_log_std,
    deterministic_action,
    sample_squashed,
    squashed_action,
)
from music_rllib.intrinsic.estimator import MutualInformationEstimator, intrinsic_reward, two_frames
from music_rllib.optim.adam import FusedAdam
from music_rllib.tac.kernels.forward import Bootstrap, TACForward
from music_rllib.tac.networks import Critics, Perceptron
from music_rllib.tac.normaliser import RunningNormaliser

__all__ = [
    "ESTIMATOR_MODULE",
    "EstimatorModule",
    "TACModule",
    "choose_action",
]

ESTIMATOR_MODULE = "mi_estimator"
"""Module id of MUSIC's estimator in the Learner."""


class TACModule(TorchRLModule, InferenceOnlyAPI, TargetNetworkAPI):
    """The networks of TAC behind one observation normaliser.

    In the paper's form: policy, value, averaged value and twin critics. `bootstrap: critics` has
    averaged critics in the value networks' place; a deterministic policy has one critic, and an
    average of itself (DDPG).

    Observations are a one-dimensional Box, or a goal dictionary, of which the networks see
    observation and desired goal. `model_config["tac"]` is a dumped `TACSettings`.
    """

    def setup(self) -> None:
        settings = self.settings = TACSettings.model_validate(self.model_config["tac"])
        observation, goal = observation_sizes(self.observation_space)
        inputs, actions = observation + goal, int(self.action_space.shape[0])
        sizes = settings.hidden_sizes
        self.input_size, self.action_size = inputs, actions
        self.deterministic = settings.policy == "deterministic"
        # Acting is a few rows at a time, on machines of any kind.
        bf16 = settings.precision == "bf16" and not self.inference_only
        outputs = actions if self.deterministic else 2 * actions
        self.policy = Perceptron(inputs, sizes, outputs, bf16=bf16)
        count = 1 if self.deterministic else 2
        self.critics = Critics(inputs + actions, sizes, count, bf16=bf16)
        if settings.bootstrap == "value":
            self.value = Perceptron(inputs, sizes, 1, bf16=bf16)
        self.normaliser: nn.Module = nn.Identity()
        if settings.normalise_observations:
            self.normaliser = RunningNormaliser(
                inputs, epsilon=settings.normaliser_epsilon, clip=settings.observation_clip
            )
        if isinstance(settings.alpha, LearnedAlpha):
            self.log_alpha = nn.Parameter(torch.tensor(settings.alpha.initial).log())
        self.make_target_networks()

    # -- acting ---------------------------------------------------------------------------

    def policy_parameters(self, normalised: Tensor) -> tuple[Tensor, Tensor | None]:
        """[B, I] -> mean [B, A] before tanh, log standard deviation [B, A] within its bounds."""
        return self.distribution(self.policy(normalised))

    def distribution(self, outputs: Tensor) -> tuple[Tensor, Tensor | None]:
        """What the outputs of the policy's network stand for: mean and log standard deviation."""
        if self.deterministic:
            return outputs, None
        mean, raw = outputs.chunk(2, dim=-1)
        settings = self.settings
        return mean, bounded_log_std(raw, settings.log_std_bounds, settings.log_std_form)

    @torch.no_grad()
    def act(self, inputs: Tensor, noise: Tensor | None = None) -> Tensor:
        """[B, I] -> [B, A] in [-1, 1]: a sample for standard normal noise [B, A], or tanh(mean)."""
        mean, log_std = self.policy_parameters(self.normaliser(inputs))
        if noise is None or log_std is None:
            return deterministic_action(mean)
        return squashed_action(mean, log_std, noise)

    def _forward_inference(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTIONS: self.act(_network_inputs(batch[Columns.OBS]))}

    def _forward_exploration(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        inputs = _network_inputs(batch[Columns.OBS])
        noise = torch.randn(inputs.shape[0], self.action_size, device=inputs.device)
        return {Columns.ACTIONS: self.act(inputs, noise)}

    # -- learning -------------------------------------------------------------------------

    def _forward_train(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        """Everything the losses need; `batch` is documented at `TACLearner`."""
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
        """As ever, but fast: RLlib asks for each update, of which all layers took 3 %."""
        return self if self.training == mode else super().train(mode)

    @property
    def _has_value(self) -> bool:
        return self.settings.bootstrap == "value"

    @torch.no_grad()
    def forward_target(self, batch: dict[str, Any]) -> Bootstrap:
        """The target networks at the next states."""
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
        """Copies of all tensors as arrays; for acting only, without what that does not need."""
        left_out = set(self.get_non_inference_attributes()) if inference_only else set()
        return {
            name: tensor.detach().cpu().numpy().copy()
            for name, tensor in self.state_dict().items()
            if name.partition(".")[0] not in left_out
        }

    def set_state(self, state: StateDict) -> None:
        """Takes over the tensors of `state` that this module has."""
        own = self.state_dict()
        known = {name: torch.tensor(state[name]) for name in own if name in state}
        if self.inference_only and (missing := own.keys() - known.keys()):
            raise ValueError(f"the state lacks {', '.join(sorted(missing))}")
        self.load_state_dict(known, strict=False)

    def get_non_inference_attributes(self) -> list[str]:
        targets = [f"{name}_target" for name in self._averaged]
        return ["critics", "value", "log_alpha", *targets]


class EstimatorModule(TorchRLModule, SelfSupervisedLossAPI):
    """MUSIC's estimator; lives on the Learner only and is trained on whole trajectories.

    `model_config`: `agent_indices` and `surrounding_indices` into the observation,
    `hidden_size`, `reward_scale`.
    """

    agent: Tensor
    surrounding: Tensor

    def setup(self) -> None:
        config = self.model_config
        for half in ("agent", "surrounding"):
            # A buffer moves to the module's device; it is no weight to be handed over.
            indices = torch.tensor(config[f"{half}_indices"])
            self.register_buffer(half, indices, persistent=False)
        self.reward_scale: float = config["reward_scale"]
        self.estimator = MutualInformationEstimator(
            len(self.agent), len(self.surrounding), config["hidden_size"]
        )

    def split(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """[..., D] observations -> [..., X] agent state and [..., Y] surrounding state."""
        return (
            observations.index_select(-1, self.agent),
            observations.index_select(-1, self.surrounding),
        )

    def adapt_to(self, observations: Tensor) -> None:
        """Before its first training: [..., D] observations such as those it is to learn from."""
        self.estimator.adapt_to(*self.split(observations))

    def bound(
        self, observations: Tensor, permutations: Tensor, inside: Tensor | None = None
    ) -> Tensor:
        """[N, T, D] trajectories, [N, T] permutations and padding -> [N] bounds in nats."""
        return self.estimator.bound(*self.split(observations), permutations, inside)

    @torch.no_grad()
    def learn(
        self, states: Tensor, followers: Tensor, swapped: Sequence[bool],
        trajectories: Mapping[str, Tensor], optimizer: FusedAdam,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """K updates on a CPU, by compiled code.

        Args:
            states: [K, B, D], of whose transitions each update takes the reward first.
            followers: [K, B, D] the next states.
            swapped: K, as `reward` takes it.
            trajectories: [K*N, T, D] "obs", [K*N, T] "permutations" and padding "inside".
            optimizer: of this module's parameters.

        Returns:
            [K, B] rewards in [-1, 0], and [K] mean bounds of the trajectories in nats.
        """
        updates, rows = states.shape[:2]
        frames = torch.stack([states, followers], dim=2).flatten(0, 1)
        others = torch.cat([two_frames(rows, one) for one in swapped])
        of = self.estimator.data
        found, means = self.estimator.learn(
            of(*self.split(frames), others, None),
            of(
                *self.split(trajectories["obs"]),
                trajectories["permutations"],
                trajectories.get("inside"),
            ),
            optimizer,
            updates,
        )
        return intrinsic_reward(found, self.reward_scale).view(updates, rows), means

    def transition_bounds(self, observations: Tensor, *, swapped: bool = True) -> Tensor:
        """[T, D] states of one trajectory -> [T-1] bounds of its transitions, in nats."""
        frames = torch.stack([observations[:-1], observations[1:]], dim=1)
        return self.estimator.transition_bound(*self.split(frames), swapped=swapped)

    @torch.no_grad()
    def reward(self, inputs: Tensor, next_inputs: Tensor, *, swapped: bool = True) -> Tensor:
        """Intrinsic reward of transitions, [B, D] each -> [B] in [-1, 0]."""
        frames = torch.stack([inputs, next_inputs], dim=1)
        bound = self.estimator.transition_bound(*self.split(frames), swapped=swapped)
        return intrinsic_reward(bound, self.reward_scale)

    def _forward_train(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {}  # the Learner's intrinsic reward asks for the bound

    def compute_self_supervised_loss(
        self, *, learner: Any, module_id: str, config: Any, batch: Any, fwd_out: dict[str, Tensor]
    ) -> Tensor:
        loss: Tensor = learner.loss_of_trajectories(batch)
        return loss


def choose_action(
    mean: Tensor, log_std: Tensor | None, noise: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """Action [B, A] and its log-density [B, A], which a deterministic policy has not."""
    if log_std is None or noise is None:
        return deterministic_action(mean), None
    sample = sample_squashed(mean, log_std, noise)
    return sample.action, sample.log_density


def _network_inputs(observation: Any) -> Tensor:
    """Observation and desired goal side by side, for callers that have a goal dictionary."""
    if isinstance(observation, dict):
        return torch.cat([observation["observation"], observation["desired_goal"]], dim=-1).float()
    return torch.as_tensor(observation).float()
