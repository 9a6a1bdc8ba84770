"""Numbers of runs and environment steps: of the plan, and of its searches at most."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Stage, SweepConfig
from music_rllib.config.search import SearchSettings
from music_rllib.experiment.plan import Node, Plan

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
        """`stage/task`."""
        return f"{self.stage}/{self.settings.task.name}"

    @property
    def all_env_steps(self) -> int:
        """Environment steps of all runs together."""
        return self.runs * self.env_steps

    @property
    def grad_updates(self) -> int:
        """Gradient updates of one run."""
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
    source = config.source_of(stage)
    for fresh, (trials, seeds, env_steps) in enumerate(phases):
        if source is not None:
            points = _points_of(search, source.name)
            # A source whose settings are not searched has its other runs in the plan.
            count = min(trials * studies, points) if fresh or points > 1 else 0
            for task, run in source.points[0].runs.items():
                runs[source.name, task, run.env_steps] += count * seeds
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


def _points_of(search: SearchSettings, stage: str) -> int:
    """The largest number of points that a search has in the settings of another stage."""
    names = [name for name in (*search.space, *search.compare) if name.startswith(f"{stage}:")]
    return math.prod(
        len(search.compare[name])
        if name in search.compare
        else search.space[name].size or search.count
        for name in names
    )
