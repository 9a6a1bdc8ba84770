"""What has changed in a sweep since it was last run, and which results that leaves behind."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.continuation import budget_settings, continued_from
from music_rllib.experiment.plan import Node
from music_rllib.experiment.session import Sweep
from music_rllib.labels import ShortLabels
from music_rllib.store.files import write_atomically
from music_rllib.store.node_store import NodeStore, steps_of
from music_rllib.store.object_folder import StorageError
from music_rllib.store.paths import resolve_storage, sweep_folder
from music_rllib.version import ALGORITHM_VERSION

__all__ = ["Changes", "changes_since", "check_begun", "keep_settings", "longer"]

FILE = "settings.json"
FINISHED = "is finished"
SHOWN = 10
"""Lines of each list that are shown."""


@dataclass(frozen=True, kw_only=True)
class Changes:
    """How a sweep differs from the last one of its name."""

    name: str
    what: tuple[str, ...]
    """`tac.lr: 0.001 -> 0.0003 (4 runs)`, one line each."""
    lost: tuple[str, ...]
    """Runs that have something which the changed sweep has no use for, and what."""

    def __str__(self) -> str:
        one = len(self.lost) == 1
        runs, have = ("1 run", "it has") if one else (f"{len(self.lost)} runs", "they have")
        return "\n".join(
            (
                f"the configuration of sweep {self.name!r} has changed since it was last run:",
                *_indented(self.what),
                f"{runs} would be trained anew, and not use what {have}:",
                *_indented(self.lost),
                "Choose: --accept-changes does that (the old results stay in the storage), "
                "--name NEW keeps both sweeps, the old configuration uses what is there.",
            )
        )


def _indented(lines: tuple[str, ...]) -> list[str]:
    more = [f"  ... and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
    return [f"  {line}" for line in lines[:SHOWN]] + more


def keep_settings(sweep: Sweep) -> None:
    """Remember what `changes_since` compares with.

    Raises:
        StorageError: The sweep's folder can't be written.
    """
    runs = {node.label: {"key": node.key, **_settings(node)} for node in sweep.plan.nodes}
    path = sweep.folder / FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(
            path, json.dumps({"algorithm": ALGORITHM_VERSION, "runs": runs}, indent=1).encode()
        )
    except OSError as error:
        place = error.filename or path
        raise StorageError(f"{place} must be writable: {error.strerror}") from error


def check_begun(config: SweepConfig) -> None:
    """Whether there is a sweep to go on with.

    Raises:
        StorageError: There is none of this name.
    """
    folder = sweep_folder(resolve_storage(config.storage)[0], config.name)
    if not (folder / FILE).is_file():
        raise StorageError(
            f"--resume must find an earlier run of sweep {config.name!r}, there is none in {folder}"
        )


def _settings(node: Node) -> dict[str, Any]:
    return {
        "settings": node.run.model_dump(mode="json"),
        "source": node.source_key,
    }


def changes_since(sweep: Sweep) -> Changes | None:
    """What the last run of this sweep has made and this one has no use for; None: nothing.

    Runs that are new, or that aren't asked for any more, are no such change.
    """
    try:
        before = json.loads((sweep.folder / FILE).read_bytes())
        runs: Mapping[str, Any] = before["runs"]
        algorithm = before["algorithm"]
    except (OSError, ValueError, KeyError, TypeError):
        return None  # the first time, or nothing that tells
    keys = {node.key for node in sweep.plan.nodes}
    short = ShortLabels.of(node.label for node in sweep.plan.nodes)
    what: Counter[str] = Counter()
    lost = []
    for node in sweep.plan.nodes:
        was = runs.get(node.label)
        if was is None or was["key"] == node.key or was["key"] in keys:
            continue
        differences = list(_differences(was["settings"], node.run.model_dump(mode="json")))
        extends = _extends(was, node) and len(differences) == 1
        if extends and continued_from(sweep.store, node) is not None:
            continue
        what.update(differences)
        if (has := _what_there_is(sweep.store, was["key"])) is not None:
            why = _why_not_longer(node) if extends and has == FINISHED else ""
            lost.append(f"{short(node.label)}: {has}{why}")
    if not lost:
        return None
    lines = [f"{line} ({count} run{'s' * (count > 1)})" for line, count in what.items()]
    if algorithm != ALGORITHM_VERSION:
        lines.append(f"version of the algorithm: {algorithm} -> {ALGORITHM_VERSION}")
    return Changes(
        name=sweep.plan.name, what=tuple(lines or ["what it starts from"]), lost=tuple(lost)
    )


def longer(sweep: Sweep) -> list[str]:
    """A line about runs that go on where finished ones with fewer `env_steps` have ended."""
    if not sweep.store.has_continuations():
        return []
    left = [node for node in sweep.plan.nodes if node.key not in sweep.finished]
    found = [steps for node in left if (steps := continued_from(sweep.store, node)) is not None]
    if not found:
        return []
    runs = "1 run goes" if len(found) == 1 else f"{len(found)} runs go"
    return [
        f"{runs} on from the end of a finished one with fewer env_steps: {sum(found):,} env "
        "steps less to train."
    ]


def _extends(was: Mapping[str, Any], node: Node) -> bool:
    source = node.source_key
    return bool(was["source"] == source and was["settings"]["env_steps"] < node.run.env_steps)


def _why_not_longer(node: Node) -> str:
    """Why a run with more `env_steps` doesn't go on where the shorter one has ended."""
    if settings := budget_settings(node.run):
        return f"; {' and '.join(settings)} would have had other values with the new env_steps"
    return "; it has kept no checkpoint of its end (checkpoints.finished_mb)"


def _what_there_is(store: NodeStore, key: str) -> str | None:
    if store.is_finished(key):
        return FINISHED
    checkpoints = store.work_folder(key).names()
    if not checkpoints:
        return None
    return f"is at {steps_of(checkpoints[-1]):,} env steps"


def _differences(before: Any, after: Any, place: str = "") -> Iterator[str]:
    if isinstance(before, dict) and isinstance(after, dict):
        for key in before | after:
            inner = f"{place}.{key}" if place else str(key)
            yield from _differences(before.get(key), after.get(key), inner)
    elif before != after:
        yield f"{place}: {json.dumps(before)} -> {json.dumps(after)}"
