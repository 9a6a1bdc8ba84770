"""The same TAC update in bare torch: no RLlib, no replay. The reference for the Learner's speed.

Optimized: batched critics, no critic gradients in the policy's step, fused Adam, one backward pass.
"""

from __future__ import annotations

import torch
from torch import Tensor

from music_rllib.functional import actor_critic
from music_rllib.functional.distribution import ln_q_of_policy, sample_squashed
from music_rllib.kernels.adam import FusedAdam
from music_rllib.tac.networks import Critics, Perceptron, RunningNormaliser

HIDDEN = (256, 256, 256)


class RawUpdate:
    """Five networks and their update on data that is already in memory."""

    def __init__(self, inputs: int, actions: int, batch: int, *, q: float, alpha: float) -> None:
        torch.manual_seed(0)
        self.q, self.alpha = q, alpha
        self.policy = Perceptron(inputs, HIDDEN, 2 * actions)
        self.critics = Critics(inputs + actions, HIDDEN)
        self.value = Perceptron(inputs, HIDDEN, 1)
        self.target = Perceptron(inputs, HIDDEN, 1)
        self.target.requires_grad_(False)
        self.normaliser = RunningNormaliser(inputs, epsilon=0.01, clip=5.0)
        self.normaliser.update(torch.randn(1000, inputs))
        trained = [*self.policy.parameters(), *self.critics.parameters(), *self.value.parameters()]
        self.optimizer = FusedAdam(trained, lr=1e-3)
        self.targets: list[Tensor] = list(self.target.parameters())
        self.online: list[Tensor] = list(self.value.parameters())
        self.obs, self.next_obs = torch.randn(2, batch, inputs)
        self.actions = torch.rand(batch, actions) * 2 - 1
        self.reward, self.discount = -torch.ones(batch), torch.ones(batch)

    def step(self) -> Tensor:
        """One update."""
        obs = self.normaliser(self.obs)
        with torch.no_grad():
            next_value = self.target(self.normaliser(self.next_obs)).squeeze(-1)
        mean, log_std = self.policy(obs).chunk(2, -1)
        sample = sample_squashed(mean, log_std.clamp(-20, 2), torch.randn_like(mean))
        ln_q_pi = ln_q_of_policy(sample.log_density, self.q, "per_dimension")
        q_data = self.critics(torch.cat([obs, self.actions], -1))
        q_policy = self.critics(torch.cat([obs, sample.action], -1), frozen=True)
        value = self.value(obs).squeeze(-1)
        target = actor_critic.critic_target(self.reward, self.discount, next_value, 0.98)
        loss = (
            actor_critic.critic_loss(q_data, target)
            + actor_critic.value_loss(
                value, actor_critic.value_target(q_policy, ln_q_pi, self.alpha)
            )
            + actor_critic.policy_loss(q_policy.amin(0), ln_q_pi, self.alpha)
        )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(self.targets, self.online, 0.005)
        return loss.detach()
