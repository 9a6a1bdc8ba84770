"""Export of a sweep's best policy with its settings and the reasons for its choice."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from music_rllib import names
from music_rllib.config.run_settings import VARIANTS
from music_rllib.config.schema import Stage
from music_rllib.config.yaml_file import Dumper
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.open_sweep import OpenSweep, open_started
from music_rllib.experiment.plan import Node, Plan
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.redaction import redact
from music_rllib.results.data import LastValues, Sweep
from music_rllib.results.read import searches_of
from music_rllib.search.best import best_so_far, best_text, condition_of, ranking_metric
from music_rllib.store.files import write_atomically
from music_rllib.store.handoff import MANIFEST as HANDOFF_FILE
from music_rllib.store.storage import StorageError, is_remote

CHOSEN, RUN = "chosen.json", "run.yaml"


def export_best(location: SweepLocation, stage_name: str | None, output: Path) -> dict[str, Any]:
    """Export the policy of the best condition for each of its tasks.

    Of the condition's runs on a task, the run with the median score is exported: it represents the
    settings, where the best run would represent luck.

    Returns:
        The choice and its reasons, as they are also written beside the policy.

    Raises:
        BadInputError: Nothing is finished, or there is no such stage.
        StorageError: The folder can't be written.
    """
    opened = open_started(location)
    stage = opened.config.stage(stage_name)
    sweep = LastValues(opened.plan).sweep(opened.results())
    searches = searches_of(location, opened.config)
    metric = ranking_metric(stage, sweep).metric
    best = _best(opened, stage, sweep, metric, searches)
    others = best.pop("other_tasks", None)
    if not others:
        own = metric if stage.search else best["metric"]
        chosen = _export_condition(opened, stage, sweep, best, own, output)
        _remove_others(output, chosen["policies"])
        return chosen
    rows = [best, *others]
    exported = [
        _export_condition(opened, stage, sweep, row, row["metric"], output / row["task"])
        for row in rows
    ]
    why = (f"{row['task']}: {one['why']}" for row, one in zip(rows, exported, strict=True))
    policies = [policy for one in exported for policy in one["policies"]]
    _remove_others(output, policies)
    return exported[0] | {"why": "\n".join(why), "policies": policies}


def _best(
    opened: OpenSweep,
    stage: Stage,
    sweep: Sweep,
    metric: str,
    searches: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """The best condition of a stage as plain data, with its trial if the stage is searched."""
    best = best_so_far([stage], opened.plan, sweep, searches)
    if best is None:
        needed = f"a finished run of stage {stage.name} that reported {metric}"
        if stage.search is not None:
            needed = f"a scored trial of stage {stage.name}"
        raise BadInputError(f"SWEEP must have {needed}, {opened.config.name} has none")
    return best if stage.search is None else best | {"metric": stage.search.objectives[0].label}


def _export_condition(
    opened: OpenSweep,
    stage: Stage,
    sweep: Sweep,
    best: Mapping[str, Any],
    metric: str,
    output: Path,
) -> dict[str, Any]:
    """Export the policies of one condition, on all its tasks or on the task of `best`."""
    runs = _runs_of(best, stage, opened.plan, sweep, metric)
    if not any(sweep.final(run, metric) is not None for run in runs):
        raise BadInputError(
            f"SWEEP must have the runs of its best trial, {best['trial']} of stage {stage.name}: "
            f"{redact(opened.storage)} has none of them"
        )
    success = condition_of(best, stage, opened.plan, sweep, names.EVAL_SUCCESS)
    chosen: dict[str, Any] = {
        "sweep": opened.config.name,
        "stage": stage.name,
        "values": best["values"],
        **({"trial": best["trial"]} if stage.search else {}),
        "metric": best["metric"],
        "direction": best["direction"],
        "value": best["value"],
        "interval": best["interval"],
        "success_rate": None if success is None else float(success.estimate.value),
        "entropies": best.get("entropies", {}),
        "on_fresh_seeds": best["on_fresh_seeds"],
        "why": best_text(best),
    }
    policies = []
    tasks = list(dict.fromkeys(sweep.runs[run].task for run in runs))
    tasks = [best["task"]] if "task" in best else tasks
    for task in tasks:
        run = sweep.median_run(runs, task, metric)
        if run is None:
            continue
        folder = output if len(tasks) == 1 else output / task
        policy = {
            "task": task,
            "seed": int(run.seed),
            "node": run.node_key,
            "run": run.name,
            "folder": str(folder.absolute()),
        }
        policies.append(policy)
        _export(opened, run.node_key, folder, chosen | policy)
    return chosen | {"policies": policies}


def _runs_of(
    best: Mapping[str, Any], stage: Stage, plan: Plan, sweep: Sweep, metric: str
) -> Sequence[int]:
    """The runs of the best condition; those of a trial may be runs of an earlier stage, too."""
    if stage.search is None:
        scored = condition_of(best, stage, plan, sweep, metric)
        return () if scored is None else scored.condition.runs
    part = f"{'final' if best['on_fresh_seeds'] else 'trial'}{best['trial']}"
    own = (run for run in plan.runs if (run.stage, run.part) == (stage.name, part))
    keys = {run.key for run in own if dict(run.values) == best["values"]}
    return [position for position, run in enumerate(sweep.runs) if run.node_key in keys]


def _export(opened: OpenSweep, key: str, folder: Path, chosen: Mapping[str, Any]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=folder) as temporary:
            opened.store.fetch(key, Path(temporary))
            _refuse_other_files(folder, Path(temporary))
            for part in Path(temporary).iterdir():
                target = folder / part.name
                if target.is_dir():
                    if not (target / HANDOFF_FILE).is_file():
                        raise BadInputError(
                            f"--output must be a new folder or one of `best`, got {folder}: its "
                            f"{part.name}/ is not a policy's"
                        )
                    shutil.rmtree(target)
                part.replace(target)
        document = yaml.dump(sweep_of_run(opened, key, folder), Dumper=Dumper, sort_keys=False)
        write_atomically(folder / CHOSEN, sweep_files.as_json(chosen).encode())
        write_atomically(folder / RUN, document.encode())
    except OSError as error:
        place = error.filename or folder
        raise StorageError(f"{place} must be writable: {error.strerror}") from error


def _refuse_other_files(folder: Path, new: Path) -> None:
    """Check that no file of the user would be replaced by those in `new`, or by our own two."""
    if (folder / CHOSEN).is_file() or (folder / "handoff" / HANDOFF_FILE).is_file():
        return  # an earlier export, perhaps an interrupted one
    files = sorted({*(one.name for one in new.iterdir() if one.is_file()), CHOSEN, RUN})
    if found := [name for name in files if os.path.lexists(folder / name)]:
        raise BadInputError(
            f"--output must be a new folder or one of `best`, got {folder}, which has "
            f"{', '.join(found)}"
        )


def _remove_others(output: Path, policies: Sequence[Mapping[str, Any]]) -> None:
    """Remove what an earlier call with one task, or with several, has left in `output`.

    Readers of `output` would find the policy of the earlier call.
    """
    if not policies:
        return
    folder = Path(policies[0]["folder"])
    is_single = folder == output.absolute()
    exports = [one.parent for one in output.glob(f"*/{CHOSEN}")]
    # A sub-folder with another name than its task's is the user's.
    of_tasks = [one for one in exports if _task_of(one) == one.name]
    for other in of_tasks if is_single else [output] * (output / CHOSEN).is_file():
        for part in [other / one.name for one in folder.iterdir()]:
            shutil.rmtree(part) if part.is_dir() else part.unlink(missing_ok=True)
        if not any(other.iterdir()):
            other.rmdir()


def _task_of(export: Path) -> object:
    try:
        return json.loads((export / CHOSEN).read_text(encoding="utf-8")).get("task")
    except (OSError, ValueError, AttributeError):
        return None


def sweep_of_run(sweep: OpenSweep, key: str, folder: Path) -> dict[str, Any]:
    """A sweep's document that trains one run, and the runs that it starts from, to the same keys.

    A handoff from outside that it starts from is copied from a bucket into `folder`.
    """
    chain = sweep.plan.chain(key)
    sources = [node.input.task for node in chain if node.input is not None]
    tasks = {task.name: task for task in (*sources, *(node.run.task for node in chain))}
    environments = {
        name: task.model_dump(mode="json", exclude={"name"})
        for name, task in tasks.items()
        if name not in BUILT_IN_TASKS
    }
    return {
        "name": f"{sweep.config.name[:75]}-best",
        "tasks": [chain[-1].run.task.name],
        "seeds": [chain[-1].run.seed],
        **({"environments": environments} if environments else {}),
        "stages": [_stage(sweep, node, folder) for node in chain],
    }


def _stage(sweep: OpenSweep, node: Node, folder: Path) -> dict[str, Any]:
    """A stage with all settings of a node, except those that its variant refuses."""
    run = node.run
    settings = run.model_dump(mode="json", exclude={"task", "variant", "seed"})
    for dotted in VARIANTS[run.variant].without_effect:
        group, _, name = dotted.partition(".")
        settings[group].pop(name)
    header = {"name": node.stage, "variant": run.variant, "tasks": [run.task.name]}
    if (given := node.input) is None:
        return header | settings
    if given.checkpoint is None:
        place = {"stage": sweep.plan.node(given.key).stage}
    else:
        checkpoint = sweep.store.lasting_files(given.key)
        if is_remote(sweep.storage):  # `checkpoint` is a temporary copy
            checkpoint = shutil.copytree(checkpoint, folder / "source", dirs_exist_ok=True)
        place = {"checkpoint": str(checkpoint.absolute())}
    return header | {"init_from": place | {"task": given.task.name}} | settings
