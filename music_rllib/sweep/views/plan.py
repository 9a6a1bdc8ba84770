"""The plan of a sweep, as text with tables and as plain data."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from music_rllib import names
from music_rllib.command_line import clock, new_table
from music_rllib.config.load import warnings_of
from music_rllib.config.problems import shown
from music_rllib.config.schema import Source, Stage, SweepConfig
from music_rllib.config.search import SearchSettings
from music_rllib.config.tac_settings import MatchedAlpha, NormalisedAlpha, alpha_at, setting_text
from music_rllib.envs.tasks import Task
from music_rllib.experiment.open_sweep import OpenSweep, plan_node
from music_rllib.experiment.plan import Node, Plan, remarks, short
from music_rllib.names import in_runs
from music_rllib.redaction import redact
from music_rllib.schedules import AdaptiveSchedule, Measured, value_at

if TYPE_CHECKING:
    from music_rllib.runtime.ray_cluster import Capacity
    from music_rllib.sweep.views.cost import RunGroup

SAMPLED = 50
"""Largest number of finished runs whose speed is averaged."""


def plan_view(config: SweepConfig, plan: Plan, finished: Collection[str]) -> RenderableType:
    """Stages, trials, runs, environment steps, and finished runs."""
    heads = ("stage", "trials", "runs", "env steps per run", "env steps", "finished")
    table = new_table(f"Sweep {plan.name}", heads, left=["stage"])
    seeds = len(config.seeds)
    searched = _searched_runs(config)
    for stage in config.stages:
        own = [one for one in searched.get(stage.name, ()) if one.stage == stage.name]
        cells = _stage_cells(stage, plan, finished, own)
        table.add_row(stage.name, *cells)
    lines = [*(_stage_text(stage, seeds) for stage in config.stages), _summary(plan, finished)]
    if groups := [group for of_stage in searched.values() for group in of_stage]:
        runs, steps = sum(one.runs for one in groups), sum(one.all_env_steps for one in groups)
        sources = any(group.stage not in searched for group in groups)
        lines[-1] += f" Searches: up to {runs} more runs and {steps:,} more env steps"
        lines[-1] += ", with the runs that they start from." if sources else "."
    parts: list[RenderableType] = [table, *map(Text, lines)]
    if rows := alpha_rows(plan):
        parts.append(_alpha_table(rows))
    return Group(*parts)


def _searched_runs(config: SweepConfig) -> dict[str, list[RunGroup]]:
    """Name of each searched stage to the runs of its search, with those that they start from."""
    searched = [stage for stage in config.stages if stage.search is not None]
    if not searched:
        return {}
    from music_rllib.sweep.views.cost import searched_runs

    return {stage.name: searched_runs(config, stage) for stage in searched}


def _stage_cells(
    stage: Stage, plan: Plan, finished: Collection[str], searched: Sequence[RunGroup]
) -> list[str]:
    if stage.search is not None:
        studies, trials = len(stage.search.compared()), stage.search.count
        return [
            f"{studies} x {trials}" if studies > 1 else str(trials),
            f"≤ {sum(group.runs for group in searched)}",
            f"≤ {max(group.env_steps for group in searched):,}",
            f"≤ {sum(group.all_env_steps for group in searched):,}",
            "-",
        ]
    runs = [run for run in plan.runs if run.stage == stage.name]
    if not runs:  # a search varies its settings and asks for its runs
        env_steps = next(iter(stage.points[0].runs.values())).env_steps
        return ["as needed", "-", f"{env_steps:,}", "-", "-"]
    budgets = sorted(plan.node(run.key).run.env_steps for run in runs)
    return [
        str(len({run.trial for run in runs})),
        str(len(runs)),
        " to ".join(f"{steps:,}" for steps in dict.fromkeys((budgets[0], budgets[-1]))),
        f"{sum(budgets):,}",
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
    settings = _grid_settings(stage) if search is None else _searched_settings(search)
    return "\n  ".join((text, *settings))


def _task_text(task: Task) -> str:
    """The task's name, with its primary metric unless that is success."""
    metric = task.primary_metric
    return task.name if metric == names.EVAL_SUCCESS else f"{task.name} ({names.word_of(metric)})"


def _source_text(source: Source | None) -> str:
    if source is None:
        return "scratch"
    origin = source.stage or str(source.checkpoint.folder if source.checkpoint else "")
    return f"{origin} ({source.task.name})" if source.task else origin


def _grid_settings(stage: Stage) -> list[str]:
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


def _searched_settings(search: SearchSettings) -> Iterator[str]:
    yield f"searched by {search.sampler}:"
    for name, dimension in search.space.items():
        kept = dimension.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        yield f"{name}: {shown(kept)}"
    for name, values in search.compare.items():
        yield f"{name}: {', '.join(short(value, name) for value in values)} ({search.mode})"


def _summary(plan: Plan, finished: Collection[str]) -> str:
    left = [node for node in plan.nodes if node.key not in finished]
    parts = [in_runs(len(plan.runs))]
    if len(plan.nodes) < len(plan.runs):
        parts.append(f"{len(plan.nodes)} different ones")
    parts.append(f"{plan.env_steps:,} env steps in total")
    if reused := len(plan.nodes) - len(left):
        parts.append(f"{reused} finished earlier and reused")
        parts.append(f"{sum(node.run.env_steps for node in left):,} env steps left")
    return ", ".join(parts) + "."


def plan_answer(opened: OpenSweep, changes: str) -> dict[str, Any]:
    """The plan as plain data, with the changes since the last run of the sweep."""
    config, plan = opened.config, opened.plan
    searched = _searched_runs(config)
    searches = [
        {
            "stage": stage.name,
            "mode": stage.search.mode,
            "sampler": stage.search.sampler,
            "studies": len(stage.search.compared()),
            "trials": stage.search.count,
            "runs_at_most": sum(
                group.runs for group in searched[stage.name] if group.stage == stage.name
            ),
            "space": stage.search.model_dump(mode="json", by_alias=True)["space"],
        }
        for stage in config.stages
        if stage.search is not None
    ]
    finished = opened.finished
    nodes = [plan_node(node) | {"finished": node.key in finished} for node in plan.nodes]
    return {
        "sweep": config.name,
        "storage": redact(opened.storage),
        "seeds": list(config.seeds),
        "runs": len(plan.runs),
        "env_steps": plan.env_steps,
        "env_steps_left": sum(node["env_steps"] for node in nodes if not node["finished"]),
        "nodes": nodes,
        "searches": searches,
        "remarks": [*warnings_of(config), *remarks(plan)],
        "alpha": alpha_rows(plan),
        "changes": changes or None,
    }


def cluster_answer(opened: OpenSweep, capacity: Capacity) -> dict[str, Any]:
    """The room of a cluster, and the time that the runs left take on it, as plain data.

    The time is computed from the speed of finished runs of the plan; null if there are none.
    """
    finished = opened.finished
    left = [node for node in opened.plan.nodes if node.key not in finished]
    keys = sorted(finished)[:SAMPLED]
    done = [result for result in opened.store.map(opened.store.result, keys) if result is not None]
    steps = sum(result.env_steps for result in done)
    seconds = None
    if steps:
        pace = sum(result.seconds for result in done) / steps
        budgets = [node.run.env_steps for node in left]
        seconds = pace * max(sum(budgets) / capacity.at_once, max(budgets, default=0))
    return {
        "nodes": capacity.nodes,
        "runs_at_once": capacity.now,
        "grows": capacity.grows,
        "runs_left": len(left),
        "expected_seconds": seconds,
    }


def cluster_text(address: str, answer: Mapping[str, Any]) -> str:
    """The answer as a sentence: `Cluster head:6379: 3 nodes hold 8 runs at a time. ...`."""
    nodes = "1 node holds" if answer["nodes"] == 1 else f"{answer['nodes']} nodes hold"
    text = f"Cluster {address}: {nodes} {in_runs(answer['runs_at_once'])} at a time"
    if not answer["runs_left"]:  # the runs of a search are not planned yet
        return f"{text}."
    left, seconds = in_runs(answer["runs_left"]), answer["expected_seconds"]
    if seconds is None:
        return f"{text}. 'plan --measure' estimates the duration of the {left} left."
    return f"{text}. The {left} left take about {clock(seconds)}, at the speed of finished runs."


# -- alpha ----------------------------------------------------------------------------------------


def alpha_rows(plan: Plan) -> list[dict[str, Any]]:
    """Alpha at the start and at the end of a run, for each stage, scaled alpha and q.

    A plain alpha has no row because it is as given, a learned one because it is not known yet.
    """
    scaled = [
        node
        for node in plan.nodes
        if isinstance(node.run.tac.alpha, MatchedAlpha | NormalisedAlpha)
    ]
    # Only the joint entropy's scale depends on the number of dimensions of an action.
    joint = {n.run.task.name: n.run.task for n in scaled if n.run.tac.entropy_form == "joint"}
    dimensions = {name: _action_dimensions(task) for name, task in joint.items()}
    rows = (_alpha_row(node, dimensions.get(node.run.task.name, 1)) for node in scaled)
    unique = {repr(row): row for row in rows}.values()
    return sorted(unique, key=lambda row: (row["stage"], row["alpha"], row["q_at_start"]))


def _alpha_row(node: Node, action_dimensions: int) -> dict[str, Any]:
    tac, budget = node.run.tac, node.run.env_steps
    q_at_start = value_at(tac.entropic_index, 0, budget)
    q_at_end = _final_q(tac.entropic_index, budget)
    return {
        "stage": node.stage,
        "alpha": setting_text(tac.alpha),
        "q": setting_text(tac.entropic_index),
        "q_at_start": q_at_start,
        "at_start": alpha_at(tac, q_at_start, 0, budget, action_dimensions),
        "at_end": alpha_at(tac, q_at_end, budget, budget, action_dimensions),
    }


def _final_q(q: AdaptiveSchedule, budget: int) -> float:
    """The q at the end of a run; one that follows a measurement ends at its last point."""
    if isinstance(q, Measured):
        return q.points[-1 if q.follows == "success_rate" else 0][1]
    return value_at(q, budget, budget)


def _action_dimensions(task: Task) -> int:
    from music_rllib.envs.make import make_env  # few plans need an environment

    with closing(make_env(task.env_id, **task.env_kwargs)) as env:
        return int(env.action_space.shape[0])  # type: ignore[index]


def _alpha_table(rows: Iterable[dict[str, Any]]) -> Table:
    heads = ("stage", "alpha", "q", "α at the start", "at the end")
    table = new_table("α for each q", heads, left=heads[:2])
    for row in rows:
        numbers = (f"{row['at_start']:.4g}", f"{row['at_end']:.4g}")
        table.add_row(row["stage"], row["alpha"], row["q"], *numbers)
    return table
