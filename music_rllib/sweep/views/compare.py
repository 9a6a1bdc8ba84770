"""The answer of `compare` as tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.experiment.plan import short
from music_rllib.labels import symbol
from music_rllib.results.statistics import with_interval
from music_rllib.sweep.views.tables import new_table, seeds_in_words
from music_rllib.sweep.views.text import percent

IN_THE_SEARCH = "in the search"
"""Part of a group of trials on the seeds that they were chosen by."""


def compare_view(document: Mapping[str, Any]) -> RenderableType:
    """The answer, the comparisons, and a table for each group of conditions."""
    earlier = [Text(document["earlier"])] if document["earlier"] else []
    if not document["groups"]:
        text = f"Stage {document['stage']} of {document['sweep']} has no finished run yet."
        return Group(Text(text), *earlier)
    parts: list[RenderableType] = [*map(Text, document["answer"]), *earlier, Text()]
    parts += [Text(line, style="yellow") for line in document["environments"]]
    if document["comparisons"]:
        parts.append(_comparisons_table(document["comparisons"]))
    if document["conditions"]:
        parts.append(_areas_table(document["conditions"]))
    for group in document["groups"]:
        parts.append(_group_table(document["stage"], group))
        if group["part"] == IN_THE_SEARCH:
            parts.append(Text("Trials were chosen by these runs: their order is biased."))
        if any(row["entropies"] for row in group["conditions"]):
            parts.append(_entropies_table(group))
    return Group(*parts)


def _comparisons_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    task = _task_column(rows)
    heads = ("first - second", *task, "difference", "interval", "p", "verdict", "planned")
    table = new_table("Comparisons", heads, left=heads)
    for row in rows:
        verdict, interval, p_value = row["in_words"]
        table.add_row(
            f"{row['first']} - {row['second']}",
            *(row[name] for name in task),
            f"{row['difference']:+.3g}",
            interval,
            p_value.removeprefix("p = "),
            verdict,
            "yes" if row["planned"] else "no",
        )
    return table


def _areas_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    measure = " or ".join(dict.fromkeys(row["measure"] for row in rows))
    task = _task_column(rows)
    heads = ("condition", *task, "mean, 95 %", "each seed", "runs")
    table = new_table(f"Compared by: {measure}", heads, left=["condition"])
    for row in rows:
        table.add_row(
            row["condition"],
            *(row[name] for name in task),
            with_interval(row["value"], (row["lower"], row["upper"])),
            seeds_in_words(list(row["by_seed"].values())),
            f"{row['seeds']} of {row['runs']}"
            + (f", {row['failed']} failed" * (row["failed"] > 0)),
        )
    return table


def _group_table(stage: str, group: Mapping[str, Any]) -> Table:
    rows = group["conditions"]
    title = f"Final {group['metric']} of {stage} on {group['tasks']} {group['part']}".strip()
    settings = dict.fromkeys(name for row in rows for name in row["values"])
    numbers = ("mean, 95 %", "each seed", "runs", "best - this, 95 %", "P(best is\nbetter)")
    table = new_table(title, (*_setting_heads(settings), *numbers))
    for row in rows:
        table.add_row(
            *(
                short(row["values"][name], name) if name in row["values"] else "-"
                for name in settings
            ),
            with_interval(row["value"], row["interval"]),
            seeds_in_words(row["seeds"]),
            f"{row['runs']} of {row['planned']}",
            "" if row["gap"] is None else with_interval(row["gap"], row["gap_interval"]),
            percent(row["best_is_better_with"]),
        )
    return table


def _entropies_table(group: Mapping[str, Any]) -> Table:
    title = f"Entropy of the policies at the end on {group['tasks']}"
    table = Table(title=title, title_justify="left")
    for name in ("condition", "Shannon, nats, 95 %", "S_q, 95 %"):
        table.add_column(name, justify="left" if name == "condition" else "right")
    for row in group["conditions"]:
        entropies = [row["entropies"].get(metric) for metric in names.ENTROPIES]
        cells = ("-" if e is None else with_interval(e["value"], e["interval"]) for e in entropies)
        table.add_row(row["label"], *cells)
    return table


def _task_column(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The head of the column of tasks, where there are several."""
    return ["task"] if len({row["task"] for row in rows}) > 1 else []


def _setting_heads(settings: Iterable[str]) -> list[str]:
    """Settings as labels call them, or by their whole names where that would be ambiguous."""
    brief = [symbol(name) for name in settings]
    return brief if len(set(brief)) == len(brief) else list(settings)
