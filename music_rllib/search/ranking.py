"""Which condition of a stage is the best, and by what: a search's own judgement where there is one.

A search is read here as the plain data that `searches.outcome` makes of it, so that a sweep can be
judged from its files alone, without its study's database.
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

__all__ = ["Leader", "Measure", "best_in_words", "best_of", "best_so_far", "leader", "measure_of"]


@dataclass(frozen=True, kw_only=True)
class Measure:
    """What tells good runs from bad ones: the last value of a metric."""

    metric: str
    maximised: bool = True

    @property
    def word(self) -> str:
        """For a line of text."""
        return names.word_of(self.metric)


def measure_of(stage: Stage, plan: Plan, results: Mapping[str, RunResult]) -> Measure:
    """What a stage is judged by where nobody says: its search's metric, else its tasks' own.

    An objective may read what is no run's last value, as the budget is.
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
    """Of the first objective."""
    scores: Sequence[Sequence[float]]
    """The same of its runs, `[seeds, tasks]`."""
    fresh: bool
    """On the fresh seeds of the final ranking, which are what counts once all are there."""


def leader(search: Mapping[str, Any]) -> Leader | None:
    """The best of a search's trials by its own judgement; None before one is judged."""
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
    first = max(best, key=lambda trial: sign * float(trial["objective"][0]))
    return Leader(
        trial=first["number"],
        values=first["values"],
        value=first["objective"][0],
        scores=first["scores"][0],
        fresh=False,
    )


def best_of(found: Iterable[Condition], measure: Measure) -> Condition | None:
    """The best by its mean, of those that have all their runs if there are any."""
    numbers = [(float(one.estimate().value), one) for one in found]
    numbers = [(number, one) for number, one in numbers if math.isfinite(number)]
    numbers = [pair for pair in numbers if pair[1].complete] or numbers
    sign = 1.0 if measure.maximised else -1.0
    return max(numbers, key=lambda pair: sign * pair[0], default=(0.0, None))[1]


def best_so_far(
    stages: Sequence[Stage],
    plan: Plan,
    results: Mapping[str, RunResult],
    searches: Sequence[Mapping[str, Any]],
) -> dict[str, Any] | None:
    """The best condition of the last stage that has one, as plain data.

    Args:
        stages: Those that count, in the sweep's order.
        plan: The sweep's plan.
        results: Node key to result.
        searches: What came of the sweep's searches so far.
    """
    by_stage = {search["stage"]: search for search in searches}
    for stage in reversed(stages):
        if stage.search is None:
            found = _best_condition(stage, plan, results)
        else:
            found = _best_trial(stage, stage.search, by_stage.get(stage.name))
        if found is not None:
            part = "" if stage.search is None else "final" if found["on_fresh_seeds"] else "search"
            random = entropies(plan, results, stage.name, part, found["values"])
            return found | {"entropies": random}
    return None


def _best_condition(
    stage: Stage, plan: Plan, results: Mapping[str, RunResult]
) -> dict[str, Any] | None:
    measure = measure_of(stage, plan, results)
    found = conditions(plan, results, measure.metric)
    best = best_of((one for one in found if one.stage == stage.name), measure)
    if best is None:
        return None
    ends = best.estimate()
    return {
        "stage": stage.name,
        "values": dict(best.values),
        "by": measure.word,
        "metric": measure.metric,
        "direction": "maximize",
        "value": float(ends.value),
        "interval": [float(ends.lower), float(ends.upper)],
        "runs": best.planned if best.complete else len(best.runs),
        "planned": best.planned,
        "on_fresh_seeds": False,
    }


def _best_trial(
    stage: Stage, settings: SearchSettings, search: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    first = None if search is None else leader(search)
    if first is None:
        return None
    objective = settings.objectives[0]
    ends = interval(objective, np.asarray(first.scores, float), stage.evaluation_episodes)
    direction = "maximize" if objective.maximised else "minimize"
    runs = int(np.size(first.scores))
    return {
        "stage": stage.name,
        "values": dict(first.values),
        "by": f"{objective.label} ({direction})",
        "metric": objective.metric,
        "direction": direction,
        "value": first.value,
        "interval": [float(ends.lower), float(ends.upper)],
        "runs": runs,
        "planned": runs,
        "on_fresh_seeds": first.fresh,
    }


def best_in_words(best: Mapping[str, Any]) -> str:
    """`best_so_far` in a line."""
    values = ", ".join(f"{symbol(name)} = {short(value)}" for name, value in best["values"].items())
    number = with_interval(best["value"], best["interval"])
    runs, planned = best["runs"], best.get("planned", best["runs"])
    text = f"{best['stage']} {values}".rstrip() + f": {best.get('by', 'success')} {number}, "
    if runs < planned:
        text += f"{runs} of {planned} runs (no condition has all of its runs yet)"
    else:
        text += f"{in_runs(runs)}{' on fresh seeds' if best['on_fresh_seeds'] else ''}"
    entropy = best.get("entropies", {}).get(names.SHANNON_ENTROPY)
    return text if entropy is None else f"{text}, entropy {entropy['value']:.3g} nats"
