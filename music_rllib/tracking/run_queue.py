"""The queue of the records that one run still has to send to MLflow.

The queue is in memory only. If the driver dies, nothing is lost: a resumed run reports the
history of its checkpoint again, and a finished run has its whole history in the store.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice, takewhile
from typing import NamedTuple

from mlflow.entities import Metric
from mlflow.utils.mlflow_tags import MLFLOW_RUN_NAME

from music_rllib import names
from music_rllib.experiment.run_info import RunInfo
from music_rllib.redaction import flat_params, redact
from music_rllib.runtime.machine import provenance_tags
from music_rllib.store.history import Report
from music_rllib.tracking.client import MAX_METRICS, Experiment, KnownRun, Status

Record = Report | Callable[[], None]
"""A report, or a function that sends something else."""


class StoredRun(NamedTuple):
    """The data of a finished run in the store."""

    reports: Sequence[Report]
    read_policy: Callable[[], bytes | None] | None = None
    """Reads the policy; called after the histories of all runs were sent."""
    provenance: Mapping[str, str] = {}
    """Tags that name the code that computed it; another version may send it."""


_PLACE = (
    MLFLOW_RUN_NAME, names.TAG_LABEL, names.TAG_STAGE, names.TAG_TRIAL, names.TAG_PART,
    names.TAG_RESULT,
)  # fmt: skip
"""Tags of a run's place in its sweep, which no result depends on; and a tag that old runs lack."""


class RunQueue:
    """Queues the records of one run, and sends them to MLflow in order.

    Any thread may add to the queue; only one thread sends. `start` or `mirror` must come first.
    The sweep's own run has no node key and no parent. MLflow gets each step of a metric once:
    values up to the last step that it has are skipped.
    """

    def __init__(
        self,
        experiment: Experiment,
        node_key: str = "",
        sweep_tags: Mapping[str, str] = {},
        added: Callable[[RunQueue], None] = lambda run: None,
    ) -> None:
        """Send to a run of `experiment`, which also gets the tags `sweep_tags`.

        `added` is called after something was added to the queue.
        """
        self.node_key = node_key
        self.refused: str | None = None
        """Reason of a lasting failure, after which nothing more is sent."""
        self.unclear_since: float | None = None
        """Time of the first of the latest failures that may pass or not."""
        self.is_running = False
        """Whether the run has started and not ended."""
        self._experiment, self._sweep_tags, self._added = experiment, sweep_tags, added
        self._info: RunInfo
        self._records: deque[Record] = deque()
        self._lock = threading.Lock()
        self._run: KnownRun | None = None
        self._last_steps: dict[str, int] = {}
        self._is_new = self._has_begun = False
        """Whether this process created the run, which has no params yet; or has begun it."""
        self._read_policy: Callable[[], bytes | None] | None = None

    # -- adding to the queue -----------------------------------------------------------------

    def _add(self, *records: Record) -> None:
        with self._lock:
            self._records.extend(records)
        self._added(self)

    def start(self, info: RunInfo) -> None:
        """The run starts or is resumed; its reports follow, from the first one on."""
        self._info, self.is_running = info, True
        self._add(self._send_start)

    def report(self, reports: Iterable[Report]) -> None:
        self._add(*reports)

    def end(self, status: Status, tags: Mapping[str, str]) -> None:
        """The run ends without a result in the store."""
        self.is_running = False
        self._add(partial(self._send_end, status, _now(), tags))

    def mirror(self, info: RunInfo, read: Callable[[], StoredRun]) -> None:
        """The run is in the store: the result of `read` replaces all records in the queue."""
        self._info, self.is_running = info, False
        self.drop()
        self._add(partial(self._send_stored, read), self._send_policy)

    def keep_current(self, node_keys: Iterable[str]) -> None:
        """The sweep, whose parent run this is, has the runs of these nodes and no others."""
        self._add(partial(self._experiment.keep_current, frozenset(node_keys)))

    def put_text(self, name: str, text: str) -> None:
        self._add(lambda: self._experiment.client.log_text(self.attach().run_id, text, name))

    # -- state -------------------------------------------------------------------------------

    @property
    def source(self) -> str | None:
        return self._info.source_node

    @property
    def records(self) -> int:
        return len(self._records)

    def drop(self) -> None:
        with self._lock:
            self._records.clear()

    # -- sending -----------------------------------------------------------------------------

    def send(self, *, policy: bool = True) -> None:
        """Send the records in order, up to the policy or with it.

        Raises MLflow's error at the first record that fails.
        """
        while records := self._next():
            if (first := records[0]) == self._send_policy and not policy:
                return
            if callable(first):
                first()
            else:
                self._log([record for record in records if isinstance(record, Report)])
            self._remove(records)

    def attach(
        self, started: int | None = None, tags: Mapping[str, str] = {}, *, retrained: bool = False
    ) -> KnownRun:
        """The run in MLflow, which is found there or created.

        Args:
            started: Start time of a run that is created, in ms since the epoch; by default now.
            tags: Further tags of a run that is created.
            retrained: Whether to replace a complete run, because its node is trained again.
        """
        if self._run is None:
            again = started is None  # another driver may have begun the run meanwhile
            run = self._experiment.find(self.node_key, self._identity, again=again)
            if run is not None and retrained and run.is_complete:
                self._experiment.delete(self.node_key)
                run = None
            if run is None:
                name, time = self._info.name, started or _now()
                all_tags = {**self._tags(), **tags}
                run = self._experiment.create(self.node_key, name, time, all_tags)
                self._is_new = True
            else:
                self._last_steps = self._experiment.last_steps(run.run_id)
            self._run = run
        return self._run

    def _next(self) -> list[Record]:
        """The first record, or all reports at the front of the queue, for one request."""
        with self._lock:
            reports = list(takewhile(lambda record: isinstance(record, Report), self._records))
            return reports or list(islice(self._records, 1))

    def _remove(self, records: Iterable[Record]) -> None:
        """Remove sent records from the queue, unless `mirror` has replaced them meanwhile."""
        with self._lock:
            for record in records:
                if self._records and self._records[0] is record:
                    self._records.popleft()

    def _send_start(self) -> None:
        self.attach(retrained=bool(self.node_key))
        params, tags = self._begin()
        self._experiment.log(self.attach().run_id, params=params, tags=tags)
        self._is_new, self._has_begun = False, True

    def _begin(
        self, started: int | None = None, tags: Mapping[str, str] = {}
    ) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Create the run, or resume it; the params and tags that it still lacks."""
        run_id, params = self.attach(started, tags).run_id, flat_params(self._info.config)
        if self._is_new:
            return params, {}
        tags = {**self._tags(), **tags}
        if self._has_begun:
            return {}, tags
        # The plan may have changed since the run began, and its name has what varies.
        self._experiment.begin_run(run_id, {**tags, MLFLOW_RUN_NAME: self._info.name}, params)
        return {}, {}

    def _send_end(self, status: Status, time: int, tags: Mapping[str, str]) -> None:
        run_id = self.attach().run_id
        self._log([], tags={**self._tags(), **tags})
        self._has_begun = False
        self._experiment.client.set_terminated(run_id, status, time)

    def _send_stored(self, read: Callable[[], StoredRun]) -> None:
        known = self._experiment.find(self.node_key, self._identity)
        if self._run is None and known is not None and known.is_complete:
            self._run, self._read_policy = known, None
            # A stage may have another name since, and a trial another number.
            tags = {**self._tags(), MLFLOW_RUN_NAME: self._info.name}
            self._experiment.correct(known, {key: tags[key] for key in _PLACE if key in tags})
            if names.TAG_PART in known.tags and names.TAG_PART not in tags:  # of a search no longer
                self._experiment.remove_tag(known.run_id, names.TAG_PART)
                del known.tags[names.TAG_PART]
            return
        stored = read()
        self._read_policy = stored.read_policy
        self._info = replace(self._info, tags={**self._info.tags, **stored.provenance})
        times = [report.timestamp_ms for report in stored.reports] or [_now()]
        unfinished = {names.TAG_INCOMPLETE: "its policy is not uploaded yet"}
        left = self._begin(times[0], {} if stored.read_policy is None else unfinished)
        self._log(stored.reports, *left)
        self._is_new = self._has_begun = False
        self._experiment.client.set_terminated(self.attach().run_id, "FINISHED", times[-1])
        # The policy, which may wait for long, needs the tags only.
        self._info = replace(self._info, config={}, settings={})

    def _send_policy(self) -> None:
        if self._read_policy is None:
            return
        run_id = self.attach().run_id
        if (policy := self._read_policy()) is not None:
            self._experiment.log_policy(run_id, policy, self._tags())
        self._experiment.remove_tag(run_id, names.TAG_INCOMPLETE)

    def _log(
        self,
        reports: Sequence[Report],
        params: Mapping[str, str] = {},
        tags: Mapping[str, str] = {},
    ) -> None:
        """Log settings and the values that MLflow lacks, as a resumed run repeats steps."""
        run_id = self.attach().run_id
        metrics = [
            Metric(name, value, report.timestamp_ms, report.env_steps)
            for report in reports
            for name, value in report.metrics.items()
        ]
        # Settings follow the first report, as MLflow's page that compares runs plots the metric
        # that was logged first: a plot of a setting, such as q against q, would be useless.
        position = len(reports[0].metrics) if reports else 0
        time = reports[0].timestamp_ms if reports else _now()
        metrics[position:position] = [
            Metric(name, value, time, 0) for name, value in self._info.settings.items()
        ]
        last, new = dict(self._last_steps), []
        for metric in metrics:
            if metric.step > last.get(metric.key, -1):
                last[metric.key] = metric.step
                new.append(metric)
        for begin in range(0, len(new) or 1, MAX_METRICS):
            chunk = new[begin : begin + MAX_METRICS]
            self._experiment.log(run_id, metrics=chunk, params=params, tags=tags)
            params, tags = {}, {}
            self._last_steps.update((metric.key, metric.step) for metric in chunk)

    @property
    def _identity(self) -> dict[str, str]:
        """The tags that a run of other numbers has with other values."""
        found = {tag: self._info.tags.get(tag) for tag in (names.TAG_ENVIRONMENT, names.TAG_RESULT)}
        return {tag: str(value) for tag, value in found.items() if value is not None}

    def _tags(self) -> dict[str, str]:
        """The run's tags, with the MLflow run that it starts from as soon as that is known."""
        own = {
            key: redact(str(value)) for key, value in self._info.tags.items() if value is not None
        }
        source = self._experiment.known_id(self._info.source_node or "")
        known = {names.TAG_SOURCE_RUN: source} if self._info.source_node and source else {}
        return {**provenance_tags(), **own, **known, **self._sweep_tags}


def _now() -> int:
    """Now, in ms since the epoch, as MLflow counts."""
    return round(time.time() * 1000)
