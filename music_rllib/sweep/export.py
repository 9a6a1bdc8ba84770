"""Export of a sweep's best policy with its settings and the reasons for its choice."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from music_rllib import names
from music_rllib.config.schema import Stage
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.plan import Run
from music_rllib.experiment.session import Sweep
from music_rllib.labels import in_runs
from music_rllib.redaction import redact
from music_rllib.results.comparison import with_interval
from music_rllib.results.from_store import Condition, conditions
from music_rllib.search.ranking import best_so_far, leader, measure_of
from music_rllib.store.files import write_atomically
from music_rllib.store.object_folder import StorageError
from music_rllib.sweep.cli_helpers import find_stage

CHOSEN = "chosen.json"


def export_best(sweep: Sweep, stage_name: str | None, output: Path) -> dict[str, Any]:
    """Export the policy of the best condition for each of its tasks.

    Of the condition's runs on a task, the middle one by the same measure is taken: it stands for
    what the settings give, where the best one would stand for luck.

    Returns:
        What was chosen and why, as it is written beside the policy too.

    Raises:
        BadInputError: Nothing is finished, or there is no such stage.
        StorageError: The folder can't be written.
    """
    stage = find_stage(sweep.config, stage_name)
    metric = measure_of(stage, sweep.plan, sweep.results()).metric
    best = _best(sweep, stage, metric)
    condition = _condition(sweep, stage, best, metric)
    if condition is None:
        raise BadInputError(
            f"SWEEP must have the runs of its best trial, {best['trial']} of stage {stage.name}: "
            f"{redact(sweep.storage)} has none of them"
        )
    success = _condition(sweep, stage, best, names.EVAL_SUCCESS)
    by, rest = best["by"], ""
    if not condition.complete:
        rest = f", of {condition.planned} planned: no condition has all of its runs"
    fresh = best["on_fresh_seeds"]
    chosen: dict[str, Any] = {
        "sweep": sweep.config.name,
        "stage": stage.name,
        "values": best["values"],
        **({"trial": best["trial"]} if stage.search else {}),
        "metric": best["metric"],
        "direction": best["direction"],
        "value": best["value"],
        "interval": best["interval"],
        "success_rate": None if success is None else float(success.estimate().value),
        "entropies": best["entropies"],
        "on_fresh_seeds": fresh,
        "why": f"{stage.name}: {condition.label} is first by {by} on "
        f"{'fresh seeds' if fresh else 'the seeds that it was chosen by'}; {by} "
        f"({'' if stage.search else 'mean, '}95 %): "
        f"{with_interval(best['value'], best['interval'])} over "
        f"{in_runs(len(condition.runs))}{rest}",
    }
    policies = []
    for task in condition.tasks:
        run = _middle_run(condition, task)
        if run is None:
            continue
        folder = output if len(condition.tasks) == 1 else output / task
        policy = {
            "task": task,
            "seed": run.seed,
            "node": run.key,
            "run": run.label,
            "folder": str(folder.absolute()),
        }
        policies.append(policy)
        _export(sweep, run, folder, chosen | policy)
    return chosen | {"policies": policies}


def _best(sweep: Sweep, stage: Stage, metric: str) -> dict[str, Any]:
    """The best condition of a stage as plain data, with its trial if the stage is searched."""
    search = None if stage.search is None else _search_of(sweep, stage.name)
    best = best_so_far([stage], sweep.plan, sweep.results(), [search] if search else [])
    if best is None:
        needed = f"a finished run of stage {stage.name} that reported {metric}"
        if stage.search is not None:
            needed = f"a judged trial of stage {stage.name}"
        raise BadInputError(f"SWEEP must have {needed}, {sweep.config.name} has none")
    if stage.search is not None and search is not None and (first := leader(search)) is not None:
        best |= {"metric": stage.search.objectives[0].label, "trial": first.trial}
    return best


def _condition(
    sweep: Sweep, stage: Stage, best: Mapping[str, Any], metric: str
) -> Condition | None:
    """The runs of the best condition, with their scores by a metric; None if there are none."""
    part = "" if stage.search is None else "final" if best["on_fresh_seeds"] else "search"
    wanted = (stage.name, part, best["values"])
    for condition in conditions(sweep.plan, sweep.results(), metric):
        if (condition.stage, condition.part, dict(condition.values)) == wanted:
            return condition
    return None


def _search_of(sweep: Sweep, stage: str) -> Mapping[str, Any] | None:
    """The outcome of a stage's search: with its ranking once it is over, and as it is before."""
    state = sweep_files.read(sweep.storage, f"{sweep.config.name}/{sweep_files.STATE}") or {}
    ended = sweep_files.read(sweep.storage, f"{sweep.config.name}/{sweep_files.SEARCH}") or ()
    now = [search for search in state.get("searches", ()) if search["stage"] == stage]
    then = [search for search in ended if search["stage"] == stage]
    # A search that was extended goes on after an earlier end: its present state counts.
    return next(iter(now if now and not now[0]["complete"] else [*then, *now]), None)


def _middle_run(best: Condition, task: str) -> Run | None:
    """The run with the median score on a task; None where none is finished."""
    column = best.scores[:, best.tasks.index(task)]
    runs = {run.seed: run for run in best.runs if run.task == task}
    order = sorted(
        (float(score), seed)
        for seed, score in zip(best.seeds, column, strict=True)
        if seed in runs and not np.isnan(score)
    )
    return runs[order[len(order) // 2][1]] if order else None


def _export(sweep: Sweep, run: Run, folder: Path, chosen: Mapping[str, Any]) -> None:
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
        place = error.filename or folder
        raise StorageError(f"{place} must be writable: {error.strerror}") from error
