"""The results of a sweep's searches, as plain data for files, tables and MLflow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from music_rllib.redaction import redact
from music_rllib.results.statistics import IMPORTANCE_TRIALS, improvement
from music_rllib.search.controller import SearchController
from music_rllib.search.objective import aggregate, interval
from music_rllib.search.sampler import VALUES
from music_rllib.search.searches import DATABASE_ERRORS, Finalist, Search
from music_rllib.search.study import LOST, REASON, SCORES, OptunaStudy

_STATES = {
    TrialState.COMPLETE: "judged",
    TrialState.PRUNED: "pruned",
    TrialState.FAIL: "failed",
    TrialState.RUNNING: "running",
    TrialState.WAITING: "waiting",
}


def outcome(controller: SearchController, *, thorough: bool = True) -> list[dict[str, Any]]:
    """The state of each search.

    Only a `thorough` one has intervals and importance, which take a while to compute. The list is
    empty if the database does not answer: the results are in the node store too.
    """
    try:
        return [_search(search, thorough) for search in controller.searches]
    except DATABASE_ERRORS:
        return []


def _search(search: Search, thorough: bool) -> dict[str, Any]:
    settings = search.settings
    return {
        "stage": search.stage.name,
        "mode": settings.mode,
        "sampler": settings.sampler,
        "objectives": [
            {
                "name": objective.label,
                "direction": "maximize" if objective.maximised else "minimize",
            }
            for objective in settings.objectives
        ],
        "storage": None if settings.storage is None else redact(settings.storage),
        "arms": [_study(search, study, thorough) for study in search.studies],
        "ranking": _ranking(search, thorough),
        "complete": search.over,
    }


def _study(search: Search, study: OptunaStudy, thorough: bool) -> dict[str, Any]:
    trials, best = study.trials(), study.ranked()
    states = [_STATES[trial.state] for trial in trials]
    return {
        "values": study.compared,
        "study": study.name,
        **{state: states.count(state) for state in ("judged", "pruned", "failed", "running")},
        "trials": [_trial(search, study, trial, thorough) for trial in trials],
        "best": best[0].number if best else None,
        "front": [t.number for t in best] if len(search.settings.objectives) > 1 else [],
        "importance": _importance(study) if thorough else {},
    }


def _trial(
    search: Search, study: OptunaStudy, trial: FrozenTrial, thorough: bool
) -> dict[str, Any]:
    scores = trial.user_attrs.get(SCORES, {})
    last = scores[max(scores, key=int)] if scores else None
    document = {
        "number": trial.number,
        "state": _STATES[trial.state],
        "values": {**study.compared, **trial.user_attrs.get(VALUES, {})},
        "objective": list(trial.values) if trial.state is TrialState.COMPLETE else None,
        "scores": last,
        "reason": trial.user_attrs.get(REASON),
        "lost": bool(trial.user_attrs.get(LOST)),
    }
    if thorough and trial.state is TrialState.COMPLETE and last:
        document["interval"] = _intervals(search, last)
    return document


def _intervals(search: Search, scores: Sequence[Any]) -> list[list[float]]:
    """Ends of each objective's 95% interval over seeds; NaN for a single run."""
    estimates = [
        interval(objective, np.asarray(of_objective), search.stage.evaluation_episodes)
        for objective, of_objective in zip(search.settings.objectives, scores, strict=True)
    ]
    return [[*estimate.numbers[1:]] for estimate in estimates]


def _importance(study: OptunaStudy) -> dict[str, float]:
    """Share of the first objective's variance by setting (fANOVA), the largest first.

    Empty if too few trials are complete, or if all have the same value.
    """
    complete = study.complete()
    if len(complete) < IMPORTANCE_TRIALS or len({trial.values[0] for trial in complete}) < 2:
        return {}
    if all(len({str(t.params.get(name)) for t in complete}) < 2 for name in study.settings.space):
        return {}
    try:
        shares = optuna.importance.get_param_importances(
            study.as_optuna(),
            evaluator=optuna.importance.FanovaImportanceEvaluator(seed=study.settings.seed),
            target=lambda trial: float(trial.values[0]),
        )
    except (ValueError, RuntimeError):  # no setting that all trials have, or no variance
        return {}
    return {name: float(share) for name, share in shares.items()}


def _ranking(search: Search, thorough: bool) -> list[dict[str, Any]]:
    """Finalists by their values on fresh seeds, the best first, each compared with the best."""
    maximised = search.settings.objectives[0].maximised
    finalists = search.finalists or []
    rows = [_finalist(search, one, thorough) for one in finalists if one.scores is not None]
    rows.sort(key=lambda row: row["fresh"][0], reverse=maximised)
    if not thorough:
        return rows
    for row in rows[1:]:
        better = improvement(np.asarray(rows[0]["scores"][0]), np.asarray(row["scores"][0]))
        row["best_is_better_with"] = better if maximised else 1 - better
    return rows + [
        {"trial": finalist.number, "values": dict(finalist.values), "failure": finalist.failure}
        for finalist in finalists
        if finalist.failure
    ]


def _finalist(search: Search, finalist: Finalist, thorough: bool) -> dict[str, Any]:
    scores = finalist.scores or []
    fresh = [aggregate(*pair) for pair in zip(search.settings.objectives, scores, strict=True)]
    row = {
        "trial": finalist.number,
        "values": dict(finalist.values),
        "fresh": fresh,
        "scores": [of_objective.tolist() for of_objective in scores],
    }
    if thorough:
        pairs = zip(finalist.searched, fresh, strict=True)
        row |= {
            "searched": list(finalist.searched),
            "interval": _intervals(search, scores),
            "selection_bias": [searched - value for searched, value in pairs],
            "nodes": [run.key for run in finalist.runs],
        }
    return row
