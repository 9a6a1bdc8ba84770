"""Tables of a sweep: its state, and the results of its runs and searches."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.command_line import clock, new_table, percent
from music_rllib.config.run_settings import RunSettings
from music_rllib.experiment.open_sweep import SHOWN
from music_rllib.experiment.plan import Plan, short
from music_rllib.experiment.scheduler import Status
from music_rllib.names import ShortLabels
from music_rllib.results.search_tables import search_in_words, search_tables
from music_rllib.results.tables import Table as DataTable
from music_rllib.search.best import best_text
from music_rllib.store.history import RunResult
from music_rllib.store.node_store import TRAIN_AGAIN

_STYLES = {Status.FAILED: "red", Status.SKIPPED: "yellow", Status.WAITING: "yellow"}
_STATES = {Status.STARTED: "interrupted", Status.WAITING: "not started"}


def results_table(
    plan: Plan, status: Callable[[str], Status], results: Mapping[str, RunResult]
) -> Table:
    """One row for each run: its last metrics, of its result or its progress so far, and its state.

    `status` and `results` are by node key. Of the runs that have not started, only the first have a
    row, and the last row has the number of the others.
    """
    metrics = _metric_columns({node.run.task.primary_metric for node in plan.nodes})
    shown = {
        node.key: shown_metric(node.run, results[node.key].metrics)
        for node in plan.nodes
        if node.key in results
    }
    if names.EVAL_DISPLACEMENT in shown.values():
        metrics |= {names.EVAL_DISPLACEMENT: "object\nmoved"}
    if any(names.SHANNON_ENTROPY in result.metrics for result in results.values()):
        metrics |= {names.SHANNON_ENTROPY: "entropy,\nnats"}
    heads = ("run", *metrics.values(), "env steps", "time", "state")
    table = new_table(f"Results of {plan.name}", heads, left=("run", "state"))
    label = ShortLabels.of(run.label for run in plan.runs)
    runs = [run for run in plan.runs if not run.part]  # the table of trials has those of searches
    left = [run for run in runs if status(run.key) is Status.WAITING and run.key not in results]
    more = {run.key for run in left[SHOWN:]}
    for run in (run for run in runs if run.key not in more):
        result, state = results.get(run.key), status(run.key)
        cells = ["-"] * (len(metrics) + 2)
        if result is not None:
            hidden = names.EVAL_RATES if shown[run.key] == names.EVAL_DISPLACEMENT else ()
            values = (None if name in hidden else result.metrics.get(name) for name in metrics)
            cells = [
                *map(measured, metrics, values),
                f"{result.env_steps:,}",
                clock(result.seconds),
            ]
        name = _STATES.get(state, str(state))
        table.add_row(label(run.label), *cells, name, style=_STYLES.get(state))
    if more:
        row = (f"and {len(more):,} more", *["-"] * (len(metrics) + 2), _STATES[Status.WAITING])
        table.add_row(*row, style=_STYLES[Status.WAITING])
    return table


def _metric_columns(primary: Set[str]) -> dict[str, str]:
    """The evaluation metrics for these primary metrics, with the heads of their columns."""
    of_success = {names.EVAL_SUCCESS: "success", names.EVAL_SUCCESS_ANY: "at any\nstep"}
    of_return = {names.EVAL_RETURN: "return"}
    if names.EVAL_RETURN not in primary:
        return of_success
    return of_return if primary == of_return.keys() else of_success | of_return


def search_views(searches: Iterable[Mapping[str, Any]]) -> Iterator[RenderableType]:
    """Tables of trials, the importance of settings, and the final ranking of searches."""
    for search in searches:
        yield Text(f"Search of stage {search['stage']}: {search_in_words(search)}")
        for arm in search["arms"]:
            if arm["front"]:
                yield Text(f"Trials of the Pareto front: {', '.join(map(str, arm['front']))}")
        for table in reversed(list(search_tables(search))):
            if table.rows:
                yield console_table(table)


def console_table(table: DataTable) -> Table:
    """A table of the report for the console.

    A task or metric that is the same in all rows is in the title: 80 columns are few.
    """
    columns = [
        (head, kind, [cells[i].text for cells in table.cells])
        for i, (head, kind) in enumerate(table.heads)
    ]
    same = [c for c in columns if c[0] in ("Task", "Measure", "Metric") and len(set(c[2])) == 1]
    shown = [c for c in columns if c not in same]
    title = ": ".join(filter(None, (table.title, ", ".join(c[2][0] for c in same))))
    left = [head for head, kind, _ in shown if kind != "number"]
    new = new_table(title, [head for head, _, _ in shown], left)
    for row in zip(*(texts for _, _, texts in shown), strict=True):
        new.add_row(*row)
    return new


def measured(metric: str, value: float | None) -> str:
    """`35 %` for a rate, `0.12 m` for a displacement, `-5.2` for a return, `-` for None."""
    if value is None or metric in names.EVAL_RATES:
        return percent(value)
    if metric == names.EVAL_DISPLACEMENT:
        return f"{value:.2f} m"
    return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"


def evaluation_text(run: RunSettings, metrics: Mapping[str, float], *, any_step: bool) -> str:
    """A run's last evaluation: `success 35 % (any step 40 %)`, `return -5.2` or `moved 0.12 m`."""
    metric = shown_metric(run, metrics)
    text = f"{names.word_of(metric)} {measured(metric, metrics.get(metric))}"
    if metric != names.EVAL_SUCCESS or not any_step:
        return text
    return f"{text} (any step {percent(metrics.get(names.EVAL_SUCCESS_ANY))})"


def shown_metric(run: RunSettings, metrics: Mapping[str, float]) -> str:
    """The task's primary metric; without the task's reward, how far the run moves objects."""
    by_chance = not run.music.task_reward and names.EVAL_DISPLACEMENT in metrics
    return names.EVAL_DISPLACEMENT if by_chance else run.task.primary_metric


_STATUSES = (
    *("finished", "reused", "started", "interrupted", "waiting", "paused", "pruned"),
    *("failed", "skipped"),
)
"""Statuses of runs, in the order of the columns."""
SHOWN_FAILURES = 20
_STATE_STYLES = {"finished": "green", "failed": "red", "interrupted": "yellow", "stopped": "yellow"}


def status_view(state: Mapping[str, Any], labels: Iterable[str]) -> RenderableType:
    """Stages, budget, searches, runs and failures; the `labels` of all runs shorten each label."""
    title = Text(f"Sweep {state['sweep']}: ")
    title.append(state["state"], _STATE_STYLES.get(state["state"], "bold"))
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
    if since := state["finished_since"]:
        are = "more run is" if since == 1 else "more runs are"
        yield (
            f"{since} {are} finished in the storage since then. Compare, report and best show "
            "them; the next run counts them here."
        )
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
