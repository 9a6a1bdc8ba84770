"""The Learner: TAC's losses, MUSIC's estimator and intrinsic reward, many updates a call.

A call of `update()` carries K minibatches behind each other, one row each (B transitions,
N trajectories, T frames, I network inputs, D observation, A actions):

- module `default_policy`: OBS [K*B, I], ACTIONS [K*B, A], REWARDS [K*B] (the task's),
  "discounts" [K*B], NEXT_OBS [K*B, I], and "weights" [K*B] where the replay is prioritised
- module `mi_estimator`, where it is trained: OBS [K*N, T, D] whole trajectories

Each of the K updates prices its transitions with the current estimator, and then takes one step
of every network and one of the estimator.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core import ALL_MODULES, DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from ray.rllib.core.learner.training_data import TrainingData
from ray.rllib.policy.sample_batch import MultiAgentBatch
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME
from ray.rllib.utils.typing import ModuleID, ParamDict, ResultDict, StateDict
from torch import Tensor

from music_rllib import names
from music_rllib.config.tac_settings import LearnedAlpha, TACSettings
from music_rllib.functional import actor_critic
from music_rllib.functional.mutual_information import time_permutations
from music_rllib.functional.tsallis import ln_q_of_policy
from music_rllib.intrinsic.held_out import HeldOutBound
from music_rllib.replay.buffer import Trajectory
from music_rllib.runtime.allocator import keep_freed_memory
from music_rllib.runtime.quiet import quiet_third_parties
from music_rllib.schedules import Quantity
from music_rllib.tac import diagnostics
from music_rllib.tac.kernels.adam import FusedAdam
from music_rllib.tac.kernels.cuda_graphs import CapturedUpdate, CudaRecorder
from music_rllib.tac.kernels.forward import Bootstrap, TACForward
from music_rllib.tac.kernels.precision import check_precision
from music_rllib.tac.kernels.update import DirectUpdate
from music_rllib.tac.normaliser import RunningNormaliser
from music_rllib.tac.rl_module import ESTIMATOR_MODULE, EstimatorModule, TACModule, choose_action
from music_rllib.tac.scheduled import ScheduledSettings

__all__ = ["GRAD_UPDATES", "HELD_OUT_STEPS", "NonFiniteLossError", "TACLearner"]

GRAD_UPDATES = "grad_updates"
PRIORITY_CLIP = 2e-4
"""MUSIC-p: largest bound (nats) of one step that counts for its trajectory's priority."""
LOSSES = "losses"
HELD_OUT_STEPS = "held_out_steps"
"""Metric: steps behind the bound on fresh trajectories, which it is averaged by."""
Minibatch = dict[ModuleID, dict[str, Tensor]]
FlatMinibatch = Mapping[tuple[ModuleID, str], Tensor]


class _Constants(NamedTuple):
    """What an update depends on and what is no tensor: captured, it stays as it was."""

    entropic_index: float
    mi_reward_weight: float
    alpha: float | None
    """None: learned, and a tensor."""
    swapped: bool
    """Whether the two frames of a transition are swapped for the intrinsic reward."""
    trajectories: tuple[int, bool] | None
    """Frames of the estimator's trajectories, and whether some are shorter."""


class _Loss(NamedTuple):
    """The losses of a minibatch, and what their derivatives are made of."""

    total: Tensor
    target: Tensor
    """[B] of the critics."""
    value_target: Tensor
    """[B] of the value network, where there is one."""
    excess_entropy: Tensor
    """[] entropy of the policy less its target, the derivative by a learned log alpha."""


class NonFiniteLossError(RuntimeError):
    """A loss became infinite or NaN; the message names it and the update."""


class TACLearner(TorchLearner):
    """Tsallis actor-critic updates (paper III-B), with MUSIC's reward (III-A) where configured."""

    # -- construction ---------------------------------------------------------------------

    def build(self) -> None:
        quiet_third_parties()  # a remote Learner is a process of its own
        keep_freed_memory()
        self._settings: TACSettings = self.config.tac_settings()
        self._music = self.config.music_settings()
        # A driver-side algorithm would otherwise use every core for 256-row products, and with
        # another trial beside it run twenty times slower; the sums would also change.
        torch.set_num_threads(self.config.torch_threads)
        self._adam: dict[str, FusedAdam] = {}
        super().build()
        check_precision(self._settings.precision, self._device)
        seed = self.config.seed if self.config.seed is not None else torch.seed()
        self._generator = torch.Generator(device=self._device).manual_seed(seed + 7919)
        self._grad_updates = 0
        self._held_out = HeldOutBound()
        self._losses: dict[str, Tensor] = {}
        self._observed: dict[str, Tensor] = {}
        self._names_of_losses: list[str] = []
        self._td_errors: Tensor | None = None
        self._now = ScheduledSettings(
            self._settings,
            self._music,
            self.config.total_env_steps or 0,
            self._policy_module.action_size,
        )
        self._target_entropy = self._resolve_target_entropy()
        pairs = self._policy_module.get_target_network_pairs()
        self._online: list[Tensor] = [p for online, _ in pairs for p in online.parameters()]
        self._targets: list[Tensor] = [p for _, target in pairs for p in target.parameters()]
        on_gpu, plain = self._device.type == "cuda", self._keeps_gradients_to_itself
        self._captured: CapturedUpdate[_Constants] | None = None
        if on_gpu and plain:
            self._captured = CapturedUpdate(self._step, CudaRecorder(self._device))
        standard = not on_gpu and plain and self._is_standard
        self._direct = DirectUpdate(self._policy_module) if standard else None

    @property
    def _keeps_gradients_to_itself(self) -> bool:
        """Whether RLlib neither looks at gradients nor exchanges them."""
        config = self.config
        return config.grad_clip is None and not config.log_gradients and config.num_learners <= 1

    @property
    def _is_standard(self) -> bool:
        """Whether networks and losses are those that `DirectUpdate` has the derivatives of."""
        own_loss = type(self).compute_loss_for_module is TACLearner.compute_loss_for_module
        own_networks = type(self._policy_module) is TACModule
        return own_loss and own_networks and self._settings.precision == "float32"

    @property
    def _policy_module(self) -> TACModule:
        return self.module[DEFAULT_MODULE_ID].unwrapped()  # type: ignore[no-any-return]

    @property
    def _input_size(self) -> int:
        """Features of a network input: the first columns of a frame."""
        return self._policy_module.input_size

    @property
    def _estimator(self) -> EstimatorModule | None:
        if ESTIMATOR_MODULE not in self.module:
            return None
        return self.module[ESTIMATOR_MODULE].unwrapped()  # type: ignore[no-any-return]

    def configure_optimizers_for_module(self, module_id: ModuleID, config: Any = None) -> None:
        named = dict(self.module[module_id].named_parameters())
        log_alpha = named.pop("log_alpha", None)
        weights = [p for p in named.values() if p.requires_grad]
        if module_id == ESTIMATOR_MODULE:
            if self._music.estimator == "trained":
                self._register(module_id, "estimator", weights, self._music.lr)
            return
        self._register(module_id, "networks", weights, self._settings.lr)
        if log_alpha is not None:
            assert isinstance(self._settings.alpha, LearnedAlpha)
            self._register(module_id, "alpha", [log_alpha], self._settings.alpha.lr)

    def _register(self, module_id: ModuleID, name: str, params: list[Tensor], lr: float) -> None:
        self._adam[name] = FusedAdam(params, lr)
        self.register_optimizer(
            module_id=module_id,
            optimizer_name=name,
            optimizer=self._adam[name],
            params=params,
            lr_or_lr_schedule=lr,
        )

    def _resolve_target_entropy(self) -> float:
        alpha = self._settings.alpha
        if not isinstance(alpha, LearnedAlpha) or alpha.target_entropy != "auto":
            return float(getattr(alpha, "target_entropy", 0.0))
        # S_q of a density of e per dimension: -1 nat each at q = 1, as SAC has it.
        ones = torch.ones(1, self._policy_module.action_size)
        q, form = self._now.entropic_index, self._settings.entropy_form
        return -float(ln_q_of_policy(ones, q, form))

    # -- the update loop ------------------------------------------------------------------

    def before_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        super().before_gradient_based_update(timesteps=timesteps)
        self._now.advance(int(timesteps.get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0)))
        self._target_entropy = self._resolve_target_entropy()

    def observe_measured(self, quantity: Quantity, measured: float, env_steps: int) -> None:
        """Takes what was measured after `env_steps`; settings follow it from the next update on."""
        self._now.observe(quantity, measured, env_steps)

    def update(
        self,
        batch: MultiAgentBatch | None = None,
        *,
        training_data: TrainingData | None = None,
        timesteps: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> ResultDict:
        """Runs all minibatches of the batch; metrics are their means, logged once.

        Raises:
            NonFiniteLossError: a loss is not finite any more.
        """
        self._check_is_built()
        self.before_gradient_based_update(timesteps=timesteps or {})
        if training_data is not None:
            training_data.solve_refs()
            batch = training_data.batch
        assert batch is not None
        self._weights_seq_no += 1
        if self._direct is not None and not self._direct.flat.is_in_use:
            self._direct = DirectUpdate(self._policy_module)
        history: list[Mapping[str, Tensor]] = []
        step = self._captured or self._step
        for minibatch, constants in self._minibatches(self._convert_batch_type(batch)):
            outputs = step(minibatch, constants)
            self._grad_updates += 1
            if self._grad_updates % self._settings.target_update_interval == 0:
                self._average()
            history.append(outputs)
        if history:
            self._log_history(history)
        self.after_gradient_based_update(timesteps=timesteps or {})
        return self.metrics.reduce()

    @torch.no_grad()  # else the targets keep a graph of all their averages
    def _average(self) -> None:
        torch._foreach_lerp_(self._targets, self._online, self._settings.tau)

    def postprocess_gradients(self, gradients_dict: ParamDict) -> ParamDict:
        """RLlib sorts them by module and optimizer first; for nothing where nothing is clipped."""
        if self.config.grad_clip is None and not self.config.log_gradients:
            return gradients_dict
        return super().postprocess_gradients(gradients_dict)

    def _step(self, minibatch: FlatMinibatch, constants: _Constants) -> dict[str, Tensor]:
        """One update of every network but the targets; nothing in it waits for the device.

        Returns:
            `LOSSES` [M], in the order of `_names_of_losses`, and what `_diagnosed` takes.
        """
        columns: Minibatch = {}
        for (module_id, name), values in minibatch.items():
            columns.setdefault(module_id, {})[name] = values
        self._losses, self._observed = {}, {}
        priced = self._priced(columns, swapped=constants.swapped)
        if self._direct is None:
            self._update(priced)
        else:
            self._update_directly(self._direct, priced)
        self._names_of_losses = list(self._losses)
        return {LOSSES: torch.stack(list(self._losses.values())), **self._observed}

    def _minibatches(self, batch: MultiAgentBatch) -> Iterator[tuple[FlatMinibatch, _Constants]]:
        """Cuts the batch up; random numbers of all its updates are drawn here, in one go."""
        columns: Minibatch = {mid: dict(b) for mid, b in batch.policy_batches.items()}
        rows = {DEFAULT_MODULE_ID: self._settings.batch_size}
        policy = columns[DEFAULT_MODULE_ID]
        policy |= self._policy_noise(policy[Columns.ACTIONS])
        updates = len(policy[Columns.ACTIONS]) // self._settings.batch_size
        swapped = [True] * updates
        if self._music.shuffle == "random":
            swapped = self._coins(updates)
        if ESTIMATOR_MODULE in columns:
            rows[ESTIMATOR_MODULE] = self._music.batch_trajectories
            trajectories = columns[ESTIMATOR_MODULE]
            if self._grad_updates == 0 and (estimator := self._estimator) is not None:
                estimator.adapt_to(trajectories[Columns.OBS])
            trajectories["permutations"] = self._permutations(trajectories, updates)
        for k in range(updates):
            minibatch = {
                (mid, name): values[k * n : (k + 1) * n]
                for mid, n in rows.items()
                for name, values in columns[mid].items()
            }
            yield minibatch, self._constants(minibatch, swapped=swapped[k])

    def _constants(self, minibatch: FlatMinibatch, *, swapped: bool) -> _Constants:
        alpha = None if isinstance(self._settings.alpha, LearnedAlpha) else self._now.alpha
        shape = None
        if (ESTIMATOR_MODULE, Columns.OBS) in minibatch:
            frames = minibatch[ESTIMATOR_MODULE, Columns.OBS].shape[1]
            shape = (frames, (ESTIMATOR_MODULE, "inside") in minibatch)
        now = self._now
        return _Constants(now.entropic_index, now.mi_reward_weight, alpha, swapped, shape)

    def _policy_noise(self, actions: Tensor) -> dict[str, Tensor]:
        """Standard normal numbers for the policy's actions, and the next ones where needed."""
        if self._settings.policy == "deterministic":
            return {}
        wanted = ["noise"] if self._settings.bootstrap == "value" else ["noise", "next_noise"]
        return {name: self._normal(actions.shape) for name in wanted}

    def _normal(self, shape: tuple[int, ...]) -> Tensor:
        return torch.randn(shape, generator=self._generator, device=self._device)

    def _coins(self, updates: int) -> list[bool]:
        """The original's shuffle of two frames: for a whole minibatch swapped or not."""
        drawn = torch.rand(updates, generator=self._generator, device=self._device) < 0.5
        return drawn.tolist()

    def _permutations(self, trajectories: Mapping[str, Tensor], updates: int) -> Tensor:
        rows, frames = trajectories[Columns.OBS].shape[:2]
        sharing = 1 if self._music.shuffle == "independent" else rows // updates
        inside = trajectories.get("inside")
        return time_permutations(rows, frames, self._generator, sharing=sharing, inside=inside)

    def _priced(self, minibatch: Minibatch, *, swapped: bool) -> Minibatch:
        """The minibatch with the reward that is learned from: task and intrinsic, weighted."""
        estimator = self._estimator
        if estimator is None:
            return minibatch
        policy = minibatch[DEFAULT_MODULE_ID]
        intrinsic = estimator.reward(policy[Columns.OBS], policy[Columns.NEXT_OBS], swapped=swapped)
        reward = self._total_reward(policy[Columns.REWARDS], intrinsic)
        self._observed["intrinsic"] = intrinsic
        return {**minibatch, DEFAULT_MODULE_ID: {**policy, Columns.REWARDS: reward}}

    def _total_reward(self, task: Tensor, intrinsic: Tensor) -> Tensor:
        weighted = self._now.mi_reward_weight * intrinsic
        return task + weighted if self._music.task_reward else weighted

    # -- losses ---------------------------------------------------------------------------

    def compute_loss_for_module(
        self, *, module_id: ModuleID, config: Any, batch: dict[str, Any], fwd_out: dict[str, Any]
    ) -> Tensor:
        return self._loss(fwd_out["tac"], batch).total

    def _loss(self, forward: TACForward, batch: Mapping[str, Tensor]) -> _Loss:
        settings, alpha = self._settings, self._current_alpha()
        target = actor_critic.critic_target(
            batch[Columns.REWARDS],
            batch["discounts"],
            self._soft_value(forward.next),
            settings.gamma,
            settings.target_bounds,
        )
        ln_q_pi = self._ln_q(forward.log_density)
        critic = actor_critic.critic_loss(forward.q_values, target, batch.get("weights"))
        improved = actor_critic.policy_value(forward.q_of_policy, settings.policy_critic)
        policy = actor_critic.policy_loss(improved, ln_q_pi, alpha)
        if settings.action_l2 > 0:
            policy = policy + settings.action_l2 * forward.action.square().mean()
        total = critic + policy
        value_target = actor_critic.value_target(forward.q_of_policy, ln_q_pi, alpha)
        if forward.value is not None:
            value = actor_critic.value_loss(forward.value, value_target)
            total = total + value
            self._losses[names.VALUE_LOSS] = value.detach()
        excess = self._excess_entropy(forward, ln_q_pi)
        if isinstance(settings.alpha, LearnedAlpha):
            total = total + actor_critic.alpha_loss(self._policy_module.log_alpha, excess)
        self._observe(forward, target, critic=critic, policy=policy)
        return _Loss(total, target, value_target, excess)

    def _excess_entropy(self, forward: TACForward, ln_q_pi: Tensor) -> Tensor:
        """[] how much too random the policy is for a learned alpha, in its target's own measure."""
        alpha = self._settings.alpha
        if not isinstance(alpha, LearnedAlpha) or forward.log_density is None:
            return torch.zeros((), device=self._device)
        if alpha.target_shannon is not None:
            return -forward.log_density.detach().sum(-1).mean() - alpha.target_shannon
        if alpha.target_width is not None:
            assert forward.log_std is not None
            return forward.log_std.detach().mean() - math.log(alpha.target_width)
        return -ln_q_pi.mean().detach() - self._target_entropy

    def _update_directly(self, direct: DirectUpdate, minibatch: Minibatch) -> None:
        """RLlib's `_update` without its detours and, for the policy's module, without autograd."""
        batch = minibatch[DEFAULT_MODULE_ID]
        forward = direct.forward(batch)
        with torch.no_grad():
            loss = self._loss(forward, batch)
        direct.backward(
            forward,
            batch,
            target=loss.target,
            value_target=loss.value_target,
            entropic_index=self._now.entropic_index,
            alpha=self._current_alpha(),
        )
        self._adam["networks"].step_flat(direct.flat)
        if "alpha" in self._adam:
            self._policy_module.log_alpha.grad = loss.excess_entropy
            self._adam["alpha"].step()
        if "estimator" in self._adam:
            self._train_estimator(minibatch[ESTIMATOR_MODULE])

    def _train_estimator(self, batch: dict[str, Tensor]) -> None:
        module = self.module[ESTIMATOR_MODULE].unwrapped()
        self._adam["estimator"].zero_grad()
        module.compute_self_supervised_loss(
            learner=self,
            module_id=ESTIMATOR_MODULE,
            config=self.config,
            batch=batch,
            fwd_out=module.forward_train(batch),
        ).backward()
        self._adam["estimator"].step()

    def _ln_q(self, log_density: Tensor | None) -> Tensor:
        """[B, A] -> [B] ln_q of the policy's density; 0 for a deterministic policy."""
        if log_density is None:
            return torch.zeros((), device=self._device)
        return ln_q_of_policy(log_density, self._now.entropic_index, self._settings.entropy_form)

    def _soft_value(self, bootstrap: Bootstrap) -> Tensor:
        """[B] value of the states, the policy's entropy there included."""
        if bootstrap.log_density is None:
            return bootstrap.value
        return bootstrap.value - self._current_alpha() * self._ln_q(bootstrap.log_density)

    def _current_alpha(self) -> Tensor | float:
        if isinstance(self._settings.alpha, LearnedAlpha):
            return self._policy_module.log_alpha.detach().exp()
        return self._now.alpha

    # -- metrics --------------------------------------------------------------------------

    def _observe(
        self, forward: TACForward, target: Tensor, *, critic: Tensor, policy: Tensor
    ) -> None:
        """Keeps what is measured of one minibatch: reading it out here would wait for it."""
        self._losses |= {names.CRITIC_LOSS: critic.detach(), names.POLICY_LOSS: policy.detach()}
        self._observed |= {"q_values": forward.q_values.detach(), "targets": target}
        if forward.log_density is not None and forward.log_std is not None:
            self._observed |= {
                "log_density": forward.log_density.detach(),
                "log_std": forward.log_std.detach(),
            }

    def observe_bound(self, bound: Tensor) -> None:
        """Called by the estimator's module with the mean bound of its minibatch, in nats."""
        self._losses[names.MI_BOUND] = bound

    def _log_history(self, history: Sequence[Mapping[str, Tensor]]) -> None:
        """Means of the updates' metrics; `history` has what `_step` returned of each."""
        columns = {name: torch.stack([outputs[name] for outputs in history]) for name in history[0]}
        losses_of_updates = dict(zip(self._names_of_losses, columns.pop(LOSSES).T, strict=True))
        metrics = losses_of_updates | self._diagnosed(columns)
        keys, table = list(metrics), torch.stack([m.float() for m in metrics.values()], dim=1)
        self._check_finite(keys, table)
        log = self.metrics.log_value
        means = dict(zip(keys, table.mean(0).tolist(), strict=True))
        for key, mean in {**means, **self._now.metrics()}.items():
            log((DEFAULT_MODULE_ID, key), mean, window=1)
        if (held_out := self._held_out.take()) is not None:
            for key, value in zip((names.HELD_OUT_BOUND, HELD_OUT_STEPS), held_out, strict=True):
                log((DEFAULT_MODULE_ID, key), value, window=1)
        log((DEFAULT_MODULE_ID, names.ALPHA), float(self._current_alpha()), window=1)
        log((ALL_MODULES, GRAD_UPDATES), self._grad_updates, window=1)
        if names.SHANNON_ENTROPY in means:
            self._now.observe("shannon_entropy", means[names.SHANNON_ENTROPY])

    def _diagnosed(self, observed: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Metrics of K updates, [K] each, from what was observed of them, [K, ...] each."""
        settings = self._settings
        q_values, targets = observed["q_values"], observed["targets"]
        metrics = {names.Q_MEAN: q_values.mean((1, 2))}
        metrics |= diagnostics.of_targets(targets, settings.target_bounds)
        if "log_density" in observed:
            metrics |= diagnostics.of_policy(
                observed["log_density"],
                observed["log_std"],
                self._now.entropic_index,
                settings.entropy_form,
                settings.log_std_bounds,
            )
        if "intrinsic" in observed:
            metrics |= diagnostics.of_intrinsic_reward(observed["intrinsic"])
        if self.config.replay_priority == "td_error":
            self._td_errors = (q_values - targets.unsqueeze(1)).abs().mean(1).flatten()
        return metrics

    def _check_finite(self, keys: list[str], table: Tensor) -> None:
        """A NaN never leaves the networks again, so looking once a call is enough."""
        bad = ~torch.isfinite(table)
        if not bad.any():
            return
        step = int(bad.any(1).nonzero()[0])
        culprits = [key for key, is_bad in zip(keys, bad[step].tolist(), strict=True) if is_bad]
        update = self._grad_updates - len(table) + step + 1
        q, alpha = self._now.entropic_index, float(self._current_alpha())
        raise NonFiniteLossError(
            f"{', '.join(culprits)} not finite at gradient update {update} "
            f"(entropic_index {q:g}, alpha {alpha:g}). "
            "The run stops here; its last checkpoint is good. Try a smaller tac.lr or tac.alpha, "
            "or an entropic_index nearer to 1."
        )

    # -- fresh episodes, td errors --------------------------------------------------------

    @torch.no_grad()
    def diagnose(self, episodes: Sequence[Trajectory]) -> None:
        """Measures fresh episodes of the policy, before anything is learned from them.

        Logs the critics' bias at their first steps, and the estimator's bound on them.
        """
        module, width = self._policy_module, self._input_size
        lengths = [len(episode) for episode in episodes]
        states = self._tensor([episode.frames[:-1, :width] for episode in episodes])
        followers = self._tensor([episode.frames[1:, :width] for episode in episodes])
        actions = self._tensor([episode.actions for episode in episodes])
        rewards = self._tensor([episode.rewards for episode in episodes])
        first = np.cumsum([0, *lengths[:-1]])
        last = np.cumsum(lengths) - 1
        if (estimator := self._estimator) is not None:
            rewards = self._total_reward(rewards, estimator.reward(states, followers))
            self._held_out.add(episodes, estimator.bound, self._generator)
        noise = self._policy_noise(actions)
        mean, log_std = module.policy_parameters(module.normaliser(states))
        entropy = -self._ln_q(choose_action(mean, log_std, noise.get("noise"))[1]).expand(
            len(rewards)
        )
        earned = (rewards + float(self._current_alpha()) * entropy).cpu().numpy().astype(float)
        # The first action is what the critic is asked about: its entropy is not in its value.
        earned[first] = rewards.cpu().numpy()[first]
        ends = {Columns.NEXT_OBS: followers[last]}
        ends |= {name: values[last] for name, values in noise.items()}
        tail = self._soft_value(module.forward_target(ends)).cpu().numpy()
        bootstrapped = np.array([not episode.terminated for episode in episodes])
        gamma = self._settings.gamma
        realised = diagnostics.discounted_returns(earned, lengths, gamma)
        realised += bootstrapped * gamma ** np.array(lengths) * tail
        asked = torch.cat([module.normaliser(states[first]), actions[first]], -1)
        predicted = module.critics(asked).amin(0).cpu().numpy()
        bias = float((predicted - realised).mean())
        self.metrics.log_value((DEFAULT_MODULE_ID, names.Q_BIAS), bias, window=1)

    @torch.no_grad()
    def trajectory_priorities(self, episodes: Sequence[Trajectory]) -> NDArray[np.float64]:
        """MUSIC-p: the sum of each episode's per-step bounds, each clipped to [0, 2e-4] nats."""
        estimator = self._estimator
        assert estimator is not None
        frames = [torch.as_tensor(e.frames, device=self._device) for e in episodes]
        sums = [estimator.transition_bounds(f).clamp(0.0, PRIORITY_CLIP).sum() for f in frames]
        return torch.stack(sums).cpu().numpy().astype(np.float64)

    def take_td_errors(self) -> NDArray[np.float32]:
        """[K*B] absolute TD errors of the last call's transitions, for prioritised replay."""
        assert self._td_errors is not None
        errors: NDArray[np.float32] = self._td_errors.cpu().numpy()
        self._td_errors = None
        return errors

    def _tensor(self, arrays: Sequence[NDArray[Any]]) -> Tensor:
        return torch.as_tensor(np.concatenate(arrays), device=self._device)

    # -- normaliser, state ----------------------------------------------------------------

    def observe_inputs(self, inputs: Any) -> None:
        """Takes [B, I] new network inputs (numpy) into the running normaliser."""
        normaliser = self._policy_module.normaliser
        if isinstance(normaliser, RunningNormaliser):
            normaliser.update(torch.as_tensor(inputs, device=self._device))

    def get_state(self, *args: Any, **kwargs: Any) -> StateDict:
        state = super().get_state(*args, **kwargs)
        state["tac"] = {
            "generator": self._generator.get_state().numpy(),
            GRAD_UPDATES: self._grad_updates,
            "held_out": self._held_out.state(),
            "scheduled": self._now.state(),
        }
        return state

    def set_state(self, state: StateDict) -> None:
        # RLlib keeps newer weights over older ones; restoring means what the state says.
        self._weights_seq_no = 0
        super().set_state(state)
        for optimizer in self._optimizer_parameters:
            for group in optimizer.param_groups:  # a state may come from another device
                group["capturable"] = self._device.type == "cuda"
        if self._captured is not None:
            self._captured.forget()
        if "tac" in state:
            self._generator.set_state(torch.from_numpy(state["tac"]["generator"].copy()))
            self._grad_updates = int(state["tac"][GRAD_UPDATES])
            self._held_out.load_state(state["tac"]["held_out"])
            if "scheduled" in state["tac"]:  # older states have none
                self._now.load_state(state["tac"]["scheduled"])
