"""`compare` as a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib.experiment.plan import short
from music_rllib.results.comparison import with_interval
from music_rllib.sweep.views.tables import seeds_in_words
from music_rllib.sweep.views.text import percent

__all__ = ["compare_view"]


def compare_view(document: Mapping[str, Any]) -> RenderableType:
    """One table for each group of conditions that may be compared."""
    if not document["groups"]:
        return Text(f"Stage {document['stage']} of {document['sweep']} has no finished run yet.")
    parts: list[RenderableType] = []
    for group in document["groups"]:
        parts += [_table(document, group), Text(group["verdict"])]
    return Group(*parts)


def _table(document: Mapping[str, Any], group: Mapping[str, Any]) -> Table:
    rows = group["conditions"]
    title = f"{group['metric']} of {document['stage']} on {group['tasks']} {group['part']}".strip()
    table = Table(title=title, title_justify="left")
    settings = dict.fromkeys(name for row in rows for name in row["values"])
    for name in (
        *settings,
        "mean, 95 %",
        "each seed",
        "runs",
        "gap, 95 %",
        "P(first is better)",
        "p",
    ):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            *(short(row["values"][name]) if name in row["values"] else "-" for name in settings),
            with_interval(row["value"], row["interval"]),
            seeds_in_words(row["seeds"]),
            f"{row['runs']} of {row['planned']}",
            "" if row["gap"] is None else with_interval(row["gap"], row["gap_interval"]),
            percent(row["best_is_better_with"]),
            "" if row["p_value"] is None else f"{row['p_value']:.2g}",
        )
    return table
