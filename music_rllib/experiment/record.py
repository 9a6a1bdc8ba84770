"""The record of a sweep's configuration and plan, and changes since it was written.

A run that the plan no longer has stays in the storage. `plan.json` keeps its key as one of an
earlier version of the sweep, so that it can be named; nothing compares it. A later plan that has
the run again uses it again.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from typing import Any, NamedTuple

from music_rllib import names
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Stage, SweepConfig
from music_rllib.errors import BadInputError, indented
from music_rllib.experiment.open_sweep import FINISHED, OpenSweep, plan_node
from music_rllib.experiment.plan import Node, budget_settings, continuation_key, make_plan
from music_rllib.experiment.sweep_files import (
    CONFIG,
    IN_STORAGE,
    PLAN,
    SweepLocation,
    as_json,
    sweeps_in,
)
from music_rllib.names import in_runs
from music_rllib.redaction import redact, without_secrets
from music_rllib.store.node_store import NodeStore
from music_rllib.store.storage import StorageError, database_url
from music_rllib.store.work_folder import steps_of

# Writing the record -------------------------------------------------------------------------------


def keep_record(sweep: OpenSweep) -> None:
    """Write the configuration and the plan into the sweep's folder.

    Raises:
        StorageError: The folder can't be written.
    """
    location = sweep.location
    configuration = as_json(configuration_of(sweep.config))
    unchanged = _unchanged_plan(sweep, configuration)
    with contextlib.suppress(StorageError):  # a damaged record is replaced
        sweep.earlier[:] = unchanged["earlier"] if unchanged else _earlier_runs(sweep)
    keeps_trials = unchanged is not None and sweep.plan.searched and not sweep.plan.trials
    # The plan first: the earlier one may have trials of stages that the configuration lacks.
    if unchanged is None or not keeps_trials:
        location.keep(PLAN, as_json(plan_document(sweep)))
    elif sweep.removed:  # the record has trials that the plan does not have yet
        location.keep(PLAN, as_json({**unchanged, **_retrained(sweep)}))
    location.keep(CONFIG, configuration)


def _retrained(sweep: OpenSweep) -> dict[str, list[str]]:
    """The nodes to train again: a search that is stopped before must know them, too."""
    return {"retrain": sorted(sweep.removed)} if sweep.removed else {}


def record_retraining(storage: str, keys: Collection[str]) -> None:
    """Name runs in the plans of all sweeps that have them, before these runs are deleted.

    A search does not ask again for the runs of its ended trials, unless its plan names them.

    Raises:
        StorageError: A plan can't be written.
    """
    for location in sweeps_in(storage) if keys else ():
        try:
            plan = location.read(PLAN)
        except StorageError:  # a damaged plan names no trials
            continue
        nodes = (*plan["nodes"], *plan.get("earlier", ()))
        if own := {node["key"] for node in nodes}.intersection(keys):
            retrain = sorted(own.union(plan.get("retrain", ())))
            location.keep(PLAN, as_json({**plan, "retrain": retrain}))


def plan_document(sweep: OpenSweep) -> dict[str, Any]:
    """The content of `plan.json`: all nodes so far, and those of earlier plans."""
    keys = {node.key for node in sweep.plan.nodes}
    return {
        "storage": redact(sweep.storage),
        "algorithm": sweep.plan.algorithm,
        "nodes": [plan_node(node) for node in sweep.plan.nodes],
        "trials": sweep.plan.trials,
        **_retrained(sweep),
        "environments": {task: dict(found) for task, found in sweep.environments.now.items()},
        "earlier": [one for one in sweep.earlier if one["key"] not in keys],
    }


def configuration_of(config: SweepConfig) -> dict[str, Any]:
    """The whole configuration without secrets, in a form that is valid on every machine."""
    document: dict[str, Any] = json.loads(as_json(without_secrets(config.document)))
    if uri := (document.get("mlflow") or {}).get("tracking_uri"):
        document["mlflow"]["tracking_uri"] = database_url(uri)
    for stage, resolved in zip(document["stages"], config.stages, strict=True):
        search = stage.get("search") or {}
        if str(search.get("storage")).startswith("sqlite:"):  # its path may be relative
            search["storage"] = database_url(search["storage"])
        if resolved.source and resolved.source.checkpoint:
            stage["init_from"]["checkpoint"] = f"{IN_STORAGE}{resolved.source.checkpoint.key}"
    return document


def _unchanged_plan(sweep: OpenSweep, configuration: str) -> dict[str, Any] | None:
    """The content of `plan.json` if the plan has not changed since; else None."""
    with contextlib.suppress(StorageError):
        plan: dict[str, Any] | None = sweep.location.read(PLAN)
        same = sweep.location.read(CONFIG) == json.loads(configuration)
        if same and plan and plan.get("algorithm") == sweep.plan.algorithm and "earlier" in plan:
            return plan
    return None


# Runs of earlier versions -------------------------------------------------------------------------


def _earlier_runs(sweep: OpenSweep) -> list[dict[str, Any]]:
    """The runs in `plan.json` that the plan does not have; `clean` needs their `continuation`."""
    recorded = sweep.location.read(PLAN) or {"nodes": []}
    known = {one["key"]: one for one in (*recorded["nodes"], *recorded.get("earlier", ()))}
    gone = known.keys() - {node.key for node in sweep.plan.nodes}
    kept = ("key", "label", "input", "continuation")
    earlier = (one for key, one in known.items() if key in gone)
    return [{name: one[name] for name in kept if name in one} for one in earlier]


def results_of_other_budgets(sweep: OpenSweep) -> dict[str, dict[str, str]]:
    """By key of a planned node: tags about the first result of runs that begin like it.

    These are runs of an earlier plan or of another stage with other `env_steps`. A hypothesis that
    is newer than their results is not planned.
    """
    recorded = (*sweep.recorded.get("nodes", ()), *sweep.recorded.get("earlier", ()))
    known = {one["key"]: one["continuation"] for one in recorded if "continuation" in one}
    own = {
        node.key: known.get(node.key)
        or continuation_key(node.run, node.source_key, sweep.plan.algorithm)
        for node in sweep.plan.nodes
    }
    known |= own
    counts, ours = Counter(known.values()), {*own.values()}
    shared = [key for key, of in known.items() if counts[of] > 1 and of in ours]
    times: dict[str, int] = {}
    for key in sweep.store.finished(shared) if shared else ():
        with contextlib.suppress(StorageError):  # the result of a damaged run is not known
            of, ended = known[key], sweep.store.history(key)[-1].timestamp_ms
            times[of] = min(times.get(of, ended), ended)
    return {
        key: {names.TAG_EARLIER_RESULT: str(times[of])} for key, of in own.items() if of in times
    }


def earlier_text(location: SweepLocation) -> str | None:
    """A sentence about a sweep's runs of earlier versions; None if there are none."""
    recorded = (location.read(PLAN) or {}).get("earlier", ())
    if not recorded:
        return None
    store = NodeStore(location.storage)
    known = store.begun() | store.finished(one["key"] for one in recorded)
    number = sum(one["key"] in known for one in recorded)
    are = "is" if number == 1 else "are"
    text = f"{in_runs(number)} of an earlier version of this sweep {are} not shown (see {PLAN})."
    return text if number else None


# Changes since the last run -----------------------------------------------------------------------


class Changes(NamedTuple):
    """Differences of a sweep from its last run."""

    name: str
    differences: tuple[str, ...]
    """Lines such as `tac.lr: 0.001 -> 0.0003 (4 runs)`."""
    lost: tuple[str, ...]
    """Labels and progress of runs whose results or checkpoints the changed sweep does not use."""

    def __str__(self) -> str:
        have = "its result" if len(self.lost) == 1 else "their results"
        return "\n".join(
            (
                f"the configuration of sweep {self.name!r} has changed since it was last run:",
                *indented(self.differences),
                f"{in_runs(len(self.lost))} would be retrained without using {have}:",
                *indented(self.lost),
                "Choose: --accept-changes does that (the old results stay in the storage), "
                "--name NEW keeps both sweeps, the old configuration uses the existing results.",
            )
        )


def changes_since(sweep: OpenSweep) -> Changes | None:
    """Results of the sweep's last run that this one does not use; None if there are none.

    Runs that are new, or that the plan no longer has, do not count.
    """
    recorded = {node["label"]: node for node in sweep.recorded.get("nodes", ())}
    keys = {node.key for node in sweep.plan.nodes}
    nodes = [node for node in sweep.plan.nodes if node.label in recorded]
    changed = [node for node in nodes if recorded[node.label]["key"] not in keys]
    if not recorded or not (changed or sweep.plan.searched):
        return None
    before = _last_configuration(sweep)
    runs = {node.label: node.run for node in make_plan(before).nodes} if before and changed else {}
    counts: Counter[str] = Counter()
    lost, short = [], sweep.short
    for node in changed:
        old = recorded[node.label]
        lines = list(_changed_settings(runs[node.label], node.run)) if node.label in runs else []
        is_longer = (
            old.get("continuation") == node.continuation and old["env_steps"] < node.run.env_steps
        )
        continued = sweep.continued_from(node) if is_longer else None
        if continued is not None and _checkpointed(sweep, old["key"]) <= continued:
            continue
        counts.update(lines)
        if (progress := sweep.progress(old["key"])) is not None:
            why = _why_not_continued(node) if is_longer and progress == FINISHED else ""
            lost.append(f"{short(node.label)}: {progress}{why}")
    for stage, lines in _changed_searches(sweep, before, [node.stage for node in changed]):
        for label, old in recorded.items():
            if not label.startswith(f"{stage}/") or old["key"] in keys:
                continue
            if (progress := sweep.progress(old["key"])) is not None:
                counts.update(lines)
                lost.append(f"{label}: {progress}")
    if not lost:
        return None
    differences = [f"{line} ({in_runs(count)})" for line, count in counts.items()]
    algorithm = sweep.recorded.get("algorithm")
    if algorithm != sweep.plan.algorithm:
        differences.append(f"version of the algorithm: {algorithm} -> {sweep.plan.algorithm}")
    return Changes(
        name=sweep.plan.name,
        differences=tuple(differences or ["the runs that it starts from"]),
        lost=tuple(lost),
    )


def _checkpointed(sweep: OpenSweep, key: str) -> int:
    """Environment steps of the last checkpoint of an unfinished run; 0 without one."""
    checkpoints = [] if sweep.store.is_finished(key) else sweep.store.work_folder(key).names()
    return steps_of(checkpoints[-1]) if checkpoints else 0


def _last_configuration(sweep: OpenSweep) -> SweepConfig | None:
    """The configuration of the sweep's last run; None if this version cannot read it."""
    with contextlib.suppress(BadInputError):
        return sweep.location.config() if sweep.location.read(CONFIG) else None
    return None


def _changed_searches(
    sweep: OpenSweep, before: SweepConfig | None, changed: Iterable[str]
) -> Iterator[tuple[str, list[str]]]:
    """Searched stages with changed settings, and the lines of the changes, each once.

    A setting that a search chooses or compares may be new in its space: that makes new trials.
    `changed` are the stages whose other runs have changed.
    """
    chosen = [
        name if ":" in name else f"{stage.name}:{name}"
        for stage in sweep.plan.searched
        if stage.search is not None
        for name in (*stage.search.space, *stage.search.compare)
    ]
    planned = {node.stage for node in sweep.plan.nodes if not node.part}
    earlier = {stage.name: stage.points[0].runs for stage in before.stages} if before else {}
    all_changed = {*changed}
    for stage in sweep.config.stages:
        if stage.name in planned or stage.name not in earlier:
            continue
        lines = [
            line
            for task, run in stage.points[0].runs.items()
            if task in earlier[stage.name]
            for line in _changed_settings(earlier[stage.name][task], run)
            if not any(f"{stage.name}:{line}".startswith((f"{one}:", f"{one}.")) for one in chosen)
        ]
        source, now = (_source_of(one.stage(stage.name)) for one in (before, sweep.config) if one)
        if source != now:
            lines.append(f"init_from: {source} -> {now}")
        if lines or stage.source_stage in all_changed:
            all_changed.add(stage.name)
            yield stage.name, list(dict.fromkeys(lines))


def _source_of(stage: Stage) -> str:
    """`init_from` of a stage in words; a checkpoint by its hash."""
    source = stage.source
    if source is None:
        return "none"
    checkpoint = source.checkpoint.manifest.content_hash[:12] if source.checkpoint else None
    return f"{source.stage or checkpoint}{f' on {source.task.name}' if source.task else ''}"


def _why_not_continued(node: Node) -> str:
    """The reason why a run with more `env_steps` does not continue the shorter one."""
    if settings := budget_settings(node.run):
        return f"; {' and '.join(settings)} would have had other values with the new env_steps"
    return (
        "; it has kept no checkpoint of its end (checkpoints.finished_mb, or its env_steps are not "
        "a multiple of evaluation.interval and of 1,000)"
    )


def _changed_settings(before: RunSettings, after: RunSettings) -> Iterator[str]:
    dumps = before.model_dump(mode="json"), after.model_dump(mode="json")
    for place, old, new in _differences(*dumps):
        yield f"{place}: {json.dumps(old)} -> {json.dumps(new)}"


def _differences(before: Any, after: Any, place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Dotted name, old and new value of each setting that differs."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in before | after:
            inner = f"{place}.{key}" if place else str(key)
            yield from _differences(before.get(key), after.get(key), inner)
    elif before != after:
        yield place, before, after
