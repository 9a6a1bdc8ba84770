"""Runs of a plan as a `Sweep`, from their last values alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from music_rllib import names
from music_rllib.experiment.plan import Node, Plan
from music_rllib.experiment.run_info import run_info
from music_rllib.redaction import flat_params
from music_rllib.results.data import Points, RunRecord, Sweep, columns
from music_rllib.store.history import RunResult


def planned_run(node: Node, algorithm: str) -> RunRecord:
    """A run that has not started."""
    info = run_info(node)
    tags = {**info.tags, names.TAG_NODE_KEY: node.key, names.TAG_ALGORITHM: algorithm}
    return RunRecord(
        run_id=node.key,
        name=node.label,
        status="SCHEDULED",
        params=flat_params(info.config),
        tags={name: str(value) for name, value in tags.items() if value is not None},
    )


class LastValues:
    """Sweeps with the last values of a plan's runs, without their curves."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._runs: dict[str, RunRecord] = {}
        """Cached runs by node key: describing a run is the expensive part."""

    def sweep(self, results: Mapping[str, RunResult]) -> Sweep:
        """The runs that are planned so far, with `results` by node key."""
        nodes = self._plan.nodes
        for node in nodes:
            if node.key not in self._runs:
                self._runs[node.key] = planned_run(node, self._plan.algorithm)
        return Sweep(
            name=self._plan.name,
            runs=[
                replace(run, status="FINISHED") if node.key in results else run
                for node in nodes
                for run in [self._runs[node.key]]
            ],
            history=columns(_last_points(results.get(node.key)) for node in nodes),
        )


def _last_points(result: RunResult | None) -> Points:
    if result is None:
        return Points((), (), (), ())
    values = [result.metrics[name] for name in sorted(result.metrics)]
    steps = [result.env_steps] * len(values)
    return Points(sorted(result.metrics), steps, [0] * len(values), values)
