"""What a plan takes on this machine: a run of each kind is trained for some seconds."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.table import Table

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Stage, SweepConfig
from music_rllib.experiment.plan import Plan
from music_rllib.runtime import machine
from music_rllib.sweep.views.tables import fresh_runs, new_table, search_budget, search_runs
from music_rllib.sweep.views.text import clock

if TYPE_CHECKING:
    from music_rllib.training.sample_run import RunSample

__all__ = ["Kind", "cost_document", "cost_table", "kinds", "measure"]

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
    sample: RunSample

    @property
    def seconds(self) -> float:
        """Of one run, from its start to its end."""
        evaluations = 1 + math.ceil(self.kind.env_steps / self.kind.settings.evaluation.interval)
        training = self.kind.env_steps / self.sample.steps_per_second
        return self.sample.start_seconds + training + evaluations * self.sample.evaluation_seconds


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
    return found + [kind for stage in config.stages for kind in searched(config, stage)]


def searched(config: SweepConfig, stage: Stage) -> Iterator[Kind]:
    """What the search of a stage asks for at most, with what its fresh seeds start from."""
    stages = {stage.name: stage for stage in config.stages}
    if stage.search is None:
        return
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
    """Train a run of each kind for some seconds, one after the other.

    Args:
        config: For the resources of a run.
        found: The kinds, of `kinds`.
        say: Told what is measured.

    Returns:
        The cost of each kind, and how many runs fit at once.

    Raises:
        ClusterError: Ray can't be reached or can't hold a run.
    """
    # Not by every program that shows a plan: RLlib takes seconds to load.
    from music_rllib.runtime.ray_cluster import cluster
    from music_rllib.training.sample_run import sample_run

    with cluster(config.resources) as room:
        if room.remark is not None:
            say(room.remark)
        costs = []
        for number, kind in enumerate(found, 1):
            say(f"measuring {number} of {len(found)}: {kind.label}")
            run = kind.settings.model_copy(update={"env_steps": kind.env_steps})
            sample = sample_run(run, config.resources)
            costs.append(Cost(kind=kind, sample=sample))
        return costs, room.at_once


def cost_table(costs: list[Cost], slots: int) -> Table:
    """One row per kind of run, and the whole sweep's time below."""
    document = cost_document(costs, slots)
    table = new_table("What it takes on this machine")
    table.add_column("stage/task", overflow="fold")
    for name in ("runs", "env steps", "steps/s", "memory", "start", "a run", "all"):
        table.add_column(name, justify="right", overflow="fold")
    for row in document["kinds"]:
        table.add_row(
            row["label"],
            f"{row['runs']:,}",
            f"{row['env_steps']:,}",
            f"{row['env_steps_per_second']:.0f}",
            f"{row['memory'] / 2**30:.1f} GiB",
            f"{row['start_seconds']:.0f} s",
            clock(row["seconds_a_run"]),
            clock(row["seconds"]),
        )
    at_once = "one run at a time" if slots == 1 else f"{slots} runs at a time"
    table.caption = f"About {clock(document['seconds'])} with {at_once}, each measured by itself."
    largest = max((cost.sample.memory for cost in costs), default=0)
    table.caption += f"\n{_memory_in_words(largest, slots)}"
    load = os.getloadavg()[0]
    if load > BUSY * len(os.sched_getaffinity(0)):
        table.caption += f"\nThe machine was busy with something else (load {load:.1f})."
    table.caption_justify = "left"
    return table


def _memory_in_words(largest: int, slots: int) -> str:
    """What runs side by side take of this machine's memory, and how to have fewer of them."""
    wanted, here = slots * largest / 2**30, machine.memory() / 2**30
    if machine.cluster_address() is not None:
        return f"A run takes up to {largest / 2**30:.1f} GiB of memory."
    if wanted <= here:
        return f"Together they take up to {wanted:.1f} of this machine's {here:.1f} GiB of memory."
    return (
        f"Together they would take {wanted:.1f} GiB of memory, of which this machine has "
        f"{here:.1f}: set resources.memory_per_run to {math.ceil(10 * largest / 2**30) / 10:g}."
    )


def cost_document(costs: list[Cost], slots: int) -> dict[str, Any]:
    """The same as plain data; times in seconds."""
    rows: list[dict[str, Any]] = [
        {
            "label": cost.kind.label,
            "runs": cost.kind.runs,
            "env_steps": cost.kind.env_steps,
            "grad_updates": cost.kind.grad_updates,
            "env_steps_per_second": cost.sample.steps_per_second,
            "start_seconds": cost.sample.start_seconds,
            "evaluation_seconds": cost.sample.evaluation_seconds,
            "memory": cost.sample.memory,
            "seconds_a_run": cost.seconds,
            "seconds": cost.seconds * cost.kind.runs,
        }
        for cost in costs
    ]
    alone = sum(cost.seconds * cost.kind.runs for cost in costs)
    longest = max((cost.seconds for cost in costs), default=0.0)
    return {"kinds": rows, "runs_at_once": slots, "seconds": max(alone / slots, longest)}
