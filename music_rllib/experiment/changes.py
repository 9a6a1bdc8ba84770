"""How a sweep's settings differ from those it was last run with, and which results that costs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from music_rllib.config.run_settings import RETIRED
from music_rllib.experiment.continuation import budget_settings, continued_from
from music_rllib.experiment.earlier import differences
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Node
from music_rllib.experiment.sweep_files import PLAN, SETTINGS, keep, read
from music_rllib.labels import ShortLabels, in_runs
from music_rllib.store.node_store import NodeStore
from music_rllib.store.work_folder import steps_of
from music_rllib.version import ALGORITHM_VERSION

FINISHED = "is finished"
SHOWN = 10
"""Lines of each list that are shown."""


@dataclass(frozen=True, kw_only=True)
class Changes:
    """How a sweep differs from the last one of its name."""

    name: str
    differences: tuple[str, ...]
    """`tac.lr: 0.001 -> 0.0003 (4 runs)`, one line each."""
    lost: tuple[str, ...]
    """Runs with results or checkpoints that the changed sweep does not use, and which they are."""

    def __str__(self) -> str:
        have = "it has" if len(self.lost) == 1 else "they have"
        return "\n".join(
            (
                f"the configuration of sweep {self.name!r} has changed since it was last run:",
                *_indented(self.differences),
                f"{in_runs(len(self.lost))} would be trained anew, and not use what {have}:",
                *_indented(self.lost),
                "Choose: --accept-changes does that (the old results stay in the storage), "
                "--name NEW keeps both sweeps, the old configuration uses what is there.",
            )
        )


def _indented(lines: tuple[str, ...]) -> list[str]:
    more = [f"  ... and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
    return [f"  {line}" for line in lines[:SHOWN]] + more


def keep_settings(sweep: OpenSweep) -> None:
    """Write the settings that `changes_since` compares with into the sweep's folder.

    Raises:
        StorageError: The sweep's folder can't be written.
    """
    runs = {
        node.label: {
            "key": node.key,
            "settings": node.run.model_dump(mode="json"),
            "source": node.source_key,
        }
        for node in sweep.plan.nodes
    }
    document = {"algorithm": ALGORITHM_VERSION, "runs": runs, "searched": _searched(sweep)}
    keep(sweep, SETTINGS, json.dumps(document, indent=1))


def _searched(sweep: OpenSweep) -> dict[str, dict[str, Any]]:
    """Settings that no search chooses, by stage and task, of stages that trials alone compute."""
    planned = {node.stage for node in sweep.plan.nodes if not node.part}
    return {
        stage.name: {
            task: run.model_dump(mode="json") for task, run in stage.points[0].runs.items()
        }
        for stage in sweep.config.stages
        if stage.name not in planned
    }


def _changed_searches(
    sweep: OpenSweep, before: Mapping[str, Any], planned: Iterable[str]
) -> Iterator[tuple[str, dict[str, None]]]:
    """Stages of which trials' runs would be others, and how they differ from before.

    What a search chooses or compares may be in its space now and not have been: new trials.
    `planned` are the stages of which other runs have changed.
    """
    chosen = [
        name if ":" in name else f"{stage.name}:{name}"
        for stage in sweep.config.stages
        if stage.search is not None
        for name in (*stage.search.space, *stage.search.compare)
    ]
    now = _searched(sweep)
    changed = [*planned]
    for stage in sweep.config.stages:
        after, earlier = now.get(stage.name), before.get(stage.name)
        if after is None or earlier is None:
            continue
        lines = {
            line: None
            for task in after.keys() & earlier.keys()
            for line in _differences(earlier[task], after[task])
            if not any(f"{stage.name}:{line}".startswith((f"{one}:", f"{one}.")) for one in chosen)
        }
        if lines or (stage.source and stage.source.stage in changed):
            changed.append(stage.name)
            yield stage.name, lines


def changes_since(sweep: OpenSweep) -> Changes | None:
    """What the last run of this sweep computed and this one does not use; None: nothing.

    Runs that are new, or that are not in the plan any more, do not count.

    Raises:
        StorageError: The record of the last run can't be read.
    """
    try:
        before = read(sweep.storage, f"{sweep.config.name}/{SETTINGS}")
        runs: Mapping[str, Any] = before["runs"]
        algorithm = before["algorithm"]
    except (KeyError, TypeError):
        return None  # the first run of the sweep
    keys = {node.key for node in sweep.plan.nodes}
    short = ShortLabels.of(node.label for node in sweep.plan.nodes)
    counts: Counter[str] = Counter()
    lost = []
    changed_stages: set[str] = set()
    for node in sweep.plan.nodes:
        old = runs.get(node.label)
        if old is None or old["key"] == node.key or old["key"] in keys:
            continue
        differences = list(_differences(old["settings"], node.run.model_dump(mode="json")))
        is_longer = (
            len(differences) == 1
            and old["source"] == node.source_key
            and old["settings"]["env_steps"] < node.run.env_steps
        )
        if is_longer and continued_from(sweep.store, node) is not None:
            continue
        counts.update(differences)
        changed_stages.add(node.stage)
        if (progress := _progress(sweep.store, old["key"])) is not None:
            why = _why_not_longer(node) if is_longer and progress == FINISHED else ""
            lost.append(f"{short(node.label)}: {progress}{why}")
    trials = read(sweep.storage, f"{sweep.config.name}/{PLAN}") or {"nodes": []}
    for stage, changed in _changed_searches(sweep, before.get("searched", {}), changed_stages):
        for old in trials["nodes"]:
            if not old["label"].startswith(f"{stage}/") or old["key"] in keys:
                continue
            if (progress := _progress(sweep.store, old["key"])) is not None:
                counts.update(changed.keys())
                lost.append(f"{old['label']}: {progress}")
    if not lost:
        return None
    lines = [f"{line} ({in_runs(count)})" for line, count in counts.items()]
    if algorithm != ALGORITHM_VERSION:
        lines.append(f"version of the algorithm: {algorithm} -> {ALGORITHM_VERSION}")
    return Changes(
        name=sweep.plan.name,
        differences=tuple(lines or ["what it starts from"]),
        lost=tuple(lost),
    )


def longer(sweep: OpenSweep) -> list[str]:
    """A line about runs that continue finished ones with fewer `env_steps`, if there are any."""
    if not sweep.store.has_continuations():
        return []
    left = [node for node in sweep.plan.nodes if node.key not in sweep.finished]
    steps = [done for node in left if (done := continued_from(sweep.store, node)) is not None]
    if not steps:
        return []
    go = "goes" if len(steps) == 1 else "go"
    return [
        f"{in_runs(len(steps))} {go} on from the end of a finished one with fewer env_steps: "
        f"{sum(steps):,} env steps less to train."
    ]


def _why_not_longer(node: Node) -> str:
    """Why a run with more `env_steps` does not continue from the end of the shorter one."""
    if settings := budget_settings(node.run):
        return f"; {' and '.join(settings)} would have had other values with the new env_steps"
    return (
        "; it has kept no checkpoint of its end (checkpoints.finished_mb; or its env_steps were no "
        "multiple of evaluation.interval and of 1,000)"
    )


def _progress(store: NodeStore, key: str) -> str | None:
    """How far a run is, in words; None where nothing of it is kept."""
    if store.is_finished(key):
        return FINISHED
    checkpoints = store.work_folder(key).names()
    return f"is at {steps_of(checkpoints[-1]):,} env steps" if checkpoints else None


def _differences(before: Any, after: Any) -> Iterator[str]:
    for place, old, new in differences(before, after):
        if tuple(place.split(".")) not in RETIRED:
            yield f"{place}: {json.dumps(old)} -> {json.dumps(new)}"
