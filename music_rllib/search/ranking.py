"""The best condition of a stage, and the measure that it is best by.

Searches are read here as the plain data that `summary.outcome` makes of them, so that a sweep can
be judged from its files alone, without its studies' databases.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from music_rllib import names
from music_rllib.config.schema import Stage
from music_rllib.config.search import SearchSettings
from music_rllib.experiment.plan import Plan, short
from music_rllib.labels import in_runs, symbol
from music_rllib.results import statistics as st
from music_rllib.results.conditions import AVERAGED, Condition, final_scores, find_stages
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Estimate, with_interval
from music_rllib.search.objective import interval


@dataclass(frozen=True, kw_only=True)
class Measure:
    """The metric whose last value ranks the runs of a stage."""

    metric: str
    maximised: bool = True

    @property
    def word(self) -> str:
        """The metric's name in a sentence."""
        return names.word_of(self.metric)


def measure_of(stage: Stage, sweep: Sweep) -> Measure:
    """A stage's measure: the metric of its search, else that of its tasks.

    The metric of a search is not taken where no run has reported it, as with the budget.
    """
    if stage.search is not None:
        objective = stage.search.objectives[0]
        own = enumerate(sweep.runs)
        done = [at for at, run in own if run.stage == stage.name and run.is_finished]
        if not done or any(len(sweep.column(at, objective.metric).step) for at in done):
            # Fewer steps to a threshold is better, and so is more of what has the threshold.
            maximised = objective.maximised or objective.read == "steps_to"
            return Measure(metric=objective.metric, maximised=maximised)
    return Measure(metric=stage.primary_metric)


@dataclass(frozen=True, kw_only=True)
class Leader:
    """The best trial of a search."""

    trial: int
    values: Mapping[str, Any]
    value: float
    """Its value by the first objective."""
    scores: Sequence[Sequence[float]]
    """The scores of its runs by the first objective, `[seeds, tasks]`."""
    fresh: bool
    """Whether they are those of the final ranking, on fresh seeds."""


def leader(search: Mapping[str, Any]) -> Leader | None:
    """The best trial of a search: the final ranking's once it is complete, else the best so far."""
    for row in search["ranking"] if search["complete"] else ():
        if "failure" not in row:
            return Leader(
                trial=row["trial"],
                values=row["values"],
                value=row["fresh"][0],
                scores=row["scores"][0],
                fresh=True,
            )
    best = [arm["trials"][arm["best"]] for arm in search["arms"] if arm["best"] is not None]
    if not best:
        return None
    sign = 1.0 if search["objectives"][0]["direction"] == "maximize" else -1.0
    trial = max(best, key=lambda trial: sign * float(trial["objective"][0]))
    return Leader(
        trial=trial["number"],
        values=trial["values"],
        value=trial["objective"][0],
        scores=trial["scores"][0],
        fresh=False,
    )


@dataclass(frozen=True, kw_only=True)
class Scored:
    """A condition of a stage with the mean of its scores."""

    condition: Condition
    values: Mapping[str, Any]
    """Settings that differ between the stage's conditions, as the plan has them."""
    estimate: Estimate
    """Mean over the tasks that have a result, with its 95 % interval."""
    runs: int
    """Number of its runs that have a score."""
    complete: bool
    """Whether every planned run is finished, whatever it reported."""


def scored_conditions(
    stage: str, plan: Plan, sweep: Sweep, metric: str, task: str | None = None
) -> list[Scored]:
    """The conditions of a stage that have a score by a metric, on all tasks or on one."""
    found = []
    for condition in (c for one in find_stages(sweep) if one.name == stage for c in one.conditions):
        if task is not None:
            own = tuple(run for run in condition.runs if sweep.runs[run].task == task)
            condition = replace(condition, runs=own)
        tasks = dict.fromkeys(sweep.runs[run].task for run in condition.runs)
        scores = final_scores(sweep, condition, dict.fromkeys(tasks, metric))
        known = scores[:, ~np.isnan(scores).all(axis=0)]
        if known.size:
            episodes = sweep.episodes(condition.runs) if metric in names.EVAL_RATES else None
            found.append(
                Scored(
                    condition=condition,
                    values=plan.node(sweep.runs[condition.runs[0]].node_key).values,
                    estimate=st.estimate(known, episodes),
                    runs=int(np.sum(~np.isnan(known))),
                    complete=all(sweep.runs[run].is_finished for run in condition.runs),
                )
            )
    return found


def best_of(candidates: Iterable[Scored], measure: Measure) -> Scored | None:
    """The condition with the best mean, among those that have all their runs if there are any."""
    pairs = [(float(scored.estimate.value), scored) for scored in candidates]
    pairs = [pair for pair in pairs if math.isfinite(pair[0])]
    pairs = [pair for pair in pairs if pair[1].complete] or pairs
    sign = 1.0 if measure.maximised else -1.0
    return max(pairs, key=lambda pair: sign * pair[0], default=(0.0, None))[1]


def best_so_far(
    stages: Sequence[Stage],
    plan: Plan,
    sweep: Sweep,
    searches: Sequence[Mapping[str, Any]],
) -> dict[str, Any] | None:
    """The best condition of the last of `stages` that has one, as plain data.

    `sweep` has the runs of the plan, and `searches` is the `outcome` of its searches so far.
    """
    by_stage = {search["stage"]: search for search in searches}
    for stage in reversed(stages):
        if stage.search is None:
            best = _best_condition(stage, plan, sweep)
        else:
            best = _best_trial(stage, stage.search, by_stage.get(stage.name))
        if best is not None:
            return best | {"entropies": _entropies(stage, plan, sweep, best)}
    return None


def _entropies(
    stage: Stage, plan: Plan, sweep: Sweep, best: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Entropies of a condition's policies at the end: metric to `value` and `interval`."""
    found = {}
    for metric in names.ENTROPIES:
        for scored in scored_conditions(stage.name, plan, sweep, metric, best.get("task")):
            if is_of(scored, stage, best):
                estimate = scored.estimate
                interval = [float(estimate.lower), float(estimate.upper)]
                found[metric] = {"value": float(estimate.value), "interval": interval}
    return found


def is_of(scored: Scored, stage: Stage, best: Mapping[str, Any]) -> bool:
    """Whether a stage's condition is the one that :func:`best_so_far` has described."""
    same_seeds = stage.search is None or scored.condition.is_fresh == best["on_fresh_seeds"]
    return bool(same_seeds and dict(scored.values) == best["values"])


def _best_condition(stage: Stage, plan: Plan, sweep: Sweep) -> dict[str, Any] | None:
    """The best condition; of a metric whose scale differs between tasks, that of each task.

    The first task's row then has the others under `other_tasks`.
    """
    measure = measure_of(stage, sweep)
    tasks = list(dict.fromkeys(run.task for run in sweep.runs if run.stage == stage.name))
    if measure.metric in AVERAGED or len(tasks) < 2:
        return _best_row(measure, stage, plan, sweep)
    found = ((task, _best_row(measure, stage, plan, sweep, task)) for task in tasks)
    rows = [row | {"task": task} for task, row in found if row is not None]
    return rows[0] | {"other_tasks": rows[1:]} if rows else None


def _best_row(
    measure: Measure, stage: Stage, plan: Plan, sweep: Sweep, task: str | None = None
) -> dict[str, Any] | None:
    candidates = scored_conditions(stage.name, plan, sweep, measure.metric, task)
    best = best_of(candidates, measure)
    if best is None:
        return None
    value, planned = float(best.estimate.value), len(best.condition.runs)
    rivals = (c for c in candidates if c is not best and c.complete == best.complete)
    return {
        "stage": stage.name,
        "values": dict(best.values),
        "by": measure.word,
        "metric": measure.metric,
        "direction": "maximize",
        "value": value,
        "level": sum(math.isclose(float(c.estimate.value), value) for c in rivals),
        "interval": [float(best.estimate.lower), float(best.estimate.upper)],
        "runs": planned if best.complete else best.runs,
        "planned": planned,
        "on_fresh_seeds": False,
    }


def _best_trial(
    stage: Stage, settings: SearchSettings, search: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    best = None if search is None else leader(search)
    if best is None:
        return None
    objective = settings.objectives[0]
    estimate = interval(objective, np.asarray(best.scores, float), stage.evaluation_episodes)
    direction = "maximize" if objective.maximised else "minimize"
    runs = int(np.size(best.scores))
    assert search is not None
    rivals = (
        [row["fresh"][0] for row in search["ranking"] if "failure" not in row]
        if best.fresh
        else [t["objective"][0] for arm in search["arms"] for t in arm["trials"] if t["objective"]]
    )
    return {
        "stage": stage.name,
        "values": dict(best.values),
        "by": f"{objective.label} ({direction})",
        "metric": objective.metric,
        "direction": direction,
        "value": best.value,
        "level": sum(math.isclose(value, best.value) for value in rivals) - 1,
        "interval": [float(estimate.lower), float(estimate.upper)],
        "runs": runs,
        "planned": runs,
        "on_fresh_seeds": best.fresh,
    }


def best_in_words(best: Mapping[str, Any]) -> str:
    """The result of `best_so_far` in a line."""
    if others := best.get("other_tasks"):
        rows = ({**best, "other_tasks": ()}, *others)
        return "; ".join(f"{row['task']}: {best_in_words(row)}" for row in rows)
    values = ", ".join(
        f"{symbol(name)} = {short(value, name)}" for name, value in best["values"].items()
    )
    number = with_interval(best["value"], best["interval"])
    runs, planned = best["runs"], best.get("planned", best["runs"])
    level = f" and {best['level']} more" if best.get("level") else ""  # they tie
    text = f"{best['stage']} {values}".rstrip() + f"{level}: {best.get('by', 'success')} {number}, "
    if runs < planned:
        text += f"{runs} of {planned} runs (no condition has all of its runs yet)"
    else:
        text += f"{in_runs(runs)}{' on fresh seeds' if best['on_fresh_seeds'] else ''}"
    entropy = best.get("entropies", {}).get(names.SHANNON_ENTROPY)
    return text if entropy is None else f"{text}, entropy {entropy['value']:.3g} nats"
