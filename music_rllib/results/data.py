"""The runs of one sweep with the values of their metrics, from a storage or an export."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import BaseModel, JsonValue, TypeAdapter

from music_rllib import names
from music_rllib.errors import BadInputError
from music_rllib.experiment.plan import Node, Plan
from music_rllib.experiment.run_info import run_info
from music_rllib.redaction import flat_params
from music_rllib.results.analysis_plan import PlanVersion
from music_rllib.results.statistics import Array
from music_rllib.store.history import RunResult

Ints = NDArray[np.int64]


class ReportError(BadInputError):
    """A sweep or an export can't be read or written; names the place and what to do."""


class Column(NamedTuple):
    """N values of one metric, sorted by run and step, at most one for each run and step."""

    run: Ints
    """`[N]` positions in `Sweep.runs`."""
    step: Ints
    value: Array
    """`[N]`; may be NaN or infinite."""
    time: Ints
    """`[N]` ms since the epoch."""

    def select(self, which: slice | NDArray[Any]) -> Column:
        """The values at these positions, or under this mask."""
        return Column(self.run[which], self.step[which], self.value[which], self.time[which])

    def of_run(self, run: int) -> Column:
        begin, end = np.searchsorted(self.run, [run, run + 1])
        return self.select(slice(begin, end))


_NONE = np.empty(0, np.int64)
_NO_VALUES = Column(_NONE, _NONE, np.empty(0), _NONE)

History = Mapping[str, Column]
"""Metric name to column."""


class Points(NamedTuple):
    """Everything that one run logged, `[points]` each."""

    metrics: Sequence[str] = ()
    steps: Sequence[int] | Ints = ()
    times: Sequence[int] | Ints = ()
    values: Sequence[float] | Array = ()


def columns(runs: Iterable[Points]) -> dict[str, Column]:
    """Columns from one `Points` per run, in the order of the runs."""
    runs = list(runs)
    parts = (
        Column(
            np.full(len(points.metrics), position),
            np.asarray(points.steps, np.int64),
            np.asarray(points.values, np.float64),
            np.asarray(points.times, np.int64),
        )
        for position, points in enumerate(runs)
    )
    metrics = [pa.array(points.metrics, pa.string()) for points in runs]
    return by_metric(pa.chunked_array(metrics, pa.string()), joined(parts))


def by_metric(metrics: pa.ChunkedArray, values: Column) -> dict[str, Column]:
    """Columns from a table: the metric of each row, and its other values.

    If a run has several values of a metric at one step, the one logged last counts.
    """
    coded = metrics.combine_chunks().dictionary_encode()
    codes = coded.indices.to_numpy(zero_copy_only=False)
    order = np.lexsort((values.time, values.step, values.run, codes))
    changes = [np.diff(key[order]) != 0 for key in (codes, values.run, values.step)]
    order = order[np.append(np.any(changes, axis=0), True)[: len(order)]]
    ends = np.searchsorted(codes[order], np.arange(len(coded.dictionary) + 1))
    found = sorted((name, code) for code, name in enumerate(coded.dictionary.to_pylist()))
    return {name: values.select(order[ends[code] : ends[code + 1]]) for name, code in found}


def joined(parts: Iterable[Column]) -> Column:
    """Concatenate columns."""
    return Column(*map(np.concatenate, zip(_NO_VALUES, *parts, strict=True)))


class _Tag:
    """A tag of a run as its attribute; empty if the run lacks it."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, run: RunRecord, _: object = None) -> str:
        return run.tags.get(self._name, "")


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """One run of the sweep."""

    run_id: str
    """Key of the run's node; in old exports its MLflow id."""
    name: str
    status: str
    """RUNNING, FINISHED, FAILED, KILLED or SCHEDULED."""
    started: int | None = None
    ended: int | None = None
    """Last report in ms since the epoch."""
    trained_seconds: float | None = None
    """Training time up to the last report, without pauses; None in old exports."""
    params: Mapping[str, str] = field(default_factory=dict, repr=False)
    tags: Mapping[str, str] = field(default_factory=dict, repr=False)

    node_key = _Tag(names.TAG_NODE_KEY)
    stage = _Tag(names.TAG_STAGE)
    variant = _Tag(names.TAG_VARIANT)
    task = _Tag(names.TAG_TASK)
    seed = _Tag(names.TAG_SEED)
    source = _Tag(names.TAG_SOURCE_NODE)
    """Key of the node that the run starts from; empty for a run from scratch."""
    entropic_index = _Tag(names.TAG_ENTROPIC_INDEX)
    """Entropic index in words: `1.5`, or `1 to 2` for a schedule."""

    @property
    def is_finished(self) -> bool:
        return self.status == "FINISHED"

    @property
    def failure(self) -> str | None:
        return self.tags.get(names.TAG_FAILURE)

    @property
    def budget(self) -> int | None:
        """Number of environment steps of the run's plan."""
        text = self.params.get("env_steps", "")
        return int(text) if text.isdecimal() and len(text) < 19 else None

    @property
    def seconds(self) -> float | None:
        """Training time of a run that has ended, else None.

        In old exports this is the time from start to last report, pauses included.
        """
        if self.status in {"RUNNING", "SCHEDULED"} or self.started is None or self.ended is None:
            return None
        if self.trained_seconds is not None:
            return self.trained_seconds
        return (self.ended - self.started) / 1000


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """The runs of a sweep, their curves, and its searches and plans."""

    name: str
    status: str = ""
    """Status of the sweep, in the words of :class:`RunRecord`."""
    started: int | None = None
    source: str = ""
    """Storage that the sweep was read from, without a password."""
    tags: Mapping[str, str] = field(default_factory=dict, repr=False)
    config: str | None = field(default=None, repr=False)
    runs: Sequence[RunRecord] = field(repr=False)
    history: History = field(repr=False)
    searches: Sequence[Mapping[str, Any]] = field(default=(), repr=False)
    """Content of `search.json`: trials, importance and ranking of each search."""
    plans: Sequence[PlanVersion] = field(default=(), repr=False)
    earlier: str | None = None
    """A sentence about the runs of earlier plans, which are not part of the sweep."""

    def column(self, run: int, metric: str) -> Column:
        """The values of a metric of `runs[run]`, possibly empty."""
        return self.history.get(metric, _NO_VALUES).of_run(run)

    def series(self, run: int, metric: str) -> tuple[Ints, Array]:
        """Steps and values of a metric of `runs[run]`, `[points]` each, possibly empty."""
        _, steps, values, _ = self.column(run, metric)
        return steps, values

    def finite(self, run: int, metric: str) -> tuple[Array, Array]:
        """Finite part of `series`, with the steps as floats."""
        steps, values = self.series(run, metric)
        is_finite = np.isfinite(values)
        return steps[is_finite].astype(float), values[is_finite]

    def seconds_at(self, run: int) -> tuple[Array, Array]:
        """Steps of a run's reports, and its training time until these steps in seconds.

        Old exports have no training time, only the time since the start with all pauses.
        """
        record, (steps, seconds) = self.runs[run], self.finite(run, names.SYSTEM_SECONDS)
        if len(steps):
            return steps, seconds
        if record.started is None:
            return np.empty(0), np.empty(0)
        column = self.column(run, self.primary_metric(record.task))
        return column.step.astype(float), (column.time - record.started) / 1000

    def final(self, run: int, metric: str) -> float | None:
        """The last value of a metric of `runs[run]`; None unless it is finite."""
        values = self.column(run, metric).value
        return float(values[-1]) if len(values) and np.isfinite(values[-1]) else None

    def median_run(self, runs: Iterable[int], task: str, metric: str) -> RunRecord | None:
        """The run on a task with the median score, which no luck explains; None if none is done."""
        scores = [
            (score, int(run.seed), position)
            for position in runs
            for run in [self.runs[position]]
            if run.task == task and run.is_finished
            if (score := self.final(position, metric)) is not None
        ]
        return self.runs[sorted(scores)[len(scores) // 2][2]] if scores else None

    def early(self, run: int, metric: str) -> float | None:
        """Mean of a metric of `runs[run]` over the first quarter of its steps; None without one.

        There, training episodes show exploration rather than what was learned.
        """
        steps, values = self.finite(run, metric)
        is_early = (steps > 0) & (steps <= 0.25 * (self.runs[run].budget or self.last_step(run)))
        return float(values[is_early].mean()) if is_early.any() else None

    def having(self, wanted: Callable[[RunRecord], bool]) -> Sweep:
        """The sweep with the runs for which `wanted` is true."""
        kept = [position for position, run in enumerate(self.runs) if wanted(run)]
        if len(kept) == len(self.runs):
            return self  # copying took most of the time of the pages of results
        history = history_of([(self, position) for position in kept])
        return replace(self, runs=[self.runs[position] for position in kept], history=history)

    def on(self, task: str) -> list[int]:
        return [position for position, run in enumerate(self.runs) if run.task == task]

    def primary_metric(self, task: str) -> str:
        """The metric by which the runs of a task are scored."""
        keys = (run.params.get("task.success_key", "") for run in self.runs if run.task == task)
        return names.primary_metric(next(keys, ""))

    def episodes(self, runs: Iterable[int]) -> float:
        """Mean number of episodes of the runs' last evaluations; infinite if unknown."""
        counts = (self.final(run, names.EVAL_EPISODES) for run in runs)
        known = [count for count in counts if count is not None]
        return float(np.mean(known)) if known else np.inf

    def last_step(self, run: int) -> int:
        """Environment steps of the last value of `runs[run]`; 0 without one."""
        steps = (column.of_run(run).step for column in self.history.values())
        return max((int(step.max(initial=0)) for step in steps), default=0)

    def least_budget(self, task: str, runs: Iterable[int]) -> float:
        """The smallest budget of these runs on a task in environment steps; infinite without runs.

        A run of unknown budget counts with its last step.
        """
        own = [run for run in runs if self.runs[run].task == task]
        return min((float(self.runs[r].budget or self.last_step(r)) for r in own), default=np.inf)


Place = tuple[Sweep, int]
"""A sweep, and the position of a run in it."""


def history_of(places: Iterable[Place]) -> History:
    """Metrics of the runs at `places`, numbered in that order."""
    parts: defaultdict[str, list[Column]] = defaultdict(list)
    for number, (sweep, position) in enumerate(places):
        for metric, column in sweep.history.items():
            part = column.of_run(position)
            if len(part.run):
                parts[metric].append(part._replace(run=np.full_like(part.run, number)))
    return {metric: joined(parts[metric]) for metric in sorted(parts)}


# Searches -----------------------------------------------------------------------------------------


class _Trial(BaseModel):
    number: int
    state: str
    values: dict[str, JsonValue]
    objective: list[float | None] | None = None
    interval: list[tuple[float | None, float | None]] | None = None
    reason: str | None


class _StudyOfOneValue(BaseModel):
    values: dict[str, JsonValue]
    importance: dict[str, float] | None
    trials: list[_Trial]


class _Ranked(BaseModel):
    trial: JsonValue
    values: dict[str, JsonValue]
    failure: str | None = None
    scores: list[list[JsonValue]] | None = None
    searched: list[float | None] | None = None
    fresh: list[float | None] | None = None
    interval: list[tuple[float | None, float | None]] | None = None
    best_is_better_with: float | None = None


class _Objective(BaseModel):
    name: str
    direction: str


class _Search(BaseModel):
    """The fields of a search that are read; others are allowed."""

    stage: str
    mode: str
    sampler: str
    objectives: list[_Objective]
    arms: list[_StudyOfOneValue]
    ranking: list[_Ranked] | None


def checked_searches(document: Any) -> list[dict[str, Any]]:
    """Validate the content of a `search.json`, which may come from strangers.

    Raises:
        ValueError: The document is not a list of searches.
    """
    TypeAdapter(list[_Search]).validate_python(document)
    searches: list[dict[str, Any]] = document
    for search in searches:
        objectives, ranking = len(search["objectives"]), search["ranking"] or []
        for row in [trial for one in search["arms"] for trial in one["trials"]] + ranking:
            for name in ("objective", "interval", "fresh"):
                if row.get(name) and len(row[name]) != objectives:
                    raise ValueError(f"{name} must have {objectives} entries, got {len(row[name])}")
        if any("failure" not in row and not row.get("scores") for row in ranking):
            raise ValueError("ranking must have scores or a failure in each row")
    return searches


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
        self._runs: dict[str, RunRecord] = {}  # describing a run is the expensive part

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
        return Points()
    count = len(result.metrics)
    steps = [result.env_steps] * count
    return Points(list(result.metrics), steps, [0] * count, list(result.metrics.values()))
