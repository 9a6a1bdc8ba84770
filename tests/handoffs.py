"""Handoffs of a pretrained estimator, without pretraining."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from music_rllib.config.run_settings import RunSettings, variant_music
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.store.handoff import write_handoff
from tests.hostile_files import SPACES


def music_u(task: str = "FetchPush", /, **changes: Any) -> RunSettings:
    """Settings of a run of music-u on a built-in task."""
    built_in = BUILT_IN_TASKS[task]
    music = variant_music("music-u", built_in)
    base = {"task": built_in, "variant": "music-u", "seed": 0, "music": music}
    return RunSettings.model_validate(base | changes)


def write_estimator(folder: Path, run: RunSettings) -> Path:
    """A handoff of this run, with an estimator whose weights are zero."""
    weights = {"mi_estimator": {"w": np.zeros((4, 4), np.float32)}}
    write_handoff(folder, weights, run.handoff_info("0" * 20, 50, SPACES))
    return folder
