"""Runs in the storage that used a different environment: find, retrain or keep them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from music_rllib.envs.fingerprint import Fingerprint, digest_of
from music_rllib.errors import BadInputError
from music_rllib.experiment.open_sweep import FINISHED, SAME_ENVIRONMENTS, OpenSweep
from music_rllib.experiment.plan import continuation_key
from music_rllib.experiment.scheduler import Scheduler
from music_rllib.experiment.sweep_files import as_json, read_json
from music_rllib.names import in_runs, label_matches
from music_rllib.store.storage import open_storage

SHOWN = 10
ADVICE = (
    "--retrain RUN (a run's label, a part of it, or a task; may be repeated) or --accept-changes "
    "deletes these results and retrains the runs, --keep-runs uses them as they are"
)


class EnvironmentChangedError(BadInputError, RuntimeError):
    """A result or checkpoint in the storage was computed in a different environment."""


@dataclass(frozen=True, kw_only=True)
class FoundRun:
    """A run with a result or a checkpoint that the sweep would use."""

    key: str
    label: str
    task: str
    """Its task, with the module of its intrinsic reward if that is the user's own."""
    continuation: str | None
    """Key of the last checkpoint that it shares with runs of other budgets."""
    progress: str = ""
    """Such as `is finished`; empty if the storage has nothing of it."""
    environment: Fingerprint | None = None
    differences: tuple[str, ...] = ()
    """Differences of its environment from the present one, such as `lab_env.py changed`."""


def found_runs(sweep: OpenSweep) -> list[FoundRun]:
    """All runs that have a result or a checkpoint in the storage, in the order of the plan."""
    runs = [
        FoundRun(
            key=node.key,
            label=node.label,
            task=node.run.code,
            continuation=continuation_key(node.run, node.source_key),
        )
        for node in sweep.plan.nodes
    ]
    runs += [
        FoundRun(
            key=node["key"],
            label=node["label"],
            task=node.get("code", node["label"].split("/")[1]),
            continuation=node.get("continuation"),
        )
        for node in (sweep.recorded.get("nodes", ()) if sweep.plan.searched else ())
        if not sweep.scheduler.knows(node["key"])
    ]

    def find(run: FoundRun) -> FoundRun:
        progress, environment = _in_storage(sweep, run)
        changed = tuple(sweep.environments.differences(run.task, environment))
        return replace(run, progress=progress, environment=environment, differences=changed)

    return [run for run in sweep.store.map(find, runs) if run.progress]


def _in_storage(sweep: OpenSweep, run: FoundRun) -> tuple[str, Fingerprint | None]:
    """The progress of a run, or of a shorter run that it would continue, and its environment."""
    store = sweep.store
    if (progress := sweep.progress(run.key)) is not None:
        finished = progress == FINISHED
        return progress, (
            store.environment(run.key) if finished else store.work_folder(run.key).environment()
        )
    if run.continuation is not None and sweep.scheduler.knows(run.key):
        steps = sweep.continued_from(sweep.scheduler.node(run.key))
        if steps is not None:
            environment = store.continuation(run.continuation).environment()
            return f"would continue a run of {steps:,} env steps", environment
    return "", None


def changed_text(sweep: OpenSweep, runs: Iterable[FoundRun]) -> str | None:
    """A message with the changes of environments, the runs and the choices; None if no change."""
    groups: dict[tuple[str, tuple[str, ...]], list[FoundRun]] = {}
    for run in runs:
        if run.differences:
            groups.setdefault((run.task, run.differences), []).append(run)
    if not groups:
        return None
    lines = []
    for (task, changes), members in groups.items():
        more = f" and {len(changes) - SHOWN} more" if len(changes) > SHOWN else ""
        lines.append(
            f"the environment of {task} has changed since {in_runs(len(members))} used it: "
            f"{', '.join(changes[:SHOWN])}{more}"
        )
        lines += [f"  {sweep.short(run.label)}: {run.progress}" for run in members[:SHOWN]]
        lines += [f"  ... and {len(members) - SHOWN} more"] * (len(members) > SHOWN)
    return "\n".join((*lines, f"Choose: {ADVICE}."))


def to_retrain(
    sweep: OpenSweep, runs: Sequence[FoundRun], named: Sequence[str], *, all_changed: bool
) -> list[FoundRun]:
    """The runs to retrain: named ones, changed ones if asked, and those that start from them.

    Raises:
        BadInputError: A name fits no run that has a result or a checkpoint.
    """
    chosen = {run.key for run in runs if all_changed and run.differences}
    for name in named:
        fits = {run.key for run in runs if label_matches(name, run.label)}
        if not fits:
            known = ", ".join(run.label for run in runs[:SHOWN]) or "none"
            raise BadInputError(
                f"--retrain must name a task or a run with a result or a checkpoint, got {name!r} "
                f"(there are: {known})"
            )
        chosen |= fits
    for node in sweep.plan.nodes:  # every node comes after its input
        if node.source_key in chosen:
            chosen.add(node.key)
    return [run for run in runs if run.key in chosen]


def decide(
    sweep: OpenSweep,
    runs: Sequence[FoundRun],
    retrain: Sequence[str],
    *,
    all_changed: bool,
    keep: bool,
) -> tuple[list[FoundRun], list[FoundRun]]:
    """The runs to retrain, and the runs of different environments to keep.

    Args:
        sweep: The sweep.
        runs: Its runs in the storage.
        retrain: Names of `--retrain`.
        all_changed: Retrain all runs of different environments.
        keep: Keep the runs of different environments that are not retrained.

    Raises:
        BadInputError: A name fits no run, or no option decides about a changed environment.
    """
    again = to_retrain(sweep, runs, retrain, all_changed=all_changed)
    changed = [run for run in runs if run.differences and run not in again]
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
    finished = sweep.finished - {run.key for run in runs}
    return replace(sweep, scheduler=Scheduler(sweep.plan, finished))


def accept_environments(
    sweep: OpenSweep, runs: Sequence[FoundRun], say: Callable[[str], None]
) -> OpenSweep:
    """Record that runs of different environments are used; returns the sweep that uses them.

    Raises:
        StorageError: The decision can't be recorded.
    """
    answers = {
        (digest_of(run.environment), digest_of(sweep.environments.now[run.task])): run.differences
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
