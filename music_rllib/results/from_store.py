"""Conditions of a plan and their scores, read from the results in a storage."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from music_rllib import names
from music_rllib.experiment.plan import Plan, Run, short
from music_rllib.labels import symbol
from music_rllib.results import statistics as st
from music_rllib.results.comparison import Scope, scopes_of
from music_rllib.results.statistics import Array, Estimate
from music_rllib.store.run_record import RunResult


@dataclass(frozen=True, kw_only=True, eq=False)
class Condition:
    """Runs that differ in their task and seed only."""

    stage: str
    values: Mapping[str, Any]
    part: str
    """`search` for runs that trials were chosen by, `final` for those on fresh seeds, or empty."""
    metrics: Mapping[str, str]
    """Task to the metric whose last value is the score."""
    seeds: tuple[int, ...]
    runs: tuple[Run, ...]
    """Runs with a result."""
    planned: int
    """Number of planned runs."""
    complete: bool
    """Whether every planned run is finished, whatever it reported."""
    scores: Array
    """`[seeds, tasks]`, NaN where there is no result."""
    episodes: float
    """Episodes of an evaluation, mean of the runs; infinite where they are not known."""

    @property
    def tasks(self) -> tuple[str, ...]:
        return tuple(self.metrics)

    @property
    def label(self) -> str:
        """`q = 1.5, alpha = 0.1`, or the stage where nothing varies."""
        pairs = [f"{symbol(name)} = {short(value, name)}" for name, value in self.values.items()]
        return ", ".join(pairs) or self.stage

    def estimate(self) -> Estimate:
        """Mean over the tasks that have a result, with its 95 % interval."""
        is_rate = set(self.metrics.values()) <= names.EVAL_RATES
        known = self.scores[:, ~np.isnan(self.scores).all(axis=0)]
        return st.estimate(known, self.episodes if is_rate else None)


def conditions(
    plan: Plan, results: Mapping[str, RunResult], metric: str | None = None
) -> list[Condition]:
    """Every condition of the plan that has a result, in the plan's order.

    Args:
        plan: the sweep's.
        results: node key to result.
        metric: None for each task's primary one.
    """
    groups: defaultdict[tuple[str, str, str], list[Run]] = defaultdict(list)
    for run in plan.runs:
        part = "final" if run.part.startswith("final") else "search" if run.part else ""
        values = ",".join(f"{name}={value!r}" for name, value in run.values.items())
        groups[run.stage, part, values].append(run)
    found = []
    for (stage, part, _), runs in groups.items():
        metrics = {r.task: metric or plan.node(r.key).run.task.primary_metric for r in runs}
        seeds, tasks = list(dict.fromkeys(run.seed for run in runs)), list(metrics)
        scores = np.full((len(seeds), len(tasks)), np.nan)
        scored, episodes = [], []
        for run in runs:
            result = results.get(run.key)
            if result is not None and metrics[run.task] in result.metrics:
                score = result.metrics[metrics[run.task]]
                scores[seeds.index(run.seed), tasks.index(run.task)] = score
                episodes.append(result.metrics.get(names.EVAL_EPISODES, np.inf))
                scored.append(run)
        if scored:
            found.append(
                Condition(
                    stage=stage,
                    values=runs[0].values,
                    part=part,
                    metrics=metrics,
                    seeds=tuple(seeds),
                    runs=tuple(scored),
                    planned=len({run.key for run in runs}),
                    complete=all(run.key in results for run in runs),
                    scores=scores,
                    episodes=float(np.mean(episodes)),
                )
            )
    return found


def entropies(
    plan: Plan, results: Mapping[str, RunResult], stage: str, part: str, values: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Entropies of a condition's policies at the end, over all its tasks.

    Returns:
        Metric (of `names.ENTROPIES`) to `value` and `interval`; empty where there is none.
    """
    found = {}
    for metric in names.ENTROPIES:
        for condition in conditions(plan, results, metric):
            own = (condition.stage, condition.part, dict(condition.values))
            if own == (stage, part, dict(values)):
                estimate = condition.estimate()
                interval = [float(estimate.lower), float(estimate.upper)]
                found[metric] = {"value": float(estimate.value), "interval": interval}
    return found


def scopes(found: Sequence[Condition]) -> tuple[Scope[Condition], ...]:
    """Comparisons of the conditions of one stage; of a search only of those on fresh seeds."""
    metrics = {task: metric for one in found for task, metric in one.metrics.items()}
    scored = []
    for condition in found:
        scores = np.full((len(condition.seeds), len(metrics)), np.nan)
        scores[:, [list(metrics).index(task) for task in condition.tasks]] = condition.scores
        scored.append((condition, scores, condition.episodes))
    return scopes_of(metrics, scored, [one for one in found if one.part != "search"])
