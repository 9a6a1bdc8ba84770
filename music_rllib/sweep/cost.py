"""The cost of a plan on this machine, from some seconds of training for each group of runs."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.console import Group

from music_rllib.command_line import clock, new_table
from music_rllib.config.schema import SweepConfig
from music_rllib.runtime import machine
from music_rllib.sweep.views.budget import RunGroup

if TYPE_CHECKING:
    from music_rllib.training.sample_run import RunSample

BUSY_LOAD = 0.75
"""Load average per CPU above which other programs have disturbed the measurement."""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """A group of runs, and the measurement of a short run of it."""

    group: RunGroup
    sample: RunSample

    @property
    def seconds(self) -> float:
        """Time of one whole run, from its start to its end."""
        group, sample = self.group, self.sample
        evaluations = 1 + math.ceil(group.env_steps / group.settings.evaluation.interval)
        training = group.env_steps / sample.steps_per_second
        return sample.start_seconds + training + evaluations * sample.evaluation_seconds


def measure(
    config: SweepConfig, groups: Collection[RunGroup], say: Callable[[str], None]
) -> tuple[list[Cost], int]:
    """Train runs of each group for some seconds, as many side by side as fit.

    Args:
        config: Has the resources of a run.
        groups: Groups of runs, as `run_groups` returns them.
        say: Receives a line before each measurement.

    Returns:
        The cost of each group, and how many runs fit at once.

    Raises:
        ClusterError: Ray can't be reached or can't hold a run.
    """
    # RLlib takes seconds to load.
    from music_rllib.runtime.ray_cluster import cluster
    from music_rllib.training.sample_run import sample_run

    with cluster(config.resources) as room:
        if room.remark is not None:
            say(room.remark)
        costs = []
        for number, group in enumerate(groups, 1):
            say(f"measuring {number} of {len(groups)}: {group.label}")
            run = group.settings.model_copy(update={"env_steps": group.env_steps})
            sample = sample_run(run, config.resources, min(room.at_once, max(group.runs, 1)))
            costs.append(Cost(group=group, sample=sample))
        return costs, room.at_once


def cost_document(costs: Sequence[Cost], slots: int) -> dict[str, Any]:
    """The cost as plain data; times in seconds, memory in bytes."""
    rows: list[dict[str, Any]] = [
        {
            "label": cost.group.label,
            "runs": cost.group.runs,
            "env_steps": cost.group.env_steps,
            "grad_updates": cost.group.grad_updates,
            "env_steps_per_second": cost.sample.steps_per_second,
            "start_seconds": cost.sample.start_seconds,
            "evaluation_seconds": cost.sample.evaluation_seconds,
            "memory": cost.sample.memory,
            "seconds_a_run": cost.seconds,
            "seconds": cost.seconds * cost.group.runs,
        }
        for cost in costs
    ]
    alone = sum(row["seconds"] for row in rows)
    longest = max((cost.seconds for cost in costs), default=0.0)
    return {"kinds": rows, "runs_at_once": slots, "seconds": max(alone / slots, longest)}


def cost_view(costs: Sequence[Cost], slots: int) -> Group:
    """One row for each group of runs; the total time and memory below."""
    document = cost_document(costs, slots)
    heads = ("stage/task", "runs", "env steps", "steps/s", "memory", "start", "one run", "all")
    table = new_table("Cost on this machine", heads, left=["stage/task"])
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
    at_once = "one run at a time" if slots == 1 else f"{slots} runs at a time, as measured"
    largest = max((cost.sample.memory for cost in costs), default=0)
    lines = [f"About {clock(document['seconds'])} with {at_once}.", _memory_text(largest, slots)]
    load = os.getloadavg()[0]
    if load > BUSY_LOAD * len(os.sched_getaffinity(0)):
        lines.append(f"Other programs used the machine (load {load:.1f}).")
    return Group(table, *lines)


def _memory_text(largest: int, slots: int) -> str:
    """The memory of runs side by side, and how to run fewer of them if it is too much.

    Args:
        largest: Bytes of the largest run.
        slots: Runs at a time.
    """
    gib = largest / 2**30
    if machine.cluster_address() is not None:
        return f"A run needs up to {gib:.1f} GiB of memory."
    wanted, here = slots * gib, machine.memory() / 2**30
    if wanted <= here:
        return f"Together they need up to {wanted:.1f} of this machine's {here:.1f} GiB of memory."
    return (
        f"Together they would need {wanted:.1f} GiB of memory; this machine has {here:.1f}. Set "
        f"resources.memory_per_run to {math.ceil(10 * gib) / 10:g}."
    )
