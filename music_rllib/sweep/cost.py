"""What a plan takes on this machine: a run of each kind is trained for some seconds."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.plan import Plan
from music_rllib.runtime.ray_cluster import cluster
from music_rllib.sweep.views.tables import fresh_runs, search_budget, search_runs
from music_rllib.sweep.views.text import clock
from music_rllib.training.run import TrainingRun

__all__ = ["Kind", "cost_document", "cost_table", "kinds", "measure"]

START_SECONDS = 6.0
"""From a run's beginning to its first step, most of it importing (docs/performance.md)."""
MEASURED_SECONDS = 4.0
"""So long each kind of run is trained at least, after a round that warms up."""
BUSY = 0.75
"""Load average per CPU above which other programs ran beside the one that measures."""
_WITHOUT_COST: dict[str, bool | set[str]] = {
    "seed": True,
    "env_steps": True,
    "tac": {"entropic_index", "alpha", "gamma", "tau", "lr", "random_steps", "target_bounds"},
    "music": {"mi_reward_weight", "lr"},
}
"""Settings that change what is computed, and not how much of it."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Runs that cost the same."""

    label: str
    runs: int
    """How many of them are left to compute; of a search at most."""
    settings: RunSettings
    env_steps: int
    """Of one run, on average."""

    @property
    def grad_updates(self) -> int:
        """Of one run."""
        learning = self.env_steps - self.settings.tac.random_steps
        return round(learning * self.settings.tac.replay_ratio)


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What one run of a kind takes."""

    kind: Kind
    steps_per_second: float
    """Environment steps, while it learns."""
    evaluation_seconds: float
    """Of one evaluation."""

    @property
    def seconds(self) -> float:
        """Of one run, from its start to its end."""
        evaluations = math.ceil(self.kind.env_steps / self.kind.settings.evaluation.interval)
        training = self.kind.env_steps / self.steps_per_second
        return START_SECONDS + training + evaluations * self.evaluation_seconds


def kinds(config: SweepConfig, plan: Plan, finished: Collection[str]) -> list[Kind]:
    """The kinds of runs that are left, in the order of the plan, those of searches last."""
    groups: dict[str, list[tuple[str, RunSettings]]] = {}
    for node in plan.nodes:
        if node.key not in finished:
            label = f"{node.stage}/{node.run.task.name}"
            alike = node.run.model_dump(mode="json", exclude=dict(_WITHOUT_COST))
            groups.setdefault(json.dumps([label, alike]), []).append((label, node.run))
    found = [
        Kind(
            label=group[0][0],
            runs=len(group),
            settings=group[0][1],
            env_steps=round(sum(run.env_steps for _, run in group) / len(group)),
        )
        for group in groups.values()
    ]
    return found + list(_searched(config))


def _searched(config: SweepConfig) -> Iterator[Kind]:
    stages = {stage.name: stage for stage in config.stages}
    for stage in config.stages:
        if stage.search is None:
            continue
        source = stages.get(str(stage.source.stage)) if stage.source else None
        if source is not None and stage.search.final is not None:
            for task in source.tasks:
                settings = source.points[0].runs[task.name]
                yield Kind(
                    label=f"{source.name}/{task.name}, fresh seeds",
                    runs=stage.search.final.seeds,
                    settings=settings,
                    env_steps=settings.env_steps,
                )
        final, budget = stage.search.final, search_budget(stage, stage.search)
        fresh = fresh_runs(stage, stage.search) // len(stage.tasks)
        runs = search_runs(stage, stage.search, len(config.seeds)) // len(stage.tasks) - fresh
        longer = None if final is None else final.env_steps
        for task in stage.tasks:
            settings, label = stage.points[0].runs[task.name], f"{stage.name}/{task.name}"
            yield Kind(
                label=label,
                runs=runs if longer else runs + fresh,
                settings=settings,
                env_steps=budget,
            )
            if longer:
                yield Kind(
                    label=f"{label}, fresh seeds", runs=fresh, settings=settings, env_steps=longer
                )


def measure(
    config: SweepConfig, found: list[Kind], say: Callable[[str], None]
) -> tuple[list[Cost], int]:
    """Train a run of each kind for some seconds in this process, one after the other.

    Args:
        config: For the resources of a run.
        found: The kinds, of `kinds`.
        say: Told what is measured.

    Returns:
        The cost of each kind, and how many runs fit at once.

    Raises:
        ClusterError: Ray can't be reached or can't hold a run.
    """
    with cluster(config.resources) as room:
        if room.remark is not None:
            say(room.remark)
        costs = []
        for number, kind in enumerate(found, 1):
            say(f"measuring {number} of {len(found)}: {kind.label}")
            costs.append(_measure_one(kind, config.resources.gpus_per_run))
        return costs, room.at_once


def _measure_one(kind: Kind, gpus: float) -> Cost:
    run = kind.settings
    # Steps that teach nothing are many times cheaper than the others, and soon over.
    tac = run.tac.model_copy(update={"random_steps": 0})
    training = TrainingRun(run.model_copy(update={"tac": tac}), gpus=gpus)
    try:
        training.algorithm.train()
        first, began = training.env_steps, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < MEASURED_SECONDS:
            training.algorithm.train()
        steps = training.env_steps - first
        began = time.perf_counter()
        training.evaluate()
        evaluation = time.perf_counter() - began
    finally:
        training.close()
    return Cost(kind=kind, steps_per_second=steps / elapsed, evaluation_seconds=evaluation)


def cost_table(costs: list[Cost], slots: int) -> Table:
    """One row per kind of run, and the whole sweep's time below."""
    document = cost_document(costs, slots)
    table = Table(title="What it takes on this machine", title_justify="left")
    table.add_column("stage/task")
    for name in ("runs", "env steps a run", "updates a run", "env steps/s", "a run", "all"):
        table.add_column(name, justify="right")
    for row in document["kinds"]:
        table.add_row(
            row["label"],
            f"{row['runs']:,}",
            f"{row['env_steps']:,}",
            f"{row['grad_updates']:,}",
            f"{row['env_steps_per_second']:.0f}",
            clock(row["seconds_a_run"]),
            clock(row["seconds"]),
        )
    at_once = "one run at a time" if slots == 1 else f"{slots} runs at a time"
    table.caption = f"About {clock(document['seconds'])} with {at_once}, each measured by itself."
    load = os.getloadavg()[0]
    if load > BUSY * len(os.sched_getaffinity(0)):
        table.caption += f"\nThe machine was busy with something else (load {load:.1f})."
    table.caption_justify = "left"
    return table


def cost_document(costs: list[Cost], slots: int) -> dict[str, Any]:
    """The same as plain data; times in seconds."""
    rows: list[dict[str, Any]] = [
        {
            "label": cost.kind.label,
            "runs": cost.kind.runs,
            "env_steps": cost.kind.env_steps,
            "grad_updates": cost.kind.grad_updates,
            "env_steps_per_second": cost.steps_per_second,
            "seconds_a_run": cost.seconds,
            "seconds": cost.seconds * cost.kind.runs,
        }
        for cost in costs
    ]
    alone = sum(cost.seconds * cost.kind.runs for cost in costs)
    longest = max((cost.seconds for cost in costs), default=0.0)
    return {"kinds": rows, "runs_at_once": slots, "seconds": max(alone / slots, longest)}
