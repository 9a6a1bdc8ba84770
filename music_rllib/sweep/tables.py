"""The plan before a sweep and the results after it, as tables."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib.experiment.model import Source, Stage, SweepConfig
from music_rllib.experiment.plan import Node, Plan, short
from music_rllib.experiment.result import RunResult
from music_rllib.sweep.board import Status
from music_rllib.sweep.words import clock, in_words, percent
from music_rllib.tracking import names

__all__ = ["plan_view", "results_table"]


def plan_view(config: SweepConfig, plan: Plan, finished: Collection[str]) -> RenderableType:
    """Stages, trials, runs, budgets, and what an earlier sweep has finished."""
    table = Table(title=f"Sweep {plan.name}", title_justify="left")
    for name in ("stage", "variant", "starts from", "tasks", "grid"):
        table.add_column(name)
    for name in ("trials", "seeds", "runs", "env steps a run", "env steps", "finished"):
        table.add_column(name, justify="right")
    nodes = {node.key: node for node in plan.nodes}
    for stage in config.stages:
        table.add_row(*_stage_row(stage, plan, nodes, finished, len(config.seeds)))
    return Group(table, Text(_summary(plan, finished)))


def _stage_row(
    stage: Stage,
    plan: Plan,
    nodes: Mapping[str, Node],
    finished: Collection[str],
    seeds: int,
) -> list[str]:
    runs = [run for run in plan.runs if run.stage == stage.name]
    budgets = sorted({nodes[run.key].run.env_steps for run in runs})
    return [
        stage.name,
        stage.variant,
        _source(stage.source),
        ", ".join(task.name for task in stage.tasks),
        "\n".join(_axes(stage)) or "-",
        str(len({run.trial for run in runs})),
        str(seeds),
        str(len(runs)),
        " to ".join(f"{steps:,}" for steps in dict.fromkeys((budgets[0], budgets[-1]))),
        f"{sum(nodes[run.key].run.env_steps for run in runs):,}",
        str(sum(run.key in finished for run in runs)),
    ]


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
    parts = [f"{len(plan.runs)} runs"]
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
) -> Table:
    """One row per run: what it reached, or why there is nothing.

    Args:
        plan: The sweep's plan.
        status: Node key to its state.
        results: Node key to its result, for finished nodes.
        mlflow_run: Node key to MLflow's id of its run, if there is one.
    """
    grid = _grid_columns(plan)
    table = Table(title=f"Results of {plan.name}", title_justify="left")
    for name in ("stage", "task", "seed", "q", *grid):
        table.add_column(name, justify="right" if name in {"seed", "q"} else "left")
    for name in ("success,\nlast step", "success,\nany step", "MI reward", "env steps", "time"):
        table.add_column(name, justify="right")
    table.add_column("MLflow run", no_wrap=True)
    table.add_column("state", no_wrap=True)
    nodes = {node.key: node for node in plan.nodes}
    for run in plan.runs:
        state = status(run.key)
        table.add_row(
            run.stage,
            run.task,
            str(run.seed),
            in_words(nodes[run.key].run.tac.entropic_index),
            *(short(run.values[name]) if name in run.values else "-" for name in grid),
            *_reached(results.get(run.key)),
            (mlflow_run(run.key) or "-")[:8],
            _STATE.get(state, str(state)),
            style=_COLOURS.get(state),
        )
    return table


def _grid_columns(plan: Plan) -> list[str]:
    """What tells trials apart, besides q, which has its column."""
    found = dict.fromkeys(name for run in plan.runs for name in run.values)
    return [name for name in found if name != "tac.entropic_index"]


def _reached(result: RunResult | None) -> list[str]:
    if result is None:
        return ["-"] * 5
    reward = result.metrics.get(names.MI_REWARD)
    return [
        percent(result.metrics.get(names.EVAL_SUCCESS)),
        percent(result.metrics.get(names.EVAL_SUCCESS_ANY)),
        "-" if reward is None else f"{reward:.3f}",
        f"{result.env_steps:,}",
        clock(result.seconds),
    ]
