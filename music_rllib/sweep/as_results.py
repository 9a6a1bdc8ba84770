"""What a storage holds of a sweep, as `results` takes it; it is what MLflow has."""

from __future__ import annotations

from collections.abc import Collection

from music_rllib import names
from music_rllib.experiment.plan import Node
from music_rllib.experiment.session import Sweep
from music_rllib.redaction import flat_params
from music_rllib.results.claims.record import plans_in
from music_rllib.results.data import Points, RunRecord, columns
from music_rllib.results.data import Sweep as Results
from music_rllib.store.run_record import Report
from music_rllib.sweep.listeners.mlflow import run_info

__all__ = ["results_of"]


def results_of(sweep: Sweep, metrics: Collection[str]) -> Results:
    """Its runs, the finished ones with these metrics.

    Raises:
        DamagedError: A run has no readable history.
        StorageError: Its plan can't be read.
    """
    nodes, finished = sweep.plan.nodes, sweep.finished
    histories = [sweep.store.history(node.key) if node.key in finished else [] for node in nodes]
    return Results(
        name=sweep.config.name,
        status="",
        run_id="",
        experiment_id="",
        started=None,
        source="",
        tags={},
        config=None,
        runs=[_record(node, found) for node, found in zip(nodes, histories, strict=True)],
        history=columns(_points(found, metrics) for found in histories),
        plans=plans_in(sweep.storage, sweep.config.name),
    )


def _record(node: Node, history: list[Report]) -> RunRecord:
    info = run_info(node)
    times = [report.timestamp_ms for report in history]
    return RunRecord(
        run_id=node.key,
        name=node.label,
        status="FINISHED" if history else "SCHEDULED",
        started=min(times, default=None),
        ended=max(times, default=None),
        params=flat_params(info.config),
        tags={
            names.TAG_NODE_KEY: node.key,
            **{name: str(value) for name, value in info.tags.items() if value is not None},
        },
    )


def _points(history: list[Report], metrics: Collection[str]) -> Points:
    rows = sorted(
        (metric, report.env_steps, report.timestamp_ms, value)
        for report in history
        for metric, value in report.metrics.items()
        if metric in metrics
    )
    named, steps, times, values = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Points(list(named), list(steps), list(times), list(values))
