"""Tables, and values in a few characters."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from rich.table import Table

from music_rllib import names
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import short


def new_table(title: str, heads: Iterable[str], left: Collection[str] = ()) -> Table:
    """A table whose cells are folded and never cut.

    Args:
        title: Text above it.
        heads: Heads of its columns, in order.
        left: Heads of the left-aligned columns of text; numbers are right-aligned.
    """
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for head in heads:
        table.add_column(head, justify="left" if head in left else "right", overflow="fold")
    return table


def setting_cells(settings: Iterable[str], values: Mapping[str, Any]) -> list[str]:
    """A cell for each setting: its value, or `-` if it has none."""
    return [short(values[name], name) if name in values else "-" for name in settings]


def percent(value: float | None) -> str:
    """`35 %`, or `-` for None."""
    return "-" if value is None else f"{100 * value:.0f} %"


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


def clock(seconds: float | None) -> str:
    """`1:02:03`, `2:03`, or `-` for None."""
    if seconds is None:
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
