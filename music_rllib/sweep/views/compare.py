"""`compare` as a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.experiment.plan import short
from music_rllib.labels import symbol
from music_rllib.results.comparison import with_interval
from music_rllib.sweep.views.tables import new_table, seeds_in_words
from music_rllib.sweep.views.text import percent

__all__ = ["compare_view"]


def compare_view(document: Mapping[str, Any]) -> RenderableType:
    """One table for each group of conditions that may be compared."""
    if not document["groups"]:
        return Text(f"Stage {document['stage']} of {document['sweep']} has no finished run yet.")
    parts: list[RenderableType] = [*map(Text, document["answer"]), Text()]
    if document["comparisons"]:
        parts.append(_comparisons(document))
    if document["conditions"]:
        parts.append(_primary(document))
    for group in document["groups"]:
        parts += [_table(document, group), Text(group["verdict"])]
        if any(row["entropies"] for row in group["conditions"]):
            parts.append(_entropies(group))
    return Group(*parts)


def _comparisons(document: Mapping[str, Any]) -> Table:
    rows = document["comparisons"]
    table = new_table("Comparisons")
    for name in ("first - second", *_task(rows), "difference, 95 %", "p", "verdict", "planned"):
        table.add_column(name, overflow="fold")
    for row in rows:
        within = row["verdict"] == "equivalent"
        p_value = row["p_equivalent_holm"] if within else row["p_value_holm"]
        table.add_row(
            f"{row['first']} - {row['second']}",
            *(row[name] for name in _task(rows)),
            with_interval(row["difference"], (row["lower"], row["upper"])),
            f"{p_value:.2g}",
            f"{row['verdict']} (within {row['margin']:g})" if within else row["verdict"],
            "yes" if row["planned"] else "no",
        )
    return table


def _primary(document: Mapping[str, Any]) -> Table:
    rows = document["conditions"]
    measure = " or ".join(dict.fromkeys(row["measure"] for row in rows))
    title = f"Area under the learning curve: {measure}"
    table = new_table(title)
    for name in ("condition", *_task(rows), "mean, 95 %", "each seed", "runs"):
        table.add_column(name, justify="left" if name == "condition" else "right", overflow="fold")
    for row in rows:
        table.add_row(
            row["condition"],
            *(row[name] for name in _task(rows)),
            with_interval(row["value"], (row["lower"], row["upper"])),
            seeds_in_words(list(row["by_seed"].values())),
            f"{row['seeds']} of {row['runs']}",
        )
    return table


def _table(document: Mapping[str, Any], group: Mapping[str, Any]) -> Table:
    rows = group["conditions"]
    title = f"{group['metric']} of {document['stage']} on {group['tasks']} {group['part']}".strip()
    table = new_table(title)
    settings = dict.fromkeys(name for row in rows for name in row["values"])
    for name in (
        *_heads(settings),
        "mean, 95 %",
        "each seed",
        "runs",
        "gap, 95 %",
        "P(first\nis better)",
        "p",
    ):
        table.add_column(name, justify="right", overflow="fold")
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


def _entropies(group: Mapping[str, Any]) -> Table:
    table = Table(title=f"Entropy of the policies at the end on {group['tasks']}")
    table.title_justify = "left"
    for name in ("condition", "Shannon, nats, 95 %", "S_q, 95 %"):
        table.add_column(name, justify="left" if name == "condition" else "right")
    for row in group["conditions"]:
        found = [row["entropies"].get(metric) for metric in names.ENTROPIES]
        cells = (
            "-" if one is None else with_interval(one["value"], one["interval"]) for one in found
        )
        table.add_row(row["label"], *cells)
    return table


def _task(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The column of tasks, where there are several."""
    return ["task"] if len({row["task"] for row in rows}) > 1 else []


def _heads(settings: Iterable[str]) -> list[str]:
    """Columns' heads, as labels call the settings, or whole where that would be ambiguous."""
    brief = [symbol(name) for name in settings]
    return brief if len(set(brief)) == len(brief) else list(settings)
