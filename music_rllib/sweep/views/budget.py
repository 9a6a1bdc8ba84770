"""Numbers of runs and environment steps: of the plan, and of its searches at most."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Stage, SweepConfig
from music_rllib.experiment.plan import Plan

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
class SearchBudget:
    """Upper bounds over all studies and tasks: trials may stop early, and points repeat."""

    trial_runs: int
    """Runs of trials."""
    trial_env_steps: int
    """Environment steps of one of these runs."""
    fresh_runs: int
    """Runs of the final ranking, on fresh seeds."""
    fresh_env_steps: int
    """Environment steps of one of these runs."""

    @property
    def runs(self) -> int:
        """All runs."""
        return self.trial_runs + self.fresh_runs

    @property
    def env_steps(self) -> int:
        """Environment steps of all runs together."""
        return self.trial_runs * self.trial_env_steps + self.fresh_runs * self.fresh_env_steps


def search_budget(stage: Stage, seeds: int) -> SearchBudget:
    """The budget of a searched stage in a sweep with this number of seeds."""
    search = stage.search
    assert search is not None
    env_steps = stage.most_env_steps
    fresh_runs, fresh_env_steps = 0, env_steps
    runs_per_seed = len(search.compared()) * len(stage.tasks)
    if (final := search.final) is not None:
        finalists = min(final.most(len(search.points_to_evaluate)), search.count)
        fresh_runs = finalists * final.seeds * runs_per_seed
        fresh_env_steps = final.env_steps or env_steps
    return SearchBudget(
        trial_runs=search.count * seeds * runs_per_seed,
        trial_env_steps=env_steps,
        fresh_runs=fresh_runs,
        fresh_env_steps=fresh_env_steps,
    )


@dataclass(frozen=True, kw_only=True)
class RunGroup:
    """Runs of one stage and task that take equally long."""

    label: str
    runs: int
    """Runs left to train; at most, for a search."""
    settings: RunSettings
    env_steps: int
    """Environment steps of one run, on average."""

    @property
    def grad_updates(self) -> int:
        """Gradient updates of one run."""
        learning = self.env_steps - self.settings.tac.steps_before_updates
        return round(learning * self.settings.tac.replay_ratio)


def run_groups(config: SweepConfig, plan: Plan, finished: Collection[str]) -> list[RunGroup]:
    """Groups of the runs that are left: those of the plan in its order, then those of searches."""
    groups: dict[str, list[tuple[str, RunSettings]]] = {}
    for node in plan.nodes:
        if node.key not in finished:
            label = f"{node.stage}/{node.run.task.name}"
            alike = node.run.model_dump(mode="json", exclude=dict(_WITHOUT_COST))
            groups.setdefault(json.dumps([label, alike]), []).append((label, node.run))
    planned = [
        RunGroup(
            label=group[0][0],
            runs=len(group),
            settings=group[0][1],
            env_steps=round(sum(run.env_steps for _, run in group) / len(group)),
        )
        for group in groups.values()
    ]
    return planned + [group for stage in config.stages for group in searched_runs(config, stage)]


def searched_runs(config: SweepConfig, stage: Stage) -> Iterator[RunGroup]:
    """The runs that the search of a stage trains at most, and their source runs."""
    if stage.search is None:
        return
    budget = search_budget(stage, len(config.seeds))
    yield from _source_runs(config, stage, budget)
    runs, fresh_runs = budget.trial_runs, budget.fresh_runs
    if budget.fresh_env_steps == budget.trial_env_steps:
        runs, fresh_runs = runs + fresh_runs, 0
    for task in stage.tasks:
        for text, count, env_steps in (
            ("", runs, budget.trial_env_steps),
            (", fresh seeds", fresh_runs, budget.fresh_env_steps),
        ):
            if count:
                yield RunGroup(
                    label=f"{stage.name}/{task.name}{text}",
                    runs=count // len(stage.tasks),
                    settings=stage.points[0].runs[task.name],
                    env_steps=env_steps,
                )


def _source_runs(config: SweepConfig, stage: Stage, budget: SearchBudget) -> Iterator[RunGroup]:
    """The runs of another stage that the trials start from, if the search varies them."""
    search = stage.search
    source = next((s for s in config.stages if stage.source and s.name == stage.source.stage), None)
    if source is None or search is None:
        return
    names = [
        name for name in (*search.space, *search.compare) if name.startswith(f"{source.name}:")
    ]
    most = math.prod(
        len(search.compare[name])
        if name in search.compare
        else search.space[name].size or search.count
        for name in names
    )
    per_seed = len(stage.tasks) * len(config.seeds)
    trials = min(budget.trial_runs // per_seed, most) if most > 1 else 0
    counts = {"": trials * len(config.seeds)}
    if (final := search.final) is not None:
        finalists = budget.fresh_runs // (len(stage.tasks) * final.seeds)
        counts[", fresh seeds"] = min(finalists, most) * final.seeds
    for task in source.tasks:
        for text, runs in counts.items():
            if runs:
                settings = source.points[0].runs[task.name]
                yield RunGroup(
                    label=f"{source.name}/{task.name}{text}",
                    runs=runs,
                    settings=settings,
                    env_steps=settings.env_steps,
                )
