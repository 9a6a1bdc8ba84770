"""Logs a sweep to MLflow: an experiment, a parent run, and a child run per node.

MLflow gets the reports of running runs and the stored history of finished ones. Only the
constructor waits for a server; afterwards every call only fills a queue, which a thread sends
(:mod:`music_rllib.tracking.sender`).
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shlex
import shutil
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self
from urllib.parse import urlencode
from weakref import WeakValueDictionary

import yaml

from music_rllib import names
from music_rllib.command_line import PROGRAM
from music_rllib.config.yaml_file import Dumper
from music_rllib.errors import TrackingError, is_stop
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.run_info import RunInfo
from music_rllib.redaction import redact, without_secrets
from music_rllib.store.history import Report
from music_rllib.store.serialization import content_key
from music_rllib.store.storage import below
from music_rllib.tracking.client import (
    Experiment,
    Status,
    answers_named,
    mlflow_reason,
    open_client,
)
from music_rllib.tracking.run_queue import RunQueue, StoredRun
from music_rllib.tracking.sender import Pending, Sender
from music_rllib.tracking.store import (
    SweepRecord,
    TrackingStore,
    check_reachable,
    mlflow_version,
    resolve_store,
)

logger = logging.getLogger(__name__)

REQUESTS_AT_ONCE = 4
"""To a server, which has two processes by default."""
MAX_CAUSE_LENGTH = 1000
"""Longest tag that says why a run ended, in characters; the run's log has all of it."""


class Tracker:
    """Logs one sweep to MLflow.

    A tracker that is opened again on the same sweep continues its runs. Several threads may call
    it. Processes that track the same sweep are opened one after another, and log other runs.
    """

    def __init__(
        self,
        *,
        sweep_name: str,
        storage: str,
        config: Mapping[str, object],
        tracking_uri: str | None = None,
    ) -> None:
        """Check the store, create the experiment and the parent run, and start the thread.

        Args:
            sweep_name: Name of the sweep and of the experiment.
            storage: The sweep's storage, a folder or a bucket URI.
            config: All settings of the sweep; they become params and the artifact
                `config/sweep.yaml` of the parent run. Other settings that change the plan have
                another parent run.
            tracking_uri: `mlflow.tracking_uri`; None for a SQLite file in `storage`.

        Raises:
            TrackingError: The store is not reachable or refuses, or the storage is not writable.
        """
        self.store = resolve_store(tracking_uri, storage)
        check_reachable(self.store)
        self._runs: WeakValueDictionary[str, RunQueue] = WeakValueDictionary()
        """Queue by node key; the sender keeps each until its run has ended and is delivered."""
        self._undelivered: Pending | None = None
        self._view: dict[str, str] = {}
        self._name, self._place = sweep_name, below(redact(storage), sweep_name)
        record = SweepRecord.read(storage, sweep_name)
        self.sweep_id = record.sweep_id if record else uuid.uuid4().hex[:16]
        uri = None if tracking_uri is None else self.store.public_uri
        if record is None or record.tracking_uri != uri:
            record = SweepRecord(sweep_name=sweep_name, sweep_id=self.sweep_id, tracking_uri=uri)
            record.write(storage)  # before MLflow has anything that must be found again
        self._experiment = Experiment(self.store, sweep_name, self.sweep_id, _plan_key(config))
        # A SQLite file has one writer at a time.
        at_once = REQUESTS_AT_ONCE if self.store.is_server else 1
        self._sender = Sender(self.store.public_uri, at_once)
        self._parent = self._parent_run(config)
        replace(record, experiment_id=self.experiment_id, run_id=self.parent_run_id).write(storage)
        self._sender.start()

    @property
    def experiment_id(self) -> str:
        return self._experiment.id

    @property
    def parent_run_id(self) -> str:
        return self._parent.attach().run_id

    def start(self, run: RunInfo) -> None:
        """A run starts or is resumed; all its reports follow, from the first one on."""
        self._queue(run.node_key).start(run)

    def log(self, node_key: str, reports: Sequence[Report]) -> None:
        self._runs[node_key].report(reports)

    def end(self, node_key: str, status: Status, tags: Mapping[str, str] | None = None) -> None:
        """End a started run that has no result in the store; `tags` say why.

        The status of a stopped run that can be resumed is KILLED.
        """
        short = {key: redact(value)[:MAX_CAUSE_LENGTH] for key, value in (tags or {}).items()}
        self._runs[node_key].end(status, short)

    def mirror(self, run: RunInfo, read: Callable[[], StoredRun]) -> None:
        """Log a finished run of the store, from this sweep or an earlier one.

        The sending thread calls `read`, unless MLflow has all of the run already.
        """
        self._queue(run.node_key).mirror(run, read)

    def forget(self, node_key: str) -> None:
        """Delete the MLflow run of a node that is trained again; errors are only logged."""
        try:
            self._experiment.delete(node_key)
        except Exception as error:
            logger.warning("MLflow keeps the earlier run %s: %s", node_key, mlflow_reason(error))

    def leave(self, node_key: str) -> None:
        if (queue := self._runs.pop(node_key, None)) is not None:
            queue.is_running = False  # the sender keeps it no longer
            queue.drop()

    def look_again(self) -> None:
        """Send what is waiting, and find the runs that other drivers have created meanwhile."""
        self._sender.flush(20.0)
        self._experiment.known = None

    def keep_current(self, node_keys: Iterable[str]) -> None:
        """Mark the runs of these nodes as the sweep's current runs, and all others as earlier."""
        self._parent.keep_current(node_keys)

    def put_sweep_artifact(self, name: str, content: str) -> None:
        self._parent.put_text(name, content)

    def is_running(self, node_key: str) -> bool:
        queue = self._runs.get(node_key)
        return queue is not None and queue.is_running

    def keep_view(self, content: str, versions: Sequence[str]) -> None:
        """Save a view for `comparison_url`, if MLflow has one of these versions.

        Other versions may have another format. Errors are only logged: the page works without.
        """
        version = mlflow_version(self.store) or ""
        if not version.startswith(tuple(f"{known}." for known in versions)):
            return
        try:
            key = names.TAG_VIEW_PREFIX + self.sweep_id
            self._experiment.client.set_experiment_tag(self.experiment_id, key, content)
        except Exception as error:
            logger.warning("MLflow's page has no view of the sweep: %s", mlflow_reason(error))
        else:
            self._view = {"viewStateShareKey": self.sweep_id}

    def comparison_url(self) -> str:
        """URL of the experiment's chart page, with the view of `keep_view`."""
        query = urlencode({"compareRunsMode": "CHART", **self._view})
        return f"{self.store.pages}/#/experiments/{self.experiment_id}/runs?{query}"

    def pending(self) -> Pending:
        return self._undelivered or self._sender.pending()

    def flush(self, timeout: float) -> bool:
        """Wait at most `timeout` s for delivery; returns whether everything is delivered."""
        return self._sender.flush(timeout)

    def close(
        self,
        status: Status = "FINISHED",
        timeout: float = 20.0,
        say: Callable[[int], None] | None = None,
    ) -> Pending:
        """End the parent run, send what is left, and return the undelivered records.

        Unfinished runs are marked KILLED; a later sweep continues them. A second call only
        returns the same value again.

        Args:
            status: Status of the parent run.
            timeout: Seconds after which to stop sending; with `say`, seconds without any progress.
            say: Receives the number of records that are left, every few seconds. Ctrl-C then ends
                the wait.
        """
        if self._undelivered is None:
            for node_key, queue in self._runs.items():
                if queue.is_running:
                    self.end(node_key, "KILLED")
            self._parent.end(status, {})
            with contextlib.suppress(*(() if say is None else (KeyboardInterrupt,))):
                self._sender.flush(timeout, say)
            self._sender.stop()
            self._sender.join(1.0)  # a request that is being sent ends by itself, and is harmless
            self._undelivered = self._sender.pending()
        return self._undelivered

    def undelivered_message(self) -> str | None:
        """The undelivered records and the command that sends them; None if all was delivered."""
        pending = self.pending()
        if not pending:
            return None
        return (
            f"{pending.records} records did not reach MLflow at {self.store.public_uri} "
            f"({pending.error or 'there was no time left'}). The results are in the storage; send "
            f"them with:\n  {shlex.join([PROGRAM, 'resume', self._place])}"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, *rest: object) -> None:
        self.close("FINISHED" if error is None else "KILLED" if is_stop(error) else "FAILED")

    def _parent_run(self, config: Mapping[str, object]) -> RunQueue:
        """The parent run. It is created at once, as its children need its id."""
        sweep = {names.TAG_SWEEP: self._name}
        parent = RunQueue(self._experiment, "", sweep, self._sender.add)
        parent.start(RunInfo(node_key="", name=self._name, config=config))
        parent.put_text(names.ARTIFACT_SWEEP_CONFIG, _as_yaml(config))
        with answers_named(self.store, "accept the sweep's run"):
            parent.attach()
        return parent

    def _queue(self, node_key: str) -> RunQueue:
        if (queue := self._runs.get(node_key)) is None:
            tags = {names.TAG_SWEEP: self._name, names.TAG_PARENT_RUN: self.parent_run_id}
            queue = RunQueue(self._experiment, node_key, tags, self._sender.add)
            self._runs[node_key] = queue
        return queue


@dataclass(frozen=True, kw_only=True)
class SweepRun:
    """The parent run of a sweep's current plan in MLflow."""

    store: TrackingStore
    experiment_id: str
    run_id: str

    @classmethod
    def of(cls, sweep: OpenSweep) -> SweepRun:
        """The run that the sweep's record names.

        Raises:
            TrackingError: The sweep was not tracked.
        """
        record = SweepRecord.read(sweep.storage, sweep.config.name)
        if record is None or not record.run_id:
            raise TrackingError(
                f"--attach must be given with a sweep that was tracked, {sweep.config.name} has no "
                "run in MLflow: run the sweep again, which reuses finished runs"
            )
        # The record has no password; the driver of a sweep passes the whole URI to the report.
        uri = os.environ.get(names.VARIABLE_TRACKING_URI) or record.tracking_uri
        store = resolve_store(uri, sweep.storage)
        return cls(store=store, experiment_id=record.experiment_id, run_id=record.run_id)

    @property
    def page(self) -> str:
        """The address of the run's page, or its id if no server shows it."""
        if not self.store.is_server:
            return f"run {self.run_id}"
        return f"{self.store.pages}/#/experiments/{self.experiment_id}/runs/{self.run_id}"

    def attach(self, folder: Path, files: Iterable[str], name: str, note: str) -> None:
        """Log `files` of `folder` as artifacts below `name`, and set the run's description.

        Raises:
            TrackingError: MLflow does not answer, or refuses the files.
        """
        check_reachable(self.store)
        with answers_named(self.store, "take the report"), TemporaryDirectory() as copy:
            for file in files:  # one upload of these files only
                target = Path(copy, file)
                target.parent.mkdir(exist_ok=True)
                shutil.copyfile(folder / file, target)
            client = open_client(self.store)
            client.log_artifacts(self.run_id, copy, name)
            client.set_tag(self.run_id, names.TAG_NOTE, note)


_NOT_PLANNED = {"storage", "resources", "mlflow", "checkpoints", "analysis"}
"""Top-level settings that do not change which runs a sweep has."""


def _plan_key(config: Mapping[str, object]) -> str:
    """A hash of the settings that determine a sweep's runs."""
    planned = {name: value for name, value in config.items() if name not in _NOT_PLANNED}
    return content_key(json.loads(json.dumps(without_secrets(planned), default=str)))


def _as_yaml(settings: Mapping[str, object]) -> str:
    """Settings as a YAML file, without secrets."""
    plain = json.loads(json.dumps(without_secrets(settings), default=str))
    return str(yaml.dump(plain, Dumper=Dumper, sort_keys=False, allow_unicode=True))
