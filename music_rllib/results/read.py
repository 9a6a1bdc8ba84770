"""Read the runs, curves and searches of a sweep from its storage or from an export.

A sweep is its current plan: every command and page reads it here and shows the same runs. Runs of
earlier versions of the plan are not read; a sentence names them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from pydantic_core import from_json

from music_rllib import names
from music_rllib.config.schema import SweepConfig
from music_rllib.config.yaml_file import Dumper
from music_rllib.envs.fingerprint import digest_of
from music_rllib.errors import reason_of
from music_rllib.experiment import sweep_files
from music_rllib.experiment.open_sweep import OpenSweep, open_started
from music_rllib.experiment.plan import Node
from music_rllib.experiment.record import earlier_text, results_of_other_budgets
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
    folder = folder_at(place) if storage is None or "/" in place else None
    if folder is not None and is_archive(folder):
        sweep = read_archive(folder)
        if metrics is not None:
            own = {name: column for name, column in sweep.history.items() if name in metrics}
            sweep = replace(sweep, history=own)
        return SweepRead(sweep=sweep, folder=folder)
    location = find_sweep(place, None if "/" in place else storage)
    return read_stored(location, metrics=metrics, lenient=lenient)


def read_stored(
    location: SweepLocation, *, metrics: Collection[str] | None = None, lenient: bool = False
) -> SweepRead:
    """Read a sweep from its storage; see :func:`read_sweep`."""
    metrics = None if metrics is None else frozenset(metrics)
    opened = open_started(location, lenient=lenient)
    state = location.read(sweep_files.STATE) or _NOT_STARTED
    found = list(opened.store.map(_reader(opened, state, metrics, lenient), opened.plan.nodes))
    runs = [one.record for one in found]
    damage = {one.record.name: one.damage for one in found if one.damage is not None}
    configuration = location.read(sweep_files.CONFIG)
    sweep = Sweep(
        name=location.name,
        status=_status(state),
        started=min((run.started for run in runs if run.started is not None), default=None),
        source=redact(opened.storage),
        tags=next((one.provenance for one in reversed(found) if one.provenance), {}),
        config=yaml.dump(
            configuration, Dumper=Dumper, sort_keys=False, allow_unicode=True, width=math.inf
        ),
        runs=runs,
        history=columns(one.points for one in found),
        searches=searches_of(location, opened.config),
        plans=plans_in(location.storage, location.name),
        earlier=earlier_text(location),
    )
    return SweepRead(
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
        # A driver that was killed has not replaced `search.json`.
        newer = {
            stage: search
            for stage, search in now.items()
            if not search["complete"] or _trials(search) != _trials(ended.get(stage, search))
        }
        known = now | ended | newer
        return checked_searches(
            [known[stage.name] for stage in config.stages if stage.search and stage.name in known]
        )
    except (ValueError, TypeError, KeyError) as error:
        raise StorageError(
            f"{location.place}/{sweep_files.SEARCH} must hold the results of searches as "
            f"the driver writes them: {reason_of(error)}"
        ) from error


def _trials(search: Mapping[str, Any]) -> list[Any]:
    """The studies of a search with their numbers of trials, and its ranked trials."""
    studies = [(arm["study"], len(arm["trials"])) for arm in search["arms"]]
    ranked = [row for row in search["ranking"] if "failure" not in row]
    return [*studies, sorted((row["trial"], str(row["values"])) for row in ranked)]


_NOT_STARTED: dict[str, Any] = {
    "driver": {"outcome": "waiting", "ended": 0.0},
    "failures": (),
    "searches": (),
}


def _status(state: Mapping[str, Any]) -> str:
    if sweep_files.is_alive(state):
        return "RUNNING"
    ended = {"finished": "FINISHED", "failed": "FAILED", "waiting": "SCHEDULED"}
    return ended.get(state["driver"]["outcome"], "KILLED")


class _Run(NamedTuple):
    """A run of the plan with everything that the storage has of it."""

    record: RunRecord
    points: Points = Points()
    provenance: Mapping[str, str] = {}
    damage: DamagedError | None = None


def _reader(
    opened: OpenSweep, state: Mapping[str, Any], metrics: Collection[str] | None, lenient: bool
) -> Callable[[Node], _Run]:
    """The function that reads a run; an unfinished one up to its last checkpoint."""
    store, begun = opened.store, opened.store.begun()
    damaged, causes = store.damage(opened.damaged), _causes(opened, state)
    is_alive, pruned = sweep_files.is_alive(state), state.get("pruned", ())
    shown = results_of_other_budgets(opened)

    def read(node: Node) -> _Run:
        run = planned_run(node, opened.plan.algorithm)
        if node.key in shown:
            run = replace(run, tags={**run.tags, **shown[node.key]})
        try:
            if node.key in damaged:
                raise damaged[node.key]
            if opened.is_finished(node.key):
                lines, provenance, environment = store.lines(node.key)
                if environment is not None:
                    provenance[names.TAG_ENVIRONMENT] = digest_of(environment)
                run = replace(run, status="FINISHED", tags={**provenance, **run.tags})
                return _Run(*_with_history(run, node, lines, metrics), provenance)
        except DamagedError as error:
            if not lenient:
                raise
            # Not FAILED, which has the worst score: the run has a result that can't be read.
            run = replace(run, status="KILLED", tags={**run.tags, names.TAG_FAILURE: str(error)})
            return _Run(run, damage=error)
        if node.key in pruned:
            run = replace(run, tags={**run.tags, names.TAG_PRUNED: "by the search"})
        if (cause := causes.get(node.key)) is not None:
            run = replace(run, status="FAILED", tags={**run.tags, names.TAG_FAILURE: cause})
        elif node.key in begun or node.key in pruned:
            is_running = is_alive and node.key not in pruned
            run = replace(run, status="RUNNING" if is_running else "KILLED")
        if node.key not in begun:
            return _Run(run)
        return _Run(*_with_history(run, node, store.work_folder(node.key).lines(), metrics))

    return read


def _with_history(
    run: RunRecord, node: Node, lines: bytes, metrics: Collection[str] | None
) -> tuple[RunRecord, Points]:
    """Parse the `history.jsonl` of a run; its settings count as values at step 0.

    Raises:
        DamagedError: The lines are not reports.
    """
    try:
        # Parsing line by line, or with a model of the fields, would be several times slower.
        reports = from_json(b"[%s]" % b",".join(lines.splitlines()))
        if not reports:
            return run, Points()
        times = [report["timestamp_ms"] for report in reports]
        began = round(times[0] - 1000 * reports[0]["seconds"])
        measured = [(0, began, run_info(node).settings)]
        for report in reports:
            values = {**report["metrics"], names.SYSTEM_SECONDS: report["seconds"]}
            measured.append((report["env_steps"], report["timestamp_ms"], values))
        rows = [
            (name, step, time, value)
            for step, time, values in measured
            for name, value in values.items()
            if metrics is None or name in metrics
        ]
        points = Points(
            [name for name, *_ in rows],
            np.array([step for _, step, *_ in rows], np.int64),
            np.array([time for *_, time, _ in rows], np.int64),
            np.array([value for *_, value in rows], np.float64),
        )
        seconds = float(reports[-1]["seconds"])
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DamagedError(f"the history of {node.label} must hold reports: {error}") from error
    return replace(run, started=began, ended=max(times), trained_seconds=seconds), points


def _causes(opened: OpenSweep, state: Mapping[str, Any]) -> dict[str, str]:
    """Node key to cause, for runs that failed and for runs whose source failed."""
    failed = {failure["run"]: failure["cause"] for failure in state["failures"]}
    causes: dict[str, str] = {}
    for node in opened.plan.nodes:  # a source precedes the runs that start from it
        cause = failed.get(node.label) or causes.get(node.source_key or "")
        if cause is not None and not opened.is_finished(node.key):
            causes[node.key] = cause
    return causes
