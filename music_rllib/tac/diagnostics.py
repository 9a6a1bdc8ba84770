"""Metrics of gradient updates and of fresh episodes. Formulas: docs/algorithms.md.

All updates of a call are measured at once, which takes a tenth of the time of one by one.

Shape legend: K updates, B batch, A action dimensions, C critics, E fresh episodes, S steps of all
of them, I network inputs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from torch import Tensor

from music_rllib import names
from music_rllib.config.tac_settings import TACSettings
from music_rllib.functional.distribution import (
    MAX_EXPONENT,
    bound_active,
    ln_q_of_log,
    ln_q_of_policy,
)
from music_rllib.replay.trajectories import Trajectory
from music_rllib.tac.losses import TACLoss
from music_rllib.tac.rl_module import TACModule, mean_values


class NonFiniteLossError(RuntimeError):
    """A loss is infinite or NaN; the message names it and the update."""


def check_finite(keys: Sequence[str], table: Tensor, updates: int, q: float, alpha: float) -> None:
    """Raise NonFiniteLossError if a metric of a call is not finite.

    `table` is [K, M] with the metrics named by `keys`, `updates` the number of the last update.
    """
    bad = ~torch.isfinite(table)
    if not bad.any():
        return
    step = int(bad.any(1).nonzero()[0])
    culprits = [key for key, is_bad in zip(keys, bad[step].tolist(), strict=True) if is_bad]
    raise NonFiniteLossError(
        f"{', '.join(culprits)} not finite at gradient update {updates - len(table) + step + 1} "
        f"(entropic_index {q:g}, alpha {alpha:g}). "
        "The run stops here; its last checkpoint is good. Try a smaller tac.lr or tac.alpha, "
        "or an entropic_index nearer to 1."
    )


@torch.no_grad()
def of_updates(
    observed: Mapping[str, Tensor], settings: TACSettings, q: float
) -> dict[str, Tensor]:
    """Metrics of K updates, [K] each, from their observed tensors.

    `observed` has `q_values` [K, C, B] and `targets` [K, B]; with a stochastic policy `log_density`
    and `log_std` [K, B, A]; with an intrinsic reward `intrinsic` [K, B].
    """
    target = observed["targets"]
    metrics = {names.Q_MEAN: observed["q_values"].mean((1, 2))}
    if settings.target_bounds is not None:
        low, high = settings.target_bounds
        # The mean of equal atoms may round to a number beside them.
        share = 1e-5 if settings.quantiles else 0.0
        bounds = low + share * abs(low), high - share * abs(high)
        metrics[names.CLIPPED_TARGETS] = _share_at_bounds(target, bounds)
    if "log_density" in observed:
        metrics |= _of_policy(observed["log_density"], q, settings.entropy_form)
        log_std, bounds = observed["log_std"], settings.log_std_bounds
        metrics[names.LOG_STD_AT_BOUND] = _share_at_bounds(log_std, bounds)
    if "intrinsic" in observed:
        reward = observed["intrinsic"]
        metrics[names.MI_REWARD] = reward.mean(1)
        metrics[names.MI_REWARD_LOWEST] = _share(reward <= -1.0)
        metrics[names.MI_REWARD_HIGHEST] = _share(reward >= 0.0)
    return metrics


def td_errors(observed: Mapping[str, Tensor]) -> Tensor:
    """[K*B] mean absolute TD error over the critics."""
    errors = observed["q_values"] - observed["targets"].unsqueeze(1)
    return errors.abs().mean(1).flatten()


def _of_policy(log_density: Tensor, q: float, form: str) -> dict[str, Tensor]:
    """Entropies of the policy, and the share of densities beyond the bound of ln_q.

    `log_density` is [K, B, A].
    """
    # Bounded as in the losses: a metric that overflows would stop a run whose losses are finite.
    tsallis = -ln_q_of_log(log_density, q, max_exponent=MAX_EXPONENT).mean(1)
    shannon = -log_density.mean(1)
    per_dimension = {f"{names.ENTROPY_OF_DIMENSION}{i}": s for i, s in enumerate(tsallis.T)}
    per_dimension |= {f"{names.SHANNON_OF_DIMENSION}{i}": s for i, s in enumerate(shannon.T)}
    bounded = log_density if form == "per_dimension" else log_density.sum(-1)
    return per_dimension | {
        names.ENTROPY: -ln_q_of_policy(log_density, q, form).mean(1),
        names.SHANNON_ENTROPY: shannon.sum(1),
        names.CLIPPED_DENSITIES: _share(bound_active(bounded, q)),
    }


def _share_at_bounds(values: Tensor, bounds: tuple[float, float]) -> Tensor:
    low, high = bounds
    return _share((values <= low) | (values >= high))


def _share(holds: Tensor) -> Tensor:
    """[K, ...] booleans -> [K]."""
    return holds.flatten(1).float().mean(1)


# -- fresh episodes, before they are trained on ----------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class FreshEpisodes:
    """Concatenated episodes: states and next states [S, I], actions [S, A], task rewards [S]."""

    states: Tensor
    followers: Tensor
    actions: Tensor
    rewards: Tensor
    lengths: list[int]
    """[E] steps of each episode."""
    terminated: NDArray[np.bool_]
    """[E]"""

    @classmethod
    def of(cls, episodes: Sequence[Trajectory], inputs: int, device: torch.device) -> FreshEpisodes:
        """The episodes on a device; the first `inputs` columns of a frame are a network's input."""

        def concatenated(arrays: Sequence[NDArray[Any]]) -> Tensor:
            return torch.as_tensor(np.concatenate(arrays), device=device)

        return cls(
            states=concatenated([episode.frames[:-1, :inputs] for episode in episodes]),
            followers=concatenated([episode.frames[1:, :inputs] for episode in episodes]),
            actions=concatenated([episode.actions for episode in episodes]),
            rewards=concatenated([episode.rewards for episode in episodes]),
            lengths=[len(episode) for episode in episodes],
            terminated=np.array([episode.terminated for episode in episodes]),
        )


def critic_bias(
    fresh: FreshEpisodes,
    rewards: Tensor,
    module: TACModule,
    objective: TACLoss,
    noise: Mapping[str, Tensor],
    n_steps: int = 1,
) -> float:
    """Mean over episodes of the critics' value of the first step minus the realized return.

    Args:
        rewards: [S] with the intrinsic reward.
        objective: gives the entropy's part of the return, and the value after a truncation.
        noise: standard normal noise [S, A] for the policy's actions, by name.
        n_steps: of the critics' targets, which leave out the entropies of the steps in between.
    """
    first = np.cumsum([0, *fresh.lengths[:-1]])
    last = np.cumsum(fresh.lengths) - 1
    normalised = module.normaliser(fresh.states)
    _, log_density, _ = module.sample_with_density(normalised, noise.get("noise"))
    entropy = -objective.ln_q(log_density).expand(len(rewards))
    earned = (rewards + float(objective.alpha) * entropy).cpu().numpy().astype(float)
    # A critic's value does not include the entropy of the action that it is given.
    steps = np.concatenate([np.arange(length) for length in fresh.lengths])
    without = (steps == 0) | (steps % n_steps > 0)
    earned[without] = rewards.cpu().numpy()[without]
    ends = {Columns.NEXT_OBS: fresh.followers[last]}
    ends |= {name: values[last] for name, values in noise.items()}
    tails = objective.soft_value(module.forward_target(ends))
    tail = (tails.mean(-1) if tails.ndim == 2 else tails).cpu().numpy()
    gamma = objective.gamma
    episodes = np.split(earned, first[1:])
    realized = np.array([episode @ gamma ** np.arange(len(episode)) for episode in episodes])
    realized += ~fresh.terminated * gamma ** np.array(fresh.lengths) * tail
    inputs = torch.cat([module.normaliser(fresh.states[first]), fresh.actions[first]], -1)
    predicted = mean_values(module.critics(inputs)).amin(0).cpu().numpy()
    return float((predicted - realized).mean())
