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
from music_rllib.config.run_settings import VARIANTS
from music_rllib.config.schema import Stage
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.plan import Node, Run
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
        document = yaml.safe_dump(sweep_of_run(sweep, run.key, folder), sort_keys=False)
        write_atomically(folder / CHOSEN, sweep_files.as_json(chosen).encode())
        write_atomically(folder / "run.yaml", document.encode())
    except OSError as error:
        place = error.filename or folder
        raise StorageError(f"{place} must be writable: {error.strerror}") from error


def sweep_of_run(sweep: Sweep, key: str, folder: Path) -> dict[str, Any]:
    """A sweep's document that trains one run, and the runs that it starts from, to the same keys.

    A handoff from outside that it starts from is copied from a bucket into `folder`.
    """
    chain = [sweep.plan.node(key)]
    while (given := chain[0].input) is not None and given.checkpoint is None:
        chain.insert(0, sweep.plan.node(given.key))
    tasks = {node.run.task.name: node.run.task for node in chain}
    environments = {
        name: task.model_dump(mode="json", exclude={"name"})
        for name, task in tasks.items()
        if name not in BUILT_IN_TASKS
    }
    return {
        "name": f"{sweep.config.name}-best"[:80],
        "tasks": [chain[-1].run.task.name],
        "seeds": [chain[-1].run.seed],
        **({"environments": environments} if environments else {}),
        "stages": [_stage(sweep, node, folder) for node in chain],
    }


def _stage(sweep: Sweep, node: Node, folder: Path) -> dict[str, Any]:
    """A stage with all settings of a node, except those that its variant refuses."""
    run = node.run
    settings = run.model_dump(mode="json", exclude={"task", "variant", "seed"})
    for dotted in VARIANTS[run.variant].without_effect:
        group, _, name = dotted.partition(".")
        settings[group].pop(name)
    source: dict[str, Any] = {}
    if (given := node.input) is not None and given.checkpoint is None:
        place = {"stage": sweep.plan.node(given.key).stage}
        source = {"init_from": place | {"task": given.task.name}}
    elif given is not None:
        checkpoint = sweep.store.folder(given.key)
        if sweep_files.is_remote(sweep.storage):  # the copy that this is does not stay
            checkpoint = shutil.copytree(checkpoint, folder / "source", dirs_exist_ok=True)
        place = {"checkpoint": str(checkpoint.absolute())}
        source = {"init_from": place | {"task": given.task.name}}
    header = {"name": node.stage, "variant": run.variant, "tasks": [run.task.name]}
    return header | source | settings
