"""What is measured of updates or of fresh episodes. Formulas: docs/algorithms.md.

All updates of a call are measured at once, which takes a tenth of the time of one by one.

Shape legend: K updates, B batch, A action dimensions, S steps of several episodes behind each
other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from music_rllib import names
from music_rllib.config.tac_settings import TACSettings
from music_rllib.functional.tsallis import MAX_EXPONENT, bound_active, ln_q_of_log, ln_q_of_policy

__all__ = [
    "NonFiniteLossError",
    "check_finite",
    "discounted_returns",
    "of_intrinsic_reward",
    "of_policy",
    "of_targets",
    "of_updates",
    "td_errors",
]


class NonFiniteLossError(RuntimeError):
    """A loss became infinite or NaN; the message names it and the update."""


def check_finite(keys: Sequence[str], table: Tensor, updates: int, q: float, alpha: float) -> None:
    """Raises where a metric of a call is not finite.

    Args:
        keys: M names.
        table: [K, M]
        updates: of the run, after this call's.
        q: entropic index, for the message, as `alpha`.

    Raises:
        NonFiniteLossError: names what, and at which update.
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


def of_updates(
    observed: Mapping[str, Tensor], settings: TACSettings, q: float
) -> dict[str, Tensor]:
    """Metrics of K updates, [K] each, from what was observed of them, [K, ...] each."""
    metrics = {names.Q_MEAN: observed["q_values"].mean((1, 2))}
    metrics |= of_targets(observed["targets"], settings.target_bounds)
    if "log_density" in observed:
        density, log_std = observed["log_density"], observed["log_std"]
        form, bounds = settings.entropy_form, settings.log_std_bounds
        metrics |= of_policy(density, log_std, q, form, bounds)
    if "intrinsic" in observed:
        metrics |= of_intrinsic_reward(observed["intrinsic"])
    return metrics


def td_errors(observed: Mapping[str, Tensor]) -> Tensor:
    """[K*B] mean absolute TD error over the critics."""
    errors = observed["q_values"] - observed["targets"].unsqueeze(1)
    return errors.abs().mean(1).flatten()


@torch.no_grad()
def of_policy(
    log_density: Tensor, log_std: Tensor, q: float, form: str, log_std_bounds: tuple[float, float]
) -> dict[str, Tensor]:
    """Entropies of the minibatches' policies, and which of their numerical bounds act.

    Args:
        log_density: [K, B, A] of the policy's actions.
        log_std: [K, B, A]
        q: entropic index.
        form: of ln_q, as `ln_q_of_policy` has it.
        log_std_bounds: what `log_std` was clipped to.
    """
    low, high = log_std_bounds
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
        names.LOG_STD_AT_BOUND: _share((log_std <= low) | (log_std >= high)),
    }


@torch.no_grad()
def of_targets(target: Tensor, bounds: tuple[float, float] | None) -> dict[str, Tensor]:
    """Share of critic targets [K, B] that lie on their bounds; nothing where there are none."""
    if bounds is None:
        return {}
    low, high = bounds
    return {names.CLIPPED_TARGETS: _share((target <= low) | (target >= high))}


@torch.no_grad()
def of_intrinsic_reward(reward: Tensor) -> dict[str, Tensor]:
    """Means of the intrinsic rewards [K, B], and the shares at the ends of their range [-1, 0]."""
    return {
        names.MI_REWARD: reward.mean(1),
        names.MI_REWARD_LOWEST: _share(reward <= -1.0),
        names.MI_REWARD_HIGHEST: _share(reward >= 0.0),
    }


def _share(holds: Tensor) -> Tensor:
    """[K, ...] booleans -> [K]."""
    return holds.flatten(1).float().mean(1)


def discounted_returns(
    rewards: NDArray[np.float64], lengths: Sequence[int], gamma: float
) -> NDArray[np.float64]:
    """Discounted sum of each episode's rewards: [S] and the episodes' lengths -> one each."""
    episodes = np.split(rewards, np.cumsum(lengths)[:-1])
    return np.array([episode @ gamma ** np.arange(len(episode)) for episode in episodes])
