"""What a storage holds of a sweep, as `results` takes it; it is what MLflow has."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from music_rllib import names
from music_rllib.experiment import session, sweep_files
from music_rllib.experiment.location import find_sweep
from music_rllib.experiment.plan import Node
from music_rllib.experiment.run_info import run_info
from music_rllib.redaction import flat_params, redact
from music_rllib.results.claims.record import plans_in
from music_rllib.results.data import Points, RunRecord, Sweep, columns
from music_rllib.store.run_record import Report

_STATUS = {"finished": "FINISHED", "stopped": "KILLED", "failed": "FAILED"}
"""A sweep's, as MLflow calls them."""


def read_storage(place: str, storage: str) -> Sweep:
    """Read the sweep that `place` names: its folder, its name in `storage`, or its YAML file.

    Runs that are not finished are `FAILED` or `SCHEDULED`, and have no curves.

    Raises:
        BadInputError: There is no such sweep.
        StorageError: The storage can't be read, or finished runs in it are damaged.
    """
    found = find_sweep(place, None if "/" in place else storage)
    opened = found.open()
    state = found.read(sweep_files.STATE) or {"driver": {"outcome": "running"}, "failures": ()}
    failures = {failure["run"]: failure["cause"] for failure in state["failures"]}
    read = results_of(opened)
    return replace(
        read,
        status=_STATUS.get(state["driver"]["outcome"], "RUNNING"),
        source=redact(found.storage),
        config=opened.config.text,
        runs=[
            _failed(run, failures[run.name]) if run.name in failures else run for run in read.runs
        ],
    )


def results_of(sweep: session.Sweep, metrics: Collection[str] | None = None) -> Sweep:
    """Its runs, the finished ones with these metrics, or all.

    Raises:
        DamagedError: A run has no readable history.
        StorageError: Its plan can't be read.
    """
    nodes, finished = sweep.plan.nodes, sweep.finished
    histories = [sweep.store.history(node.key) if node.key in finished else [] for node in nodes]
    return Sweep(
        name=sweep.config.name,
        status="",
        run_id="",
        experiment_id="",
        started=None,
        source="",
        tags={},
        config=None,
        runs=[_record(node, found) for node, found in zip(nodes, histories, strict=True)],
        history=columns(
            _points(found, run_info(node).settings, metrics)
            for node, found in zip(nodes, histories, strict=True)
        ),
        plans=plans_in(sweep.storage, sweep.config.name),
    )


def _failed(run: RunRecord, cause: str) -> RunRecord:
    """A run that failed, unless it has been finished since."""
    if run.status == "FINISHED":
        return run
    return replace(run, status="FAILED", tags={**run.tags, names.TAG_FAILURE: cause})


def _record(node: Node, history: list[Report]) -> RunRecord:
    info = run_info(node)
    times = [report.timestamp_ms for report in history]
    tags = {**info.tags, names.TAG_NODE_KEY: node.key}
    return RunRecord(
        run_id=node.key,
        name=node.label,
        status="FINISHED" if history else "SCHEDULED",
        started=min(times, default=None),
        ended=max(times, default=None),
        params=flat_params(info.config),
        tags={name: str(value) for name, value in tags.items() if value is not None},
    )


def _points(
    history: list[Report], settings: Mapping[str, float], metrics: Collection[str] | None
) -> Points:
    began = min((report.timestamp_ms for report in history), default=0)
    logged = [(name, 0, began, value) for name, value in settings.items() if history]
    logged += [
        (metric, report.env_steps, report.timestamp_ms, value)
        for report in history
        for metric, value in report.metrics.items()
    ]
    rows = sorted(row for row in logged if metrics is None or row[0] in metrics)
    named, steps, times, values = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Points(list(named), list(steps), list(times), list(values))
