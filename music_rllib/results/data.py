"""One sweep as a report sees it: its runs, and every metric as tidy columns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib import names
from music_rllib.errors import BadInputError
from music_rllib.results.claims.plan import PlanVersion
from music_rllib.results.statistics import Array

__all__ = [
    "Column",
    "History",
    "Points",
    "ReportError",
    "RunRecord",
    "Sweep",
    "columns",
    "joined",
]

Ints = NDArray[np.int64]


class ReportError(BadInputError):
    """There is nothing to report on; names the place and what to do."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """One metric of all runs; N values, sorted by run and step, each (run, step) once."""

    run: Ints
    """`[N]` positions in `Sweep.runs`."""
    step: Ints
    """`[N]` environment steps."""
    value: Array
    """`[N]`; may be NaN or infinite."""
    time: Ints
    """`[N]` ms since the epoch."""


History = Mapping[str, Column]
"""Metric name to column."""


class Points(NamedTuple):
    """Everything that one run logged, `[points]` each, sorted by metric and step."""

    metrics: Sequence[str]
    steps: Sequence[int] | Ints
    times: Sequence[int] | Ints
    values: Sequence[float] | Array


def columns(runs: Iterable[Points]) -> dict[str, Column]:
    """Columns from one `Points` per run, in the runs' order.

    Of several values of a metric at one step of a run, the one logged last counts.
    """
    parts: dict[str, list[Column]] = {}
    for position, points in enumerate(runs):
        steps, times = (np.asarray(part, dtype=np.int64) for part in points[1:3])
        values = np.asarray(points.values, dtype=np.float64)
        begin = 0
        for metric, count in Counter(points.metrics).items():
            part = np.arange(begin, begin + count)
            begin += count
            last = np.append(np.diff(steps[part]) != 0, True)
            if not last.all():
                part = part[np.lexsort((times[part], steps[part]))]
            chosen = part[last]
            parts.setdefault(metric, []).append(
                Column(
                    run=np.full(len(chosen), position, dtype=np.int64),
                    step=steps[chosen],
                    value=values[chosen],
                    time=times[chosen],
                )
            )
    return {metric: joined(found) for metric, found in parts.items()}


def joined(parts: Sequence[Column]) -> Column:
    """The values of one part after those of the other; at least one part."""
    return Column(
        run=np.concatenate([part.run for part in parts]),
        step=np.concatenate([part.step for part in parts]),
        value=np.concatenate([part.value for part in parts]),
        time=np.concatenate([part.time for part in parts]),
    )


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """One run of the sweep."""

    run_id: str
    """MLflow's."""
    name: str
    status: str
    """MLflow's: RUNNING, FINISHED, FAILED, KILLED, SCHEDULED."""
    started: int | None
    """ms since the epoch, as is `ended`."""
    ended: int | None
    params: Mapping[str, str] = field(repr=False)
    tags: Mapping[str, str] = field(repr=False)

    @property
    def node_key(self) -> str:
        return self.tags.get(names.TAG_NODE_KEY, "")

    @property
    def stage(self) -> str:
        return self.tags.get(names.TAG_STAGE, "")

    @property
    def variant(self) -> str:
        return self.tags.get(names.TAG_VARIANT, "")

    @property
    def task(self) -> str:
        return self.tags.get(names.TAG_TASK, "")

    @property
    def seed(self) -> str:
        return self.tags.get(names.TAG_SEED, "")

    @property
    def entropic_index(self) -> str:
        """In words: `1.5`, or `1 to 2` for a schedule."""
        return self.tags.get(names.TAG_ENTROPIC_INDEX, "")

    @property
    def failure(self) -> str | None:
        return self.tags.get(names.TAG_FAILURE)

    @property
    def budget(self) -> int | None:
        """Environment steps that it is to train for."""
        text = self.params.get("env_steps", "")
        return int(text) if text.isdecimal() and len(text) < 19 else None

    @property
    def seconds(self) -> float | None:
        """From its start to its end, pauses included."""
        if self.started is None or self.ended is None:
            return None
        return (self.ended - self.started) / 1000


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Everything that a report needs of one sweep."""

    name: str
    status: str
    """Of the sweep's own run in MLflow."""
    run_id: str
    experiment_id: str
    started: int | None
    source: str
    """Where MLflow keeps it: a URI without a password."""
    tags: Mapping[str, str] = field(repr=False)
    config: str | None = field(repr=False)
    """The configuration as YAML; None where it was not kept."""
    runs: Sequence[RunRecord] = field(repr=False)
    history: History = field(repr=False)
    searches: Sequence[Mapping[str, Any]] = field(default=(), repr=False)
    """What its searches found: trials, importance, ranking; as their driver keeps it."""
    plans: Sequence[PlanVersion] = field(default=(), repr=False)
    """Versions of its analysis plan, in the order of their times."""

    def series(self, run: int, metric: str) -> tuple[Ints, Array]:
        """Steps and values of a metric of `runs[run]`, `[points]` each; empty where it has none."""
        found = self.history.get(metric)
        if found is None:
            return np.empty(0, dtype=np.int64), np.empty(0)
        begin, end = np.searchsorted(found.run, [run, run + 1])
        return found.step[begin:end], found.value[begin:end]

    def finite(self, run: int, metric: str) -> tuple[Array, Array]:
        """`series` without NaN and infinities, steps as numbers."""
        steps, values = self.series(run, metric)
        there = np.isfinite(values)
        return steps[there].astype(float), values[there]

    def seconds_at(self, run: int) -> tuple[Array, Array]:
        """Steps of a run's evaluations, and seconds since its start, pauses included."""
        record = self.runs[run]
        found = self.history.get(self.primary_metric(record.task))
        if found is None or record.started is None:
            return np.empty(0), np.empty(0)
        begin, end = np.searchsorted(found.run, [run, run + 1])
        return found.step[begin:end].astype(float), (found.time[begin:end] - record.started) / 1000

    def final(self, run: int, metric: str) -> float | None:
        """A run's last value of a metric; None where it has none, or NaN."""
        values = self.series(run, metric)[1]
        return float(values[-1]) if len(values) and not np.isnan(values[-1]) else None

    def on(self, task: str) -> list[int]:
        """Positions of the runs on a task."""
        return [position for position, run in enumerate(self.runs) if run.task == task]

    def primary_metric(self, task: str) -> str:
        """What the runs of a task are judged by."""
        keys = (run.params.get("task.success_key", "") for run in self.runs if run.task == task)
        return names.primary_metric(next(keys, ""))

    def episodes(self, runs: Iterable[int]) -> float:
        """Of the last evaluation, mean of `runs`; infinite where it is not known."""
        found = [self.final(run, names.EVAL_EPISODES) for run in runs]
        known = [episodes for episodes in found if episodes is not None]
        return float(np.mean(known)) if known else np.inf

    def last_step(self, run: int) -> int:
        """Environment steps that `runs[run]` is known to have done."""
        return max(
            (
                int(steps[-1])
                for metric in self.history
                if len(steps := self.series(run, metric)[0])
            ),
            default=0,
        )

    def url(self, run_id: str) -> str | None:
        """The page of a run, where a server shows it."""
        if not self.source.startswith(("http://", "https://")):
            return None
        return f"{self.source.rstrip('/')}/#/experiments/{self.experiment_id}/runs/{run_id}"
