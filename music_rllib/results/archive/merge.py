"""Merging of exports: the runs of several sittings, machines and sweeps as one sweep."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from music_rllib import names
from music_rllib.experiment.plan import Node, Plan
from music_rllib.results.claims.plan import PlanVersion
from music_rllib.results.data import Column, History, RunRecord, Sweep, joined

_Place = tuple[Sweep, int]
"""An export that has a run, and the run's position in it."""


def merged(earlier: Sweep, later: Sweep) -> Sweep:
    """Every run of either export; of a run that both have, the finished one, or else the later one.

    Runs are the same where their node key is: the hash of everything that determines their numbers.
    The sweep's own fields are those of `later`, searches those of the last export to have any.
    """
    places = list(_best([earlier, later]).values())
    return replace(
        later,
        runs=[_run(place) for place in places],
        history=_history(places),
        searches=later.searches or earlier.searches,
        plans=_plans([earlier, later]),
    )


def of_plan(plan: Plan, exports: Iterable[Sweep], *earlier: Plan) -> Sweep | None:
    """The runs of a plan that any export has, whichever sweep has computed them.

    A run is that of the plan's node with its key: the same settings, seed and source, under
    whatever names. It gets the plan's name for it, and the plan's order. The sweep's own fields are
    those of the last export that has a run.

    Args:
        plan: The plan.
        exports: The exports that are searched.
        earlier: The same plan under earlier versions of the algorithm, for runs that have not been
            made since. A run's source is of the version that the run started from.

    Returns:
        None where no export has any of its runs.
    """
    exports = list(exports)
    best = _best(exports)
    versions = (plan, *earlier)
    found: list[tuple[Plan, Node]] = []
    sources: set[str | None] = set()
    # A run has the same position in each plan, and its source comes before it.
    for nodes in reversed(list(zip(*(version.nodes for version in versions), strict=True))):
        known = [pair for pair in zip(versions, nodes, strict=True) if pair[1].key in best]
        if known:
            found.append(min(known, key=lambda pair: pair[1].key not in sources))
            sources.add(found[-1][1].source_key)
    runs, places = [], []
    for version, node in reversed(found):
        places.append(best[node.key])
        run = _run(best[node.key])
        own = {
            names.TAG_SWEEP: plan.name,
            names.TAG_STAGE: node.stage,
            names.TAG_ALGORITHM: version.algorithm,
            names.TAG_TRIAL: str(node.trial),
        }
        runs.append(replace(run, name=node.label, tags={**run.tags, **own}))
    if not runs:
        return None
    return replace(
        places[-1][0],
        name=plan.name,
        runs=runs,
        history=_history(places),
        searches=(),
        plans=_plans(sweep for sweep in exports if sweep.name == plan.name),
    )


def _plans(sweeps: Iterable[Sweep]) -> tuple[PlanVersion, ...]:
    """Every version of a plan once, as recorded first, without later ones for fewer seeds."""
    kept: list[PlanVersion] = []
    versions = (version for sweep in sweeps for version in sweep.plans)
    for version in sorted(versions, key=lambda version: version.recorded_ms):
        if not any(version.plan.is_part_of(earlier.plan) for earlier in kept):
            kept.append(version)
    return tuple(kept)


def _run(place: _Place) -> RunRecord:
    sweep, position = place
    return sweep.runs[position]


def _best(sweeps: Iterable[Sweep]) -> dict[str, _Place]:
    """The last finished run of each node key, or else the last run, in the keys' first order."""
    best: dict[str, _Place] = {}
    for sweep in sweeps:
        for position, run in enumerate(sweep.runs):
            before = best.get(run.node_key)
            if before is None or run.is_finished or not _run(before).is_finished:
                best[run.node_key] = (sweep, position)
    return best


def _history(places: Sequence[_Place]) -> History:
    """The metrics of the runs at `places`, numbered in that order."""
    parts: defaultdict[str, list[Column]] = defaultdict(list)
    for number, (sweep, position) in enumerate(places):
        for metric in sweep.history:
            part = sweep.column(position, metric)
            if len(part.run):
                parts[metric].append(replace(part, run=np.full_like(part.run, number)))
    return {metric: joined(parts[metric]) for metric in sorted(parts)}
