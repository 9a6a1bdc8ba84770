"""One run's way from its spool to MLflow: in order, and safe to repeat at any point.

After a crash between sending and remembering, the same records are sent again with the same
times and steps, and MLflow keeps one value each. A run is recognised by its tags, so a lost
answer to "create this run", or a lost ``delivered.json``, does not make a second one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.tracking.curve import learning_curve_png
from music_rllib.tracking.mlflow_client import MAX_METRICS, Experiment
from music_rllib.tracking.spool import Delivered, Finish, Metrics, Record, Spool, Start

logger = logging.getLogger(__name__)


class Delivery:
    """Sends one spool to its run in an experiment. Used by one thread at a time."""

    def __init__(
        self,
        spool: Spool,
        experiment: Experiment,
        identity: Mapping[str, str],
        parent_run: str | None = None,
        find_source: Callable[[str], str | None] = lambda node_key: None,
    ) -> None:
        """Prepare; nothing is sent yet.

        Args:
            spool: what is to be sent.
            experiment: where to.
            identity: the tags by which the run is found again.
            parent_run: id of the run that this one is shown below.
            find_source: run id of a node key, for the source tag; None where it has no run.
        """
        self.spool = spool
        self._experiment = experiment
        self._identity = identity
        self._nesting = {} if parent_run is None else {names.TAG_PARENT_RUN: parent_run}
        self._find_source = find_source
        self._run_id: str | None = None
        self._cancelled = False
        self._already_there: dict[str, int] = {}

    @property
    def run_id(self) -> str | None:
        """The run's id in MLflow, once it is known there."""
        return self._run_id or self.spool.delivered.run_id

    def send_records(self) -> None:
        """Send every whole record of the spool. Stops with MLflow's error where one fails."""
        if self.spool.start is None or not self.spool.undelivered:
            return
        self.spool.sync()
        run_id = self.attach()
        for group in _groups(self.spool.read(self.spool.delivered.offset)):
            if self._cancelled:
                return
            self._send(run_id, [record for record, _ in group])
            delivered = self.spool.delivered
            self.spool.set_delivered(
                Delivered(
                    run_id=run_id, offset=group[-1][1], records=delivered.records + len(group)
                )
            )

    def send_artefacts(self) -> None:
        """Upload what waits in the outbox. Stops with MLflow's error where one fails."""
        for name in self.spool.queued_artefacts():
            if self._cancelled:
                return
            run_id = self.attach()
            send = self._experiment.upload
            if name == names.ARTEFACT_POLICY:
                send = self._experiment.log_policy
            self.spool.send_artefact(name, partial(send, run_id, name))

    @property
    def ended(self) -> bool:
        """Whether the run has ended and MLflow has all of it."""
        return (
            self.spool.finished is not None
            and not self.spool.undelivered
            and not self.spool.queued_artefacts()
        )

    def cancel(self) -> None:
        """Send nothing more after the request that is under way."""
        self._cancelled = True

    def attach(self) -> str:
        """Find the run by its tags, or create it; its id.

        Where the remembered run is not the one found (another server, a deleted run, a lost
        file), the spool is sent from its begin, without what the found run has already.
        """
        if self._run_id is not None:
            return self._run_id
        start = self.spool.start
        assert start is not None, "a spool begins with its start"
        run_id = self._experiment.find_run(self._identity)
        if run_id is None:
            tags = {**start.tags, **self._nesting, **self._identity}
            run_id = self._experiment.create_run(start.name, start.time, tags)
            self._already_there = {}
        elif run_id != self.spool.delivered.run_id:
            self._already_there = self._experiment.last_steps(run_id)
        if run_id != self.spool.delivered.run_id:
            self.spool.set_delivered(Delivered(run_id=run_id))
        self._run_id = run_id
        return run_id

    def _send(self, run_id: str, records: list[Record]) -> None:
        first = records[0]
        if isinstance(first, Start):
            self._send_start(run_id, first)
        elif isinstance(first, Finish):
            self._send_finish(run_id, first)
        else:
            metrics = [record for record in records if isinstance(record, Metrics)]
            fresh = [self._without_known(record) for record in metrics]
            self._experiment.log_metrics(run_id, fresh)

    def _send_start(self, run_id: str, start: Start) -> None:
        tags = {**start.tags, **self._nesting, **self._source_tags()}
        self._experiment.begin_run(run_id, tags, start.params)

    def _send_finish(self, run_id: str, finish: Finish) -> None:
        self._queue_learning_curve()
        self._experiment.set_tags(run_id, {**finish.tags, **self._source_tags()})
        self._experiment.end_run(run_id, finish.status, finish.time)

    def _source_tags(self) -> dict[str, str]:
        source = self.spool.start.source_node if self.spool.start else None
        if source is None:
            return {}
        run_id = self._find_source(source)
        known = {} if run_id is None else {names.TAG_SOURCE_RUN: run_id}
        return {names.TAG_SOURCE_NODE: source, **known}

    def _without_known(self, record: Metrics) -> Metrics:
        if not self._already_there:
            return record
        values = {
            name: value
            for name, value in record.values.items()
            if record.step > self._already_there.get(name, -1)
        }
        return replace(record, values=values)

    def _queue_learning_curve(self) -> None:
        history = self.spool.history()
        if not history or self.spool.start is None:
            return
        try:
            picture = learning_curve_png(history, title=self.spool.start.name)
            self.spool.put_artefact(names.ARTEFACT_LEARNING_CURVE, picture)
        except (TrackingError, ValueError, RuntimeError) as error:
            logger.warning("%s: no learning curve (%s)", self.spool.folder, error)


def _groups(
    records: Iterator[tuple[Record, int]],
) -> Iterator[list[tuple[Record, int]]]:
    """Neighbouring metrics records as one group of at most ``MAX_METRICS`` values, others alone."""
    group: list[tuple[Record, int]] = []
    values = 0
    for item in records:
        record = item[0]
        size = len(record.values) if isinstance(record, Metrics) else MAX_METRICS
        if group and values + size > MAX_METRICS:
            yield group
            group, values = [], 0
        group.append(item)
        values += size
    if group:
        yield group
