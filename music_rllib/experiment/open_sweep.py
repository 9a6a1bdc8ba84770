"""A planned sweep with its storage open, and its runs of a different environment."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from music_rllib.config.schema import SweepConfig
from music_rllib.envs.fingerprint import Fingerprint, differences, digest_of
from music_rllib.errors import BadInputError, indented
from music_rllib.experiment.plan import Node, Plan, budget_settings, make_plan
from music_rllib.experiment.scheduler import DONE, Scheduler
from music_rllib.experiment.sweep_files import PLAN, SweepLocation, as_json, read_json
from music_rllib.names import ShortLabels, in_runs, label_matches
from music_rllib.store.history import RunResult
from music_rllib.store.node_store import CONTINUATIONS, NodeStore, damage_in_words
from music_rllib.store.storage import DamagedError, StorageError, open_storage
from music_rllib.store.work_folder import steps_of

FINISHED = "is finished"
SAME_ENVIRONMENTS = "environments.json"
"""File of a storage: the environments that the user declared equivalent."""


@dataclass(frozen=True, kw_only=True)
class Environments:
    """The present environments of a sweep's tasks."""

    now: Mapping[str, Fingerprint] = field(default_factory=dict)
    """Fingerprints by task; empty if they were not computed."""
    kept: Sequence[tuple[str, str]] = ()
    """Digests of an earlier and a later environment whose runs are used together."""

    @classmethod
    def of(cls, now: Mapping[str, Fingerprint], storage: str) -> Environments:
        """Environments with the user's earlier decisions in this storage."""
        kept = (read_json(open_storage(storage), SAME_ENVIRONMENTS) or {}).get("kept", ())
        return cls(now=now, kept=tuple((one["earlier"], one["later"]) for one in kept))

    def same(self, task: str) -> frozenset[str]:
        """Digests of all environments that count as the task's."""
        found = {digest_of(self.now[task])} if task in self.now else set()
        while more := {one for pair in self.kept if found & {*pair} for one in pair} - found:
            found |= more
        return frozenset(found)

    def earliest(self, task: str) -> str:
        """Digest of the first of the environments that count as the task's."""
        same, later = self.same(task), {one for _, one in self.kept}
        first = (one for one, _ in self.kept if one in same and one not in later)
        return next(first, digest_of(self.now[task]))

    def differences(self, task: str, run: Fingerprint | None) -> list[str]:
        """Differences from the environment of a run; none if that was not recorded."""
        if run is None or task not in self.now or digest_of(run) in self.same(task):
            return []
        return differences(run, self.now[task])


@dataclass(frozen=True, kw_only=True)
class OpenSweep:
    """A planned sweep with its storage open."""

    config: SweepConfig
    plan: Plan
    storage: str
    """Absolute folder, or URI."""
    store: NodeStore
    scheduler: Scheduler
    environments: Environments = field(default_factory=Environments)
    damaged: Mapping[str, str] = field(default_factory=dict)
    """Key of each damaged finished node, which will be retrained, with a message."""
    recorded: Mapping[str, Any] = field(default_factory=dict)
    """Content of `plan.json` when the sweep was opened; empty if there was none."""
    earlier: list[dict[str, Any]] = field(default_factory=list)
    """Runs of earlier versions of the plan, as in `plan.json`."""
    removed: frozenset[str] = frozenset()
    """Keys of the nodes that were deleted and are not trained again yet."""

    @cached_property
    def location(self) -> SweepLocation:
        """The place of the sweep's own files."""
        return SweepLocation(storage=self.storage, name=self.config.name)

    @property
    def folder(self) -> Path:
        """Folder of the sweep's own files on this machine."""
        return self.location.folder

    @property
    def finished(self) -> set[str]:
        """Keys of the nodes that have a result."""
        return {node.key for node in self.scheduler.having(*DONE)}

    def is_finished(self, key: str) -> bool:
        return self.scheduler.knows(key) and self.scheduler[key] in DONE

    @property
    def short(self) -> ShortLabels:
        """Shortens the labels of the planned runs."""
        return ShortLabels.of(node.label for node in self.plan.nodes)

    def results(self) -> dict[str, RunResult]:
        results = zip(self.finished, self.store.map(self.store.result, self.finished), strict=True)
        return {key: result for key, result in results if result is not None}

    @cached_property
    def existing(self) -> dict[str, set[str]]:
        """The folders of runs in the storage when they were first asked for."""
        return self.store.existing()

    def continued_from(self, node: Node) -> int | None:
        """Environment steps of the finished shorter run that `node` would continue, if any."""
        resumes = node.key in self.existing["work"] and self.store.work_folder(node.key).names()
        is_kept = node.continuation in self.existing[CONTINUATIONS]
        if resumes or not is_kept or budget_settings(node.run):
            return None
        steps = [steps_of(name) for name in self.store.continuation(node.continuation).names()]
        return max((count for count in steps if count < node.run.env_steps), default=None)

    def progress(self, key: str) -> str | None:
        """The progress of a run as text; None if it has neither a result nor a checkpoint."""
        if self.is_finished(key) or (key in self.existing["nodes"] and self.store.is_finished(key)):
            return FINISHED
        if key not in self.existing["work"]:
            return None
        checkpoints = self.store.work_folder(key).names()
        return f"is at {steps_of(checkpoints[-1]):,} env steps" if checkpoints else None


def open_sweep(
    config: SweepConfig,
    plan: Plan,
    storage: str,
    *,
    environments: Mapping[str, Fingerprint] | None = None,
    lenient: bool = False,
) -> OpenSweep:
    """Open the storage, and find the runs in it that are finished and undamaged.

    A sweep that is to be run needs the fingerprints of its `environments`. `lenient` accepts
    damaged runs, which wait for `remove_damaged`.

    Raises:
        StorageError: The storage can't be reached, or finished runs in it are damaged.
    """
    store = NodeStore(storage)
    try:
        recorded = SweepLocation(storage=storage, name=config.name).read(PLAN) or {}
    except StorageError:  # the record is damaged, and the next run replaces it
        recorded = {}
    labels = _labels(plan, recorded)
    published = store.finished(labels)
    damaged = store.damage(key for key in labels if key in published)
    if damaged and not lenient:
        raise DamagedError(damage_in_words({labels[key]: why for key, why in damaged.items()}))
    finished = published & {node.key for node in plan.nodes}
    return OpenSweep(
        config=config,
        plan=plan,
        storage=storage,
        store=store,
        scheduler=Scheduler(plan, finished - damaged.keys()),
        environments=Environments.of(environments, storage) if environments else Environments(),
        damaged={
            key: f"{labels[key]}: damaged, will be retrained: {why}" for key, why in damaged.items()
        },
        recorded=recorded,
        removed=frozenset(recorded.get("retrain", ())) - published,
    )


def reopened(sweep: OpenSweep) -> OpenSweep:
    """The sweep with the runs that are finished now."""
    return open_sweep(
        sweep.config,
        sweep.plan,
        sweep.storage,
        environments=sweep.environments.now,
        lenient=bool(sweep.damaged),
    )


def open_started(location: SweepLocation, *, lenient: bool = False) -> OpenSweep:
    """Open a sweep with its plan as of its last run, and its finished runs.

    The plan includes the searched trials. Its keys are of the version of the algorithm that the
    sweep was run with. `lenient` accepts damaged runs, which then count as not finished.
    """
    recorded = location.read(PLAN) or {}
    config = location.config()
    plan = make_plan(config, algorithm=recorded.get("algorithm"))
    for trial in recorded.get("trials", ()):
        plan.add_trial(**trial)
    return open_sweep(config, plan, location.storage, lenient=lenient)


def continued_runs_text(sweep: OpenSweep) -> list[str]:
    """A line about runs that continue finished ones with fewer `env_steps`, if there are any."""
    left = [node for node in sweep.plan.nodes if not sweep.is_finished(node.key)]
    steps = [done for node in left if (done := sweep.continued_from(node)) is not None]
    if not steps:
        return []
    continues = "continues a finished run" if len(steps) == 1 else "continue finished runs"
    return [
        f"{in_runs(len(steps))} {continues} with fewer env_steps: {sum(steps):,} env steps less to "
        "train."
    ]


def remove_damaged(sweep: OpenSweep, say: Callable[[str], None]) -> None:
    """Delete the damaged nodes, and print each; the caller must hold the sweep's lease."""
    for key, text in sweep.damaged.items():
        sweep.store.remove(key)
        say(text)


def plan_node(node: Node) -> dict[str, Any]:
    """A node in `plan.json`."""
    return {
        "key": node.key,
        "label": node.label,
        "input": node.source_key,
        "env_steps": node.run.env_steps,
        "continuation": node.continuation,
        **({"code": node.run.code} if node.run.own_modules else {}),
    }


def _labels(plan: Plan, recorded: Mapping[str, Any]) -> dict[str, str]:
    """Labels of all nodes that the sweep may reuse, by key; with those of earlier trials."""
    labels = {}
    if plan.searched:
        labels = {node["key"]: node["label"] for node in recorded.get("nodes", ())}
    labels |= {handoff.key: f"handoff {handoff.folder}" for handoff in plan.imports}
    short = ShortLabels.of(node.label for node in plan.nodes)
    return labels | {node.key: short(node.label) for node in plan.nodes}


SHOWN = 10
ADVICE = (
    "--retrain RUN (a run's label, a part of it, or a task; may be repeated) or --accept-changes "
    "deletes these results and retrains the runs, --keep-runs uses them as they are"
)


# Runs of a different environment ---------------------------------------------------------


class EnvironmentChangedError(BadInputError, RuntimeError):
    """A result or checkpoint in the storage was computed in a different environment."""


@dataclass(frozen=True, kw_only=True)
class FoundRun:
    """A run with a result or a checkpoint that the sweep would use."""

    key: str
    label: str
    code: str
    """Its task, with the module of its intrinsic reward if that is the user's own."""
    continuation: str | None
    """Key of the last checkpoint that it shares with runs of other budgets."""
    progress: str
    """Such as `is finished`."""
    environment: Fingerprint | None
    differences: tuple[str, ...]
    """Differences of its environment from the present one, such as `lab_env.py changed`."""


def found_runs(sweep: OpenSweep) -> list[FoundRun]:
    """All runs that have a result or a checkpoint in the storage, in the order of the plan."""
    nodes = [plan_node(node) for node in sweep.plan.nodes]
    if sweep.plan.searched:  # the recorded trials, which the plan does not have yet
        recorded = sweep.recorded.get("nodes", ())
        nodes += [node for node in recorded if not sweep.scheduler.knows(node["key"])]
    found = sweep.store.map(partial(_found_run, sweep), nodes)
    return [run for run in found if run is not None]


def _found_run(sweep: OpenSweep, node: Mapping[str, Any]) -> FoundRun | None:
    """A run of `plan.json` with its progress, or that of a shorter run that it would continue."""
    key, continuation, store = node["key"], node.get("continuation"), sweep.store
    progress = sweep.progress(key)
    if progress == FINISHED:
        environment = None if key in sweep.damaged else store.environment(key)
    elif progress is not None:
        environment = store.work_folder(key).environment()
    elif sweep.scheduler.knows(key) and continuation is not None:
        steps = sweep.continued_from(sweep.scheduler.node(key))
        if steps is None:
            return None
        progress = f"would continue a run of {steps:,} env steps"
        environment = store.continuation(continuation).environment()
    else:
        return None
    code = node.get("code", node["label"].split("/")[1])
    return FoundRun(
        key=key,
        label=node["label"],
        code=code,
        continuation=continuation,
        progress=progress,
        environment=environment,
        differences=tuple(sweep.environments.differences(code, environment)),
    )


def changed_text(sweep: OpenSweep, runs: Iterable[FoundRun]) -> str | None:
    """A message with the changes of environments, the runs and the choices; None if no change."""
    groups: dict[tuple[str, tuple[str, ...]], list[FoundRun]] = {}
    for run in (run for run in runs if run.differences):
        groups.setdefault((run.code, run.differences), []).append(run)
    lines, short = [], sweep.short
    for (task, changes), members in groups.items():
        more = f" and {len(changes) - SHOWN} more" if len(changes) > SHOWN else ""
        lines.append(
            f"the environment of {task} has changed since {in_runs(len(members))} used it: "
            f"{', '.join(changes[:SHOWN])}{more}"
        )
        lines += indented([f"{short(run.label)}: {run.progress}" for run in members], SHOWN)
    return "\n".join((*lines, f"Choose: {ADVICE}.")) if lines else None


def decide(
    sweep: OpenSweep,
    runs: Sequence[FoundRun],
    retrain: Sequence[str],
    *,
    all_changed: bool,
    keep: bool,
) -> tuple[list[FoundRun], list[FoundRun]]:
    """The runs to retrain (with those that start from them), and the changed runs to keep.

    `retrain` are the names of `--retrain`; `all_changed` retrains all runs of different
    environments, and `keep` keeps those that are not retrained.

    Raises:
        BadInputError: A name fits no run, or no option decides about a changed environment.
    """
    chosen = {run.key for run in runs if all_changed and run.differences}
    for name in retrain:
        exact = {run.key for run in runs if name == run.label}
        fits = exact or {run.key for run in runs if label_matches(name, run.label)}
        if not fits:
            known = ", ".join(run.label for run in runs[:SHOWN]) or "none"
            raise BadInputError(
                f"--retrain must name a task or a run with a result or a checkpoint, got {name!r} "
                f"(there are: {known})"
            )
        chosen |= fits
    recorded = [(node["key"], node["input"]) for node in sweep.recorded.get("nodes", ())]
    sources = dict([*recorded, *((node.key, node.source_key) for node in sweep.plan.nodes)])
    while more := {key for key, source in sources.items() if source in chosen} - chosen:
        chosen |= more
    again = [run for run in runs if run.key in chosen]
    changed = [run for run in runs if run.differences and run.key not in chosen]
    if not keep and (text := changed_text(sweep, changed)) is not None:
        raise BadInputError(text)
    return again, changed


def remove_runs(
    sweep: OpenSweep, runs: Sequence[FoundRun], say: Callable[[str], None]
) -> OpenSweep:
    """Delete results and checkpoints of runs; returns the sweep in which they wait.

    The caller must hold the sweep's lease.

    Raises:
        BadInputError: One of them is being computed; nothing was deleted.
    """
    for run in runs:
        holder = sweep.store.work_folder(run.key).lease.read()
        if holder is not None and holder.holds():
            raise BadInputError(
                f"{run.label} must not be running to be retrained, it is computed by {holder}"
            )
    for run in runs:
        say(f"{run.label}: {run.progress}; deleted, to be retrained")
        sweep.store.remove(run.key)
        sweep.store.work_folder(run.key).clear()
        if run.continuation is not None:
            sweep.store.continuation(run.continuation).clear()
    keys = {run.key for run in runs}
    scheduler = Scheduler(sweep.plan, sweep.finished - keys)
    return replace(sweep, scheduler=scheduler, removed=sweep.removed | keys | sweep.damaged.keys())


def accept_environments(
    sweep: OpenSweep, runs: Sequence[FoundRun], say: Callable[[str], None]
) -> OpenSweep:
    """Record that runs of different environments are used; returns the sweep that uses them.

    Raises:
        StorageError: The decision can't be recorded.
    """
    answers = {
        (digest_of(run.environment), digest_of(sweep.environments.now[run.code])): run.differences
        for run in runs
        if run.environment is not None
    }
    if not answers:
        return sweep
    say(f"using {in_runs(len(runs))} of a different environment (--keep-runs)")
    storage = open_storage(sweep.storage)
    document = read_json(storage, SAME_ENVIRONMENTS) or {"kept": []}
    now = time.strftime("%Y-%m-%d %H:%M:%S")
    document["kept"] += [
        {"earlier": earlier, "later": later, "differences": list(lines), "answered": now}
        for (earlier, later), lines in answers.items()
    ]
    storage.write(SAME_ENVIRONMENTS, as_json(document).encode())
    kept = (*sweep.environments.kept, *answers)
    return replace(sweep, environments=replace(sweep.environments, kept=kept))
