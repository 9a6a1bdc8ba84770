"""Runs that a sweep had in an earlier version of its plan, and that it does not have any more.

They stay in the storage, and `plan.json` keeps their keys, so that they can be named. They are not
part of the sweep: nothing compares them. A plan that has them again takes them back.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from music_rllib.experiment.plan import Plan
from music_rllib.experiment.sweep_files import PLAN, SETTINGS, read
from music_rllib.labels import in_runs

MOST_REASONS = 4
"""Largest number of reasons in a sentence."""
MOST_SETTINGS = 3
"""Largest number of settings in a reason."""


def earlier_runs(plan: Plan, storage: str) -> list[dict[str, Any]]:
    """The runs in the sweep's `plan.json` that `plan` does not have, for the next `plan.json`.

    Returns:
        `key`, `label` and `why` of each run: the settings that it has and the plan does not.

    Raises:
        StorageError: The files of the sweep can't be read.
    """
    recorded = read(storage, f"{plan.name}/{PLAN}") or {"nodes": []}
    known = {one["key"]: one for one in (*recorded["nodes"], *recorded.get("earlier", ()))}
    gone = known.keys() - {node.key for node in plan.nodes}
    settings = (read(storage, f"{plan.name}/{SETTINGS}") or {}) if gone else {}
    return [
        {"key": key, "label": one["label"], "why": one.get("why") or _why(one, plan, settings)}
        for key, one in known.items()
        if key in gone
    ]


def earlier_text(earlier: Iterable[Mapping[str, Any]]) -> str | None:
    """A sentence about runs of earlier plans; None if there are none."""
    counts = Counter(one["why"] for one in earlier)
    if not counts:
        return None
    reasons = [
        f"{why} ({in_runs(number)})" if len(counts) > 1 else why
        for why, number in counts.most_common(MOST_REASONS)
    ]
    if len(counts) > MOST_REASONS:
        reasons.append(f"{len(counts) - MOST_REASONS} other reasons")
    number = counts.total()
    return (
        f"{in_runs(number)} of an earlier version of this sweep {'is' if number == 1 else 'are'} "
        f"not shown: {'; '.join(reasons)}."
    )


def differences(before: Any, after: Any, place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Dotted name, old and new value of each setting that differs."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in before | after:
            inner = f"{place}.{key}" if place else str(key)
            yield from differences(before.get(key), after.get(key), inner)
    elif before != after:
        yield place, before, after


def _why(old: Mapping[str, Any], plan: Plan, settings: Mapping[str, Any]) -> str:
    """What an earlier run has that the plan does not have.

    Args:
        old: The run in `plan.json`.
        plan: The present plan.
        settings: The content of `settings.json`, which may be of the plan that the run is from.
    """
    same = next((node for node in plan.nodes if node.label == old["label"]), None)
    if same is None:
        return _why_label(old["label"], plan)
    before = settings.get("runs", {}).get(old["label"], {})
    if before.get("key") == old["key"]:
        changed = differences(before["settings"], same.run.model_dump(mode="json"))
        texts = [f"{place} = {json.dumps(value)}" for place, value, _ in changed]
        if len(texts) > MOST_SETTINGS:
            texts[MOST_SETTINGS:] = ["..."]
        if texts:
            return ", ".join(texts)
        if settings.get("algorithm") != plan.algorithm:
            return f"version {settings.get('algorithm')} of the algorithm"
    elif old.get("env_steps", same.run.env_steps) != same.run.env_steps:
        return f"env_steps = {old['env_steps']}"
    return "trained from another source"


def _why_label(label: str, plan: Plan) -> str:
    """The part of an earlier run's label that no run of the plan has."""
    stage, *middle, seed = label.split("/")
    rest = "/".join(middle)
    own = [run for run in plan.runs if run.stage == stage]
    if not own:
        in_search = any(one.name == stage for one in plan.searched)
        return f"other trials of {stage}" if in_search else f"stage = {stage}"
    if seed not in {f"seed{run.seed}" for run in own}:
        return f"seed = {seed.removeprefix('seed')}"
    tasks = dict.fromkeys(run.task for run in own)
    task = next((name for name in tasks if f"{rest}/".startswith(f"{name}/")), None)
    if task is None:
        return f"task = {rest.partition('/')[0]}"
    values = rest.removeprefix(task).strip("/")
    if any(one.name == stage for one in plan.searched):
        return f"other trials of {stage}"
    return values.replace("=", " = ").replace(",", ", ") or "other settings"
