"""The sweep driver's one way to MLflow: tell and go on; the rest happens behind.

MLflow is a projection of what is in the store and what running runs report
(:mod:`music_rllib.tracking.projection`): after the constructor nothing here waits for a server or
writes to a disk, and a thread brings what is new.
"""

from __future__ import annotations

import json
import logging
import re
import shlex
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
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
from music_rllib.store.paths import sweep_folder
from music_rllib.store.run_record import Report
from music_rllib.tracking.mlflow_client import Experiment, Status, check_metric_name, first_line
from music_rllib.tracking.projection import End, RunProjection, Start, StoredRun
from music_rllib.tracking.provenance import provenance_tags
from music_rllib.tracking.sender import Pending, Sender
from music_rllib.tracking.store import (
    SweepRecord,
    check_reachable,
    resolve_store,
    version,
)

__all__ = ["Tracker"]

logger = logging.getLogger(__name__)

MAX_CAUSE_LENGTH = 1000
"""Characters of why a run ended that are kept as a tag; the rest is in the run's log."""
_NODE_KEY = re.compile(r"[\w\-]+")


class Tracker:
    """Brings one sweep to MLflow: an experiment, a parent run, and a child run per node.

    Opening it again on the same sweep continues the same runs: a value whose step MLflow has is
    left out, so a run that repeats steps after a resume shows each step once.
    Calls may come from several threads; only one process at a time can track a sweep.
    """

    def __init__(
        self,
        *,
        sweep_name: str,
        storage: str,
        config: Mapping[str, object],
        tracking_uri: str | None = None,
    ) -> None:
        """Check the store, create the experiment and the parent run, begin to send.

        Args:
            sweep_name: also the experiment's name.
            storage: the sweep's storage, a folder or a bucket URI.
            config: the whole sweep's settings: params and the artefact ``config/sweep.yaml``
                of the parent run.
            tracking_uri: ``mlflow.tracking_uri``; None for a sqlite file in ``storage``.

        Raises:
            TrackingError: where the store is not reachable or refuses, where the storage is not
                writable, or where another process tracks this sweep.
        """
        self.store = resolve_store(tracking_uri, storage)
        check_reachable(self.store)
        folder = sweep_folder(storage, sweep_name)
        self._lock = _locked(folder / "tracking")
        self._runs: dict[str, RunProjection] = {}
        self._checked_names: set[str] = set()
        self._left: Pending | None = None
        self._view: dict[str, str] = {}
        self._place = f"{redact(storage)}/{sweep_name}"
        self._provenance = provenance_tags()
        try:
            # A version before this one kept the record of a bucket's sweep on the driver's disk.
            known = SweepRecord.read(storage, sweep_name) or SweepRecord.read(
                str(folder.parent), folder.name
            )
            self.sweep_id = known.sweep_id if known else uuid.uuid4().hex[:16]
            self._sweep_tags = {names.TAG_SWEEP: sweep_name, names.TAG_SWEEP_ID: self.sweep_id}
            SweepRecord(
                sweep_name=sweep_name,
                sweep_id=self.sweep_id,
                tracking_uri=None if tracking_uri is None else self.store.public_uri,
            ).write(storage)
            self._experiment = Experiment(self.store, sweep_name, self.sweep_id)
            self._parent = self._begin(sweep_name, config)
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
        """A run begins, or goes on after a resume; its reports are then told from its first one on.

        Raises:
            ValueError: where a name or key is not one that MLflow accepts.
        """
        told = self._run(run.node_key)
        told.start(self._as_start(run))
        told.put_artefact(names.ARTEFACT_RUN_CONFIG, partial(_as_yaml, run.config))
        self._sender.add(told)

    def log(self, node_key: str, reports: Sequence[Report]) -> None:
        """Reports of a started run; values of a step that MLflow has are left out.

        Raises:
            ValueError: where the run was not started, or a metric's name is not one that MLflow
                accepts.
        """
        run = self._started(node_key)
        for report in reports:
            self._check_names(report.metrics)
        run.report(reports)
        self._sender.add(run)

    def end(self, node_key: str, status: Status, tags: Mapping[str, str] | None = None) -> None:
        """A started run ended without a result in the store; its learning curve is drawn.

        Args:
            node_key: the run.
            status: FAILED, or KILLED for one that was stopped and can go on.
            tags: say why; their beginnings are kept.

        Raises:
            ValueError: where the run was not started.
        """
        run = self._started(node_key)
        run.end(End(time=_now(), status=status, tags=_shortened(tags or {})))
        self._sender.add(run)

    def mirror(self, run: RunInfo, read: Callable[[], StoredRun]) -> None:
        """The store has a run: MLflow gets what it has not of it, now or by an earlier sweep.

        Args:
            run: as for `start`.
            read: gives all of the run; called by another thread, unless MLflow has it.

        Raises:
            ValueError: where a name or key is not one that MLflow accepts.
        """
        told = self._run(run.node_key)
        told.mirror(self._as_start(run), read)
        told.put_artefact(names.ARTEFACT_RUN_CONFIG, partial(_as_yaml, run.config))
        self._sender.add(told)

    def put_sweep_artefact(self, name: str, content: str) -> None:
        """An artefact of the parent run."""
        self._parent.put_artefact(name, content.encode())
        self._sender.add(self._parent)

    def run_id(self, node_key: str) -> str | None:
        """MLflow's id of a run; None until the server has it (see :meth:`flush`)."""
        run = self._runs.get(node_key)
        return None if run is None else run.run_id

    def keep_view(self, content: str, versions: Sequence[str]) -> None:
        """Have :meth:`comparison_url` open a view, where MLflow is of one of these versions.

        Another one may have another format. Never fails: the page is of use without a view.
        """
        found = version(self.store) or ""
        if not found.startswith(tuple(f"{known}." for known in versions)):
            return
        try:
            self._experiment.keep_view(self.sweep_id, content)
        except Exception as error:
            logger.warning("MLflow's page has no view of the sweep: %s", first_line(error))
        else:
            self._view = {"viewStateShareKey": self.sweep_id}

    def comparison_url(self) -> str:
        """The chart page of the sweep's experiment, with the view of `keep_view`."""
        query = urlencode({"compareRunsMode": "CHART", **self._view})
        return f"{self.store.pages}/#/experiments/{self.experiment_id}/runs?{query}"

    def ui_command(self) -> str:
        """What opens MLflow's pages: a command, or a server's address."""
        return self.store.ui_command()

    def pending(self) -> Pending:
        """What MLflow does not have yet, and why; for a progress display."""
        return self._left or self._sender.pending()

    def flush(self, timeout: float) -> bool:
        """Wait until MLflow has everything; False where that takes more than ``timeout`` s."""
        return self._sender.flush(timeout)

    def close(self, status: Status = "FINISHED", timeout: float = 20.0) -> Pending:
        """End the sweep's run, send for at most ``timeout`` s, and say what is left over.

        Runs that were started and not finished are marked KILLED; a later sweep continues them.
        The second call only repeats the first one's answer.
        """
        if self._left is None:
            for node_key, run in self._runs.items():
                if run.under_way:
                    self.end(node_key, "KILLED")
            self._parent.end(End(time=_now(), status=status))
            self._sender.add(self._parent)
            self._sender.flush(timeout)
            self._sender.stop()
            self._sender.join(1.0)  # a request under way ends by itself, and is harmless
            self._lock.release()
            self._left = self._sender.pending()
        return self._left

    def undelivered_message(self) -> str | None:
        """What did not arrive, and how to send it; None where all arrived."""
        left = self.pending()
        if not left:
            return None
        command = shlex.join(["python", "-m", "music_rllib.tracking", "deliver", self._place])
        return (
            f"{left.records} records and {left.artefacts} artefacts did not reach MLflow at "
            f"{self.store.public_uri} ({left.error or 'there was no time left'}). The results are "
            f"in the storage; send them with:\n  {command}"
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

    def _begin(self, sweep_name: str, config: Mapping[str, object]) -> RunProjection:
        """The sweep's own run, found or created at once, so that runs are nested below it."""
        parent = RunProjection(self._experiment)
        parent.start(
            Start(
                time=_now(),
                name=sweep_name,
                tags=self._sweep_tags,
                provenance=self._provenance,
                params=flat_params(config),
            )
        )
        parent.put_artefact(names.ARTEFACT_SWEEP_CONFIG, _as_yaml(config))
        try:
            parent.attach()
        except Exception as error:
            raise TrackingError(
                f"MLflow at {self.store.public_uri} must accept the sweep's run, "
                f"it answered: {first_line(error)}"
            ) from error
        return parent

    def _run(self, node_key: str) -> RunProjection:
        if not _NODE_KEY.fullmatch(node_key):
            raise ValueError(f"a node key is letters, digits, - and _, got {node_key!r}")
        if node_key not in self._runs:
            self._runs[node_key] = RunProjection(
                self._experiment, node_key, self._parent.attach(), self._experiment.known_id
            )
        return self._runs[node_key]

    def _started(self, node_key: str) -> RunProjection:
        run = self._runs.get(node_key)
        if run is None or not run.under_way:
            raise ValueError(f"start(...) must come before log and end, for node {node_key!r}")
        return run

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
        """Before MLflow would refuse all of the run's records for one name."""
        for name in metrics.keys() - self._checked_names:
            check_metric_name(name)
            self._checked_names.add(name)


def _now() -> int:
    """MLflow's time: ms since the epoch."""
    return round(time.time() * 1000)


def _shortened(tags: Mapping[str, str]) -> dict[str, str]:
    return {key: redact(value)[:MAX_CAUSE_LENGTH] for key, value in tags.items()}


def _as_yaml(settings: Mapping[str, object]) -> bytes:
    """Settings as a file, no secret in it."""
    plain = json.loads(json.dumps(without_secrets(settings), default=str))
    return str(yaml.safe_dump(plain, sort_keys=False, allow_unicode=True)).encode()


def _locked(folder: Path) -> FileLock:
    """Against a second process that tracks the sweep on this machine."""
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
