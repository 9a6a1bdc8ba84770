"""The cost of a plan on this machine, from some seconds of training for each kind of run."""

from __future__ import annotations

import itertools
import json
import math
import os
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.table import Table

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Stage, SweepConfig
from music_rllib.config.search import SearchSettings
from music_rllib.experiment.plan import Plan
from music_rllib.runtime import machine
from music_rllib.sweep.views.search_budget import search_budget
from music_rllib.sweep.views.tables import new_table
from music_rllib.sweep.views.text import clock

if TYPE_CHECKING:
    from music_rllib.training.sample_run import RunSample

BUSY_LOAD = 0.75
"""Load average per CPU above which other programs have disturbed the measurement."""
_WITHOUT_COST: dict[str, bool | set[str]] = {
    "seed": True,
    "env_steps": True,
    "tac": {"entropic_index", "alpha", "gamma", "tau", "lr", "target_bounds"}
    | {"random_steps", "warmup_steps"},
    "music": {"mi_reward_weight", "lr"},
}
"""Settings that change what is computed, and not how long it takes."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Runs of one stage and task that cost the same."""

    label: str
    runs: int
    """Runs that are left to compute; for a search at most."""
    settings: RunSettings
    env_steps: int
    """Env steps of one run, on average."""

    @property
    def grad_updates(self) -> int:
        """Gradient updates of one run."""
        learning = self.env_steps - self.settings.tac.steps_before_updates
        return round(learning * self.settings.tac.replay_ratio)


@dataclass(frozen=True, kw_only=True)
class Cost:
    """A kind of run, and what a short run of it took."""

    kind: Kind
    sample: RunSample

    @property
    def seconds(self) -> float:
        """Time of one whole run, from its start to its end."""
        evaluations = 1 + math.ceil(self.kind.env_steps / self.kind.settings.evaluation.interval)
        training = self.kind.env_steps / self.sample.steps_per_second
        return self.sample.start_seconds + training + evaluations * self.sample.evaluation_seconds


def kinds(config: SweepConfig, plan: Plan, finished: Collection[str]) -> list[Kind]:
    """The kinds of runs that are left: those of the plan in its order, then those of searches."""
    groups: dict[str, list[tuple[str, RunSettings]]] = {}
    for node in plan.nodes:
        if node.key not in finished:
            label = f"{node.stage}/{node.run.task.name}"
            alike = node.run.model_dump(mode="json", exclude=dict(_WITHOUT_COST))
            groups.setdefault(json.dumps([label, alike]), []).append((label, node.run))
    planned = [
        Kind(
            label=group[0][0],
            runs=len(group),
            settings=group[0][1],
            env_steps=round(sum(run.env_steps for _, run in group) / len(group)),
        )
        for group in groups.values()
    ]
    return planned + [kind for stage in config.stages for kind in searched(config, stage)]


def searched(config: SweepConfig, stage: Stage) -> Iterator[Kind]:
    """The runs that the search of a stage asks for at most, and what fresh seeds start from."""
    if stage.search is None:
        return
    final = stage.search.final
    source = next((s for s in config.stages if stage.source and s.name == stage.source.stage), None)
    budget = search_budget(stage, len(config.seeds))
    if source is not None:
        most = _sources_of_a_seed(stage.search, source.name)
        per_seed = len(stage.tasks) * len(config.seeds)
        trials = min(budget.trial_runs // per_seed, most) if most > 1 else 0
        counts = {"": trials * len(config.seeds)}
        if final is not None:
            finalists = budget.fresh_runs // (len(stage.tasks) * final.seeds)
            counts[", fresh seeds"] = min(finalists, most) * final.seeds
        for task, (text, runs) in itertools.product(source.tasks, counts.items()):
            settings = source.points[0].runs[task.name]
            label = f"{source.name}/{task.name}{text}"
            if runs:
                yield Kind(label=label, runs=runs, settings=settings, env_steps=settings.env_steps)
    runs, fresh_runs = budget.trial_runs, budget.fresh_runs
    longer = final is not None and final.env_steps is not None
    if not longer:
        runs, fresh_runs = runs + fresh_runs, 0
    for task in stage.tasks:
        label = f"{stage.name}/{task.name}"
        settings = stage.points[0].runs[task.name]
        yield Kind(
            label=label,
            runs=runs // len(stage.tasks),
            settings=settings,
            env_steps=budget.trial_env_steps,
        )
        if longer:
            yield Kind(
                label=f"{label}, fresh seeds",
                runs=fresh_runs // len(stage.tasks),
                settings=settings,
                env_steps=budget.fresh_env_steps,
            )


def _sources_of_a_seed(search: SearchSettings, source: str) -> int:
    """How many different runs of the source the trials of a seed may start from, at most."""
    names = [name for name in (*search.space, *search.compare) if name.startswith(f"{source}:")]
    sizes = [
        len(search.compare[name])
        if name in search.compare
        else search.space[name].size or search.count
        for name in names
    ]
    return math.prod(sizes)


def measure(
    config: SweepConfig, kinds: Collection[Kind], say: Callable[[str], None]
) -> tuple[list[Cost], int]:
    """Train runs of each kind for some seconds, as many side by side as fit.

    Args:
        config: Has the resources of a run.
        kinds: As `kinds` returns them.
        say: Receives a line before each measurement.

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
        for number, kind in enumerate(kinds, 1):
            say(f"measuring {number} of {len(kinds)}: {kind.label}")
            run = kind.settings.model_copy(update={"env_steps": kind.env_steps})
            sample = sample_run(run, config.resources, min(room.at_once, max(kind.runs, 1)))
            costs.append(Cost(kind=kind, sample=sample))
        return costs, room.at_once


def cost_table(costs: list[Cost], slots: int) -> Table:
    """One row for each kind of run, and the whole sweep's time below."""
    document = cost_document(costs, slots)
    heads = ("stage/task", "runs", "env steps", "steps/s", "memory", "start", "a run", "all")
    table = new_table("What it takes on this machine", heads, left=["stage/task"])
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
    at_once = "one run at a time" if slots == 1 else f"{slots} runs at a time, measured so"
    largest = max((cost.sample.memory for cost in costs), default=0)
    lines = [
        f"About {clock(document['seconds'])} with {at_once}.",
        _memory_in_words(largest, slots),
    ]
    load = os.getloadavg()[0]
    if load > BUSY_LOAD * len(os.sched_getaffinity(0)):
        lines.append(f"The machine was busy with something else (load {load:.1f}).")
    table.caption = "\n".join(lines)
    table.caption_justify = "left"
    return table


def _memory_in_words(largest: int, slots: int) -> str:
    """The memory that runs side by side take, and how to have fewer of them where it is too much.

    Args:
        largest: Bytes of the largest run.
        slots: Runs at a time.
    """
    gib = largest / 2**30
    if machine.cluster_address() is not None:
        return f"A run takes up to {gib:.1f} GiB of memory."
    wanted, here = slots * gib, machine.memory() / 2**30
    if wanted <= here:
        return f"Together they take up to {wanted:.1f} of this machine's {here:.1f} GiB of memory."
    return (
        f"Together they would take {wanted:.1f} GiB of memory, of which this machine has "
        f"{here:.1f}: set resources.memory_per_run to {math.ceil(10 * gib) / 10:g}."
    )


def cost_document(costs: list[Cost], slots: int) -> dict[str, Any]:
    """The cost as plain data; times in seconds, memory in bytes."""
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
    alone = sum(row["seconds"] for row in rows)
    longest = max((cost.seconds for cost in costs), default=0.0)
    return {"kinds": rows, "runs_at_once": slots, "seconds": max(alone / slots, longest)}
