"""Critics that have diverged, told of while a run trains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from music_rllib import names
from music_rllib.config.returns import Range, have_diverged, reward_of_step
from music_rllib.config.run_settings import RunSettings
from music_rllib.store.history import Report


def divergence(run: RunSettings, reports: Sequence[Report]) -> list[str]:
    """A message where the last of a run's reports is the first to show it; else none."""
    task_reward = run.task.reward_range
    if task_reward is None and run.music.task_reward:
        return []  # nobody knows what can be reached
    reward = reward_of_step(Range(*(task_reward or (0.0, 0.0))), run.music)
    metrics = [report.metrics for report in reports]
    means = np.array([of.get(names.Q_MEAN, 0.0) for of in metrics])
    bonuses = np.array([of.get(names.ALPHA, 0.0) * of.get(names.ENTROPY, 0.0) for of in metrics])
    diverged = have_diverged(means, bonuses, reward, run.tac.gamma)
    if not diverged[-1] or diverged[:-1].any():
        return []
    return [
        f"its critics diverge: {means[-1]:.3g} on average, with rewards of {reward} a step "
        f"at gamma {run.tac.gamma:g}"
    ]
