"""TAC's losses on one minibatch, by the current settings.

Shape legend: B batch, A action dimensions, C critics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from ray.rllib.core.columns import Columns
from torch import Tensor

from music_rllib import names
from music_rllib.config.tac_settings import LearnedAlpha, TACSettings
from music_rllib.functional import actor_critic
from music_rllib.functional.tsallis import ln_q_of_policy
from music_rllib.tac.kernels.forward import Bootstrap, TACForward
from music_rllib.tac.rl_module import TACModule
from music_rllib.tac.scheduled import ScheduledSettings


class Losses(NamedTuple):
    """The losses of a minibatch."""

    total: Tensor
    named: dict[str, Tensor]
    """[] each, by the metric's name."""
    target: Tensor
    """[B] of the critics."""


class Objective:
    """TAC's losses (paper III-B) with the current networks, q and alpha.

    `module` has TAC's networks, with log alpha where it is learned; `now` the scheduled settings.
    """

    def __init__(self, settings: TACSettings, module: TACModule, now: ScheduledSettings) -> None:
        self._settings, self._module, self._now = settings, module, now
        self._no_entropy = torch.zeros((), device=next(module.parameters()).device)
        self.refresh()

    def refresh(self) -> None:
        """Adapts a learned alpha's target to the current q; called once for many updates."""
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
        """The coefficient of the entropy, learned or by its schedule."""
        if isinstance(self._settings.alpha, LearnedAlpha):
            return self._module.log_alpha.detach().exp()
        return self._now.alpha

    def ln_q(self, log_density: Tensor | None) -> Tensor:
        """[B, A] -> [B] ln_q of the policy's density; 0 for a deterministic policy."""
        if log_density is None:
            return self._no_entropy
        return ln_q_of_policy(log_density, self._now.entropic_index, self._settings.entropy_form)

    def soft_value(self, bootstrap: Bootstrap) -> Tensor:
        """[B] value of the states, with the entropy of the policy's action."""
        if bootstrap.log_density is None:
            return bootstrap.value
        return bootstrap.value - self.alpha * self.ln_q(bootstrap.log_density)

    def losses(self, forward: TACForward, batch: Mapping[str, Tensor]) -> Losses:
        """The losses of a minibatch; `batch` has the columns documented at `TACLearner`."""
        settings, alpha = self._settings, self.alpha
        target = actor_critic.critic_target(
            batch[Columns.REWARDS],
            batch["discounts"],
            self.soft_value(forward.next),
            settings.gamma,
            settings.target_bounds,
        )
        ln_q_pi = self.ln_q(forward.log_density)
        critic = actor_critic.critic_loss(forward.q_values, target, batch.get("weights"))
        improved = actor_critic.policy_value(forward.q_of_policy, settings.policy_critic)
        policy = actor_critic.policy_loss(improved, ln_q_pi, alpha)
        if settings.action_l2 > 0:
            policy = policy + settings.action_l2 * forward.action.square().mean()
        total, named = critic + policy, {}
        if forward.value is not None:
            value_target = actor_critic.value_target(forward.q_of_policy, ln_q_pi, alpha)
            value = actor_critic.value_loss(forward.value, value_target)
            total, named[names.VALUE_LOSS] = total + value, value.detach()
        if isinstance(settings.alpha, LearnedAlpha):
            assert forward.log_density is not None
            assert forward.log_std is not None
            excess = self.excess_entropy(
                forward.log_density.detach(), forward.log_std.detach(), ln_q_pi.detach()
            )
            total = total + actor_critic.alpha_loss(self._module.log_alpha, excess)
        named |= {names.CRITIC_LOSS: critic.detach(), names.POLICY_LOSS: policy.detach()}
        return Losses(total, named, target)

    def excess_entropy(self, log_density: Tensor, log_std: Tensor, ln_q_pi: Tensor) -> Tensor:
        """The policy's entropy minus the target of a learned alpha, in the target's own measure.

        [] from log_density and log_std [B, A] and ln_q_pi [B]; the derivative of alpha's loss.
        """
        alpha = self._settings.alpha
        assert isinstance(alpha, LearnedAlpha)
        if alpha.target_shannon is not None:
            return -log_density.sum(-1).mean() - alpha.target_shannon
        if alpha.target_width is not None:
            return log_std.mean() - math.log(alpha.target_width)
        return -ln_q_pi.mean() - self._target_entropy

    def _target_of(self, alpha: LearnedAlpha) -> float:
        """The target S_q; `auto` follows q."""
        if alpha.target_entropy != "auto":
            return float(alpha.target_entropy)
        # S_q of a density of e per dimension: -1 nat each at q = 1, as in SAC.
        ones = torch.ones(1, self._module.action_size)
        return -float(ln_q_of_policy(ones, self._now.entropic_index, self._settings.entropy_form))
