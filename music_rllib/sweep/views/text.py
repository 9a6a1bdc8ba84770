"""Values in a few characters, for tables, lines and tags."""

from __future__ import annotations

from collections.abc import Mapping

from music_rllib import names
from music_rllib.envs.tasks import Task


def percent(value: float | None) -> str:
    """`35 %`, or `-` for None."""
    return "-" if value is None else f"{100 * value:.0f} %"


def measured(metric: str, value: float | None) -> str:
    """`35 %` of a rate, `-5.2` of another metric, or `-` for None."""
    return percent(value) if value is None or metric in names.EVAL_RATES else f"{value:.4g}"


def evaluated_in_words(task: Task, metrics: Mapping[str, float]) -> str:
    """A run's last evaluation by its task's own metric: `success 35 % (any step 40 %)`."""
    metric = task.primary_metric
    text = f"{names.word_of(metric)} {measured(metric, metrics.get(metric))}"
    if metric != names.EVAL_SUCCESS:
        return text
    return f"{text} (any step {percent(metrics.get(names.EVAL_SUCCESS_ANY))})"


def clock(seconds: float | None) -> str:
    """`1:02:03`, `2:03`, or `-` for None."""
    if seconds is None:
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
