"""A sweep's runs by what is compared: one condition for each point, over its tasks and seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from music_rllib.experiment.plan import Plan, Run, short
from music_rllib.experiment.result import RunResult
from music_rllib.results.statistics import (
    Estimate,
    estimate,
    holm,
    improvement,
    improvement_p_value,
)
from music_rllib.tracking import names

__all__ = ["Condition", "compared", "conditions"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Condition:
    """Runs that differ in their task and seed only."""

    stage: str
    values: Mapping[str, Any]
    part: str
    """`search` for runs that trials were chosen by, `final` for those on fresh seeds, or empty."""
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    runs: tuple[Run, ...]
    """Those with a result."""
    planned: int
    complete: bool
    """Whether every planned run is finished, whatever it reported."""
    scores: Array
    """`[seeds, tasks]`, NaN where there is no result."""

    @property
    def label(self) -> str:
        """`tac.entropic_index = 1.5`, or the stage where nothing varies."""
        pairs = [f"{name} = {short(value)}" for name, value in self.values.items()]
        return ", ".join(pairs) or self.stage

    def estimate(self) -> Estimate:
        """Interquartile mean with its 95 % interval."""
        return estimate(self.scores, np.random.default_rng(0))


def conditions(
    plan: Plan, results: Mapping[str, RunResult], metric: str = names.EVAL_SUCCESS
) -> list[Condition]:
    """Every condition of the plan, in its order; without those on which nothing is finished."""
    groups: dict[tuple[str, str, str], list[Run]] = {}
    for run in plan.runs:
        values = ",".join(f"{name}={value!r}" for name, value in run.values.items())
        groups.setdefault((run.stage, _part(run), values), []).append(run)
    found = []
    for (stage, part, _), runs in groups.items():
        tasks = tuple(dict.fromkeys(run.task for run in runs))
        seeds = list(dict.fromkeys(run.seed for run in runs))
        scores = np.full((len(seeds), len(tasks)), np.nan)
        done = []
        for run in runs:
            result = results.get(run.key)
            if result is not None and metric in result.metrics:
                scores[seeds.index(run.seed), tasks.index(run.task)] = result.metrics[metric]
                done.append(run)
        if done:
            found.append(
                Condition(
                    stage=stage,
                    values=runs[0].values,
                    part=part,
                    tasks=tasks,
                    seeds=tuple(seeds),
                    runs=tuple(done),
                    planned=len({run.key for run in runs}),
                    complete=all(run.key in results for run in runs),
                    scores=scores,
                )
            )
    return found


def _part(run: Run) -> str:
    return "final" if run.part.startswith("final") else "search" if run.part else ""


def compared(found: Sequence[Condition], *, maximised: bool = True) -> list[dict[str, Any]]:
    """Conditions side by side, the best first, each with its chance to be beaten by the first.

    `p_value` is the permutation test's for that, adjusted for the number of conditions (Holm).
    """
    if not found:
        return []
    sign = 1.0 if maximised else -1.0
    first, *others = sorted(found, key=lambda one: -sign * float(one.estimate().value))
    rivals = [one for one in others if _comparable(first, one)]
    rng = np.random.default_rng(0)
    raw = [improvement_p_value(first.scores, one.scores, rng) for one in rivals]
    p_values = {id(one): p for one, p in zip(rivals, holm(raw), strict=True)}
    rows: list[dict[str, Any]] = []
    for one in (first, *others):
        ends = one.estimate()
        better = None
        if id(one) in p_values:
            chance = improvement(first.scores, one.scores)
            better = chance if maximised else 1 - chance
        rows.append(
            {
                "stage": one.stage,
                "values": dict(one.values),
                "label": one.label,
                "on_fresh_seeds": one.part == "final",
                "value": float(ends.value),
                "interval": [float(ends.lower), float(ends.upper)],
                "tasks": {
                    task: float(np.nanmean(one.scores[:, position]))
                    for position, task in enumerate(one.tasks)
                    if not np.isnan(one.scores[:, position]).all()
                },
                "runs": len(one.runs),
                "planned": one.planned,
                "best_is_better_with": better,
                "p_value": p_values.get(id(one)),
                "overlaps_best": one is not first and first.estimate().overlaps(ends),
            }
        )
    return rows


def _comparable(one: Condition, other: Condition) -> bool:
    """Whether both have a result on each of the same tasks."""
    if one.tasks != other.tasks:
        return False
    return not any(np.isnan(scores).all(0).any() for scores in (one.scores, other.scores))
