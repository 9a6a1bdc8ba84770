"""A sweep's searches opened, and what came of them as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from music_rllib.config.schema import Stage
from music_rllib.config.search.check import most_env_steps
from music_rllib.config.search.settings import Rung, SearchSettings, WarmStart
from music_rllib.experiment.plan import node_key
from music_rllib.experiment.session import Sweep
from music_rllib.redaction import redact
from music_rllib.results.statistics import improvement
from music_rllib.search.controller import SearchController
from music_rllib.search.objective import aggregate, interval
from music_rllib.search.storage import (
    DATABASE_ERRORS,
    known_studies,
    open_studies,
    same_database,
)
from music_rllib.search.study import Study
from music_rllib.search.trials import Arm, Finalist, Search, ranked
from music_rllib.search.warm_start import REASON, SCORES, VALUES, no_study_error

__all__ = ["check_studies", "learnings", "open_searches", "outcome"]

STUDY_FILE = "study.db"
"""In the sweep's folder."""
IMPORTANCE_TRIALS = 4
"""Judged trials from which on the importance of settings is estimated."""


def check_studies(sweep: Sweep) -> None:
    """Reach the databases that searches name, and look for the studies that they learn from.

    Nothing is made there, so that a sweep that is only planned leaves nothing.

    Raises:
        StorageError: One can't be used, or there is no such study.
    """
    above: list[tuple[str, str]] = []
    for stage in sweep.plan.searched:
        settings = stage.search
        assert settings is not None
        base, own = _base(sweep, stage), settings.storage or str(sweep.folder / STUDY_FILE)
        # The sweep's folder need not be there yet.
        mine = known_studies(own) if settings.storage or Path(own).exists() else []
        if settings.warm_start is not None:
            _check_warm_start(settings.warm_start, base, own, mine, above)
        above.append((base, own))


def _base(sweep: Sweep, stage: Stage) -> str:
    """What its studies' names begin with."""
    assert stage.search is not None
    return f"{stage.search.study or sweep.config.name}/{stage.name}"


def _check_warm_start(
    warm: WarmStart, base: str, own: str, mine: Sequence[str], above: Sequence[tuple[str, str]]
) -> None:
    """Look for the study to learn from.

    Args:
        warm: Names it.
        base: What the names of the search's own studies begin with.
        own: The search's storage.
        mine: The studies in it.
        above: `base` and `own` of the stages above.
    """
    if any(name.startswith((f"{base} @", f"{base}/")) for name in mine):
        return  # it has learnt already, and looks no more
    known = mine if warm.storage is None else known_studies(warm.storage, must_exist=True)
    # Those of the stages above are made before this one's.
    made = [name for name, place in above if same_database(place, warm.storage or own)]
    if any(name.startswith(warm.study) for name in known):
        return
    if not any(name.startswith(warm.study) or warm.study.startswith(name) for name in made):
        raise no_study_error(warm, known)


def open_searches(sweep: Sweep) -> list[Search]:
    """Open or make the studies of a sweep's searched stages.

    Raises:
        StorageError: A study's storage can't be used.
    """
    return [_open_search(sweep, stage) for stage in sweep.plan.searched]


def _open_search(sweep: Sweep, stage: Stage) -> Search:
    settings = stage.search
    assert settings is not None
    sweep.folder.mkdir(parents=True, exist_ok=True)
    storage = open_studies(settings.storage or str(sweep.folder / STUDY_FILE))
    arms = [
        Arm(
            values=values,
            position=position,
            study=Study(
                storage,
                _base(sweep, stage),
                settings,
                _determined_by(sweep, stage),
                arm=values,
                # The sweep's folder is locked by this process, and the file is in it.
                alone=settings.storage is None,
            ),
        )
        for position, values in enumerate(settings.arms())
    ]
    return Search(stage=stage, settings=settings, arms=arms, rungs=_rungs(sweep, stage, settings))


def learnings(searches: Sequence[Search]) -> list[str]:
    """From what each study with a warm start learns, in a line."""
    return [
        f"{search.stage.name}{''.join(f' {name}={value}' for name, value in arm.values.items())}: "
        f"{learnt}"
        for search in searches
        for arm in search.arms
        if (learnt := arm.study.learnt)
    ]


def _rungs(sweep: Sweep, stage: Stage, settings: SearchSettings) -> tuple[Rung, ...]:
    """Where a trial is looked at, its end last."""
    seeds, env_steps = len(sweep.plan.seeds), most_env_steps(settings, stage.points)
    end = Rung(seeds=seeds)
    found = [
        Rung(
            seeds=rung.seeds or seeds,
            # The whole budget is the end of a run, where nothing is paused.
            env_steps=None if (rung.env_steps or env_steps) >= env_steps else rung.env_steps,
        )
        for rung in (settings.pruning.rungs if settings.pruning else ())
    ]
    return (*dict.fromkeys(rung for rung in found if rung != end), end)


def _determined_by(sweep: Sweep, stage: Stage) -> dict[str, Any]:
    """What the stage's runs have in common, beside what is searched."""
    (point,) = stage.points
    source = stage.source
    above = next(
        (one for one in sweep.config.stages if source is not None and one.name == source.stage),
        None,
    )
    return {
        "seeds": list(sweep.plan.seeds),
        "runs": {task: node_key(run, None) for task, run in point.runs.items()},
        "source": {
            task: node_key(run, None)
            for task, run in (above.points[0].runs if above else {}).items()
        },
        "checkpoint": source.checkpoint.manifest.content_hash
        if source is not None and source.checkpoint is not None
        else None,
    }


# --- what came of them -------------------------------------------------------------------------


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
