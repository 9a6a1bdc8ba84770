"""Runs on FetchPush with a replay of random trajectories, for measurements of memory and size."""

from __future__ import annotations

import numpy as np

from benchmarks.sampling import LAYOUT, random_trajectory
from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.replay.buffer import TrajectoryReplay

__all__ = ["fill", "settings"]


def settings(env_steps: int = 10**6, seed: int = 0) -> RunSettings:
    """TAC with HER as measured for preset `small`: 3 x 256 networks, 0.4 updates per step."""
    return RunSettings.model_validate(
        {
            "task": BUILT_IN_TASKS["FetchPush"],
            "variant": "tac",
            "seed": seed,
            "env_steps": env_steps,
            "evaluation": {"interval": max(env_steps // 2, 1), "episodes": 4},
            "tac": {"replay_ratio": 0.4, "random_steps": 400},
            "replay": {"capacity": 10**6, "hindsight_k": 4.0},
        }
    )


def fill(replay: TrajectoryReplay, transitions: int) -> None:
    """Add random trajectories until the replay holds `transitions` transitions."""
    rng = np.random.default_rng(0)
    some = [random_trajectory(rng) for _ in range(100)]
    while len(replay) < transitions:
        replay.extend(some)
    assert replay.layout == LAYOUT
