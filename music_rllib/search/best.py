"""The best condition or trial of a stage, and the metric that ranks it.

Searches are read as the plain data of `outcome`, so that the files of a sweep are enough, without
the databases of its studies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from music_rllib import names
from music_rllib.config.schema import Stage
from music_rllib.config.search import SearchSettings
from music_rllib.experiment.plan import Plan, short
from music_rllib.names import in_runs, symbol
from music_rllib.results.analysis import FinalScores, Scope, stage_scopes
from music_rllib.results.conditions import ALL_TASKS, Condition, StageRuns, find_stages
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import with_interval
from music_rllib.search.objective import interval


class RankingMetric(NamedTuple):
    """The metric whose last value ranks the runs of a stage."""

    metric: str
    maximised: bool = True


def ranking_metric(stage: Stage, sweep: Sweep) -> RankingMetric:
    """The metric of a stage's search, or else that of its tasks.

    A search's metric that no run has reported, such as the budget, is not used.
    """
    if stage.search is not None:
        objective = stage.search.objectives[0]
        own = enumerate(sweep.runs)
        done = [at for at, run in own if run.stage == stage.name and run.is_finished]
        if not done or any(len(sweep.column(at, objective.metric).step) for at in done):
            # Fewer steps to a threshold are better, and so are higher values of the metric.
            maximised = objective.maximised or objective.read == "steps_to"
            return RankingMetric(objective.metric, maximised)
    return RankingMetric(stage.primary_metric)


def _scopes(runs: StageRuns | None, sweep: Sweep, metric: str | None) -> dict[str, Scope]:
    """Final values of a stage's conditions, first over all tasks if these have the same scale.

    `metric` is None for the primary metric of each task.
    """
    scopes = () if runs is None else stage_scopes(sweep, runs, metric)
    return {scope.name: scope for scope in scopes}


def _values(condition: Condition, plan: Plan, sweep: Sweep) -> dict[str, Any]:
    """Settings that differ between the stage's conditions, as the plan has them."""
    return dict(plan.node(sweep.runs[condition.runs[0]].node_key).values)


def condition_of(
    best: Mapping[str, Any], stage: Stage, plan: Plan, sweep: Sweep, metric: str
) -> FinalScores | None:
    """The condition that :func:`best_so_far` has described; None if it has no final value."""
    runs = {found.name: found for found in find_stages(sweep)}
    return _condition_in(best, stage, plan, sweep, _scopes(runs.get(stage.name), sweep, metric))


def _condition_in(
    best: Mapping[str, Any], stage: Stage, plan: Plan, sweep: Sweep, scopes: Mapping[str, Scope]
) -> FinalScores | None:
    scope = scopes.get(best.get("task", next(iter(scopes), "")))
    for final in () if scope is None else scope.finals:
        same_seeds = stage.search is None or final.condition.is_fresh == best["on_fresh_seeds"]
        if same_seeds and _values(final.condition, plan, sweep) == best["values"]:
            return final
    return None


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
    found = {runs.name: runs for runs in find_stages(sweep)} if stages else {}
    for stage in reversed(stages):
        runs = found.get(stage.name)
        if stage.search is None:
            best = _best_condition(stage, runs, plan, sweep)
        else:
            best = _best_trial(stage, stage.search, by_stage.get(stage.name))
        if best is not None:
            entropies = {
                metric: {"value": final.value, "interval": [*final.estimate.numbers[1:]]}
                for metric in names.ENTROPIES
                if (final := _condition_in(best, stage, plan, sweep, _scopes(runs, sweep, metric)))
                is not None
            }
            return best | {"entropies": entropies}
    return None


def _best_condition(
    stage: Stage, runs: StageRuns | None, plan: Plan, sweep: Sweep
) -> dict[str, Any] | None:
    """The best condition, or that of each task if the metric's scale differs between tasks.

    In the second case, the row of the first task has the others under `other_tasks`.
    """
    scopes = _scopes(runs, sweep, None)
    if ALL_TASKS in scopes:
        scopes = {ALL_TASKS: scopes[ALL_TASKS]}
    several = len(scopes) > 1
    rows = [
        _best_row(scope, stage, plan, sweep) | ({"task": task} if several else {})
        for task, scope in scopes.items()
        if scope.finals
    ]
    if not rows:
        return None
    return rows[0] | ({"other_tasks": rows[1:]} if several else {})


def _best_row(scope: Scope, stage: Stage, plan: Plan, sweep: Sweep) -> dict[str, Any]:
    """The condition with the best mean, among complete ones if there are any."""

    def planned(final: FinalScores) -> int:
        tasks = [sweep.runs[run].task for run in final.condition.runs]
        return len(tasks) if scope.name == ALL_TASKS else tasks.count(scope.name)

    ranked = [one for one in scope.finals if one.runs == planned(one)] or scope.finals
    best = max(ranked, key=lambda final: final.value)
    return {
        "stage": stage.name,
        "values": _values(best.condition, plan, sweep),
        "by": names.word_of(scope.metric),
        "metric": scope.metric,
        "direction": "maximize",
        "value": best.value,
        "level": sum(math.isclose(final.value, best.value) for final in ranked) - 1,
        "interval": [*best.estimate.numbers[1:]],
        "runs": best.runs,
        "planned": planned(best),
        "on_fresh_seeds": False,
    }


def _best_trial(
    stage: Stage, settings: SearchSettings, search: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """The best trial of a search: by the complete final ranking, or else the best so far."""
    if search is None:
        return None
    objective = settings.objectives[0]
    best = [arm["trials"][arm["best"]] for arm in search["arms"] if arm["best"] is not None]
    ranking = [row for row in search["ranking"] if "failure" not in row]
    if search["complete"] and ranking:
        first, values = ranking[0], [row["fresh"][0] for row in ranking]
        number, value = first["trial"], values[0]
    elif best:
        sign = 1.0 if objective.maximised else -1.0
        first, ranking = max(best, key=lambda trial: sign * float(trial["objective"][0])), []
        number, value = first["number"], first["objective"][0]
        trials = (trial for arm in search["arms"] for trial in arm["trials"])
        values = [trial["objective"][0] for trial in trials if trial["objective"]]
    else:
        return None
    scores = np.asarray(first["scores"][0], float)
    estimate = interval(objective, scores, stage.evaluation_episodes)
    direction = "maximize" if objective.maximised else "minimize"
    return {
        "stage": stage.name,
        "trial": number,
        "values": dict(first["values"]),
        "by": f"{objective.label} ({direction})",
        "metric": objective.metric,
        "direction": direction,
        "value": value,
        "level": sum(math.isclose(other, value) for other in values) - 1,
        "interval": [*estimate.numbers[1:]],
        "runs": scores.size,
        "planned": scores.size,
        "on_fresh_seeds": bool(ranking),
    }


def best_text(best: Mapping[str, Any]) -> str:
    """The result of `best_so_far` in a line."""
    if others := best.get("other_tasks"):
        rows = ({**best, "other_tasks": ()}, *others)
        return "; ".join(f"{row['task']}: {best_text(row)}" for row in rows)
    values = ", ".join(
        f"{symbol(name)} = {short(value, name)}" for name, value in best["values"].items()
    )
    number = with_interval(best["value"], best["interval"])
    runs, planned = best["runs"], best.get("planned", best["runs"])
    level = f", tied with {best['level']} more" if best.get("level") else ""
    text = f"{best['stage']} {values}".rstrip() + f"{level}: {best.get('by', 'success')} {number}, "
    if runs < planned:
        text += f"{runs} of {planned} runs (no condition has all of its runs yet)"
    else:
        selected = " that selected it" if "trial" in best else ""
        text += in_runs(runs) + (" on fresh seeds" if best["on_fresh_seeds"] else selected)
    entropy = best.get("entropies", {}).get(names.SHANNON_ENTROPY)
    # Conditions with the same value differ in their entropies.
    return text if entropy is None or level else f"{text}, entropy {entropy['value']:.3g} nats"
