"""What the sweep driver calls to log a sweep to MLflow.

MLflow shows a projection of the store and of what running runs report. Only the constructor waits
for a server or writes to a disk; afterwards every call only fills the queues of
:mod:`music_rllib.tracking.projection`, which a thread (:mod:`music_rllib.tracking.sender`) sends.
"""

from __future__ import annotations

import json
import logging
import re
import shlex
import time
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import urlencode

import yaml
from filelock import FileLock, Timeout

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.experiment.run_info import RunInfo
from music_rllib.redaction import flat_params, redact, without_secrets
from music_rllib.runtime.provenance import provenance_tags
from music_rllib.store.files import content_key
from music_rllib.store.history import Report
from music_rllib.store.paths import below, sweep_folder
from music_rllib.tracking.mlflow_client import Experiment, Status, check_metric_name, mlflow_reason
from music_rllib.tracking.projection import End, RunProjection, Start, StoredRun
from music_rllib.tracking.sender import Pending, Sender
from music_rllib.tracking.store import SweepRecord, check_reachable, mlflow_version, resolve_store

logger = logging.getLogger(__name__)

MAX_CAUSE_LENGTH = 1000
"""Longest tag that says why a run ended, in characters; the run's log has all of it."""
_NODE_KEY = re.compile(r"[\w\-]+")


class Tracker:
    """Logs one sweep to MLflow: an experiment, a parent run, and a child run per node.

    A tracker that is opened again on the same sweep continues its runs. Values of steps that
    MLflow has already are skipped, so a run that repeats steps after a resume shows each step once.
    Several threads may call it, but only one process at a time may track a sweep. Methods raise
    ValueError for names that MLflow would refuse, and for events of a run that was not started.
    """

    def __init__(
        self,
        *,
        sweep_name: str,
        storage: str,
        config: Mapping[str, object],
        tracking_uri: str | None = None,
        plan: str = "",
    ) -> None:
        """Check the store, create the experiment and the parent run, and start the thread.

        Args:
            sweep_name: Name of the sweep and of the experiment.
            storage: The sweep's storage, a folder or a bucket URI.
            config: All settings of the sweep; they become params and the artefact
                `config/sweep.yaml` of the parent run.
            tracking_uri: `mlflow.tracking_uri`; None for a sqlite file in `storage`.
            plan: Identifies the sweep's plan, which has a parent run of its own; by default the
                hash of the settings that determine it.

        Raises:
            TrackingError: The store is not reachable or refuses, the storage is not writable, or
                another process tracks this sweep.
        """
        self.store = resolve_store(tracking_uri, storage)
        check_reachable(self.store)
        folder = sweep_folder(storage, sweep_name)
        self._lock = _lock(folder / "tracking")
        self._runs: dict[str, RunProjection] = {}
        self._checked_names: set[str] = set()
        self._undelivered: Pending | None = None
        self._view: dict[str, str] = {}
        self._place = below(redact(storage), sweep_name)
        self._provenance = provenance_tags()
        try:
            record = SweepRecord.read(storage, sweep_name)
            self.sweep_id = record.sweep_id if record else uuid.uuid4().hex[:16]
            self._sweep_tags = {names.TAG_SWEEP: sweep_name, names.TAG_SWEEP_ID: self.sweep_id}
            record = SweepRecord(
                sweep_name=sweep_name,
                sweep_id=self.sweep_id,
                tracking_uri=None if tracking_uri is None else self.store.public_uri,
                plan=plan or _plan_key(config),
            )
            record.write(storage)  # before there is anything in MLflow to be found again
            self._experiment = Experiment(self.store, sweep_name, self.sweep_id, record.plan)
            self._parent = self._parent_run(sweep_name, config)
            replace(record, experiment_id=self.experiment_id, run_id=self.parent_run_id).write(
                storage
            )
        except BaseException:
            self._lock.release()
            raise
        self._sender = Sender(self.store.public_uri)
        self._sender.add(self._parent)
        self._sender.start()

    @property
    def experiment_id(self) -> str:
        """MLflow's id of the sweep's experiment."""
        return self._experiment.id

    @property
    def parent_run_id(self) -> str:
        """MLflow's id of the sweep's own run."""
        return self._parent.attach().run_id

    def start(self, run: RunInfo) -> None:
        """A run starts or is resumed; all its reports follow, from the first one on."""
        projection = self._projection(run)
        projection.start(self._as_start(run))
        self._sender.add(projection)

    def log(self, node_key: str, reports: Sequence[Report]) -> None:
        """Log reports of a started run."""
        projection = self._started(node_key)
        for report in reports:
            self._check_names(report.metrics)
        projection.report(reports)
        self._sender.add(projection)

    def end(self, node_key: str, status: Status, tags: Mapping[str, str] | None = None) -> None:
        """End a started run that has no result in the store; `tags` say why.

        A run that was stopped, and can be continued, is KILLED.
        """
        projection = self._started(node_key)
        short = {key: redact(value)[:MAX_CAUSE_LENGTH] for key, value in (tags or {}).items()}
        projection.end(End(time=_now(), status=status, tags=short))
        self._sender.add(projection)

    def mirror(self, run: RunInfo, read: Callable[[], StoredRun]) -> None:
        """Log a run of the store, from this sweep or an earlier one.

        The sending thread calls `read`, unless MLflow has all of the run already.
        """
        projection = self._projection(run)
        projection.mirror(self._as_start(run), read)
        self._sender.add(projection)

    def forget(self, node_key: str) -> None:
        """Delete the MLflow run of a node that is trained again; errors are only logged."""
        try:
            self._experiment.delete(node_key)
        except Exception as error:
            logger.warning("MLflow keeps the earlier run %s: %s", node_key, mlflow_reason(error))

    def keep_current(self, node_keys: Iterable[str]) -> None:
        """The sweep has the runs of these nodes: mark them, and those of earlier plans."""
        self._parent.keep_current(node_keys)
        self._sender.add(self._parent)

    def put_sweep_artefact(self, name: str, content: str) -> None:
        """Add or replace an artefact of the parent run."""
        self._parent.put_artefact(name, content.encode())
        self._sender.add(self._parent)

    def run_id(self, node_key: str) -> str | None:
        """MLflow's id of a run; None until the server has the run."""
        projection = self._runs.get(node_key)
        return None if projection is None else projection.run_id

    def keep_view(self, content: str, versions: Sequence[str]) -> None:
        """Save a view for `comparison_url`, if MLflow has one of these versions.

        Other versions may have another format. Errors are only logged: the page works without.
        """
        version = mlflow_version(self.store) or ""
        if not version.startswith(tuple(f"{known}." for known in versions)):
            return
        try:
            self._experiment.keep_view(self.sweep_id, content)
        except Exception as error:
            logger.warning("MLflow's page has no view of the sweep: %s", mlflow_reason(error))
        else:
            self._view = {"viewStateShareKey": self.sweep_id}

    def comparison_url(self) -> str:
        """URL of the experiment's chart page, with the view of `keep_view`."""
        query = urlencode({"compareRunsMode": "CHART", **self._view})
        return f"{self.store.pages}/#/experiments/{self.experiment_id}/runs?{query}"

    def pending(self) -> Pending:
        """What MLflow does not have yet, and why."""
        return self._undelivered or self._sender.pending()

    def flush(self, timeout: float) -> bool:
        """Wait at most `timeout` s for delivery; returns whether everything is delivered."""
        return self._sender.flush(timeout)

    def close(self, status: Status = "FINISHED", timeout: float = 20.0) -> Pending:
        """End the parent run, send for at most `timeout` s, and return what is not delivered.

        Runs that are under way are marked KILLED; a later sweep continues them. A second call
        only returns the same value again.
        """
        if self._undelivered is None:
            for node_key, projection in self._runs.items():
                if projection.under_way:
                    self.end(node_key, "KILLED")
            self._parent.end(End(time=_now(), status=status))
            self._sender.add(self._parent)
            self._sender.flush(timeout)
            self._sender.stop()
            self._sender.join(1.0)  # a request under way ends by itself, and is harmless
            self._lock.release()
            self._undelivered = self._sender.pending()
        return self._undelivered

    def undelivered_message(self) -> str | None:
        """What was not delivered, and the command that sends it; None if all was delivered."""
        pending = self.pending()
        if not pending:
            return None
        command = shlex.join(["python", "-m", "music_rllib.tracking", "deliver", self._place])
        return (
            f"{pending.records} records and {pending.artefacts} artefacts did not reach MLflow at "
            f"{self.store.public_uri} ({pending.error or 'there was no time left'}). The results "
            f"are in the storage; send them with:\n  {command}"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close("FINISHED")
        else:
            self.close("FAILED" if issubclass(kind, Exception) else "KILLED")

    def _parent_run(self, sweep_name: str, config: Mapping[str, object]) -> RunProjection:
        """The sweep's own run. It is created at once, as its children need its id."""
        parent = RunProjection(self._experiment)
        parent.start(self._as_start(RunInfo(node_key="", name=sweep_name, config=config)))
        parent.put_artefact(names.ARTEFACT_SWEEP_CONFIG, _as_yaml(config))
        try:
            parent.attach()
        except Exception as error:
            raise TrackingError(
                f"MLflow at {self.store.public_uri} must accept the sweep's run, "
                f"it answered: {mlflow_reason(error)}"
            ) from error
        return parent

    def _projection(self, run: RunInfo) -> RunProjection:
        """The projection of a run, with the artefact of its settings."""
        key = run.node_key
        if not _NODE_KEY.fullmatch(key):
            raise ValueError(f"a node key is letters, digits, - and _, got {key!r}")
        if key not in self._runs:
            self._runs[key] = RunProjection(self._experiment, key, self._parent.attach())
        self._runs[key].put_artefact(names.ARTEFACT_RUN_CONFIG, partial(_as_yaml, run.config))
        return self._runs[key]

    def _started(self, node_key: str) -> RunProjection:
        projection = self._runs.get(node_key)
        if projection is None or not projection.under_way:
            raise ValueError(f"start(...) must come before log and end, for node {node_key!r}")
        return projection

    def _as_start(self, run: RunInfo) -> Start:
        self._check_names(run.settings)
        tags = {key: redact(str(value)) for key, value in run.tags.items() if value is not None}
        return Start(
            time=_now(),
            name=run.name,
            tags={**self._sweep_tags, **tags},
            provenance=self._provenance,
            params=flat_params(run.config),
            settings=run.settings,
            source_node=run.source_node,
        )

    def _check_names(self, metrics: Mapping[str, float]) -> None:
        """Check names here, as MLflow would refuse the whole request for one bad name."""
        for name in metrics.keys() - self._checked_names:
            check_metric_name(name)
            self._checked_names.add(name)


def _now() -> int:
    """Now, in ms since the epoch, as MLflow counts."""
    return round(time.time() * 1000)


_NOT_PLANNED = {"storage", "resources", "mlflow", "checkpoints", "analysis"}
"""Top-level settings that do not change which runs a sweep has."""


def _plan_key(config: Mapping[str, object]) -> str:
    """A hash of the settings that determine a sweep's runs."""
    planned = {name: value for name, value in config.items() if name not in _NOT_PLANNED}
    return content_key(json.loads(json.dumps(without_secrets(planned), default=str)))


def _as_yaml(settings: Mapping[str, object]) -> bytes:
    """Settings as a YAML file, without secrets."""
    plain = json.loads(json.dumps(without_secrets(settings), default=str))
    return str(yaml.safe_dump(plain, sort_keys=False, allow_unicode=True)).encode()


def _lock(folder: Path) -> FileLock:
    """Lock out a second process that tracks the sweep on this machine."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / "lock", timeout=0, thread_local=False)
        lock.acquire()
    except Timeout as error:
        raise TrackingError(
            f"{folder} must be used by one process at a time, and another one has it. "
            "Wait for that sweep to end, or give this one another name."
        ) from error
    except OSError as error:
        raise TrackingError(f"{folder} must be writable: {error}") from error
    return lock
