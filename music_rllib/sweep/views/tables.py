"""The plan before a sweep and the results after it, as tables."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.config.schema import Source, Stage, SweepConfig
from music_rllib.config.search.check import most_env_steps
from music_rllib.config.search.settings import SearchSettings
from music_rllib.config.search.space import Choice, Dimension
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import Node, Plan, short
from music_rllib.experiment.scheduler import Status
from music_rllib.labels import ShortLabels, in_runs
from music_rllib.results.comparison import SHOW_SEEDS_BELOW, with_interval
from music_rllib.store.run_record import RunResult
from music_rllib.sweep.views.text import clock, measured, percent

__all__ = [
    "new_table",
    "plan_view",
    "ranking_table",
    "results_table",
    "search_budget",
    "search_runs",
    "search_views",
    "seeds_in_words",
]


def new_table(title: str, left: Iterable[str] = (), right: Iterable[str] = ()) -> Table:
    """A table whose cells are never cut, with columns of text on the left and of numbers."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in left:
        table.add_column(name, overflow="fold")
    for name in right:
        table.add_column(name, justify="right", overflow="fold")
    return table


ROOMY = 76
"""Columns of a screen from which progress has all that there is to say."""


def plan_view(config: SweepConfig, plan: Plan, finished: Collection[str]) -> RenderableType:
    """Stages, trials, runs, budgets, and what an earlier sweep has finished."""
    table = new_table(
        f"Sweep {plan.name}",
        ["stage"],
        ["trials", "runs", "env steps a run", "env steps", "finished"],
    )
    nodes = {node.key: node for node in plan.nodes}
    for stage in config.stages:
        table.add_row(stage.name, *_stage_row(stage, plan, nodes, finished, len(config.seeds)))
    about = [_about(stage, len(config.seeds)) for stage in config.stages]
    text = _summary(plan, finished)
    searched = [(stage, stage.search) for stage in config.stages if stage.search is not None]
    if searched:
        runs = sum(search_runs(stage, search, len(config.seeds)) for stage, search in searched)
        steps = sum(search_steps(stage, search, len(config.seeds)) for stage, search in searched)
        text += f" Searches: up to {runs} runs and {steps:,} env steps more"
        fresh = any(search.final and stage.source for stage, search in searched)
        text += ", and what runs on fresh seeds start from." if fresh else "."
    return Group(table, *map(Text, about), Text(text))


def _about(stage: Stage, seeds: int) -> str:
    """What a stage is, and what it varies."""
    search = stage.search
    fresh = f" and {search.final.seeds} fresh" if search and search.final else ""
    text = (
        f"{stage.name}: {stage.variant} on {', '.join(map(_judged, stage.tasks))} from "
        f"{_source(stage.source)}, {seeds} seed{'s' * (seeds > 1)}{fresh}"
    )
    axes = _axes(stage) if search is None else _searched_axes(search)
    return "\n  ".join((text, *axes))


def _stage_row(
    stage: Stage,
    plan: Plan,
    nodes: Mapping[str, Node],
    finished: Collection[str],
    seeds: int,
) -> list[str]:
    if stage.search is not None:
        return _search_row(stage, stage.search, seeds)
    runs = [run for run in plan.runs if run.stage == stage.name]
    if not runs:  # its settings are searched for: it runs as trials want it
        budget = next(iter(stage.points[0].runs.values())).env_steps
        return ["as needed", "-", f"{budget:,}", "-", "-"]
    budgets = sorted({nodes[run.key].run.env_steps for run in runs})
    return [
        str(len({run.trial for run in runs})),
        str(len(runs)),
        " to ".join(f"{steps:,}" for steps in dict.fromkeys((budgets[0], budgets[-1]))),
        f"{sum(nodes[run.key].run.env_steps for run in runs):,}",
        str(sum(run.key in finished for run in runs)),
    ]


def _judged(task: Task) -> str:
    """The task's name, with what it is judged by where that is not its success."""
    metric = task.primary_metric
    return task.name if metric == names.EVAL_SUCCESS else f"{task.name} ({names.word_of(metric)})"


def _search_row(stage: Stage, search: SearchSettings, seeds: int) -> list[str]:
    """What a search takes at most: it may stop trials early, and points may repeat."""
    studies, budget = len(search.arms()), search_budget(stage, search)
    return [
        f"{studies} x {search.count}" if studies > 1 else str(search.count),
        f"<= {search_runs(stage, search, seeds)}",
        f"<= {max(budget, (search.final and search.final.env_steps) or 0):,}",
        f"<= {search_steps(stage, search, seeds):,}",
        "-",
    ]


def _searched_axes(search: SearchSettings) -> list[str]:
    axes = [f"{name}: {_dimension(one)}" for name, one in search.space.items()]
    axes += [
        f"{name}: {', '.join(short(value) for value in values)} ({search.mode})"
        for name, values in search.compare.items()
    ]
    return [f"searched by {search.sampler}:", *axes]


def search_budget(stage: Stage, search: SearchSettings) -> int:
    """Environment steps of a searched stage's run, at most."""
    return most_env_steps(search, stage.points)


def search_runs(stage: Stage, search: SearchSettings, seeds: int) -> int:
    """Runs of a searched stage at most, with those of the final ranking."""
    return search.count * seeds * len(search.arms()) * len(stage.tasks) + fresh_runs(stage, search)


def fresh_runs(stage: Stage, search: SearchSettings) -> int:
    """Those of the final ranking."""
    if search.final is None:
        return 0
    finalists = min(search.final.most(len(search.points_to_evaluate)), search.count)
    return finalists * search.final.seeds * len(search.arms()) * len(stage.tasks)


def search_steps(stage: Stage, search: SearchSettings, seeds: int) -> int:
    """Environment steps of all of them at most."""
    budget, fresh = search_budget(stage, search), fresh_runs(stage, search)
    final = (search.final and search.final.env_steps) or budget
    return (search_runs(stage, search, seeds) - fresh) * budget + fresh * final


def _dimension(dimension: Dimension) -> str:
    if isinstance(dimension, Choice):
        return ", ".join(short(value) for value in dimension.choice)
    low, high = dimension.bounds
    step = "" if dimension.step in (None, 1) else f" by {dimension.step:g}"
    return f"{low:g} to {high:g}{step}{' (log)' if dimension.log else ''}"


def _source(source: Source | None) -> str:
    if source is None:
        return "scratch"
    origin = source.stage or str(source.checkpoint.folder if source.checkpoint else "")
    return f"{origin} ({source.task.name})" if source.task else origin


def _axes(stage: Stage) -> list[str]:
    values: dict[str, dict[str, None]] = {}
    for point in stage.points:
        for name, value in point.values.items():
            values.setdefault(name, {})[short(value)] = None
    return [f"{name}: {', '.join(choices)}" for name, choices in values.items()]


def _summary(plan: Plan, finished: Collection[str]) -> str:
    left = [node for node in plan.nodes if node.key not in finished]
    parts = [in_runs(len(plan.runs))]
    if len(plan.nodes) < len(plan.runs):
        parts.append(f"{len(plan.nodes)} different ones")
    parts.append(f"{plan.env_steps:,} env steps in all")
    reused = len(plan.nodes) - len(left)
    if reused:
        parts.append(f"{reused} finished earlier and reused")
        parts.append(f"{sum(node.run.env_steps for node in left):,} env steps left")
    return ", ".join(parts) + "."


_COLOURS = {Status.FAILED: "red", Status.SKIPPED: "yellow", Status.WAITING: "yellow"}
_STATE = {Status.STARTED: "interrupted", Status.WAITING: "not started"}


def results_table(
    plan: Plan,
    status: Callable[[str], Status],
    results: Mapping[str, RunResult],
    mlflow_run: Callable[[str], str | None],
    width: int | None = None,
) -> Table:
    """One row per run: what it reached, or why there is nothing.

    Args:
        plan: The sweep's plan.
        status: Node key to its state.
        results: Node key to its result, or to what it has reached so far.
        mlflow_run: Node key to MLflow's id of its run, if there is one.
        width: Of the screen; columns of `_SPARE` that it has no room for are left out.
    """
    nodes = {node.key: node for node in plan.nodes}
    metrics = _columns(node.run.task.primary_metric for node in nodes.values())
    # A reward or an entropy that no run has is no column.
    metrics |= {
        metric: head
        for metric, head in _BESIDE.items()
        if any(metric in result.metrics for result in results.values())
    }
    heads = ["run", *metrics.values(), "env steps", "time", "MLflow run", "state"]
    label = ShortLabels.of(run.label for run in plan.runs)
    rows = [
        (
            label(run.label),
            *_reached(results.get(run.key), metrics),
            (mlflow_run(run.key) or "-")[:8],
            _STATE.get(status(run.key), str(status(run.key))),
        )
        for run in plan.runs
        if not run.part  # one of many: its trial has a row in another table
    ]
    shown = _fitting(heads, rows, width)
    missing = [head.replace("\n", " ") for head in heads if head not in shown]
    table = new_table(f"Results of {plan.name}")
    table.caption = f"A wider screen also shows: {'; '.join(missing)}" if missing else None
    table.caption_justify = "left"
    for head in shown:
        left = head in ("run", "MLflow run", "state")
        table.add_column(head, justify="left" if left else "right", overflow="fold")
    keys = (run.key for run in plan.runs if not run.part)
    for key, row in zip(keys, rows, strict=True):
        cells = dict(zip(heads, row, strict=True))
        table.add_row(*(cells[head] for head in shown), style=_COLOURS.get(status(key)))
    return table


_SPARE = ("MLflow run", "at any\nstep", "time", "MI\nreward", "S_q", "env steps")
"""Columns that a narrow screen can do without, the first one first."""


def _fitting(
    heads: Sequence[str], rows: Sequence[Sequence[str]], width: int | None
) -> Sequence[str]:
    """Heads of the columns that there is room for."""
    widths = {
        head: max(len(line) for text in (head, *column) for line in text.split("\n"))
        for head, *column in zip(heads, *rows, strict=True)
    }
    left = list(heads)
    for head in _SPARE:
        # Two spaces stand between columns.
        if width is None or sum(widths[one] + 2 for one in left) <= width:
            break
        left = [one for one in left if one != head]
    return left


def search_views(searches: Sequence[Mapping[str, Any]]) -> list[RenderableType]:
    """Tables of what came of searches (`searches.outcome`): trials, importance, the ranking."""
    views: list[RenderableType] = []
    for search in searches:
        for arm in search["arms"]:
            views.append(_trials_table(search, arm))
            if arm["importance"]:
                shares = [f"{name} {percent(share)}" for name, share in arm["importance"].items()]
                views.append(Text(f"Share of the variance explained (fANOVA): {', '.join(shares)}"))
        if search["ranking"]:
            views.append(ranking_table(search))
    return views


def _trials_table(search: Mapping[str, Any], arm: Mapping[str, Any]) -> Table:
    fixed = ", ".join(f"{name} = {short(value)}" for name, value in arm["values"].items())
    table = new_table(
        f"Trials of {search['stage']}{f' with {fixed}' if fixed else ''}: "
        f"{arm['judged']} judged, {arm['pruned']} stopped early, {arm['failed']} failed"
        + ("; in bold what no other is better than in every objective" if arm["front"] else ""),
    )
    names_of = dict.fromkeys(
        name for trial in arm["trials"] for name in trial["values"] if name not in arm["values"]
    )
    table.add_column("trial", justify="right", overflow="fold")
    for name in names_of:
        table.add_column(name, justify="right", overflow="fold")
    for objective in search["objectives"]:
        table.add_column(objective["name"], justify="right", overflow="fold")
    table.add_column("state", overflow="fold")
    table.add_column("why", overflow="fold")
    for trial in arm["trials"]:
        if trial["state"] == "waiting":
            continue
        values = trial["objective"] or [None] * len(search["objectives"])
        intervals = trial.get("interval") or [None] * len(values)
        table.add_row(
            str(trial["number"]),
            *(short(trial["values"][n]) if n in trial["values"] else "-" for n in names_of),
            *(with_interval(v, i) for v, i in zip(values, intervals, strict=True)),
            trial["state"],
            trial["reason"] or "",
            style={"failed": "red", "pruned": "dim"}.get(trial["state"])
            or ("bold" if trial["number"] in (arm["best"], *arm["front"]) else None),
        )
    return table


def ranking_table(search: Mapping[str, Any]) -> Table:
    """Finalists on fresh seeds."""
    table = new_table(
        f"Ranking of {search['stage']} on fresh seeds. 'in the search' is too good: the "
        "trials were chosen for it",
    )
    names_of = dict.fromkeys(name for row in search["ranking"] for name in row["values"])
    for name in ("rank", "trial", *names_of):
        table.add_column(name, justify="right", overflow="fold")
    for objective in search["objectives"]:
        table.add_column(
            f"{objective['name']}\non fresh seeds, 95 %", justify="right", overflow="fold"
        )
        table.add_column("in the\nsearch", justify="right", overflow="fold")
    table.add_column("P(best is\nbetter)", justify="right", overflow="fold")
    for rank, row in enumerate(search["ranking"], 1):
        values = (short(row["values"][n]) if n in row["values"] else "-" for n in names_of)
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
        chance = row.get("best_is_better_with")
        table.add_row(str(rank), str(row["trial"]), *values, *numbers, percent(chance))
    return table


def seeds_in_words(scores: Sequence[float]) -> str:
    """`0.8 0.82 0.84`, the lowest first; nothing where there are too many to read."""
    few = len(scores) < SHOW_SEEDS_BELOW
    return " ".join(f"{score:.3g}" for score in sorted(scores)) if few else ""


def _columns(primary: Iterable[str]) -> dict[str, str]:
    """What runs are judged by to the heads of their columns."""
    found = set(primary)
    heads = {
        names.EVAL_SUCCESS: "success",
        names.EVAL_SUCCESS_ANY: "at any\nstep",
        names.EVAL_RETURN: "return",
    }
    if names.EVAL_RETURN not in found:
        del heads[names.EVAL_RETURN]
    if found == {names.EVAL_RETURN}:
        heads = {names.EVAL_RETURN: heads[names.EVAL_RETURN]}
    return heads


_BESIDE = {
    names.MI_REWARD: "MI\nreward",
    names.SHANNON_ENTROPY: "entropy,\nnats",
    names.ENTROPY: "S_q",
}
"""What runs are not judged by, to the heads of their columns."""


def _reached(result: RunResult | None, metrics: Iterable[str]) -> list[str]:
    if result is None:
        return ["-"] * (len(list(metrics)) + 2)
    return [
        *(_cell(metric, result.metrics.get(metric)) for metric in metrics),
        f"{result.env_steps:,}",
        clock(result.seconds),
    ]


def _cell(metric: str, value: float | None) -> str:
    return (
        "-" if value is None else f"{value:.2f}" if metric in _BESIDE else measured(metric, value)
    )
