"""TAC's losses on one minibatch, and the current values of settings that change over a run.

Shape legend: B batch, A action dimensions, C critics, T atoms of a target.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from ray.rllib.core.columns import Columns
from torch import Tensor

from music_rllib import names
from music_rllib.config.tac_settings import LearnedAlpha, TACSettings, alpha_at
from music_rllib.functional import actor_critic
from music_rllib.functional.distribution import ln_q_of_policy
from music_rllib.intrinsic.settings import IntrinsicSettings, MusicSettings
from music_rllib.schedules import Follower, Measured, Quantity, value_at
from music_rllib.tac.rl_module import Bootstrap, TACForward, TACModule


class ScheduledSettings:
    """q, alpha and the weights of intrinsic rewards at the time of the last `advance`.

    Args:
        total_env_steps: the run's budget; 0 if it is unknown.
        actions: number of action dimensions.
    """

    entropic_index: float
    mi_reward_weight: float
    intrinsic_weight: float
    alpha: float
    """Alpha at the current q; unused if alpha is learned."""

    def __init__(
        self, tac: TACSettings, music: MusicSettings, intrinsic: IntrinsicSettings,
        total_env_steps: int, actions: int,
    ) -> None:  # fmt: skip
        self._tac, self._music, self._intrinsic = tac, music, intrinsic
        self._total, self._actions = total_env_steps, actions
        adaptive = {
            names.ENTROPIC_INDEX: tac.entropic_index,
            names.MI_REWARD_WEIGHT: music.mi_reward_weight,
            names.INTRINSIC_WEIGHT: intrinsic.weight if intrinsic.reward else 0.0,
        }
        self._followers = {
            name: Follower(value) for name, value in adaptive.items() if isinstance(value, Measured)
        }
        self._set(0, {})

    def advance(self, env_steps: int) -> None:
        """Set the values for `env_steps`, using the measurements so far."""
        self._set(env_steps, {name: each.measured for name, each in self._followers.items()})

    def _set(self, env_steps: int, followed: dict[str, float | None]) -> None:
        self._env_steps, self._followed = env_steps, followed
        tac, time = self._tac, (env_steps, self._total)
        self.entropic_index = value_at(
            tac.entropic_index, *time, followed.get(names.ENTROPIC_INDEX)
        )
        self.mi_reward_weight = value_at(
            self._music.mi_reward_weight, *time, followed.get(names.MI_REWARD_WEIGHT)
        )
        self.intrinsic_weight = value_at(
            self._intrinsic.weight, *time, followed.get(names.INTRINSIC_WEIGHT)
        )
        self.alpha = alpha_at(tac, self.entropic_index, *time, self._actions)

    def observe(self, quantity: Quantity, measured: float, env_steps: int | None = None) -> None:
        """Record a measurement made after `env_steps`, or at the last `advance`."""
        at = self._env_steps if env_steps is None else env_steps
        for follower in self._followers.values():
            follower.observe(quantity, measured, at)

    def metrics(self) -> dict[str, float]:
        """The values without alpha, and the measurements that they follow, by metric name."""
        followed = {
            names.FOLLOWED[name]: measured
            for name, measured in self._followed.items()
            if measured is not None
        }
        weights = {names.MI_REWARD_WEIGHT: self.mi_reward_weight}
        if self._intrinsic.reward is not None:
            weights[names.INTRINSIC_WEIGHT] = self.intrinsic_weight
        return {names.ENTROPIC_INDEX: self.entropic_index, **weights, **followed}

    def state(self) -> dict[str, Any]:
        """The state for a checkpoint; fresh episodes are measured with the last update's values."""
        return {
            "env_steps": self._env_steps,
            "followed": dict(self._followed),
            "followers": {name: follower.state() for name, follower in self._followers.items()},
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        self._set(state["env_steps"], dict(state["followed"]))
        for name, follower in self._followers.items():
            if name in state["followers"]:  # else the setting did not follow anything
                follower.load_state(state["followers"][name])


class Losses(NamedTuple):
    """The losses of a minibatch."""

    total: Tensor
    named: dict[str, Tensor]
    """[] each, by the metric's name."""
    target: Tensor
    """[B] the critics' targets."""


class TACLoss:
    """TAC's losses (paper III-B) with the current networks, q and alpha.

    `module` has TAC's networks, with log alpha if it is learned; `now` the scheduled settings.
    """

    def __init__(self, settings: TACSettings, module: TACModule, now: ScheduledSettings) -> None:
        self._settings, self._module, self._now = settings, module, now
        self._no_entropy = torch.zeros((), device=next(module.parameters()).device)
        self.refresh()

    def refresh(self) -> None:
        """Adapt a learned alpha's target to the current q; called once for many updates."""
        alpha = self._settings.alpha
        self._target_entropy = 0.0
        if isinstance(alpha, LearnedAlpha):
            self._target_entropy = self._target_of(alpha)

    @property
    def gamma(self) -> float:
        """The discount factor."""
        return self._settings.gamma

    @property
    def alpha(self) -> Tensor | float:
        """The coefficient of the entropy, learned or scheduled."""
        if isinstance(self._settings.alpha, LearnedAlpha):
            return self._module.log_alpha.detach().exp()
        return self._now.alpha

    def ln_q(self, log_density: Tensor | None) -> Tensor:
        """[B, A] -> [B] ln_q of the policy's density; 0 for a deterministic policy."""
        if log_density is None:
            return self._no_entropy
        return ln_q_of_policy(log_density, self._now.entropic_index, self._settings.entropy_form)

    def soft_value(self, bootstrap: Bootstrap) -> Tensor:
        """[B] or [B, T] value of the states, including the entropy of the policy's action."""
        if bootstrap.log_density is None:
            return bootstrap.value
        bonus = self.alpha * self.ln_q(bootstrap.log_density)
        return bootstrap.value - (bonus if bootstrap.value.ndim == 1 else bonus[:, None])

    def losses(
        self, forward: TACForward, batch: Mapping[str, Tensor], *, improves: bool = True
    ) -> Losses:
        """The losses of a minibatch; `batch` has the columns documented in `minibatches`.

        Unless the update `improves` the policy, the total lacks the losses of policy and alpha.
        """
        settings, alpha = self._settings, self.alpha
        target, critic = self._critics(forward, batch)
        ln_q_pi = self.ln_q(forward.log_density)
        improved = actor_critic.policy_value(forward.q_of_policy, settings.policy_critic)
        policy = actor_critic.policy_loss(improved, ln_q_pi, alpha)
        if settings.action_l2 > 0:
            policy = policy + settings.action_l2 * forward.action.square().mean()
        total, named = critic + policy if improves else critic, {}
        if forward.value is not None:
            which = batch.get("target_critics", slice(None))
            value_target = actor_critic.value_target(forward.q_of_policy[which], ln_q_pi, alpha)
            value = actor_critic.value_loss(forward.value, value_target)
            total, named[names.VALUE_LOSS] = total + value, value.detach()
        if improves and isinstance(settings.alpha, LearnedAlpha):
            assert forward.log_density is not None
            assert forward.log_std is not None
            excess = self.excess_entropy(
                forward.log_density.detach(), forward.log_std.detach(), ln_q_pi.detach()
            )
            total = total + actor_critic.alpha_loss(self._module.log_alpha, excess)
        named |= {names.CRITIC_LOSS: critic.detach(), names.POLICY_LOSS: policy.detach()}
        return Losses(total, named, target)

    def _critics(self, forward: TACForward, batch: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The critics' targets [B], means of their atoms, and the critics' loss []."""
        settings, value = self._settings, self.soft_value(forward.next)
        reward, discount = batch[Columns.REWARDS], batch["discounts"]
        if value.ndim == 2:
            reward, discount = reward[:, None], discount[:, None]
        target = actor_critic.critic_target(
            reward, discount, value, settings.gamma, settings.target_bounds
        )
        weights, fractions = batch.get("weights"), self._module.quantile_fractions
        if fractions is None:
            return target, actor_critic.critic_loss(forward.q_values, target, weights)
        loss = actor_critic.quantile_loss(forward.q_values, fractions, target, weights)
        return target.mean(-1), loss

    def excess_entropy(self, log_density: Tensor, log_std: Tensor, ln_q_pi: Tensor) -> Tensor:
        """The policy's entropy minus a learned alpha's target, in the target's own measure.

        [] from log_density and log_std [B, A] and ln_q_pi [B]; the derivative of alpha's loss.
        """
        which, target = self.alpha_target
        measures = (-ln_q_pi.mean(), -log_density.sum(-1).mean(), log_std.mean())
        return measures[which] - target

    @property
    def alpha_target(self) -> tuple[int, float]:
        """Measure and target of a learned alpha, for the kernel `alpha_loss_backward`."""
        alpha = self._settings.alpha
        assert isinstance(alpha, LearnedAlpha)
        if alpha.target_shannon is not None:
            return 1, alpha.target_shannon
        if alpha.target_width is not None:
            return 2, math.log(alpha.target_width)
        return 0, self._target_entropy

    def _target_of(self, alpha: LearnedAlpha) -> float:
        """The target S_q; `auto` follows q."""
        if alpha.target_entropy != "auto":
            return float(alpha.target_entropy)
        # S_q of a density of e per dimension: -1 nat each at q = 1, as in SAC.
        ones = torch.ones(1, self._module.action_size)
        return -float(ln_q_of_policy(ones, self._now.entropic_index, self._settings.entropy_form))
