"""The winning policy of a sweep, taken out of the node store with all that says what it is."""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from music_rllib.experiment.files import write_atomically
from music_rllib.experiment.plan import Run
from music_rllib.experiment.sealed import StorageError
from music_rllib.sweep import records
from music_rllib.sweep.conditions import Condition, conditions
from music_rllib.sweep.frame import BadInputError
from music_rllib.sweep.session import Sweep
from music_rllib.sweep.tables import with_interval

__all__ = ["export_best"]

CHOSEN = "chosen.json"


def export_best(sweep: Sweep, stage: str | None, output: Path) -> dict[str, Any]:
    """Export the best condition's policy for each of its tasks.

    Of the condition's runs on a task the middle one by its success rate is taken: it stands for
    what the settings give, where the best one would stand for luck.

    Returns:
        What was chosen and why, as it is written beside the policy too.

    Raises:
        BadInputError: Nothing is finished, or there is no such stage.
        StorageError: The folder can't be written.
    """
    best, by = _best(sweep, stage)
    value = best.estimate()
    ends = [float(value.lower), float(value.upper)]
    fresh = "on fresh seeds" if best.part == "final" else "on the seeds that it was chosen by"
    chosen: dict[str, Any] = {
        "sweep": sweep.config.name,
        "stage": best.stage,
        "values": dict(best.values),
        "success_rate": float(value.value),
        "interval": ends,
        "on_fresh_seeds": best.part == "final",
        "why": f"{best.stage}: {best.label} is first by {by} {fresh}; success rate (interquartile "
        f"mean, 95 %): {with_interval(float(value.value), ends)} over {len(best.runs)} runs",
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
        about = {key: value for key, value in chosen.items() if key != "policies"}
        _export(sweep, run, folder, about | policy)
    return chosen


def _best(sweep: Sweep, stage: str | None) -> tuple[Condition, str]:
    """The condition, and what it is the best by."""
    stages = [one.name for one in sweep.config.stages]
    wanted = stage or stages[-1]
    if wanted not in stages:
        raise BadInputError(f"--stage must be one of {', '.join(stages)}, got {wanted!r}")
    found = [one for one in conditions(sweep.plan, sweep.results()) if one.stage == wanted]
    if not found:
        raise BadInputError(
            f"SWEEP must have a finished run of stage {wanted}, {sweep.config.name} has none"
        )
    for search in records.read(sweep.storage, f"{sweep.config.name}/{records.SEARCH}") or ():
        if search["stage"] == wanted and search["ranking"]:
            values = search["ranking"][0]["values"]
            first = [one for one in found if one.part == "final" and dict(one.values) == values]
            if first:
                return first[0], str(search["objectives"][0]["name"])
    ranked = [one for one in found if one.part == "final"] or found
    return max(ranked, key=lambda one: float(one.estimate().value)), "success rate"


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
        write_atomically(folder / CHOSEN, records.as_json(chosen).encode())
        write_atomically(folder / "run.yaml", yaml.safe_dump(settings, sort_keys=False).encode())
    except OSError as error:
        raise StorageError(f"{error.filename or folder} must be writable: {error.strerror}") from (
            error
        )
