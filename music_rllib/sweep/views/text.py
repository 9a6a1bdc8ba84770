"""Values in a few characters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from music_rllib import names
from music_rllib.command_line import percent
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import short


def setting_cells(settings: Iterable[str], values: Mapping[str, Any]) -> list[str]:
    """A cell for each setting: its value, or `-` if it has none."""
    return [short(values[name], name) if name in values else "-" for name in settings]


def measured(metric: str, value: float | None) -> str:
    """`35 %` for a rate, `-5.2` for another metric, or `-` for None."""
    return percent(value) if value is None or metric in names.EVAL_RATES else f"{value:.4g}"


def evaluation_text(task: Task, metrics: Mapping[str, float]) -> str:
    """A run's last evaluation by its task's primary metric: `success 35 % (any step 40 %)`."""
    metric = task.primary_metric
    text = f"{names.word_of(metric)} {measured(metric, metrics.get(metric))}"
    if metric != names.EVAL_SUCCESS:
        return text
    return f"{text} (any step {percent(metrics.get(names.EVAL_SUCCESS_ANY))})"
