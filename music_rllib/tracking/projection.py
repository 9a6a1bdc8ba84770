"""The queue of what one run still has to send to MLflow.

The queue is in memory only. If the driver dies, nothing is lost: a run that is resumed reports the
history of its checkpoint again, and a finished run has its whole history in the store. Values up to
the last step that MLflow has of a metric are skipped, so each value is logged once.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice, takewhile
from typing import NamedTuple

from mlflow.entities import Metric

from music_rllib import names
from music_rllib.store.history import Report
from music_rllib.tracking.curve import learning_curve_png
from music_rllib.tracking.mlflow_client import MAX_METRICS, Experiment, KnownRun, Status

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Start:
    """A run starts or is resumed. `time` in ms since the epoch."""

    time: int
    name: str
    tags: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Tags for the versions of the code that computes the run."""
    params: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, float] = field(default_factory=dict)
    """Settings that are logged as metrics at step 0."""
    source_node: str | None = None


@dataclass(frozen=True, kw_only=True)
class End:
    """A run ends without a result in the store. `time` in ms since the epoch."""

    time: int
    status: Status
    tags: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Current:
    """The sweep has the runs of these nodes, and no others that it may have had."""

    node_keys: frozenset[str]


class StoredRun(NamedTuple):
    """The data of a run in the store."""

    reports: Sequence[Report]
    policy: bytes | None = None
    status: Status = "FINISHED"
    tags: Mapping[str, str] = {}


ReadStoredRun = Callable[[], StoredRun]
Event = Start | Report | End | Current | ReadStoredRun
Content = bytes | Callable[[], bytes | None]
"""A file's content, or a function that makes it before the upload; None if there is no file."""


class _Cancelled(Exception):  # noqa: N818 - no error
    """`RunProjection.cancel` was called."""


class RunProjection:
    """Queues the events and artefacts of one run, and sends them to MLflow.

    Any thread may add to the queue; only one thread sends. `start` or `mirror` must come first.
    The sweep's own run has no node key and no parent.
    """

    def __init__(
        self, experiment: Experiment, node_key: str = "", parent: KnownRun | None = None
    ) -> None:
        self.node_key = node_key
        self._experiment = experiment
        self._parent = parent
        self._start: Start
        self._reports: list[Report] = []
        """Reports since the last start, for the learning curve."""
        self._events: deque[Event] = deque()
        self._artefacts: dict[str, Content] = {}
        self._lock = threading.Lock()
        self._run: KnownRun | None = None
        self._last_steps: dict[str, int] = {}
        """Last step that MLflow has of each metric."""
        self._ended = True
        self._marked_incomplete = self._cancelled = False

    # -- adding to the queue -----------------------------------------------------------------

    def start(self, start: Start) -> None:
        """The run starts or is resumed; its reports follow, from the first one on."""
        with self._lock:
            self._start, self._reports, self._ended = start, [], False
            self._events.append(start)

    def report(self, reports: Iterable[Report]) -> None:
        """Add reports. Values of steps that MLflow has already are skipped when sending."""
        with self._lock:
            new = list(reports)
            self._reports += new
            self._events += new

    def keep_current(self, node_keys: Iterable[str]) -> None:
        """The sweep, whose own run this is, has the runs of these nodes and no others."""
        with self._lock:
            self._events.append(Current(node_keys=frozenset(node_keys)))

    def end(self, end: End) -> None:
        """The run ends without a result in the store; draws its learning curve."""
        with self._lock:
            self._events.append(end)
            self._put_learning_curve(self._reports)
            self._reports, self._ended = [], True

    def mirror(self, start: Start, read: ReadStoredRun) -> None:
        """The run is in the store: `read` replaces all events that are still queued."""
        with self._lock:
            self._start, self._reports, self._ended = start, [], True
            self._events = deque([read])

    def put_artefact(self, name: str, content: Content) -> None:
        """Add or replace the artefact `name`."""
        with self._lock:
            self._artefacts[name] = content

    def _put_learning_curve(self, reports: Sequence[Report]) -> None:
        if reports:
            draw = partial(_learning_curve, reports, self._start.name)
            self._artefacts[names.ARTEFACT_LEARNING_CURVE] = draw

    # -- state -------------------------------------------------------------------------------

    @property
    def under_way(self) -> bool:
        """Whether the run has started and not ended."""
        return not self._ended

    @property
    def run_id(self) -> str | None:
        """The run's id in MLflow; None until it is known."""
        return self._run.run_id if self._run else self._experiment.known_id(self.node_key)

    @property
    def records(self) -> int:
        """Number of events in the queue."""
        return len(self._events)

    @property
    def artefacts(self) -> int:
        """Number of artefacts in the queue."""
        return len(self._artefacts) or int(self._marked_incomplete)

    @property
    def delivered(self) -> bool:
        """Whether the run has ended and MLflow has all of it."""
        return self._ended and not self.records and not self.artefacts

    def cancel(self) -> None:
        """Send nothing after the current request."""
        self._cancelled = True

    # -- sending -----------------------------------------------------------------------------

    def send_records(self) -> None:
        """Send the events in order. Raises MLflow's error at the first one that fails."""
        while not self._cancelled and (events := self._next_events()):
            with contextlib.suppress(_Cancelled):
                self._send(events)
                self._remove(events)

    def send_artefacts(self) -> None:
        """Upload the artefacts. Raises MLflow's error at the first one that fails."""
        for name, content in list(self._artefacts.items()):
            if self._cancelled:
                return
            data = content() if callable(content) else content
            if data is not None:
                is_policy = name == names.ARTEFACT_POLICY
                upload = self._experiment.log_policy if is_policy else self._experiment.upload
                upload(self.attach().run_id, name, data)
            with self._lock:
                if self._artefacts[name] is content:
                    del self._artefacts[name]
        if self._marked_incomplete and not self._artefacts and not self._cancelled:
            self._experiment.delete_tag(self.attach().run_id, names.TAG_INCOMPLETE)
            self._marked_incomplete = False

    def attach(self) -> KnownRun:
        """The run in MLflow, which is found there or created."""
        if self._run is None:
            start = self._start
            run = self._experiment.find(self.node_key, start.tags.get(names.TAG_ENVIRONMENT))
            if run is None:
                tags = {**start.provenance, **start.tags, **self._parent_tag()}
                run = self._experiment.create(self.node_key, start.name, start.time, tags)
            else:
                self._last_steps = self._experiment.last_steps(run.run_id)
            self._run = run
        return self._run

    def _next_events(self) -> list[Event]:
        """The first event, or all reports at the front of the queue, for one request."""
        with self._lock:
            reports = list(takewhile(lambda event: isinstance(event, Report), self._events))
            return reports or list(islice(self._events, 1))

    def _remove(self, events: Iterable[Event]) -> None:
        """Remove sent events from the queue, unless `mirror` has replaced them meanwhile."""
        with self._lock:
            for event in events:
                if self._events and self._events[0] is event:
                    self._events.popleft()

    def _send(self, events: Sequence[Event]) -> None:
        first = events[0]
        if isinstance(first, Start):
            run_id = self.attach().run_id
            tags = {**first.provenance, **first.tags, **self._parent_tag(), **self._source_tags()}
            self._experiment.begin_run(run_id, tags, first.params)
        elif isinstance(first, End):
            run_id = self.attach().run_id
            self._log([])
            self._experiment.set_tags(run_id, {**first.tags, **self._source_tags()})
            self._experiment.end_run(run_id, first.status, first.time)
        elif isinstance(first, Current):
            self._experiment.keep_current(first.node_keys)
        elif isinstance(first, Report):
            self._log([event for event in events if isinstance(event, Report)])
        else:
            self._send_stored(first)

    def _send_stored(self, read: ReadStoredRun) -> None:
        environment = self._start.tags.get(names.TAG_ENVIRONMENT)
        known = self._experiment.find(self.node_key, environment)
        if self._run is None and known is not None and known.complete:
            self._run = known
            self._artefacts.clear()
            return
        stored = read()
        times = [report.timestamp_ms for report in stored.reports] or [self._start.time]
        self._start = start = replace(self._start, time=times[0])
        run_id = self.attach().run_id
        tags = {**start.tags, **stored.tags, **self._source_tags()}
        if self._parent is not None and times[0] < self._parent.started:
            tags[names.TAG_REUSED] = "true"
        tags[names.TAG_INCOMPLETE] = "its learning curve and policy are still to come"
        self._experiment.begin_run(run_id, tags, start.params)
        self._log(stored.reports)
        self._experiment.end_run(run_id, stored.status, times[-1])
        with self._lock:
            self._marked_incomplete = True
            self._put_learning_curve(stored.reports)
            if stored.policy is not None:
                self._artefacts[names.ARTEFACT_POLICY] = stored.policy

    def _log(self, reports: Sequence[Report]) -> None:
        """Log the settings and the values that MLflow lacks, as a resumed run repeats steps."""
        run_id, start = self.attach().run_id, self._start
        metrics = [metric for report in reports for metric in _metrics_of(report)]
        # Settings follow the first report, as MLflow's page that compares runs plots the metric
        # that was logged first: a setting there, such as q against q, would say nothing.
        position = len(reports[0].metrics) if reports else 0
        metrics[position:position] = [
            Metric(name, value, start.time, 0) for name, value in start.settings.items()
        ]
        last, new = dict(self._last_steps), []
        for metric in metrics:
            if metric.step > last.get(metric.key, -1):
                last[metric.key] = metric.step
                new.append(metric)
        for begin in range(0, len(new), MAX_METRICS):
            if self._cancelled:
                raise _Cancelled
            chunk = new[begin : begin + MAX_METRICS]
            self._experiment.log_metrics(run_id, chunk)
            self._last_steps.update((metric.key, metric.step) for metric in chunk)

    def _parent_tag(self) -> dict[str, str]:
        return {} if self._parent is None else {names.TAG_PARENT_RUN: self._parent.run_id}

    def _source_tags(self) -> dict[str, str]:
        source = self._start.source_node
        if source is None:
            return {}
        run_id = self._experiment.known_id(source)
        known = {} if run_id is None else {names.TAG_SOURCE_RUN: run_id}
        return {names.TAG_SOURCE_NODE: source, **known}


def _metrics_of(report: Report) -> list[Metric]:
    return [
        Metric(name, value, report.timestamp_ms, report.env_steps)
        for name, value in report.metrics.items()
    ]


def _learning_curve(reports: Sequence[Report], title: str) -> bytes | None:
    try:
        return learning_curve_png(reports, title=title)
    except (ValueError, RuntimeError) as error:
        logger.warning("%s: no learning curve (%s)", title, error)
        return None
