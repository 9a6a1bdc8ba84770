"""A sweep read from its storage, as it would be read from MLflow."""

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
"""Outcome of a sweep's driver to the status in MLflow."""


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
    sweep = results_of(opened)
    return replace(
        sweep,
        status=_STATUS.get(state["driver"]["outcome"], "RUNNING"),
        source=redact(found.storage),
        config=opened.config.text,
        runs=[
            run  # it may have been finished since it failed
            if run.is_finished or run.name not in failures
            else replace(
                run, status="FAILED", tags={**run.tags, names.TAG_FAILURE: failures[run.name]}
            )
            for run in sweep.runs
        ],
    )


def results_of(sweep: session.Sweep, metrics: Collection[str] | None = None) -> Sweep:
    """The runs of a sweep; the finished ones with these metrics, or with all.

    Raises:
        DamagedError: A run has no readable history.
        StorageError: The analysis plan can't be read.
    """
    nodes, finished = sweep.plan.nodes, sweep.finished
    histories = [sweep.store.history(node.key) if node.key in finished else [] for node in nodes]
    return Sweep(
        name=sweep.config.name,
        runs=[_record(node, history) for node, history in zip(nodes, histories, strict=True)],
        history=columns(
            _points(history, run_info(node).settings, metrics)
            for node, history in zip(nodes, histories, strict=True)
        ),
        plans=plans_in(sweep.storage, sweep.config.name),
    )


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
    """The values of a run's reports and, at step 0, those of its settings."""
    began = min((report.timestamp_ms for report in history), default=0)
    logged = [(name, 0, began, value) for name, value in settings.items() if history]
    logged += [
        (metric, report.env_steps, report.timestamp_ms, value)
        for report in history
        for metric, value in report.metrics.items()
    ]
    rows = sorted(row for row in logged if metrics is None or row[0] in metrics)
    return Points(*zip(*rows, strict=True)) if rows else Points((), (), (), ())
