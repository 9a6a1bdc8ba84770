"""The Learner: gradient updates of TAC and of an intrinsic reward, many in one call.

A call of `update()` gets K concatenated minibatches (`minibatches.py`). Each of its K updates
relabels its transitions with the current intrinsic reward and takes one step of every network.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from ray.rllib.core.learner.training_data import TrainingData
from ray.rllib.policy.sample_batch import MultiAgentBatch
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME
from ray.rllib.utils.typing import ModuleID, ParamDict, ResultDict, StateDict
from torch import Tensor

from music_rllib import names
from music_rllib.config.tac_settings import LearnedAlpha, TACSettings
from music_rllib.envs.values import check_torch_type, observation_sizes
from music_rllib.intrinsic.interface import Sizes
from music_rllib.intrinsic.make import make_reward
from music_rllib.intrinsic.music import Music
from music_rllib.intrinsic.relabeling import RewardLearner
from music_rllib.replay.trajectories import Floats, Trajectory
from music_rllib.runtime.process import keep_freed_memory, use_reproducible_gpu_kernels
from music_rllib.runtime.quiet import quiet_third_parties
from music_rllib.schedules import Quantity
from music_rllib.tac import diagnostics, schedulers
from music_rllib.tac.compiled_update import (
    CompiledUpdate,
    FusedAdam,
    flushed_denormals,
    needs_autograd,
    postprocesses_gradients,
    use_threads,
)
from music_rllib.tac.diagnostics import FreshEpisodes, critic_bias
from music_rllib.tac.losses import Losses, ScheduledSettings, TACLoss
from music_rllib.tac.minibatches import INTRINSIC, STORED, Minibatch, Minibatches
from music_rllib.tac.networks import RunningNormaliser
from music_rllib.tac.random_state import generator_states, set_generators
from music_rllib.tac.rl_module import ESTIMATOR_MODULE, TACForward, TACModule, mean_values

GRAD_UPDATES = "grad_updates"


class TACLearner(TorchLearner):
    """Tsallis actor-critic updates (paper III-B), with an intrinsic reward if configured."""

    def build(self) -> None:
        quiet_third_parties()  # a remote Learner is a process of its own
        keep_freed_memory()
        check_torch_type()
        self._settings: TACSettings = self.config.settings.tac
        # Otherwise an algorithm in the driver uses every core for 256-row products, runs twenty
        # times slower beside another trial, and gets other sums.
        torch.set_num_threads(self.config.torch_threads)
        use_threads(self.config.torch_threads)
        self._adam: dict[str, FusedAdam] = {}
        if self.config.num_gpus_per_learner:
            use_reproducible_gpu_kernels()
        super().build()
        schedulers.add_schedulers(self)
        seed = self.config.seed if self.config.seed is not None else torch.seed()
        self._generator = torch.Generator(device=self._device).manual_seed(seed + 7919)
        self._grad_updates = 0
        self._losses: dict[str, Tensor] = {}
        self._observed: dict[str, Tensor] = {}
        self._td_errors: Tensor | None = None
        settings, budget = self.config.settings, self.config.total_env_steps or 0
        actions = self._policy_module.action_size
        self._now = ScheduledSettings(
            self._settings, settings.music, settings.intrinsic, budget, actions
        )
        self._objective = TACLoss(self._settings, self._policy_module, self._now)
        pairs = self._policy_module.get_target_network_pairs()
        self._online: list[Tensor] = [p for online, _ in pairs for p in online.parameters()]
        self._targets: list[Tensor] = [p for _, target in pairs for p in target.parameters()]
        self._compiled: CompiledUpdate | None = None
        if self._device.type == "cpu" and not self._needs_autograd:
            self._compiled = CompiledUpdate(self._policy_module)
        self.bonus: RewardLearner | None = None
        """The intrinsic reward that is added to MUSIC's."""
        if (intrinsic := settings.intrinsic).reward is not None:
            observation, goal = observation_sizes(self._policy_module.observation_space)
            sizes = Sizes(observation, goal, actions, *dict(settings.split).values())
            make = functools.partial(make_reward, intrinsic, sizes, seed + 4241, self._device)
            again = make if intrinsic.own_module else None
            self.bonus = RewardLearner(make(), intrinsic.lr, frozen=intrinsic.frozen, again=again)

    @cached_property
    def _music(self) -> Music:
        networks = self._estimator
        return Music(self.config.settings.music, networks and networks.estimator)

    @property
    def _estimator(self) -> Any:
        """The module of MUSIC's estimator, if there is one."""
        has_one = ESTIMATOR_MODULE in self.module
        return self.module[ESTIMATOR_MODULE].unwrapped() if has_one else None

    @property
    def _needs_autograd(self) -> bool:
        modules = self._policy_module, self._estimator
        return needs_autograd(type(self), TACLearner, self.config, *modules)

    @property
    def _policy_module(self) -> TACModule:
        return self.module[DEFAULT_MODULE_ID].unwrapped()  # type: ignore[no-any-return]

    def configure_optimizers_for_module(self, module_id: ModuleID, config: Any = None) -> None:
        named = dict(self.module[module_id].named_parameters())
        log_alpha = named.pop("log_alpha", None)
        weights = [p for p in named.values() if p.requires_grad]
        if module_id == ESTIMATOR_MODULE:
            if (lr := self._music.learning_rate) is not None:
                self._register(module_id, "estimator", weights, lr)
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

    # -- the update loop ------------------------------------------------------------------

    def before_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        super().before_gradient_based_update(timesteps=timesteps)
        self._now.advance(int(timesteps.get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0)))
        self._objective.refresh()

    def observe_measured(self, quantity: Quantity, measured: float, env_steps: int) -> None:
        """Record a measurement after `env_steps`; settings follow it from the next update on."""
        self._now.observe(quantity, measured, env_steps)

    def update(
        self,
        batch: MultiAgentBatch | None = None,
        *,
        training_data: TrainingData | None = None,
        timesteps: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> ResultDict:
        """Do one update for each minibatch of the batch, and log the means of their metrics.

        Raises `diagnostics.NonFiniteLossError` if a loss is not finite.
        """
        self._check_is_built()
        self.before_gradient_based_update(timesteps=timesteps or {})
        if training_data is not None:
            training_data.solve_refs()
            batch = training_data.batch
        assert batch is not None
        self._weights_seq_no += 1
        if self._compiled is not None and not self._compiled.is_in_use:
            self._compiled = CompiledUpdate(self._policy_module)
        minibatches = self._minibatches(self._convert_batch_type(batch))
        if minibatches.updates:
            learn = self._learn_by_autograd if self._compiled is None else self._learn_compiled
            with flushed_denormals():
                learned = learn(minibatches)
            self._log_updates(learned)
        self.after_gradient_based_update(timesteps=timesteps or {})
        return self.metrics.reduce()

    def _learn_by_autograd(self, minibatches: Minibatches) -> dict[str, Tensor]:
        history = []
        for minibatch in minibatches.one_by_one():
            history.append(self._step(minibatch))
            self._grad_updates += 1
            if self._grad_updates % self._settings.target_update_interval == 0:
                self._update_targets()
        return {name: torch.stack([each[name] for each in history]) for name in history[0]}

    def _learn_compiled(self, minibatches: Minibatches) -> dict[str, Tensor]:
        """Updates without autograd, all in one call."""
        self._losses, self._observed = {}, {}
        rewards = functools.partial(self._learn_music, minibatches)
        self._update_compiled(self._relabelled(minibatches, rewards))
        self._grad_updates += minibatches.updates
        return self._losses | self._observed

    @torch.no_grad()  # otherwise the targets would keep a graph of all their averages
    def _update_targets(self) -> None:
        torch._foreach_lerp_(self._targets, self._online, self._settings.tau)

    def postprocess_gradients(self, gradients_dict: ParamDict) -> ParamDict:
        """Skip RLlib's sorting of gradients if nothing is clipped or logged."""
        given = {key: one for key, one in gradients_dict.items() if one is not None}  # policy_delay
        has_more = postprocesses_gradients(type(self), self.config)
        return super().postprocess_gradients(given) if has_more else given

    def _step(self, minibatch: Minibatches) -> dict[str, Tensor]:
        """Update every network except the targets by autograd, on one minibatch.

        Returns the losses [], and tensors for the diagnostics, by name.
        """
        self._losses, self._observed = {}, {}
        policy, (drawn,) = minibatch.columns[DEFAULT_MODULE_ID], minibatch.drawn
        ends = (policy[Columns.OBS], policy[Columns.NEXT_OBS])
        rewards = functools.partial(self._music.reward, *ends, drawn)
        self._update(self._relabelled(minibatch, rewards))
        return self._losses | self._observed

    def _minibatches(self, batch: MultiAgentBatch) -> Minibatches:
        """The minibatches of a batch, with random numbers for all updates."""
        columns: Minibatch = {mid: dict(b) for mid, b in batch.policy_batches.items()}
        policy = columns[DEFAULT_MODULE_ID]
        policy |= self._policy_noise(policy[Columns.ACTIONS])
        rows = len(policy[Columns.ACTIONS])
        updates = rows // self._settings.batch_size
        if (some := self._settings.target_critics) is not None:
            size = (updates, self._settings.critic_count)
            order = torch.rand(size, generator=self._generator, device=self._device).argsort(1)
            policy["target_critics"] = order[:, :some].contiguous().flatten()
        trajectories, first = columns.get(ESTIMATOR_MODULE), self._grad_updates == 0
        drawn = self._music.draw(updates, rows, trajectories, self._generator, first=first)
        return Minibatches(columns, drawn)

    def _policy_noise(self, actions: Tensor) -> dict[str, Tensor]:
        """Standard normal noise for the policy's actions, and for the next ones if needed."""
        if self._settings.policy == "deterministic":
            return {}
        columns = ["noise"] if self._settings.bootstrap == "value" else ["noise", "next_noise"]
        options = {"generator": self._generator, "device": self._device}
        return {name: torch.randn(actions.shape, **options) for name in columns}

    def _relabelled(self, minibatches: Minibatches, music_of: Callable[[], Tensor]) -> Minibatch:
        """The minibatches with the total reward: the task's and the weighted intrinsic ones."""
        columns = dict(minibatches.columns)
        trajectories = columns.pop(INTRINSIC, {})
        policy = columns[DEFAULT_MODULE_ID]
        reward = policy[Columns.REWARDS]
        if self._music.is_on:
            self._observed["intrinsic"] = music = music_of()
            reward = self._music.total(reward, music.flatten(), self._now.mi_reward_weight)
        if self.bonus is not None:
            batch = self.bonus.batch(
                policy[Columns.OBS], policy[Columns.ACTIONS], policy[Columns.NEXT_OBS],
                self._generator, policy.get(STORED), trajectories,
            )  # fmt: skip
            bonus, metrics = self.bonus.learn(batch, minibatches.updates)
            if self._compiled is None:  # one update, whose metrics are stacked later
                metrics = {name: value[0] for name, value in metrics.items()}
            self._losses |= metrics
            reward = self._with_bonus(reward, bonus.flatten())
        return {**columns, DEFAULT_MODULE_ID: {**policy, Columns.REWARDS: reward}}

    def _with_bonus(self, reward: Tensor, bonus: Tensor) -> Tensor:
        """[B] rewards so far and the bonus reward -> [B] total."""
        if not (self.config.settings.music.task_reward or self._music.is_on):
            reward = torch.zeros_like(reward)
        return reward + self._now.intrinsic_weight * bonus

    def compute_loss_for_module(
        self, *, module_id: ModuleID, config: Any, batch: dict[str, Any], fwd_out: dict[str, Any]
    ) -> Tensor:
        return self._losses_of(fwd_out["tac"], batch).total

    def _losses_of(self, forward: TACForward, batch: Mapping[str, Tensor]) -> Losses:
        """The losses; keeps the tensors of the metrics, because reading them here would wait."""
        losses = self._objective.losses(forward, batch, improves=self._improves(self._grad_updates))
        self._losses |= losses.named
        q_values = mean_values(forward.q_values.detach())
        self._observed |= {"q_values": q_values, "targets": losses.target}
        for name in ("log_density", "log_std"):
            if (values := getattr(forward, name)) is not None:
                self._observed[name] = values.detach()
        return losses

    def _improves(self, done: int) -> bool:
        """Whether the update after `done` ones updates the policy."""
        return (done + 1) % self._settings.policy_delay == 0

    def loss_of_trajectories(self, batch: Mapping[str, Tensor]) -> Tensor:
        """The loss of the intrinsic reward's networks; called by their module."""
        loss, metrics = self._music.loss(batch)
        self._losses |= metrics
        return loss

    def _update_compiled(self, minibatches: Minibatch) -> None:
        """Update TAC's networks and a learned alpha without autograd."""
        assert self._compiled is not None
        q, alpha = self._now.entropic_index, float(self._objective.alpha)
        policy, tuned = minibatches[DEFAULT_MODULE_ID], None
        if "alpha" in self._adam:
            tuned = self._adam["alpha"], *self._objective.alpha_target
        learned = self._compiled.learn(
            policy, self._adam["networks"], self._grad_updates, q, alpha, tuned
        )
        self._losses |= learned.losses
        self._observed |= learned.observed

    def _learn_music(self, minibatches: Minibatches) -> Tensor:
        """[K, B] intrinsic rewards, each minibatch's before the update of its networks."""
        if "estimator" not in self._adam:
            return minibatches.music_rewards(self._music)
        trajectories = minibatches.columns[ESTIMATOR_MODULE]
        rewards, metrics = self._music.learn(
            *minibatches.transitions, minibatches.drawn, trajectories, self._adam["estimator"]
        )
        self._losses |= metrics
        return rewards

    def _log_updates(self, outputs: Mapping[str, Tensor]) -> None:
        """Log the means of the updates' metrics; `outputs` are those of `_step`, stacked to K."""
        losses_of_updates = {name: outputs[name] for name in self._losses}
        q, alpha = self._now.entropic_index, float(self._objective.alpha)
        metrics = losses_of_updates | diagnostics.of_updates(outputs, self._settings, q)
        if self.config.settings.replay.priority == "td_error":
            self._td_errors = diagnostics.td_errors(outputs)
        done = self._grad_updates - len(next(iter(outputs.values())))
        keys, table = list(metrics), torch.stack([m.float() for m in metrics.values()], dim=1)
        # A NaN never leaves the networks again, so one check per call is enough.
        diagnostics.check_finite(keys, table, self._grad_updates, q, alpha)
        means = dict(zip(keys, table.mean(0).tolist(), strict=True))
        if self._settings.policy_delay > 1:
            improving = [self._improves(done + k) for k in range(len(table))]
            losses = outputs[names.POLICY_LOSS][improving]
            del means[names.POLICY_LOSS]
            means |= {names.POLICY_LOSS: float(losses.mean())} if any(improving) else {}
        measured = {**means, **self._now.metrics(), **self._music.metrics(), names.ALPHA: alpha}
        if self.bonus is not None:
            measured |= self.bonus.metrics()
        for key, value in measured.items():
            self.metrics.log_value((DEFAULT_MODULE_ID, key), value, window=1)
        if names.SHANNON_ENTROPY in means:
            self._now.observe("shannon_entropy", means[names.SHANNON_ENTROPY])

    # -- fresh episodes, TD errors --------------------------------------------------------

    @torch.no_grad()
    def diagnose(self, episodes: Sequence[Trajectory], values: Sequence[Floats] | None) -> None:
        """Measure fresh episodes of the policy before they are trained on: the critics' bias.

        `values` are those that the replay keeps for an intrinsic reward by episode.
        """
        fresh = FreshEpisodes.of(episodes, self._policy_module.input_size, self._device)
        rewards, states, followers = fresh.rewards, fresh.states, fresh.followers
        if self._music.is_on:
            intrinsic = self._music.observe(episodes, states, followers, self._generator)
            rewards = self._music.total(rewards, intrinsic, self._now.mi_reward_weight)
        by_minibatch = self.bonus is not None and self.bonus.reward.by_minibatch
        if self.bonus is not None and not by_minibatch:
            batch = self.bonus.batch(states, fresh.actions, followers, self._generator)
            rewards = self._with_bonus(rewards, self.bonus.observe(batch, values))
        noise, n_steps = self._policy_noise(fresh.actions), self.config.settings.replay.n_steps
        if by_minibatch:
            return  # one batch of all steps would have other rewards, and takes much memory
        bias = critic_bias(fresh, rewards, self._policy_module, self._objective, noise, n_steps)
        self.metrics.log_value((DEFAULT_MODULE_ID, names.Q_BIAS), bias, window=1)

    @torch.no_grad()
    def trajectory_priorities(self, episodes: Sequence[Trajectory]) -> NDArray[np.float64]:
        """[N] priorities of the episodes in the replay."""
        frames = [torch.tensor(e.frames, device=self._device) for e in episodes]
        return self._music.priorities(frames, self._generator)

    def take_td_errors(self) -> NDArray[np.float32]:
        """[K*B] absolute TD errors of the last call's transitions, for prioritized replay."""
        errors, self._td_errors = self._td_errors, None
        assert errors is not None
        return np.asarray(errors.cpu(), np.float32)

    # -- normalizer, state ----------------------------------------------------------------

    def observe_inputs(self, inputs: Any) -> None:
        """Update the running normalizer by [B, I] new network inputs (numpy)."""
        normaliser = self._policy_module.normaliser
        if isinstance(normaliser, RunningNormaliser):
            # A remote Learner gets read-only arrays; PyTorch warns about those.
            normaliser.update(torch.tensor(inputs, device=self._device))

    def get_state(self, *args: Any, **kwargs: Any) -> StateDict:
        state = super().get_state(*args, **kwargs)
        state["tac"] = {
            **generator_states(self._generator),
            GRAD_UPDATES: self._grad_updates,
            "held_out": self._music.state(),
            "scheduled": self._now.state(),
            "schedulers": schedulers.scheduler_states(self),
            **({} if self.bonus is None else {"intrinsic": self.bonus.state()}),
        }
        return state

    def _set_optimizer_state(self, state: StateDict) -> None:
        known = self._named_optimizers  # for another one, RLlib would register all of them again
        super()._set_optimizer_state({name: state[name] for name in state if name in known})
        schedulers.apply_configured_rates(self)

    def set_state(self, state: StateDict) -> None:
        # RLlib ignores weights with an older sequence number; a restored state replaces newer ones.
        self._weights_seq_no = 0
        super().set_state(state)
        if "tac" in state:
            self._grad_updates = int(state["tac"][GRAD_UPDATES])
            set_generators(self._generator, state["tac"], self._grad_updates)
            self._music.load_state(state["tac"]["held_out"])
            self._now.load_state(state["tac"]["scheduled"])
            schedulers.load_scheduler_states(self, state["tac"].get("schedulers", {}))
            if self.bonus is not None and "intrinsic" in state["tac"]:
                self.bonus.load_state(state["tac"]["intrinsic"])
