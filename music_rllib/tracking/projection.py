"""One run on its way to MLflow: what it does not have yet, in order, and safe to repeat.

Nothing here is on disk. What a driver that dies had not sent is in the store: a run that goes on
tells the history of its checkpoint again, and a finished one has all of it in its node. The last
step that MLflow has of each metric says what is to be left out, so that each value is there once.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from music_rllib import names
from music_rllib.store.run_record import Report
from music_rllib.tracking.curve import learning_curve_png
from music_rllib.tracking.mlflow_client import MAX_METRICS, Experiment, KnownRun, Status, Value

__all__ = ["End", "RunProjection", "Start", "StoredRun"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Start:
    """The run begins, or goes on. `time` in ms since the epoch."""

    time: int
    name: str
    tags: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Tags of the code that computes it."""
    params: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, float] = field(default_factory=dict)
    """Logged as metrics at step 0."""
    source_node: str | None = None


@dataclass(frozen=True, kw_only=True)
class End:
    """The run ended, and is not in the store. `time` in ms since the epoch."""

    time: int
    status: Status
    tags: Mapping[str, str] = field(default_factory=dict)


class StoredRun(NamedTuple):
    """What the store has of a run."""

    reports: Sequence[Report]
    policy: bytes | None = None
    status: Status = "FINISHED"
    tags: Mapping[str, str] = {}


Read = Callable[[], StoredRun]
Event = Start | Report | End | Read
Content = bytes | Callable[[], bytes | None]
"""A file, or what gives it when it is sent; None where there is none after all."""


class RunProjection:
    """Brings one run to MLflow. Told by any thread, sent by one."""

    def __init__(
        self,
        experiment: Experiment,
        node_key: str = "",
        parent: KnownRun | None = None,
        find_source: Callable[[str], str | None] = lambda node_key: None,
    ) -> None:
        """Prepare; nothing is sent yet.

        Args:
            experiment: where to.
            node_key: of the run; empty for the sweep's own.
            parent: the run that this one is shown below.
            find_source: run id of a node key, for the source tag; None where it has no run.
        """
        self.node_key = node_key
        self._experiment = experiment
        self._parent = parent
        self._find_source = find_source
        self._start: Start | None = None
        self._told: list[Report] = []
        """Since the run began or went on: for its learning curve."""
        self._events: deque[Event] = deque()
        self._artefacts: dict[str, Content] = {}
        self._lock = threading.Lock()
        self._run: KnownRun | None = None
        self._last_steps: dict[str, int] = {}
        """What MLflow has of each metric."""
        self._over = self._completing = self._cancelled = False

    # -- told --------------------------------------------------------------------------------

    def start(self, start: Start) -> None:
        """The run begins, or goes on: its reports are told from the first one on."""
        with self._lock:
            self._start, self._told, self._over = start, [], False
            self._events.append(start)

    def report(self, reports: Iterable[Report]) -> None:
        """New values; those of steps that MLflow has are left out when they are sent."""
        with self._lock:
            fresh = list(reports)
            self._told += fresh
            self._events += fresh

    def end(self, end: End) -> None:
        """The run ended, and is not in the store."""
        with self._lock:
            start, told = self._start, list(self._told)
            assert start is not None, "a run begins before it ends"
            self._events.append(end)
            if told:
                self._artefacts[names.ARTEFACT_LEARNING_CURVE] = partial(_curve, told, start.name)
            self._told, self._over = [], True

    def mirror(self, start: Start, read: Read) -> None:
        """The run is in the store, from which all that MLflow has not is read when it is sent."""
        with self._lock:
            self._start, self._told, self._over = start, [], True
            self._events = deque([read])

    def put_artefact(self, name: str, content: Content) -> None:
        """To be uploaded, or read and uploaded. The last one of a name counts."""
        with self._lock:
            self._artefacts[name] = content

    @property
    def under_way(self) -> bool:
        """Whether the run has begun and not ended."""
        return self._start is not None and not self._over

    # -- what is left ------------------------------------------------------------------------

    @property
    def run_id(self) -> str | None:
        """The run's id in MLflow, once it is known there."""
        return self._run.run_id if self._run else self._experiment.known_id(self.node_key)

    @property
    def records(self) -> int:
        """How much of what was told is still to be sent."""
        return len(self._events)

    @property
    def artefacts(self) -> int:
        """How many files are still to be uploaded."""
        return len(self._artefacts) or int(self._completing)

    @property
    def delivered(self) -> bool:
        """Whether the run has ended and MLflow has all of it."""
        return self._over and not self.records and not self.artefacts

    def cancel(self) -> None:
        """Send nothing more after the request that is under way."""
        self._cancelled = True

    # -- sent --------------------------------------------------------------------------------

    def send_records(self) -> None:
        """Send what was told, in order. Stops with MLflow's error where something fails."""
        while events := self._next():
            if self._cancelled or not self._send(events):
                return
            with self._lock:
                # Unless the end of the run has taken their place meanwhile.
                while events and self._events and self._events[0] is events[0]:
                    self._events.popleft()
                    del events[0]

    def send_artefacts(self) -> None:
        """Upload what waits. Stops with MLflow's error where something fails."""
        for name, content in list(self._artefacts.items()):
            if self._cancelled:
                return
            self._upload(name, content() if callable(content) else content)
            with self._lock:
                if self._artefacts[name] is content:
                    del self._artefacts[name]
        if self._completing and not self._artefacts and not self._cancelled:
            self._experiment.delete_tag(self.attach().run_id, names.TAG_INCOMPLETE)
            self._completing = False

    def attach(self) -> KnownRun:
        """Find the run, or create it; with what MLflow has of it."""
        if self._run is None:
            start = self._start
            assert start is not None, "a run is told to begin before anything is sent"
            run = self._experiment.find(self.node_key)
            if run is None:
                tags = {**start.provenance, **start.tags, **self._nesting()}
                run = self._experiment.create(self.node_key, start.name, start.time, tags)
            else:
                self._last_steps = self._experiment.last_steps(run.run_id)
            self._run = run
        return self._run

    def _next(self) -> list[Event]:
        """The first event; neighbouring reports together, so that one request takes them."""
        with self._lock:
            events: list[Event] = []
            for event in self._events:
                if events and not (isinstance(event, Report) and isinstance(events[0], Report)):
                    break
                events.append(event)
            return events

    def _send(self, events: Sequence[Event]) -> bool:
        """False where it was cancelled in between."""
        first = events[0]
        if isinstance(first, Start):
            return self._send_start(first)
        if isinstance(first, End):
            return self._send_end(first)
        if isinstance(first, Report):
            return self._log([event for event in events if isinstance(event, Report)])
        return self._send_stored(first)

    def _send_start(self, start: Start) -> bool:
        run_id = self.attach().run_id
        tags = {**start.provenance, **start.tags, **self._nesting(), **self._source_tags()}
        self._experiment.begin_run(run_id, tags, start.params)
        return True

    def _send_end(self, end: End) -> bool:
        run_id = self.attach().run_id
        if not self._log([]):
            return False
        self._experiment.set_tags(run_id, {**end.tags, **self._source_tags()})
        self._experiment.end_run(run_id, end.status, end.time)
        return True

    def _send_stored(self, read: Read) -> bool:
        known = self._experiment.find(self.node_key)
        if self._run is None and known is not None and known.whole:
            self._run = known
            self._artefacts.clear()
            return True
        stored = read()
        assert self._start is not None, "mirror() sets it"
        times = [report.timestamp_ms for report in stored.reports] or [self._start.time]
        self._start = start = replace(self._start, time=times[0])
        run_id = self.attach().run_id
        tags = {**start.tags, **stored.tags, **self._source_tags()}
        if self._parent is not None and times[0] < self._parent.started:
            tags[names.TAG_REUSED] = "true"
        tags[names.TAG_INCOMPLETE] = "its learning curve and policy are still to come"
        self._experiment.begin_run(run_id, tags, start.params)
        if not self._log(stored.reports):
            return False
        self._experiment.end_run(run_id, stored.status, times[-1])
        with self._lock:
            self._completing = True
            if stored.reports:
                curve = partial(_curve, stored.reports, start.name)
                self._artefacts[names.ARTEFACT_LEARNING_CURVE] = curve
            if stored.policy is not None:
                self._artefacts[names.ARTEFACT_POLICY] = stored.policy
        return True

    def _log(self, reports: Sequence[Report]) -> bool:
        run_id = self.attach().run_id
        fresh = list(self._fresh(reports))
        for begin in range(0, len(fresh), MAX_METRICS):
            if self._cancelled:
                return False
            chunk = fresh[begin : begin + MAX_METRICS]
            self._experiment.log_metrics(run_id, chunk)
            self._last_steps.update((value.name, value.step) for value in chunk)
        return True

    def _fresh(self, reports: Sequence[Report]) -> Iterator[Value]:
        """The values that MLflow hasn't, each once: a run that goes on repeats steps."""
        last = dict(self._last_steps)
        for value in self._values(reports):
            if value.step > last.get(value.name, -1):
                last[value.name] = value.step
                yield value

    def _values(self, reports: Sequence[Report]) -> Iterator[Value]:
        """Settings come behind the first measurement, which MLflow then has on its axes.

        Its page that compares runs takes the metric that came first: q against q says nothing.
        """
        for report in reports[:1]:
            yield from _of(report)
        assert self._start is not None, "nothing is sent of a run that was not begun"
        for name, value in self._start.settings.items():
            yield Value(name, value, self._start.time, 0)
        for report in reports[1:]:
            yield from _of(report)

    def _upload(self, name: str, content: bytes | None) -> None:
        if content is None:
            return
        run_id = self.attach().run_id
        with TemporaryDirectory() as folder:
            file = Path(folder, Path(name).name)
            file.write_bytes(content)
            if name == names.ARTEFACT_POLICY:
                self._experiment.log_policy(run_id, name, file)
            else:
                self._experiment.upload(run_id, name, file)

    def _nesting(self) -> dict[str, str]:
        return {} if self._parent is None else {names.TAG_PARENT_RUN: self._parent.run_id}

    def _source_tags(self) -> dict[str, str]:
        source = self._start.source_node if self._start else None
        if source is None:
            return {}
        run_id = self._find_source(source)
        known = {} if run_id is None else {names.TAG_SOURCE_RUN: run_id}
        return {names.TAG_SOURCE_NODE: source, **known}


def _of(report: Report) -> Iterator[Value]:
    for name, value in report.metrics.items():
        yield Value(name, value, report.timestamp_ms, report.env_steps)


def _curve(reports: Sequence[Report], title: str) -> bytes | None:
    try:
        return learning_curve_png(reports, title=title)
    except (ValueError, RuntimeError) as error:
        logger.warning("%s: no learning curve (%s)", title, error)
        return None
