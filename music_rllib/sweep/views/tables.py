"""The plan before a sweep, and the results after it, as tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.config.schema import Source, Stage, SweepConfig
from music_rllib.config.search import SearchSettings
from music_rllib.config.space import Choice, Dimension
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import Node, Plan, short
from music_rllib.experiment.scheduler import Status
from music_rllib.labels import ShortLabels, in_runs
from music_rllib.results.statistics import SHOW_SEEDS_BELOW, with_interval
from music_rllib.store.history import RunResult
from music_rllib.sweep.views.search_budget import search_budget
from music_rllib.sweep.views.text import clock, measured, percent


def new_table(title: str, heads: Iterable[str], left: Collection[str] = ()) -> Table:
    """A table whose cells are folded and never cut.

    Args:
        title: Stands above it.
        heads: Of its columns, in order.
        left: Heads of the columns of text, on the left; numbers stand on the right.
    """
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for head in heads:
        table.add_column(head, justify="left" if head in left else "right", overflow="fold")
    return table


def seeds_in_words(scores: Sequence[float]) -> str:
    """`0.8 0.82 0.84`, the lowest first; empty where there are too many to read."""
    few = len(scores) < SHOW_SEEDS_BELOW
    return " ".join(f"{score:.3g}" for score in sorted(scores)) if few else ""


# -- the plan ----------------------------------------------------------------------------------


def plan_view(config: SweepConfig, plan: Plan, finished: Collection[str]) -> RenderableType:
    """Stages, trials, runs, budgets, and what an earlier sweep has finished."""
    heads = ("stage", "trials", "runs", "env steps a run", "env steps", "finished")
    table = new_table(f"Sweep {plan.name}", heads, left=["stage"])
    nodes = {node.key: node for node in plan.nodes}
    seeds = len(config.seeds)
    for stage in config.stages:
        table.add_row(stage.name, *_stage_cells(stage, plan, nodes, finished, seeds))
    text = _summary(plan, finished)
    searched = [stage for stage in config.stages if stage.search is not None]
    if searched:
        budgets = [search_budget(stage, seeds) for stage in searched]
        runs = sum(budget.runs for budget in budgets)
        steps = sum(budget.env_steps for budget in budgets)
        text += f" Searches: up to {runs} runs and {steps:,} env steps more"
        fresh = any(stage.search and stage.search.final and stage.source for stage in searched)
        text += ", and what runs on fresh seeds start from." if fresh else "."
    return Group(table, *(Text(_stage_text(stage, seeds)) for stage in config.stages), Text(text))


def _stage_cells(
    stage: Stage, plan: Plan, nodes: Mapping[str, Node], finished: Collection[str], seeds: int
) -> list[str]:
    if stage.search is not None:
        studies, budget = len(stage.search.compared()), search_budget(stage, seeds)
        trials = stage.search.count
        return [
            f"{studies} x {trials}" if studies > 1 else str(trials),
            f"<= {budget.runs}",
            f"<= {max(budget.trial_env_steps, budget.fresh_env_steps):,}",
            f"<= {budget.env_steps:,}",
            "-",
        ]
    runs = [run for run in plan.runs if run.stage == stage.name]
    if not runs:  # trials of a search vary its settings: its runs are those that they ask for
        env_steps = next(iter(stage.points[0].runs.values())).env_steps
        return ["as needed", "-", f"{env_steps:,}", "-", "-"]
    budgets = sorted({nodes[run.key].run.env_steps for run in runs})
    return [
        str(len({run.trial for run in runs})),
        str(len(runs)),
        " to ".join(f"{steps:,}" for steps in dict.fromkeys((budgets[0], budgets[-1]))),
        f"{sum(nodes[run.key].run.env_steps for run in runs):,}",
        str(sum(run.key in finished for run in runs)),
    ]


def _stage_text(stage: Stage, seeds: int) -> str:
    """A stage's variant, tasks, source and seeds, and a line for each setting that it varies."""
    search = stage.search
    fresh = f" and {search.final.seeds} fresh" if search and search.final else ""
    text = (
        f"{stage.name}: {stage.variant} on {', '.join(map(_task_text, stage.tasks))} from "
        f"{_source_text(stage.source)}, {seeds} seed{'s' * (seeds > 1)}{fresh}"
    )
    axes = _grid_axes(stage) if search is None else _search_axes(search)
    return "\n  ".join((text, *axes))


def _task_text(task: Task) -> str:
    """The task's name, with its primary metric where that is not success."""
    metric = task.primary_metric
    return task.name if metric == names.EVAL_SUCCESS else f"{task.name} ({names.word_of(metric)})"


def _source_text(source: Source | None) -> str:
    if source is None:
        return "scratch"
    origin = source.stage or str(source.checkpoint.folder if source.checkpoint else "")
    return f"{origin} ({source.task.name})" if source.task else origin


def _grid_axes(stage: Stage) -> list[str]:
    values: dict[str, dict[str, None]] = {}
    for point in stage.points:
        for name, value in point.values.items():
            values.setdefault(name, {})[short(value, name)] = None
    if math.prod(map(len, values.values())) > len(stage.points):  # settings that vary together
        points = [
            ", ".join(short(value, name) for name, value in point.values.items())
            for point in stage.points
        ]
        return [f"{', '.join(values)}: {'; '.join(points)}"]
    return [f"{name}: {', '.join(choices)}" for name, choices in values.items()]


def _search_axes(search: SearchSettings) -> list[str]:
    axes = [
        f"{name}: {_dimension_text(name, dimension)}" for name, dimension in search.space.items()
    ]
    axes += [
        f"{name}: {', '.join(short(value, name) for value in values)} ({search.mode})"
        for name, values in search.compare.items()
    ]
    return [f"searched by {search.sampler}:", *axes]


def _dimension_text(name: str, dimension: Dimension) -> str:
    if isinstance(dimension, Choice):
        return ", ".join(short(value, name) for value in dimension.choice)
    low, high = dimension.bounds
    step = "" if dimension.step in (None, 1) else f" by {dimension.step:g}"
    return f"{low:g} to {high:g}{step}{' (log)' if dimension.log else ''}"


def _summary(plan: Plan, finished: Collection[str]) -> str:
    left = [node for node in plan.nodes if node.key not in finished]
    parts = [in_runs(len(plan.runs))]
    if len(plan.nodes) < len(plan.runs):
        parts.append(f"{len(plan.nodes)} different ones")
    parts.append(f"{plan.env_steps:,} env steps in all")
    if reused := len(plan.nodes) - len(left):
        parts.append(f"{reused} finished earlier and reused")
        parts.append(f"{sum(node.run.env_steps for node in left):,} env steps left")
    return ", ".join(parts) + "."


# -- the results -------------------------------------------------------------------------------

_COLOURS = {Status.FAILED: "red", Status.SKIPPED: "yellow", Status.WAITING: "yellow"}
_STATES = {Status.STARTED: "interrupted", Status.WAITING: "not started"}
_SECONDARY_METRICS = {
    names.MI_REWARD: "MI\nreward",
    names.SHANNON_ENTROPY: "entropy,\nnats",
    names.ENTROPY: "S_q",
}
"""Metrics that no task is judged by, to the heads of their columns."""
_SPARE_COLUMNS = ("MLflow run", "at any\nstep", "time", "MI\nreward", "S_q", "env steps")
"""Columns that a narrow screen can do without; the first one is left out first."""


def results_table(
    plan: Plan,
    status: Callable[[str], Status],
    results: Mapping[str, RunResult],
    mlflow_run: Callable[[str], str | None],
    width: int | None = None,
) -> Table:
    """One row for each run: its last metrics, or why there are none.

    Args:
        plan: The sweep's plan.
        status: Node key to the status of the node.
        results: Node key to the result, or to what an unfinished run has reached.
        mlflow_run: Node key to the id of the run in MLflow, if there is one.
        width: Of the screen; spare columns that do not fit are left out.
    """
    metrics = _metric_columns({node.run.task.primary_metric for node in plan.nodes})
    reported = {metric for result in results.values() for metric in result.metrics}
    metrics |= {name: head for name, head in _SECONDARY_METRICS.items() if name in reported}
    heads = ["run", *metrics.values(), "env steps", "time", "MLflow run", "state"]
    label = ShortLabels.of(run.label for run in plan.runs)
    rows = {}
    for run in plan.runs:
        if run.part:  # a run of a search: the table of trials has it
            continue
        state = _STATES.get(status(run.key), str(status(run.key)))
        reached = _reached(results.get(run.key), metrics)
        mlflow_id = (mlflow_run(run.key) or "-")[:8]
        cells = (label(run.label), *reached, mlflow_id, state)
        rows[run.label, run.key] = dict(zip(heads, cells, strict=True))
    shown = _fitting(heads, list(rows.values()), width)
    table = new_table(f"Results of {plan.name}", shown, left=("run", "MLflow run", "state"))
    missing = [head.replace("\n", " ") for head in heads if head not in shown]
    table.caption = f"A wider screen also shows: {'; '.join(missing)}" if missing else None
    table.caption_justify = "left"
    for (_, key), row in rows.items():
        table.add_row(*(row[head] for head in shown), style=_COLOURS.get(status(key)))
    return table


def _metric_columns(primary: Set[str]) -> dict[str, str]:
    """Metrics of runs that are judged by the `primary` ones, to the heads of their columns."""
    of_success = {names.EVAL_SUCCESS: "success", names.EVAL_SUCCESS_ANY: "at any\nstep"}
    of_return = {names.EVAL_RETURN: "return"}
    if names.EVAL_RETURN not in primary:
        return of_success
    return of_return if primary == of_return.keys() else of_success | of_return


def _reached(result: RunResult | None, metrics: Collection[str]) -> list[str]:
    if result is None:
        return ["-"] * (len(metrics) + 2)
    numbers = [_number(metric, result.metrics.get(metric)) for metric in metrics]
    return [*numbers, f"{result.env_steps:,}", clock(result.seconds)]


def _number(metric: str, value: float | None) -> str:
    if value is not None and metric in _SECONDARY_METRICS:
        return f"{value:.2f}"
    return measured(metric, value)


def _fitting(heads: list[str], rows: Sequence[Mapping[str, str]], width: int | None) -> list[str]:
    """Heads of the columns for which there is room."""
    widths = {}
    for head in heads:
        cells = (head, *(row[head] for row in rows))
        widths[head] = max(len(line) for cell in cells for line in cell.split("\n"))
    left = heads
    for spare in _SPARE_COLUMNS:
        # Two spaces stand between columns.
        if width is None or sum(widths[head] + 2 for head in left) <= width:
            break
        left = [head for head in left if head != spare]
    return left


# -- the searches ------------------------------------------------------------------------------


def search_views(searches: Iterable[Mapping[str, Any]]) -> list[RenderableType]:
    """Tables of the outcome of searches: trials, importance of settings, final ranking."""
    views: list[RenderableType] = []
    for search in searches:
        for arm in search["arms"]:
            views.append(_trials_table(search, arm))
            if arm["importance"]:
                shares = [f"{name} {percent(share)}" for name, share in arm["importance"].items()]
                views.append(Text(f"Share of the variance explained (fANOVA): {', '.join(shares)}"))
        if search["ranking"]:
            views.append(_ranking_table(search))
    return views


def _trials_table(search: Mapping[str, Any], arm: Mapping[str, Any]) -> Table:
    fixed = ", ".join(f"{name} = {short(value, name)}" for name, value in arm["values"].items())
    title = (
        f"Trials of {search['stage']}{f' with {fixed}' if fixed else ''}: "
        f"{arm['judged']} judged, {arm['pruned']} stopped early, {arm['failed']} failed"
    )
    if arm["front"]:
        title += "; in bold what no other is better than in every objective"
    settings = dict.fromkeys(
        name for trial in arm["trials"] for name in trial["values"] if name not in arm["values"]
    )
    objectives = [objective["name"] for objective in search["objectives"]]
    heads = ("trial", *settings, *objectives, "state", "why")
    table = new_table(title, heads, left=("state", "why"))
    for trial in arm["trials"]:
        if trial["state"] == "waiting":
            continue
        values = trial["objective"] or [None] * len(objectives)
        intervals = trial.get("interval") or [None] * len(values)
        best = trial["number"] in (arm["best"], *arm["front"])
        table.add_row(
            str(trial["number"]),
            *_setting_cells(settings, trial["values"]),
            *(with_interval(v, i) for v, i in zip(values, intervals, strict=True)),
            trial["state"],
            trial["reason"] or "",
            style={"failed": "red", "pruned": "dim"}.get(trial["state"], "bold" if best else None),
        )
    return table


def _setting_cells(settings: Iterable[str], values: Mapping[str, Any]) -> list[str]:
    return [short(values[name], name) if name in values else "-" for name in settings]


def _ranking_table(search: Mapping[str, Any]) -> Table:
    """Finalists on fresh seeds."""
    settings = dict.fromkeys(name for row in search["ranking"] for name in row["values"])
    table = new_table(
        f"Ranking of {search['stage']} on fresh seeds. 'in the search' is too good: the "
        "trials were chosen for it",
        (
            *("rank", "trial", *settings),
            *(
                head
                for objective in search["objectives"]
                for head in (f"{objective['name']}\non fresh seeds, 95 %", "in the\nsearch")
            ),
            "P(best is\nbetter)",
        ),
    )
    for rank, row in enumerate(search["ranking"], 1):
        values = _setting_cells(settings, row["values"])
        if "failure" in row:
            table.add_row("-", str(row["trial"]), *values, row["failure"], style="red")
            continue
        numbers = [
            text
            for fresh, ends, searched in zip(
                row["fresh"], row["interval"], row["searched"], strict=True
            )
            for text in (with_interval(fresh, ends), f"{searched:.3g}")
        ]
        chance = percent(row.get("best_is_better_with"))
        table.add_row(str(rank), str(row["trial"]), *values, *numbers, chance)
    return table
