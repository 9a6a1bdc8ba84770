"""Values in a few characters, for tables, lines and tags."""

from __future__ import annotations

from collections.abc import Mapping

from music_rllib import names
from music_rllib.config.tac_settings import LearnedAlpha, MatchedAlpha, NormalisedAlpha
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import short
from music_rllib.schedules import Linear, Measured, Piecewise

__all__ = ["clock", "evaluated_in_words", "in_words", "measured", "percent"]


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


def in_words(
    value: float | Linear | Piecewise | Measured | LearnedAlpha | MatchedAlpha | NormalisedAlpha,
) -> str:
    """A constant, a schedule or a coefficient in a few characters: `1.5`, `1 to 2`, `learned`."""
    match value:
        case MatchedAlpha():
            return f"{in_words(value.value)} matched at {value.matched_width:g}"
        case NormalisedAlpha():
            return f"{in_words(value.value)} normalised"
        case Linear():
            return f"{value.start:g} to {value.end:g}"
        case Measured():
            quantity = value.follows.replace("_", " ")
            return f"{' to '.join(f'{point:g}' for _, point in value.points)} by {quantity}"
        case Piecewise():
            return " to ".join(f"{point:g}" for _, point in value.points)
        case LearnedAlpha(target_shannon=float(nats)):
            return f"learned, {nats:g} nats"
        case LearnedAlpha(target_width=float(width)):
            return f"learned, width {width:g}"
        case LearnedAlpha():
            return "learned"
        case _:
            return short(float(value))
