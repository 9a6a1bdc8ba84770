"""The winning policy of a sweep, taken out of the node store with all that says what it is."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from music_rllib import names
from music_rllib.config.schema import Stage
from music_rllib.config.search.settings import Objective
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.plan import Run
from music_rllib.experiment.session import Sweep
from music_rllib.labels import in_runs
from music_rllib.redaction import redact
from music_rllib.results.comparison import with_interval
from music_rllib.results.from_store import Condition, conditions, entropies
from music_rllib.search.objective import interval
from music_rllib.search.ranking import best_of, leader, measure_of
from music_rllib.store.files import write_atomically
from music_rllib.store.object_folder import StorageError

__all__ = ["export_best"]

CHOSEN = "chosen.json"


def export_best(sweep: Sweep, stage: str | None, output: Path) -> dict[str, Any]:
    """Export the best condition's policy for each of its tasks.

    Of the condition's runs on a task the middle one by the same measure is taken: it stands for
    what the settings give, where the best one would stand for luck.

    Returns:
        What was chosen and why, as it is written beside the policy too.

    Raises:
        BadInputError: Nothing is finished, or there is no such stage.
        StorageError: The folder can't be written.
    """
    best, about = _best(sweep, stage)
    fresh = "on fresh seeds" if best.part == "final" else "on the seeds that it was chosen by"
    rest = "" if best.complete else f", of {best.planned} planned: no condition has all of its runs"
    number = with_interval(about["value"], about["interval"])
    by = about.pop("by")
    chosen: dict[str, Any] = {
        "sweep": sweep.config.name,
        "stage": best.stage,
        "values": dict(best.values),
        **about,
        "success_rate": _success(sweep, best),
        "entropies": entropies(sweep.plan, sweep.results(), best.stage, best.part, best.values),
        "on_fresh_seeds": best.part == "final",
        "why": f"{best.stage}: {best.label} is first by {by} {fresh}; {by} "
        f"({'' if 'trial' in about else 'mean, '}95 %): {number} over "
        f"{in_runs(len(best.runs))}{rest}",
        "policies": [],
    }
    for task in best.tasks:
        run = _middle(best, task)
        if run is None:
            continue
        folder = output if len(best.tasks) == 1 else output / task
        policy = {
            "task": task,
            "seed": run.seed,
            "node": run.key,
            "run": run.label,
            "folder": str(folder.absolute()),
        }
        chosen["policies"].append(policy)
        shared = {key: value for key, value in chosen.items() if key != "policies"}
        _export(sweep, run, folder, shared | policy)
    return chosen


def _best(sweep: Sweep, stage: str | None) -> tuple[Condition, dict[str, Any]]:
    """The condition, and what it is the best by."""
    known = {one.name: one for one in sweep.config.stages}
    wanted = stage or list(known)[-1]
    if wanted not in known:
        raise BadInputError(f"--stage must be one of {', '.join(known)}, got {wanted!r}")
    results = sweep.results()
    measure = measure_of(known[wanted], sweep.plan, results)
    of_stage = conditions(sweep.plan, results, measure.metric)
    of_stage = [one for one in of_stage if one.stage == wanted]
    settings = known[wanted].search
    if settings is not None:
        return _best_trial(sweep, known[wanted], settings.objectives[0], of_stage)
    best = best_of(of_stage, measure)
    if best is None:
        raise BadInputError(
            f"SWEEP must have a finished run of stage {wanted} that reported {measure.metric}, "
            f"{sweep.config.name} has none"
        )
    ends = best.estimate()
    return best, {
        "by": measure.word,
        "metric": measure.metric,
        "direction": "maximize",
        "value": float(ends.value),
        "interval": [float(ends.lower), float(ends.upper)],
    }


def _best_trial(
    sweep: Sweep, stage: Stage, objective: Objective, found: Sequence[Condition]
) -> tuple[Condition, dict[str, Any]]:
    """What the stage's search itself holds to be the best."""
    search = _search_of(sweep, stage.name)
    first = None if search is None else leader(search)
    if first is None:
        raise BadInputError(
            f"SWEEP must have a judged trial of stage {stage.name}, {sweep.config.name} has none"
        )
    part = "final" if first.fresh else "search"
    best = [one for one in found if one.part == part and dict(one.values) == first.values]
    if not best:
        raise BadInputError(
            f"SWEEP must have the runs of its best trial, {first.trial} of stage {stage.name}: "
            f"{redact(sweep.storage)} has none of them"
        )
    ends = interval(objective, np.asarray(first.scores, float), stage.evaluation_episodes)
    direction = "maximize" if objective.maximised else "minimize"
    return best[0], {
        "by": f"{objective.label} ({direction})",
        "trial": first.trial,
        "metric": objective.label,
        "direction": direction,
        "value": first.value,
        "interval": [float(ends.lower), float(ends.upper)],
    }


def _search_of(sweep: Sweep, stage: str) -> Mapping[str, Any] | None:
    """What came of a search: with its ranking once it is over, and as far as it is before."""
    state = sweep_files.read(sweep.storage, f"{sweep.config.name}/{sweep_files.STATE}") or {}
    ended = sweep_files.read(sweep.storage, f"{sweep.config.name}/{sweep_files.SEARCH}") or ()
    now = [search for search in state.get("searches", ()) if search["stage"] == stage]
    then = [search for search in ended if search["stage"] == stage]
    # That of the end is older than a search that goes on, as one that has been extended does.
    return next(iter(now if now and not now[0]["complete"] else [*then, *now]), None)


def _success(sweep: Sweep, best: Condition) -> float | None:
    """Its success rate, whatever it is the best by."""
    for one in conditions(sweep.plan, sweep.results(), names.EVAL_SUCCESS):
        if (one.stage, one.part, one.values) == (best.stage, best.part, best.values):
            return float(one.estimate().value)
    return None


def _middle(best: Condition, task: str) -> Run | None:
    column = best.scores[:, best.tasks.index(task)]
    runs = {run.seed: run for run in best.runs if run.task == task}
    order = sorted(
        (float(score), seed)
        for seed, score in zip(best.seeds, column, strict=True)
        if seed in runs and not np.isnan(score)
    )
    return runs[order[len(order) // 2][1]] if order else None


def _export(sweep: Sweep, run: Run, folder: Path, chosen: dict[str, Any]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=folder) as temporary:
            sweep.store.fetch(run.key, Path(temporary))
            for part in Path(temporary).iterdir():
                target = folder / part.name
                if target.is_dir():
                    shutil.rmtree(target)
                part.replace(target)
        settings = sweep.plan.node(run.key).run.model_dump(mode="json")
        write_atomically(folder / CHOSEN, sweep_files.as_json(chosen).encode())
        write_atomically(folder / "run.yaml", yaml.safe_dump(settings, sort_keys=False).encode())
    except OSError as error:
        raise StorageError(f"{error.filename or folder} must be writable: {error.strerror}") from (
            error
        )
