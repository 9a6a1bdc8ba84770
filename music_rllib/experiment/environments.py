"""Runs of the storage whose environment was another one than it is now."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from music_rllib.envs.fingerprint import Fingerprint, differences, digest_of
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.continuation import continuation_key, continued_from
from music_rllib.experiment.scheduler import DONE, Scheduler
from music_rllib.labels import ShortLabels, in_runs, label_matches
from music_rllib.store.node_store import NodeStore
from music_rllib.store.work_folder import WorkFolder, steps_of

if TYPE_CHECKING:
    from music_rllib.experiment.open_sweep import OpenSweep

FILE = "environments.json"
"""File of a storage: which environments the user takes for the same."""
SHOWN = 10
ADVICE = (
    "--retrain RUN (a run's label, a part of it, or a task; may be repeated) or --accept-changes "
    "deletes these results and trains the runs again, --keep-runs uses them as they are"
)


class EnvironmentChangedError(BadInputError, RuntimeError):
    """Something in the storage was computed in another environment."""


@dataclass(frozen=True, kw_only=True)
class Environments:
    """The environments of a sweep's tasks as they are now."""

    now: Mapping[str, Fingerprint] = field(default_factory=dict)
    """By the task's name; empty where nobody has looked at them."""
    kept: Sequence[tuple[str, str]] = ()
    """Digests of an earlier and a later environment whose runs are used together."""

    @classmethod
    def of(cls, now: Mapping[str, Fingerprint], storage: str) -> Environments:
        """With what has been answered in this storage before."""
        kept = (sweep_files.read(storage, FILE) or {}).get("kept", ())
        return cls(now=now, kept=tuple((one["earlier"], one["later"]) for one in kept))

    def same(self, task: str) -> frozenset[str]:
        """Digests of all environments that count as the task's."""
        found = {digest_of(self.now[task])} if task in self.now else set()
        before: set[str] = set()
        while found != before:
            before = set(found)
            found |= {one for pair in self.kept for one in pair if found & {*pair}}
        return frozenset(found)

    def earliest(self, task: str) -> str:
        """Digest of the first of the environments that count as the task's."""
        found, later = digest_of(self.now[task]), {one for _, one in self.kept}
        same = self.same(task)
        return next((one for one, _ in self.kept if one in same and one not in later), found)

    def differences(self, task: str, run: Fingerprint | None) -> list[str]:
        """How the environment of a run was another one; a run that does not say is none."""
        if run is None or task not in self.now or digest_of(run) in self.same(task):
            return []
        return differences(run, self.now[task])


@dataclass(frozen=True, kw_only=True)
class OldRun:
    """A run with a result or a checkpoint that this sweep would use."""

    key: str
    label: str
    task: str
    progress: str
    continuation: str | None
    """Key of the last checkpoint that it shares with runs of another budget."""
    environment: Fingerprint | None = None
    differences: tuple[str, ...] = ()
    """`lab_env.py changed`, from then to now; empty for the same environment."""


def old_runs(sweep: OpenSweep) -> list[OldRun]:
    """All runs that have something in the storage, in the order of the plan."""
    runs, known = [], set()
    for node in sweep.plan.nodes:
        known.add(node.key)
        place = continuation_key(node.run, node.source_key)
        steps = None if sweep.store.is_finished(node.key) else continued_from(sweep.store, node)
        longer = None if steps is None else sweep.store.continuation(place)
        found = _progress(sweep.store, node.key, longer)
        if found is not None:
            runs.append(_run(sweep, node.key, node.label, node.run.task.name, place, found))
    earlier: Any = {}
    if sweep.plan.searched:
        earlier = sweep_files.read(sweep.storage, f"{sweep.config.name}/{sweep_files.PLAN}") or {}
    for node in earlier.get("nodes", ()):
        if node["key"] not in known and (found := _progress(sweep.store, node["key"], None)):
            task, place = node["label"].split("/")[1], node.get("continuation")
            runs.append(_run(sweep, node["key"], node["label"], task, place, found))
    return runs


def _progress(
    store: NodeStore, key: str, longer: WorkFolder | None
) -> tuple[str, Fingerprint | None] | None:
    """What there is of a run, in words, and the environment that it was computed in."""
    if store.is_finished(key):
        return "is finished", store.environment(key)
    work = store.work_folder(key)
    if names := work.names():
        return f"is at {steps_of(names[-1]):,} env steps", work.environment()
    if longer is None:
        return None
    steps = steps_of(longer.names()[-1])
    return f"would continue a run of {steps:,} env steps", longer.environment()


def _run(
    sweep: OpenSweep,
    key: str,
    label: str,
    task: str,
    continuation: str | None,
    found: tuple[str, Fingerprint | None],
) -> OldRun:
    return OldRun(
        key=key,
        label=label,
        task=task,
        progress=found[0],
        continuation=continuation,
        environment=found[1],
        differences=tuple(sweep.environments.differences(task, found[1])),
    )


def changed_text(sweep: OpenSweep, runs: Iterable[OldRun]) -> str | None:
    """A message with what has changed, the runs that it concerns, and what to do; None: nothing."""
    groups: dict[tuple[str, tuple[str, ...]], list[OldRun]] = {}
    for run in runs:
        if run.differences:
            groups.setdefault((run.task, run.differences), []).append(run)
    if not groups:
        return None
    short = ShortLabels.of(node.label for node in sweep.plan.nodes)
    lines = []
    for (task, changes), members in groups.items():
        more = f" and {len(changes) - SHOWN} more" if len(changes) > SHOWN else ""
        lines.append(
            f"the environment of {task} has changed since {in_runs(len(members))} used it: "
            f"{', '.join(changes[:SHOWN])}{more}"
        )
        lines += [f"  {short(run.label)}: {run.progress}" for run in members[:SHOWN]]
        lines += [f"  ... and {len(members) - SHOWN} more"] * (len(members) > SHOWN)
    return "\n".join((*lines, f"Choose: {ADVICE}."))


def to_retrain(
    sweep: OpenSweep, runs: Sequence[OldRun], named: Sequence[str], *, all_changed: bool
) -> list[OldRun]:
    """The runs to train again: named ones, changed ones if asked, and those that start from them.

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


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What is done with the runs that a sweep finds in the storage."""

    again: Sequence[OldRun]
    """Their results and checkpoints are deleted."""
    left: Sequence[OldRun]

    @classmethod
    def to(
        cls,
        sweep: OpenSweep,
        runs: Sequence[OldRun],
        retrain: Sequence[str],
        *,
        all_changed: bool,
        keep: bool,
    ) -> Answer:
        """The user's answer by the options of the command line.

        Raises:
            BadInputError: A name fits no run, or there is no answer for a changed environment.
        """
        again = to_retrain(sweep, runs, retrain, all_changed=all_changed)
        left = [run for run in runs if run not in again]
        if not keep and (text := changed_text(sweep, left)) is not None:
            raise BadInputError(text)
        return cls(again=again, left=left)

    def carry_out(self, sweep: OpenSweep, say: Callable[[str], None]) -> OpenSweep:
        """Delete, record the answer and say so; the caller must hold the sweep's lock.

        Raises:
            BadInputError: A run to delete is being computed.
            StorageError: The answer can't be written.
        """
        for run in self.again:
            say(f"{run.label}: {run.progress}; deleting that, the run is trained again")
        if kept := [run for run in self.left if run.differences]:
            say(f"{in_runs(len(kept))} of another environment used as asked (--keep-runs)")
        sweep = remove_old(sweep, self.again)
        return keep_old(sweep, kept) if kept else sweep


def remove_old(sweep: OpenSweep, runs: Sequence[OldRun]) -> OpenSweep:
    """Delete results and checkpoints of runs; the sweep in which they wait.

    Raises:
        BadInputError: One of them is being computed; nothing was deleted.
    """
    for run in runs:
        holder = sweep.store.work_folder(run.key).lease.read()
        if holder is not None and holder.holds():
            raise BadInputError(f"{run.label} must not be computed meanwhile, it is by {holder}")
    for run in runs:
        sweep.store.remove(run.key)
        sweep.store.work_folder(run.key).clear()
        if run.continuation is not None:
            sweep.store.continuation(run.continuation).clear()
    gone = {run.key for run in runs}
    finished = {node.key for node in sweep.scheduler.having(*DONE)} - gone
    return replace(sweep, scheduler=Scheduler(sweep.plan, finished))


def keep_old(sweep: OpenSweep, runs: Iterable[OldRun]) -> OpenSweep:
    """Record that runs of other environments are used; the sweep that uses them.

    Raises:
        StorageError: The answer can't be written.
    """
    document = sweep_files.read(sweep.storage, FILE) or {"kept": []}
    answers = {
        (digest_of(run.environment), digest_of(sweep.environments.now[run.task])): run.differences
        for run in runs
        if run.differences and run.environment is not None
    }
    now = time.strftime("%Y-%m-%d %H:%M:%S")
    document["kept"] += [
        {"earlier": earlier, "later": later, "differences": list(lines), "answered": now}
        for (earlier, later), lines in answers.items()
    ]
    sweep_files.write(sweep.storage, FILE, sweep_files.as_json(document))
    kept = (*sweep.environments.kept, *answers)
    return replace(sweep, environments=replace(sweep.environments, kept=kept))


def mixed(runs: Iterable[tuple[str, str, str]]) -> Iterator[str]:
    """A line for each task whose runs have several environments.

    Args:
        runs: Task, label and environment's digest of each run; "" where it is not known.
    """
    tasks: dict[str, dict[str, list[str]]] = {}
    for task, label, digest in runs:
        if digest:
            tasks.setdefault(task, {}).setdefault(digest, []).append(label)
    for task, groups in tasks.items():
        if len(groups) > 1:
            parts = (
                f"{', '.join(labels[:SHOWN])}{' ...' if len(labels) > SHOWN else ''} ({digest[:6]})"
                for digest, labels in groups.items()
            )
            yield (
                f"Runs on {task} are compared that used {len(groups)} versions of its environment: "
                f"{'; '.join(parts)}."
            )
