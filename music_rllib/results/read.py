"""Read the runs, curves and searches of a sweep from its storage or from an export.

A sweep is its current plan: every command and page reads it here and shows the same runs. Runs of
earlier versions of the plan are not read; a sentence names them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from pydantic_core import from_json

from music_rllib import names
from music_rllib.config.schema import SweepConfig
from music_rllib.envs.fingerprint import digest_of
from music_rllib.errors import first_line
from music_rllib.experiment import sweep_files
from music_rllib.experiment.open_sweep import OpenSweep, open_started
from music_rllib.experiment.plan import Node
from music_rllib.experiment.record import earlier_text
from music_rllib.experiment.run_info import run_info
from music_rllib.experiment.sweep_files import SweepLocation, find_sweep
from music_rllib.redaction import redact
from music_rllib.results.analysis_plan import plans_in
from music_rllib.results.archive import is_archive, read_archive
from music_rllib.results.data import (
    Points,
    RunRecord,
    Sweep,
    checked_searches,
    columns,
    planned_run,
)
from music_rllib.store.node_store import damage_in_words
from music_rllib.store.storage import DamagedError, StorageError, folder_at, sweep_folder


@dataclass(frozen=True, kw_only=True)
class SweepRead:
    """A sweep and the place it was read from."""

    sweep: Sweep
    folder: Path
    """Folder of the sweep on this machine, for its report."""
    opened: OpenSweep | None = None
    """The plan with its storage; None for an export."""
    damaged: str | None = None
    """A sentence about finished runs with damaged files; None if there are none."""


@dataclass(frozen=True, kw_only=True)
class StoredSweep(SweepRead):
    """A sweep that was read from its storage."""

    opened: OpenSweep


def read_sweep(
    place: str,
    storage: str | None = None,
    *,
    metrics: Collection[str] | None = None,
    lenient: bool = False,
) -> SweepRead:
    """Read the sweep that `place` names.

    Args:
        place: A sweep's folder or URI, an exported folder, a sweep's YAML file, or its name.
        storage: The storage in which a name is looked up; None: a folder, or `results`.
        metrics: The metrics to read; None for all.
        lenient: Whether to read a sweep with damaged runs; these count as unfinished.

    Raises:
        BadInputError: There is no such sweep.
        StorageError: The storage can't be read, or finished runs in it are damaged.
    """
    folder = folder_at(place)
    if folder is not None and is_archive(folder):
        return SweepRead(sweep=read_archive(folder), folder=folder)
    location = find_sweep(place, None if "/" in place else storage)
    return read_stored(location, metrics=metrics, lenient=lenient)


def read_stored(
    location: SweepLocation, *, metrics: Collection[str] | None = None, lenient: bool = False
) -> StoredSweep:
    """Read a sweep from its storage; see :func:`read_sweep`."""
    opened = open_started(location, lenient=lenient)
    state = location.read(sweep_files.STATE) or _NOT_STARTED
    runs = _read_runs(opened, metrics, lenient=lenient)
    pairs = list(zip(opened.plan.nodes, runs, strict=True))
    causes = _causes(opened, state)
    damage = {node.label: run.damage for node, run in pairs if run.damage is not None}
    provenance = [run.provenance for run in runs if run.provenance]
    configuration = location.read(sweep_files.CONFIG)
    sweep = Sweep(
        name=location.name,
        status=_status(state),
        started=min((run.started for run in runs if run.started is not None), default=None),
        source=redact(opened.storage),
        tags=provenance[-1] if provenance else {},
        config=yaml.safe_dump(configuration, sort_keys=False, allow_unicode=True),
        runs=[_record(node, run, opened.plan.algorithm, state, causes) for node, run in pairs],
        history=columns(run.points for run in runs),
        searches=searches_of(location, opened.config),
        plans=plans_in(location.storage, location.name),
        earlier=earlier_text(location),
    )
    return StoredSweep(
        sweep=sweep,
        folder=sweep_folder(location.storage, location.name),
        opened=opened,
        damaged=damage_in_words(damage) if damage else None,
    )


def searches_of(location: SweepLocation, config: SweepConfig) -> list[dict[str, Any]]:
    """The known outcome of each search of the current configuration.

    It comes from `search.json`, which has the ranking, unless the search was extended since.

    Raises:
        StorageError: A file does not have the content that the driver writes.
    """
    state = location.read(sweep_files.STATE) or _NOT_STARTED
    try:
        now = {search["stage"]: search for search in state["searches"]}
        ended = {search["stage"]: search for search in location.read(sweep_files.SEARCH) or ()}
        unfinished = {stage: search for stage, search in now.items() if not search["complete"]}
        known = now | ended | unfinished
        return checked_searches(
            [known[stage.name] for stage in config.stages if stage.search and stage.name in known]
        )
    except (ValueError, TypeError, KeyError) as error:
        raise StorageError(
            f"{location.place}/{sweep_files.SEARCH} must hold the results of searches as "
            f"the driver writes them: {first_line(error)}"
        ) from error


_NOT_STARTED: dict[str, Any] = {
    "driver": {"outcome": "waiting", "ended": 0.0},
    "failures": (),
    "searches": (),
}


def _status(state: Mapping[str, Any]) -> str:
    """The status of the whole sweep."""
    if sweep_files.is_alive(state):
        return "RUNNING"
    ended = {"finished": "FINISHED", "failed": "FAILED", "waiting": "SCHEDULED"}
    return ended.get(state["driver"]["outcome"], "KILLED")


class _Run(NamedTuple):
    """The stored part of a run."""

    points: Points = Points((), (), (), ())
    begun: bool = False
    finished: bool = False
    started: int | None = None
    ended: int | None = None
    seconds: float | None = None
    provenance: Mapping[str, str] = {}
    damage: DamagedError | None = None


def _read_runs(opened: OpenSweep, metrics: Collection[str] | None, *, lenient: bool) -> list[_Run]:
    """The runs of the plan, in its order; unfinished ones up to their last checkpoint."""
    store, finished, begun = opened.store, opened.finished, opened.store.begun()
    damaged = store.damage(opened.damaged)

    def read(node: Node) -> _Run:
        try:
            if node.key in damaged:
                raise damaged[node.key]
            if node.key in finished:
                lines, provenance, environment = store.lines(node.key)
                if environment is not None:
                    provenance[names.TAG_ENVIRONMENT] = digest_of(environment)
                run = _run(lines, node, metrics)
                return run._replace(finished=True, provenance=provenance)
        except DamagedError as error:
            if not lenient:
                raise
            return _Run(begun=True, damage=error)
        if node.key not in begun:
            return _Run()
        return _run(store.work_folder(node.key).lines(), node, metrics)

    return list(store.map(read, opened.plan.nodes))


def _run(lines: bytes, node: Node, metrics: Collection[str] | None) -> _Run:
    """Parse the `history.jsonl` of a run.

    Raises:
        DamagedError: The lines are not reports.
    """
    try:
        # Parsing line by line, or with a model of the fields, would be several times slower.
        reports = from_json(b"[%s]" % b",".join(lines.splitlines()))
        steps = [report["env_steps"] for report in reports]
        times = [report["timestamp_ms"] for report in reports]
        measured = [
            {**report["metrics"], names.SYSTEM_SECONDS: report["seconds"]} for report in reports
        ]
        began = round(times[0] - 1000 * reports[0]["seconds"]) if reports else 0
        settings = run_info(node).settings if reports else {}
        names_of_all = {name for values in measured for name in values} | settings.keys()
        order = sorted(names_of_all if metrics is None else names_of_all & set(metrics))
        at = {
            name: [-1]
            if name in settings
            else [number for number, values in enumerate(measured) if name in values]
            for name in order
        }
        values = [(measured[i] if i >= 0 else settings)[name] for name in order for i in at[name]]
        index = np.array([i for name in order for i in at[name]], dtype=np.int64)
        points = Points(
            [name for name in order for _ in at[name]],
            np.array([*steps, 0], dtype=np.int64)[index],
            np.array([*times, began], dtype=np.int64)[index],
            np.array(values, dtype=np.float64),
        )
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DamagedError(f"the history of {node.label} must hold reports: {error}") from error
    if not times:
        return _Run(points, begun=True)
    seconds = float(reports[-1]["seconds"])
    return _Run(points, begun=True, started=began, ended=max(times), seconds=seconds)


def _causes(opened: OpenSweep, state: Mapping[str, Any]) -> dict[str, str]:
    """Node key to cause, for runs that failed and for runs whose source failed."""
    failed = {failure["run"]: failure["cause"] for failure in state["failures"]}
    causes: dict[str, str] = {}
    for node in opened.plan.nodes:  # a source precedes the runs that start from it
        cause = failed.get(node.label) or causes.get(node.source_key or "")
        if cause is not None and node.key not in opened.finished:
            causes[node.key] = cause
    return causes


def _record(
    node: Node,
    run: _Run,
    algorithm: str,
    state: Mapping[str, Any],
    causes: Mapping[str, str],
) -> RunRecord:
    planned = planned_run(node, algorithm)
    tags = {**run.provenance, **planned.tags}
    cause = causes.get(node.key)
    if run.finished:
        status = "FINISHED"
    elif run.damage is not None:
        # Not FAILED, which has the worst score: the run has a result that can't be read.
        status, tags[names.TAG_FAILURE] = "KILLED", str(run.damage)
    elif cause is not None:
        status, tags[names.TAG_FAILURE] = "FAILED", cause
    elif not run.begun:
        status = "SCHEDULED"
    else:
        stopped = node.key in state.get("pruned", ()) or not sweep_files.is_alive(state)
        status = "KILLED" if stopped else "RUNNING"
    return replace(
        planned,
        status=status,
        started=run.started,
        ended=run.ended,
        trained_seconds=run.seconds,
        tags=tags,
    )
