"""Exports put together: what several sittings, machines and sweeps have computed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from music_rllib import names
from music_rllib.experiment.plan import Plan
from music_rllib.results.claims.plan import PlanVersion
from music_rllib.results.data import Column, History, Sweep, joined

FINISHED = "FINISHED"
_Place = tuple[Sweep, int]
"""A run: the export that has it, and its position there."""


def merged(earlier: Sweep, later: Sweep) -> Sweep:
    """Every run of either; of a run that both have, the finished one, or else the later one.

    Runs are the same where their node is: the hash of everything that determines their numbers.
    The sweep's own fields are those of `later`, what searches found that of the last to have any.
    """
    places = list(_best(_places(earlier) + _places(later)).values())
    runs = [sweep.runs[run] for sweep, run in places]
    searches = later.searches or earlier.searches
    history, plans = _history(places), _plans([earlier, later])
    return replace(later, runs=runs, history=history, searches=searches, plans=plans)


def of_plan(plan: Plan, exports: Iterable[Sweep], *earlier: Plan) -> Sweep | None:
    """What is known of a plan's runs, whichever sweep has computed them.

    A run is that of the plan's node with its key: the same settings, seed and source, under
    whatever names. It gets the plan's name for it, and the plan's order. The sweep's own fields are
    those of the last export that has a run.

    Args:
        plan: It.
        exports: Where to look.
        earlier: The same plan under earlier versions of the algorithm, for runs that have not been
            made since.

    Returns:
        None where no export has any of its runs.
    """
    exports = list(exports)
    found = _best([place for export in exports for place in _places(export)])
    # A run has the same position in each plan.
    versions = zip(*([(node, one) for node in one.nodes] for one in (plan, *earlier)), strict=True)
    known = [next((pair for pair in pairs if pair[0].key in found), None) for pairs in versions]
    nodes = [pair for pair in known if pair is not None]
    if not nodes:
        return None
    places = [found[node.key] for node, _ in nodes]
    runs = []
    for (node, version), (sweep, position) in zip(nodes, places, strict=True):
        run = sweep.runs[position]
        own = {names.TAG_SWEEP: plan.name, names.TAG_STAGE: node.stage}
        own[names.TAG_ALGORITHM] = version.algorithm
        tags = {**run.tags, **own, names.TAG_TRIAL: str(node.trial)}
        runs.append(replace(run, name=node.label, tags=tags))
    last = places[-1][0]
    plans = _plans([sweep for sweep in exports if sweep.name == plan.name])
    return replace(
        last, name=plan.name, runs=runs, history=_history(places), searches=(), plans=plans
    )


def _plans(sweeps: Iterable[Sweep]) -> tuple[PlanVersion, ...]:
    """Every version of a plan once, where it was recorded first."""
    known: dict[str, PlanVersion] = {}
    for version in sorted(
        (v for sweep in sweeps for v in sweep.plans), key=lambda v: v.recorded_ms
    ):
        known.setdefault(version.hash, version)
    return tuple(known.values())


def _places(sweep: Sweep) -> list[_Place]:
    return [(sweep, position) for position in range(len(sweep.runs))]


def _best(places: Iterable[_Place]) -> dict[str, _Place]:
    """By node key, in the order in which the keys first came."""
    best: dict[str, _Place] = {}
    for sweep, position in places:
        run = sweep.runs[position]
        before = best.get(run.node_key)
        if before is not None and run.status != FINISHED:
            other, its_position = before
            if other.runs[its_position].status == FINISHED:
                continue
        best[run.node_key] = (sweep, position)
    return best


def _history(places: Sequence[_Place]) -> History:
    """The metrics of the runs at `places`, numbered in that order."""
    parts: dict[str, list[Column]] = {}
    for number, (sweep, position) in enumerate(places):
        for metric, column in sweep.history.items():
            begin, end = np.searchsorted(column.run, [position, position + 1])
            if end > begin:
                part = Column(
                    run=np.full(end - begin, number, np.int64),
                    step=column.step[begin:end],
                    value=column.value[begin:end],
                    time=column.time[begin:end],
                )
                parts.setdefault(metric, []).append(part)
    return {metric: joined(parts[metric]) for metric in sorted(parts)}
