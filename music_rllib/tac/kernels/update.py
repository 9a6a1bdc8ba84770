"""TAC's gradient update without autograd.

The same numbers as autograd's to rounding, in about two thirds of its time: no graph, no new
matrices, both minibatches of the critics in one pass, no gradients that nothing needs.

Shape legend: B batch, I network inputs, A action dimensions, C critics.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import torch
from ray.rllib.core.columns import Columns
from torch import Tensor

from music_rllib.functional.squashed_gaussian import deterministic_action
from music_rllib.tac.kernels import derivatives
from music_rllib.tac.kernels.flat import FlatParameters
from music_rllib.tac.kernels.forward import Bootstrap, TACForward
from music_rllib.tac.kernels.mlp import Network, Scratch, critics, perceptron
from music_rllib.tac.kernels.products import Products, products
from music_rllib.tac.rl_module import TACModule, choose_action

__all__ = ["DirectUpdate"]


class DirectUpdate:
    """A forward pass over one minibatch, and the gradients of TAC's losses in `flat.gradients`.

    Args:
        module: on a CPU, of one type of floats. Its trained parameters, but for log alpha, become
            views of one tensor.
        by: the library that multiplies; None for the machine's.
    """

    def __init__(self, module: TACModule, by: Products | None = None) -> None:
        self._module, self._settings = module, module.settings
        named = module.named_parameters()
        trained = [p for name, p in named if p.requires_grad and name != "log_alpha"]
        self.flat = FlatParameters(trained)
        by, scratch = by or products(), Scratch()
        self._policy = perceptron(module.policy, self.flat, by, scratch)
        self._critics = critics(module.critics, self.flat, by, scratch)
        if self._settings.bootstrap == "value":
            self._value = perceptron(module.value, self.flat, by, scratch)
            self._value_target = perceptron(module.value_target, None, by, scratch)
        else:
            self._critics_target = critics(module.critics_target, None, by, scratch)
        if module.deterministic:
            self._policy_target = perceptron(module.policy_target, None, by, scratch)

    # -- forwards -------------------------------------------------------------------------

    @torch.no_grad()
    def forward(self, batch: Mapping[str, Tensor]) -> TACForward:
        """What `TACModule.forward_train` gives; `batch` is documented at `TACLearner`."""
        inputs = self._module.normaliser(batch[Columns.OBS])
        next_inputs = self._module.normaliser(batch[Columns.NEXT_OBS])
        has_value = self._settings.bootstrap == "value"
        if has_value or self._module.deterministic:
            outputs = self._policy.forward(inputs)
            following = self._value_of(next_inputs) if has_value else self._averaged(next_inputs)
        else:  # both in one pass
            both = self._policy.forward(torch.cat([inputs, next_inputs]))
            outputs, of_next = both.split(len(inputs))
            mean, log_std = self._module.distribution(of_next)
            action, log_density = choose_action(mean, log_std, batch["next_noise"])
            following = Bootstrap(self._lowest_target(next_inputs, action), log_density)
        mean, log_std = self._module.distribution(outputs)
        action, log_density = choose_action(mean, log_std, batch.get("noise"))
        self._outputs = outputs
        q_values, q_of_policy = self._ask_critics(inputs, batch[Columns.ACTIONS], action)
        return TACForward(
            action=action,
            log_density=log_density,
            log_std=log_std,
            q_values=q_values,
            q_of_policy=q_of_policy,
            value=self._value.forward(inputs).squeeze(-1) if has_value else None,
            next=following,
        )

    def _value_of(self, next_inputs: Tensor) -> Bootstrap:
        return Bootstrap(self._value_target.forward(next_inputs).squeeze(-1))

    def _averaged(self, next_inputs: Tensor) -> Bootstrap:
        """DDPG's: the averaged critic at the averaged policy's action."""
        action = deterministic_action(self._policy_target.forward(next_inputs))
        return Bootstrap(self._lowest_target(next_inputs, action))

    def _lowest_target(self, inputs: Tensor, action: Tensor) -> Tensor:
        """[B, I], [B, A] -> [B]."""
        return _values(self._critics_target, torch.cat([inputs, action], -1)).amin(0)

    def _ask_critics(self, inputs: Tensor, learned: Tensor, asked: Tensor) -> tuple[Tensor, Tensor]:
        """[C, B] at the minibatch's actions and at the policy's."""
        states = torch.cat([inputs, inputs])
        values = _values(self._critics, torch.cat([states, torch.cat([learned, asked])], -1))
        first, second = values.split(len(inputs), dim=1)
        return first, second

    # -- backwards ------------------------------------------------------------------------

    @torch.no_grad()
    def backward(
        self,
        forward: TACForward,
        batch: Mapping[str, Tensor],
        *,
        target: Tensor,
        value_target: Tensor | None,
        entropic_index: float,
        alpha: Tensor | float,
    ) -> None:
        """Writes the gradients of all losses.

        Args:
            forward: of the last call of `forward`.
            target: [B] of the critics.
            value_target: [B] of the value network; None without one.
            entropic_index: q.
            alpha: entropy coefficient.
        """
        of_action = self._through_critics(forward, target, batch.get("weights"))
        of_outputs = self._through_distribution(forward, batch, of_action, entropic_index, alpha)
        self._policy.backward(of_outputs, learned=len(of_outputs))
        if forward.value is not None:
            assert value_target is not None
            of_value = derivatives.of_value_loss(forward.value, value_target)
            self._value.backward(of_value.unsqueeze(1), learned=len(of_value))

    def _through_critics(
        self, forward: TACForward, target: Tensor, weights: Tensor | None
    ) -> Tensor:
        """[B, A]: of the policy's loss by its actions, the entropy left out."""
        of_learned = derivatives.of_critic_loss(forward.q_values, target, weights)
        counts = derivatives.of_policy_value(forward.q_of_policy, self._settings.policy_critic)
        of_values = torch.cat([of_learned, counts.div_(-len(target))], 1).unsqueeze(-1)
        rows, actions = len(target), slice(self._module.input_size, None)
        of_actions = [
            critic.of_inputs(critic.backward(of_value, learned=rows)[rows:], actions)
            for critic, of_value in zip(self._critics, of_values, strict=True)
        ]
        return functools.reduce(torch.add, of_actions)

    def _through_distribution(
        self,
        forward: TACForward,
        batch: Mapping[str, Tensor],
        of_action: Tensor,
        q: float,
        alpha: Tensor | float,
    ) -> Tensor:
        """[B, A or 2 A]: of the policy's loss by the outputs of its network."""
        settings, action = self._settings, forward.action
        if settings.action_l2 > 0:
            of_action = of_action + derivatives.of_mean_square(action, settings.action_l2)
        if forward.log_density is None or forward.log_std is None:
            return derivatives.through_tanh(of_action, action)
        slope = derivatives.of_ln_q(forward.log_density, q, settings.entropy_form)
        of_mean, of_log_std = derivatives.of_squashed_sample(
            of_action,
            slope * (alpha / len(action)),
            action,
            forward.log_std.exp() * batch["noise"],
        )
        of_raw = self._through_bounds(of_log_std, forward.log_std)
        return torch.cat([of_mean, of_raw], 1)

    def _through_bounds(self, of_log_std: Tensor, log_std: Tensor) -> Tensor:
        """[B, A]: by the network's outputs, given that by the ln sigma made of them."""
        settings = self._settings
        if settings.log_std_form == "tanh":
            return derivatives.through_scaled_tanh(of_log_std, log_std, settings.log_std_bounds)
        raw = self._outputs[:, log_std.shape[1] :]
        return derivatives.through_clamp(of_log_std, raw, log_std)


def _values(networks: list[Network], pairs: Tensor) -> Tensor:
    """[R, I + A] -> [C, R]."""
    return torch.cat([network.forward(pairs) for network in networks], 1).t()
