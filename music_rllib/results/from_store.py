"""A sweep's runs by what is compared: one condition for each point, over its tasks and seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from music_rllib import names
from music_rllib.experiment.plan import Plan, Run, short
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
    """Task to the metric that its scores are last values of."""
    seeds: tuple[int, ...]
    runs: tuple[Run, ...]
    """Those with a result."""
    planned: int
    complete: bool
    """Whether every planned run is finished, whatever it reported."""
    scores: Array
    """`[seeds, tasks]`, NaN where there is no result."""
    episodes: float
    """Of an evaluation, mean of the runs; infinite where it is not known."""

    @property
    def tasks(self) -> tuple[str, ...]:
        return tuple(self.metrics)

    @property
    def label(self) -> str:
        """`tac.entropic_index = 1.5`, or the stage where nothing varies."""
        pairs = [f"{name} = {short(value)}" for name, value in self.values.items()]
        return ", ".join(pairs) or self.stage

    def estimate(self) -> Estimate:
        """Mean of what has a result, with its 95 % interval."""
        is_rate = set(self.metrics.values()) <= names.EVAL_RATES
        there = self.scores[:, ~np.isnan(self.scores).all(axis=0)]
        return st.estimate(there, self.episodes if is_rate else None)


def conditions(
    plan: Plan, results: Mapping[str, RunResult], metric: str | None = None
) -> list[Condition]:
    """Every condition of the plan, in its order; without those on which nothing is finished.

    Args:
        plan: the sweep's.
        results: node key to result.
        metric: None for each task's primary one.
    """
    groups: dict[tuple[str, str, str], list[Run]] = {}
    for run in plan.runs:
        values = ",".join(f"{name}={value!r}" for name, value in run.values.items())
        groups.setdefault((run.stage, _part(run), values), []).append(run)
    found = []
    for (stage, part, _), runs in groups.items():
        metrics = {r.task: metric or plan.node(r.key).run.task.primary_metric for r in runs}
        seeds, tasks = list(dict.fromkeys(run.seed for run in runs)), list(metrics)
        scores = np.full((len(seeds), len(tasks)), np.nan)
        done, episodes = [], []
        for run in runs:
            result = results.get(run.key)
            if result is not None and metrics[run.task] in result.metrics:
                score = result.metrics[metrics[run.task]]
                scores[seeds.index(run.seed), tasks.index(run.task)] = score
                episodes.append(result.metrics.get(names.EVAL_EPISODES, np.inf))
                done.append(run)
        if done:
            found.append(
                Condition(
                    stage=stage,
                    values=runs[0].values,
                    part=part,
                    metrics=metrics,
                    seeds=tuple(seeds),
                    runs=tuple(done),
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
    """How random a condition's policies are at the end, over all its tasks.

    Returns:
        Metric (of `names.ENTROPIES`) to `value` and `interval`; empty where there is none.
    """
    found = {}
    for metric in names.ENTROPIES:
        for one in conditions(plan, results, metric):
            if (one.stage, one.part, dict(one.values)) == (stage, part, dict(values)):
                ends = one.estimate()
                interval = [float(ends.lower), float(ends.upper)]
                found[metric] = {"value": float(ends.value), "interval": interval}
    return found


def _part(run: Run) -> str:
    return "final" if run.part.startswith("final") else "search" if run.part else ""


def scopes(found: Sequence[Condition]) -> tuple[Scope[Condition], ...]:
    """Conditions of one stage side by side; of a search only those on fresh seeds are compared."""
    metrics = {task: metric for one in found for task, metric in one.metrics.items()}
    columns = [
        (
            one,
            np.column_stack(
                [
                    one.scores[:, one.tasks.index(task)]
                    if task in one.tasks
                    else np.full(len(one.seeds), np.nan)
                    for task in metrics
                ]
            ),
            one.episodes,
        )
        for one in found
    ]
    return scopes_of(metrics, columns, [one for one in found if one.part != "search"])
