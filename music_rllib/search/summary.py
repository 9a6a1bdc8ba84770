"""What came of a sweep's searches, as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from music_rllib.config.search.settings import SearchSettings
from music_rllib.redaction import redact
from music_rllib.results.statistics import improvement
from music_rllib.search.controller import SearchController
from music_rllib.search.objective import aggregate, interval
from music_rllib.search.storage import (
    DATABASE_ERRORS,
)
from music_rllib.search.study import Study
from music_rllib.search.study_record import REASON, SCORES, VALUES
from music_rllib.search.trials import Arm, Finalist, Search, ranked

__all__ = ["outcome"]

IMPORTANCE_TRIALS = 4
"""Judged trials from which on the importance of settings is estimated."""


def outcome(controller: SearchController, *, thorough: bool = True) -> list[dict[str, Any]]:
    """The searches' state as plain data, for files, tables and MLflow.

    Args:
        controller: It.
        thorough: With intervals and importance, which take a while.

    Returns:
        Nothing where the database does not answer: what counts is in the node store.
    """
    try:
        return [_search(search, thorough) for search in controller.searches]
    except DATABASE_ERRORS:
        return []


def _search(search: Search, thorough: bool) -> dict[str, Any]:
    settings = search.settings
    arms = [_arm(search, arm, thorough) for arm in search.arms]
    finalists = [one for arm in search.arms for one in arm.finalists or ()]
    return {
        "stage": search.stage.name,
        "mode": settings.mode,
        "sampler": settings.sampler,
        "objectives": [
            {"name": one.label, "direction": "maximize" if one.maximised else "minimize"}
            for one in settings.objectives
        ],
        "storage": None if settings.storage is None else redact(settings.storage),
        "arms": arms,
        "ranking": _ranking(search, finalists) if thorough else _order(settings, finalists),
        "complete": all(one.scores is not None or one.failure for one in finalists)
        and all(arm.finalists is not None for arm in search.arms),
    }


def _arm(search: Search, arm: Arm, thorough: bool) -> dict[str, Any]:
    trials = arm.study.trials()
    best = ranked(search.settings, trials)
    states = [trial.state.name for trial in trials]
    return {
        "values": dict(arm.values),
        "study": arm.study.name,
        "learnt_from": arm.study.prior,
        "judged": states.count("COMPLETE"),
        "pruned": states.count("PRUNED"),
        "failed": states.count("FAIL"),
        "running": states.count("RUNNING"),
        "trials": [_trial(search, arm, trial, thorough) for trial in trials],
        "best": best[0].number if best else None,
        "front": [t.number for t in best] if len(search.settings.objectives) > 1 else [],
        "importance": importance(arm.study, search.settings) if thorough else {},
    }


_STATES = {
    TrialState.COMPLETE: "judged",
    TrialState.PRUNED: "pruned",
    TrialState.FAIL: "failed",
    TrialState.RUNNING: "running",
    TrialState.WAITING: "waiting",
}


def _trial(search: Search, arm: Arm, trial: FrozenTrial, thorough: bool) -> dict[str, Any]:
    scores = trial.user_attrs.get(SCORES, {})
    last = scores[max(scores, key=int)] if scores else None
    found = {
        "number": trial.number,
        "state": _STATES[trial.state],
        "values": {**arm.values, **trial.user_attrs.get(VALUES, {})},
        "objective": list(trial.values) if trial.state is TrialState.COMPLETE else None,
        "scores": last,
        "reason": trial.user_attrs.get(REASON),
    }
    if thorough and trial.state is TrialState.COMPLETE and last:
        found["interval"] = _interval(search, last)
    return found


def _interval(search: Search, scores: Sequence[Any]) -> list[list[float]]:
    """Ends of each objective's 95 % interval over seeds; NaN where a single run has none."""
    return [
        [float(found.lower), float(found.upper)]
        for found in (
            interval(objective, np.asarray(of_objective), search.stage.evaluation_episodes)
            for objective, of_objective in zip(search.settings.objectives, scores, strict=True)
        )
    ]


def importance(study: Study, settings: SearchSettings) -> dict[str, float]:
    """Share of the objective's variance that each setting accounts for (fANOVA), the largest first.

    Empty where too few trials have been judged, or all are worth the same; for several objectives
    it is that of the first.
    """
    judged = [trial for trial in study.trials() if trial.state is TrialState.COMPLETE]
    if len(judged) < IMPORTANCE_TRIALS or len({trial.values[0] for trial in judged}) < 2:
        return {}
    if all(len({str(t.params.get(name)) for t in judged}) < 2 for name in settings.space):
        return {}
    optuna_study = study.as_optuna()
    evaluator = optuna.importance.FanovaImportanceEvaluator(seed=settings.seed)
    try:
        found = optuna.importance.get_param_importances(
            optuna_study,
            evaluator=evaluator,
            target=lambda trial: float(trial.values[0]),
        )
    except (ValueError, RuntimeError):  # no setting that all trials have, or no variance
        return {}
    return {name: float(share) for name, share in found.items()}


def _order(settings: SearchSettings, finalists: Sequence[Finalist]) -> list[dict[str, Any]]:
    """The ranking without what takes a while: intervals and comparisons."""
    rows: list[dict[str, Any]] = [
        {
            "trial": one.number,
            "values": dict(one.values),
            "fresh": [
                aggregate(objective, scores)
                for objective, scores in zip(settings.objectives, one.scores, strict=True)
            ],
            "scores": [scores.tolist() for scores in one.scores],
        }
        for one in finalists
        if one.scores is not None
    ]
    return sorted(rows, key=lambda row: row["fresh"][0], reverse=settings.objectives[0].maximised)


def _ranking(search: Search, finalists: Sequence[Finalist]) -> list[dict[str, Any]]:
    """Finalists by their values on fresh seeds, the best first, each compared with the best."""
    settings, episodes = search.settings, search.stage.evaluation_episodes
    done = [one for one in finalists if one.scores is not None]
    maximised = settings.objectives[0].maximised
    rows = []
    for finalist in done:
        assert finalist.scores is not None
        found = [
            interval(objective, scores, episodes)
            for objective, scores in zip(settings.objectives, finalist.scores, strict=True)
        ]
        rows.append(
            {
                "trial": finalist.number,
                "values": dict(finalist.values),
                "searched": list(finalist.searched),
                "fresh": [float(one.value) for one in found],
                "interval": [[float(one.lower), float(one.upper)] for one in found],
                "selection_bias": [
                    searched - float(one.value)
                    for searched, one in zip(finalist.searched, found, strict=True)
                ],
                "scores": [scores.tolist() for scores in finalist.scores],
                "nodes": [run.key for run in finalist.runs],
            }
        )
    rows.sort(key=lambda row: row["fresh"][0], reverse=maximised)  # type: ignore[index]
    if rows:
        best = np.asarray(rows[0]["scores"][0])  # type: ignore[index]
        for row in rows[1:]:
            mine = np.asarray(row["scores"][0])  # type: ignore[index]
            better = improvement(best, mine)
            row["best_is_better_with"] = better if maximised else 1 - better
    rows.extend(
        {"trial": failed.number, "values": dict(failed.values), "failure": failed.failure}
        for failed in finalists
        if failed.failure
    )
    return rows
