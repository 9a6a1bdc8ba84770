"""Longer training continues from the end of a run with a smaller budget."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import BaseModel

from music_rllib.config.run_settings import RunSettings
from music_rllib.experiment.plan import Node, node_key
from music_rllib.schedules import Linear
from music_rllib.store.node_store import NodeStore
from music_rllib.store.work_folder import steps_of

REPORT_INTERVAL = 1_000
"""Environment steps between two reports, where evaluations are not more frequent."""


def continuation_key(run: RunSettings, source: str | None) -> str:
    """Key that all runs share which differ in their budget alone."""
    return node_key(run.model_copy(update={"env_steps": 0}), source)


def budget_settings(run: RunSettings) -> list[str]:
    """Dotted settings whose value at a step depends on the budget: linear schedules."""
    return [
        f"{section}.{name}"
        for section in ("tac", "music", "replay")
        for name, value in getattr(run, section)
        if any(isinstance(inner, Linear) for inner in _values(value))
    ]


def _values(value: object) -> Iterator[object]:
    yield value
    if isinstance(value, BaseModel):
        for _, inner in value:
            yield from _values(inner)


def is_continuable(run: RunSettings) -> bool:
    """Whether a longer run passes through the very state in which this one ends.

    It does not where a schedule spans the budget, nor where the last evaluation or report is due
    only because the budget ends.
    """
    interval = run.evaluation.interval
    even = not run.env_steps % interval and not run.env_steps % min(interval, REPORT_INTERVAL)
    return even and not budget_settings(run)


def continued_from(store: NodeStore, node: Node) -> int | None:
    """Environment steps of the shorter run from whose end `node` would continue; None: of none."""
    if budget_settings(node.run):
        return None
    key = continuation_key(node.run, node.source_key)
    steps = [steps_of(name) for name in store.continuation(key).names()]
    return max((count for count in steps if count < node.run.env_steps), default=None)
