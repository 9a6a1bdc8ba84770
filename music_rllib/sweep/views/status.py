"""The view of `status`, from a sweep's `state.json`."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.command_line import clock, new_table
from music_rllib.experiment.plan import short
from music_rllib.names import ShortLabels
from music_rllib.search.best import best_text
from music_rllib.store.node_store import TRAIN_AGAIN
from music_rllib.sweep.views.results import measured

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
    lines = (Text(line) for line in _progress_lines(state))
    problems = _problem_lines(state, ShortLabels.of(labels))
    return Group(title, Text(_driver_text(state)), _stages_table(state), *lines, *problems)


def _driver_text(state: Mapping[str, Any]) -> str:
    driver = state["driver"]
    end = driver["ended"] or (driver["heartbeat"] if state["state"] != "running" else time.time())
    where = f"process {driver['pid']} on {driver['host']}"
    return f"{where}, {clock(end - driver['started'])} since its last start"


def _stages_table(state: Mapping[str, Any]) -> Table:
    shown = [name for name in _STATUSES if any(name in stage["runs"] for stage in state["stages"])]
    table = new_table("", ("stage", "variant", "trials", "runs", *shown), ("stage", "variant"))
    for stage in state["stages"]:
        runs = stage["runs"]
        counts = (stage["trials"], sum(runs.values()), *(runs.get(name, 0) for name in shown))
        table.add_row(stage["name"], stage["variant"], *map(str, counts))
    return table


def _progress_lines(state: Mapping[str, Any]) -> Iterator[str]:
    env_steps = state["env_steps"]
    more = env_steps.get("to_come")
    searched = f", at most {more:,} more if the searches need them" if more else ""
    yield f"Budget: {env_steps['done']:,} env steps done, {env_steps['left']:,} left{searched}"
    if state["earlier"] is not None:
        yield state["earlier"]
    if state["best"] is not None:
        yield f"Best so far: {best_text(state['best'])}"
    for search in state["searches"]:
        for arm in search["arms"]:
            yield _study_text(search, arm)


def _study_text(search: Mapping[str, Any], arm: Mapping[str, Any]) -> str:
    fixed = "".join(f" {name}={short(value, name)}" for name, value in arm["values"].items())
    text = (
        f"Search {search['stage']}{fixed}: {arm['judged']} of {len(arm['trials'])} trials scored, "
        f"{arm['pruned']} stopped early, {arm['failed']} failed, {arm['running']} running"
    )
    if arm["best"] is not None:
        best = arm["trials"][arm["best"]]
        values = ", ".join(f"{n} = {short(v, n)}" for n, v in best["values"].items())
        numbers = ", ".join(f"{value:.4g}" for value in best["objective"])
        text += f"; best trial {arm['best']}: {numbers} ({values})"
    return f"{text}\n    study {arm['study']!r} in {search['storage'] or 'study.db'}"


def _problem_lines(state: Mapping[str, Any], label: ShortLabels) -> Iterator[Text]:
    """Running, interrupted, damaged and failed runs."""
    for status in ("running", "interrupted"):
        for run in state.get(status, ()):
            value = f"{names.word_of(run['metric'])} {measured(run['metric'], run['value'])}"
            steps = f"{run['env_steps']:,} / {run['budget']:,} env steps"
            yield Text(f"{status}: {label(run['run'])}  {steps}, {value}")
    for damaged in state["damaged"]:
        yield Text(f"DAMAGED {label(damaged['run'])}: {damaged['cause']}", style="red")
    if state["damaged"]:
        yield Text(f"    {TRAIN_AGAIN}", style="dim")
    for failure in state["failures"][-SHOWN_FAILURES:]:
        yield Text(f"FAILED {label(failure['run'])}: {failure['cause']}", style="red")
        yield Text(f"    {failure['log']}", style="dim")
