"""The text of `status`, from a sweep's `state.json`."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.experiment.plan import short
from music_rllib.labels import ShortLabels
from music_rllib.search.ranking import best_in_words
from music_rllib.store.node_store import TRAIN_AGAIN
from music_rllib.sweep.views.text import clock, measured

_STATUSES = (
    *("finished", "reused", "started", "interrupted", "waiting", "paused", "pruned"),
    *("failed", "skipped"),
)
"""Statuses of runs, in the order of the columns."""
SHOWN_FAILURES = 20
_STYLES = {"finished": "green", "failed": "red", "interrupted": "yellow", "stopped": "yellow"}


def status_view(state: Mapping[str, Any], labels: Iterable[str]) -> RenderableType:
    """Stages, budget, searches, runs and failures; the `labels` of all runs shorten each label."""
    title = Text(f"Sweep {state['sweep']}: ")
    title.append(state["state"], _STYLES.get(state["state"], "bold"))
    title.append(f"  ({state['place']})", "dim")
    if "driver" not in state:
        return title
    label = ShortLabels.of(labels)
    parts: list[RenderableType] = [title, Text(_driver_text(state)), _stages_table(state)]
    env_steps = state["env_steps"]
    budget = (
        f"Budget: {env_steps['done']:,} env steps spent, {env_steps['left']:,} left of what is "
        "known so far"
    )
    if to_come := env_steps.get("to_come"):
        budget += f", at most {to_come:,} more that searches may ask for"
    parts.append(Text(budget))
    if state["earlier"] is not None:
        parts.append(Text(state["earlier"]))
    if state["best"] is not None:
        parts.append(Text(f"Best so far: {best_in_words(state['best'])}"))
    parts += [_search_text(search) for search in state["searches"]]
    for status in ("running", "interrupted"):
        for run in state.get(status, ()):
            value = f"{names.word_of(run['metric'])} {measured(run['metric'], run['value'])}"
            steps = f"{run['env_steps']:,} / {run['budget']:,} env steps"
            parts.append(Text(f"{status}: {label(run['run'])}  {steps}, {value}"))
    for damaged in state["damaged"]:
        parts.append(Text(f"DAMAGED {label(damaged['run'])}: {damaged['cause']}", style="red"))
    if state["damaged"]:
        parts.append(Text(f"    {TRAIN_AGAIN}", style="dim"))
    for failure in state["failures"][-SHOWN_FAILURES:]:
        parts.append(Text(f"FAILED {label(failure['run'])}: {failure['cause']}", style="red"))
        parts.append(Text(f"    {failure['log']}", style="dim"))
    return Group(*parts)


def _driver_text(state: Mapping[str, Any]) -> str:
    driver = state["driver"]
    end = driver["ended"] or (driver["heartbeat"] if state["state"] != "running" else time.time())
    where = f"process {driver['pid']} on {driver['host']}"
    return f"{where}, {clock(end - driver['started'])} since it was last started"


def _stages_table(state: Mapping[str, Any]) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("stage")
    table.add_column("variant")
    shown = [name for name in _STATUSES if any(name in stage["runs"] for stage in state["stages"])]
    for name in ("trials", "runs", *shown):
        table.add_column(name, justify="right")
    for stage in state["stages"]:
        runs = stage["runs"]
        table.add_row(
            stage["name"],
            stage["variant"],
            str(stage["trials"]),
            str(sum(runs.values())),
            *(str(runs.get(name, 0)) for name in shown),
        )
    return table


def _search_text(search: Mapping[str, Any]) -> Text:
    lines = []
    for arm in search["arms"]:
        fixed = "".join(f" {name}={short(value, name)}" for name, value in arm["values"].items())
        line = (
            f"Search {search['stage']}{fixed}: {arm['judged']} of {len(arm['trials'])} trials "
            f"judged, {arm['pruned']} stopped early, {arm['failed']} failed, "
            f"{arm['running']} running"
        )
        if arm["best"] is not None:
            best = arm["trials"][arm["best"]]
            values = ", ".join(f"{n} = {short(v, n)}" for n, v in best["values"].items())
            numbers = ", ".join(f"{value:.4g}" for value in best["objective"])
            line += f"; best trial {arm['best']}: {numbers} ({values})"
        lines.append(f"{line}\n    study {arm['study']!r} in {search['storage'] or 'study.db'}")
    return Text("\n".join(lines))
