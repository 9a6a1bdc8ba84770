"""Sweeps of tune_configs and their exported runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

from music_rllib import names
from music_rllib.config.load import load_config
from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.plan import Node, Plan, make_plan
from music_rllib.results.archive import (
    best_records,
    is_archive,
    plan_versions,
    read_archive,
)
from music_rllib.results.data import Sweep, history_of
from music_rllib.version import ALGORITHM_VERSION

ROOT = Path(__file__).parents[2]
DATA, CONFIGS = ROOT / "docs" / "results" / "data", ROOT / "tune_configs"
EARLIER = tuple(str(version) for version in range(int(ALGORITHM_VERSION) - 1, 1, -1))
"""Earlier versions of the algorithm, the latest first; their runs replace missing ones."""


@cache
def sweep_called(name: str) -> Sweep | None:
    """The exported runs of a sweep; None without any."""
    config = config_of(name)
    if config is not None and not (plan := make_plan(config)).searched:
        earlier = [make_plan(config, algorithm=version) for version in EARLIER]
        return of_plan(plan, exports(), *earlier)
    return read_archive(DATA / name) if is_archive(DATA / name) else None


@cache
def config_of(name: str) -> SweepConfig | None:
    """The sweep of this name in tune_configs, or None."""
    files = sorted(CONFIGS.glob("**/*.yaml"))
    found = (file for file in files if f"name: {name}\n" in file.read_text("utf-8"))
    file = next(found, None)
    return load_config(file) if file else None


@cache
def exports() -> list[Sweep]:
    """All exports."""
    return [read_archive(folder) for folder in sorted(DATA.iterdir()) if is_archive(folder)]


def progress(sweep: Sweep) -> tuple[int, int]:
    """Numbers of finished and of planned runs."""
    config = config_of(sweep.name)
    planned = len(make_plan(config).nodes) if config else len(sweep.runs)
    return sum(run.status == "FINISHED" for run in sweep.runs), planned


def is_complete(sweep: Sweep) -> bool:
    """Whether every planned run has finished."""
    finished, planned = progress(sweep)
    return finished == planned


def progress_text(name: str) -> str:
    """Progress of a sweep of tune_configs, in words."""
    sweep = sweep_called(name)
    if sweep is None:
        return "not started"
    finished, planned = progress(sweep)
    return f"{'complete' if is_complete(sweep) else 'running'}, {finished} of {planned} runs"


def hours_text(name: str) -> str:
    """Sum of the wall times of a sweep's runs in hours."""
    sweep = sweep_called(name)
    return f"{sum(run.seconds or 0.0 for run in sweep.runs) / 3600:.1f}" if sweep else "0"


def of_plan(plan: Plan, exports: Iterable[Sweep], *earlier: Plan) -> Sweep | None:
    """The runs of a plan that any export has, whichever sweep trained them.

    A run belongs to the node of the plan that has its key: the same settings, seed and source. It
    gets the plan's name for it, and the plan's order. The fields of the sweep come from the last
    export that has a run.

    Args:
        plan: The plan.
        exports: The exports to search.
        earlier: The same plan under earlier versions of the algorithm, for runs that have not been
            trained since. The source of a run has the version that the run started from.

    Returns:
        None if no export has any of the runs.
    """
    exports = list(exports)
    best = best_records(one.having(lambda run: run.status != "SCHEDULED") for one in exports)
    versions = (plan, *earlier)
    found: list[tuple[Plan, Node]] = []
    sources: set[str | None] = set()
    # A run has the same position in each plan, after its source.
    for nodes in reversed(list(zip(*(version.nodes for version in versions), strict=True))):
        known = [pair for pair in zip(versions, nodes, strict=True) if pair[1].key in best]
        if known:
            found.append(min(known, key=lambda pair: pair[1].key not in sources))
            sources.add(found[-1][1].source_key)
    runs, places = [], []
    for version, node in reversed(found):
        sweep, position = best[node.key]
        places.append((sweep, position))
        run = sweep.runs[position]
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
        history=history_of(places),
        searches=(),
        plans=plan_versions(sweep for sweep in exports if sweep.name == plan.name),
    )
