"""The best condition of a stage, and the measure that it is best by.

Searches are read here as the plain data that `summary.outcome` makes of them, so that a sweep can
be judged from its files alone, without its studies' databases.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from music_rllib import names
from music_rllib.config.schema import Stage
from music_rllib.config.search.settings import SearchSettings
from music_rllib.experiment.plan import Plan, short
from music_rllib.labels import in_runs, symbol
from music_rllib.results.comparison import with_interval
from music_rllib.results.from_store import Condition, conditions, entropies
from music_rllib.search.objective import interval
from music_rllib.store.run_record import RunResult


@dataclass(frozen=True, kw_only=True)
class Measure:
    """The metric whose last value ranks the runs of a stage."""

    metric: str
    maximised: bool = True

    @property
    def word(self) -> str:
        """The metric's name in a sentence."""
        return names.word_of(self.metric)


def measure_of(stage: Stage, plan: Plan, results: Mapping[str, RunResult]) -> Measure:
    """A stage's measure: the metric of its search, else that of its tasks.

    The metric of a search is not taken where no run has reported it, as with the budget.
    """
    if stage.search is not None:
        objective = stage.search.objectives[0]
        done = (results[r.key] for r in plan.runs if r.stage == stage.name and r.key in results)
        reported = {name for result in done for name in result.metrics}
        if objective.metric in reported or not reported:
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


def best_of(candidates: Iterable[Condition], measure: Measure) -> Condition | None:
    """The condition with the best mean, among those that have all their runs if there are any."""
    pairs = [(float(condition.estimate().value), condition) for condition in candidates]
    pairs = [pair for pair in pairs if math.isfinite(pair[0])]
    pairs = [pair for pair in pairs if pair[1].complete] or pairs
    sign = 1.0 if measure.maximised else -1.0
    return max(pairs, key=lambda pair: sign * pair[0], default=(0.0, None))[1]


def best_so_far(
    stages: Sequence[Stage],
    plan: Plan,
    results: Mapping[str, RunResult],
    searches: Sequence[Mapping[str, Any]],
) -> dict[str, Any] | None:
    """The best condition of the last of `stages` that has one, as plain data.

    `results` are by node key, and `searches` is the `outcome` of the sweep's searches so far.
    """
    by_stage = {search["stage"]: search for search in searches}
    for stage in reversed(stages):
        if stage.search is None:
            best, part = _best_condition(stage, plan, results), ""
        else:
            best = _best_trial(stage, stage.search, by_stage.get(stage.name))
            part = "final" if best and best["on_fresh_seeds"] else "search"
        if best is not None:
            random = entropies(plan, results, stage.name, part, best["values"])
            return best | {"entropies": random}
    return None


def _best_condition(
    stage: Stage, plan: Plan, results: Mapping[str, RunResult]
) -> dict[str, Any] | None:
    measure = measure_of(stage, plan, results)
    candidates = [c for c in conditions(plan, results, measure.metric) if c.stage == stage.name]
    best = best_of(candidates, measure)
    if best is None:
        return None
    estimate = best.estimate()
    rivals = (c for c in candidates if c is not best and c.complete == best.complete)
    return {
        "stage": stage.name,
        "values": dict(best.values),
        "by": measure.word,
        "metric": measure.metric,
        "direction": "maximize",
        "value": float(estimate.value),
        "level": sum(float(c.estimate().value) == float(estimate.value) for c in rivals),
        "interval": [float(estimate.lower), float(estimate.upper)],
        "runs": best.planned if best.complete else len(best.runs),
        "planned": best.planned,
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
    return {
        "stage": stage.name,
        "values": dict(best.values),
        "by": f"{objective.label} ({direction})",
        "metric": objective.metric,
        "direction": direction,
        "value": best.value,
        "interval": [float(estimate.lower), float(estimate.upper)],
        "runs": runs,
        "planned": runs,
        "on_fresh_seeds": best.fresh,
    }


def best_in_words(best: Mapping[str, Any]) -> str:
    """The result of `best_so_far` in a line."""
    values = ", ".join(
        f"{symbol(name)} = {short(value, name)}" for name, value in best["values"].items()
    )
    number = with_interval(best["value"], best["interval"])
    runs, planned = best["runs"], best.get("planned", best["runs"])
    level = f" and {best['level']} more" if best.get("level") else ""  # the first of equals
    text = f"{best['stage']} {values}".rstrip() + f"{level}: {best.get('by', 'success')} {number}, "
    if runs < planned:
        text += f"{runs} of {planned} runs (no condition has all of its runs yet)"
    else:
        text += f"{in_runs(runs)}{' on fresh seeds' if best['on_fresh_seeds'] else ''}"
    entropy = best.get("entropies", {}).get(names.SHANNON_ENTROPY)
    return text if entropy is None else f"{text}, entropy {entropy['value']:.3g} nats"
