"""Groups of runs that take equally long, and their cost on this machine, measured."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.console import Group

from music_rllib.command_line import clock, new_table
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Stage, SweepConfig
from music_rllib.config.search import SearchSettings
from music_rllib.experiment.plan import Node, Plan
from music_rllib.runtime import machine

if TYPE_CHECKING:
    from music_rllib.training.sample_run import RunSample

BUSY_LOAD = 0.75
"""Load average per CPU above which other programs have disturbed the measurement."""


_WITHOUT_COST: dict[str, bool | set[str]] = {
    "seed": True,
    "env_steps": True,
    "tac": {"entropic_index", "alpha", "gamma", "tau", "lr", "target_bounds"}
    | {"random_steps", "random_actions", "warmup_steps"},
    "music": {"mi_reward_weight", "lr"},
    "intrinsic": {"weight", "lr"},
}
"""Settings that do not change how long a step takes."""


@dataclass(frozen=True, kw_only=True)
class RunGroup:
    """Runs of one stage and task that take equally long."""

    stage: str
    runs: int
    """Runs left to train; at most, for a search."""
    settings: RunSettings
    env_steps: int
    """Environment steps of one run, on average."""

    @property
    def label(self) -> str:
        return f"{self.stage}/{self.settings.task.name}"

    @property
    def all_env_steps(self) -> int:
        """Environment steps of all runs together."""
        return self.runs * self.env_steps

    @property
    def grad_updates(self) -> int:
        learning = self.env_steps - self.settings.tac.steps_before_updates
        return round(learning * self.settings.tac.replay_ratio)


def run_groups(config: SweepConfig, plan: Plan, finished: Collection[str]) -> list[RunGroup]:
    """Groups of the runs that are left: those of the plan in its order, then those of searches."""
    groups: dict[str, list[Node]] = {}
    for node in plan.nodes:
        if node.key not in finished:
            alike = node.run.model_dump_json(exclude=dict(_WITHOUT_COST))
            groups.setdefault(f"{node.stage} {alike}", []).append(node)
    planned = [
        RunGroup(
            stage=group[0].stage,
            runs=len(group),
            settings=group[0].run,
            env_steps=round(sum(node.run.env_steps for node in group) / len(group)),
        )
        for group in groups.values()
    ]
    return planned + [group for stage in config.stages for group in searched_runs(config, stage)]


def searched_runs(config: SweepConfig, stage: Stage) -> list[RunGroup]:
    """The runs that the search of a stage trains at most, and the runs that these start from.

    Trials may stop early, and points repeat.
    """
    search = stage.search
    if search is None:
        return []
    studies = len(search.compared())
    phases = [(search.count, len(config.seeds), stage.most_env_steps)]
    if (final := search.final) is not None:
        finalists = min(final.most(len(search.points_to_evaluate)), search.count)
        phases.append((finalists, final.seeds, final.env_steps or stage.most_env_steps))
    runs: Counter[tuple[str, str, int]] = Counter()
    for fresh, (trials, seeds, env_steps) in enumerate(phases):
        source = config.source_of(stage)
        while source is not None:
            # A source whose settings are not searched has its other runs in the plan.
            searched = any(name.startswith(f"{source.name}:") for name in _varied(search))
            most = min(trials * studies, _points_of(search, source.name))
            count = int(most) if fresh or searched else 0
            for task, run in source.points[0].runs.items():
                longest = _most_env_steps(search, source.name, run.env_steps)
                runs[source.name, task, longest] += count * seeds
            source = config.source_of(source)
        for task in stage.points[0].runs:
            runs[stage.name, task, env_steps] += trials * studies * seeds
    return [
        RunGroup(
            stage=name,
            runs=number,
            settings=config.stage(name).points[0].runs[task],
            env_steps=env_steps,
        )
        for (name, task, env_steps), number in runs.items()
        if number
    ]


def _varied(search: SearchSettings) -> tuple[str, ...]:
    return (*search.space, *search.compare)


def _points_of(search: SearchSettings, stage: str) -> float:
    """The largest number of points that a search has in the settings of another stage."""
    sizes: list[float] = []
    for name in _varied(search):
        if not name.startswith(f"{stage}:"):
            continue
        if name in search.compare:
            sizes.append(len(search.compare[name]))
        else:  # while a condition does not hold, the stage has its own value
            dimension = search.space[name]
            sizes.append((dimension.size or math.inf) + bool(dimension.when))
    return math.prod(sizes)


def _most_env_steps(search: SearchSettings, stage: str, own: int) -> int:
    """The longest budget of another stage in a search; `own` is the stage's budget."""
    name = f"{stage}:env_steps"
    if (dimension := search.space.get(name)) is not None:
        return max(*map(int, dimension.ends()), own if dimension.when else 0)
    return max((int(float(str(steps))) for steps in search.compare.get(name, ())), default=own)


def measure(
    config: SweepConfig, groups: Collection[RunGroup], say: Callable[[str], None]
) -> dict[str, Any]:
    """Train runs of each group for some seconds, as many side by side as fit; their `cost_of`.

    Raises:
        ClusterError: Ray can't be reached or can't hold a run.
    """
    # RLlib takes seconds to load.
    from music_rllib.runtime.ray_cluster import cluster
    from music_rllib.training.sample_run import sample_run

    with cluster(config.resources) as room:
        if room.remark is not None:
            say(room.remark)
        samples = []
        for number, group in enumerate(groups, 1):
            say(f"measuring {number} of {len(groups)}: {group.label}")
            run = group.settings.model_copy(update={"env_steps": group.env_steps})
            sample = sample_run(run, config.resources, min(room.at_once, max(group.runs, 1)))
            samples.append((group, sample))
        return cost_of(samples, room.at_once)


def cost_of(samples: Sequence[tuple[RunGroup, RunSample]], slots: int) -> dict[str, Any]:
    """The cost of runs that train `slots` at a time; times in seconds, memory in bytes."""
    rows: list[dict[str, Any]] = []
    for group, sample in samples:
        evaluations = 1 + math.ceil(group.env_steps / group.settings.evaluation.interval)
        training = group.env_steps / sample.steps_per_second
        seconds = sample.start_seconds + training + evaluations * sample.evaluation_seconds
        rows.append(
            {
                "label": group.label,
                "runs": group.runs,
                "env_steps": group.env_steps,
                "grad_updates": group.grad_updates,
                "env_steps_per_second": sample.steps_per_second,
                "start_seconds": sample.start_seconds,
                "evaluation_seconds": sample.evaluation_seconds,
                "memory": sample.memory,
                "seconds_a_run": seconds,
                "seconds": seconds * group.runs,
            }
        )
    alone = sum(row["seconds"] for row in rows)
    longest = max((row["seconds_a_run"] for row in rows), default=0.0)
    return {"kinds": rows, "runs_at_once": slots, "seconds": max(alone / slots, longest)}


def cost_view(cost: Mapping[str, Any]) -> Group:
    """One row for each group of runs; the total time and memory below."""
    heads = ("stage/task", "runs", "env steps", "steps/s", "memory", "start", "one run", "all")
    table = new_table("Cost on this machine", heads, left=["stage/task"])
    for row in cost["kinds"]:
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
    slots = cost["runs_at_once"]
    at_once = "one run at a time" if slots == 1 else f"{slots} runs at a time, as measured"
    largest = max((row["memory"] for row in cost["kinds"]), default=0)
    lines = [f"About {clock(cost['seconds'])} with {at_once}.", _memory_text(largest, slots)]
    load = os.getloadavg()[0]
    if load > BUSY_LOAD * len(os.sched_getaffinity(0)):
        lines.append(f"Other programs used the machine (load {load:.1f}).")
    return Group(table, *lines)


def _memory_text(largest: int, slots: int) -> str:
    """The memory of runs side by side, and how to run fewer of them if it is too much.

    `largest` is the memory of the largest run in bytes, `slots` the number of runs at a time.
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
