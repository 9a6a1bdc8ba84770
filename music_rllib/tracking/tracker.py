"""The sweep driver's one way to MLflow: log and go on; the rest happens behind.

After the constructor nothing here waits for a server: every call appends to a spool in the
sweep's folder (:mod:`music_rllib.tracking.spool`), and a thread delivers it.
"""

from __future__ import annotations

import logging
import shlex
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import urlencode

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.experiment.run_info import RunInfo
from music_rllib.redaction import flat_params
from music_rllib.tracking.mlflow_client import first_line
from music_rllib.tracking.provenance import provenance_tags
from music_rllib.tracking.records import as_yaml, finish_of, milliseconds, number_of, texts
from music_rllib.tracking.sender import Backlog
from music_rllib.tracking.session import Session, new_sweep_id, relative_storage
from music_rllib.tracking.spool import (
    Metrics,
    Record,
    Spool,
    Start,
    Status,
    check_metric_name,
)
from music_rllib.tracking.store import (
    SweepRecord,
    check_reachable,
    local_folder,
    resolve_store,
    version,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Point:
    """Metrics of a finished run at one number of environment steps."""

    env_steps: int
    timestamp: float
    """When they were measured, in seconds since the epoch."""
    metrics: Mapping[str, float]


class Tracker:
    """Logs one sweep: an experiment, a parent run, and a child run per node.

    Opening it again on the same sweep continues the same runs: a value whose step was logged
    before is left out, so a run that repeats steps after a resume shows each step once.
    Calls may come from several threads; only one process at a time can track a sweep.
    """

    def __init__(
        self,
        *,
        sweep_name: str,
        storage: str,
        config: Mapping[str, object],
        tracking_uri: str | None = None,
        sweep_folder: Path | None = None,
        sweep_id: str | None = None,
        tags: Mapping[str, object] | None = None,
    ) -> None:
        """Check the store, create the experiment and the parent run, begin to deliver.

        Args:
            sweep_name: also the experiment's name.
            storage: the sweep's storage, a folder or a bucket URI.
            config: the whole sweep's settings: params and the artefact ``config/sweep.yaml``
                of the parent run.
            tracking_uri: ``mlflow.tracking_uri``; None for a sqlite file in ``storage``.
            sweep_folder: local folder of the spools; ``<storage>/<sweep_name>`` by default,
                needed where the storage is a bucket.
            sweep_id: what tells this sweep from others of its name on the same server; kept in
                the sweep's folder, so it is needed only where that folder does not outlive the
                machine (a bucket).
            tags: tags of the parent run.

        Raises:
            TrackingError: where the store is not reachable or refuses, where the folder is not
                writable, or where another process tracks this sweep.
            ValueError: where ``sweep_folder`` is missing.
        """
        store = resolve_store(tracking_uri, storage)
        check_reachable(store)
        folder = sweep_folder or _default_folder(storage, sweep_name)
        known = SweepRecord.read(folder)
        record = SweepRecord(
            sweep_name=sweep_name,
            sweep_id=sweep_id or (known.sweep_id if known else new_sweep_id()),
            tracking_uri=None if tracking_uri is None else store.public_uri,
            storage=relative_storage(storage, folder),
        )
        self.sweep_folder = folder
        self.store = store
        self._provenance = provenance_tags()
        self._session = Session(folder, store, record)
        self._sweep_tags = {names.TAG_SWEEP: sweep_name, names.TAG_SWEEP_ID: record.sweep_id}
        self._open: dict[str, Spool] = {}
        self._settings: dict[str, list[Metrics]] = {}
        """What is not logged yet of runs that have begun."""
        self._checked_names: set[str] = set()
        self._left: Backlog | None = None
        self._view: dict[str, str] = {}
        self._unwritten: str | None = None
        """Why something could not even be kept on disk."""
        try:
            self._begin(sweep_name, config, tags or {})
        except BaseException:
            self._session.abandon()
            raise

    @property
    def experiment_id(self) -> str:
        """MLflow's id of the sweep's experiment."""
        return self._session.experiment.id

    @property
    def parent_run_id(self) -> str:
        """MLflow's id of the sweep's own run."""
        run_id = self._session.parent.run_id
        assert run_id is not None, "the constructor creates the parent run"
        return run_id

    def start(self, run: RunInfo) -> None:
        """A run begins, or goes on after a resume.

        Raises:
            ValueError: where a name or key is not one that MLflow accepts.
            TrackingError: where its spool cannot be written.
        """
        now = time.time()
        self._append(run.node_key, [self._opening(run, now)])
        self._settings[run.node_key] = self._settings_of(run, now)
        self._open[run.node_key].put_artefact(names.ARTEFACT_RUN_CONFIG, as_yaml(run.config))
        self._session.wake(run.node_key)

    def log(
        self,
        node_key: str,
        metrics: Mapping[str, float],
        env_steps: int,
        timestamp: float | None = None,
    ) -> None:
        """Metrics of a started run at ``env_steps``; values of a step logged before are left out.

        Args:
            node_key: the run.
            metrics: ``names.*`` to numbers; NaN and infinities are kept.
            env_steps: environment steps of the run so far; rises from call to call.
            timestamp: when they were measured, in seconds since the epoch; now by default.

        Raises:
            ValueError: where the run was not started, or a metric's name or value is not one
                that MLflow accepts.
            TrackingError: where the spool cannot be written.
        """
        self._started(node_key)
        when = time.time() if timestamp is None else timestamp
        measured = self._metrics(metrics, env_steps, when)
        self._append(node_key, [measured, *self._settings.pop(node_key, [])])
        self._session.wake(node_key)

    def finish(
        self,
        node_key: str,
        status: Status,
        *,
        artefacts: Mapping[str, Path] | None = None,
        failure: str | None = None,
    ) -> None:
        """A started run ended; its learning curve is drawn and kept as an artefact.

        Args:
            node_key: the run.
            status: FINISHED, FAILED, or KILLED for one that was stopped and can go on.
            artefacts: names in MLflow to files, which are copied at once.
            failure: the cause, where it failed; its beginning becomes a tag.

        Raises:
            ValueError: where the run was not started.
            TrackingError: where an artefact cannot be read or the spool cannot be written.
        """
        spool = self._started(node_key)
        for name, file in (artefacts or {}).items():
            spool.put_artefact(name, file)
        settings = self._settings.pop(node_key, [])
        self._append(node_key, [*settings, finish_of(status, time.time(), failure)])
        del self._open[node_key]
        self._session.wake(node_key)

    def log_history(
        self, run: RunInfo, history: Iterable[Point], artefacts: Mapping[str, Path] | None = None
    ) -> bool:
        """A run that an earlier sweep finished, in one go; nothing where it is already here.

        Returns:
            Whether something was added.

        Raises:
            ValueError: where a name, key or value is not one that MLflow accepts.
            TrackingError: where the spool cannot be written.
        """
        spool = self._session.open_run(run.node_key)
        if spool.finished == "FINISHED":
            return False
        points = sorted(history, key=lambda point: point.env_steps)
        first = min((point.timestamp for point in points), default=time.time())
        last = max((point.timestamp for point in points), default=first)
        measured = [self._metrics(p.metrics, p.env_steps, p.timestamp) for p in points]
        records: list[Record] = [
            self._opening(run, first, {names.TAG_REUSED: "true"}),
            *measured[:1],
            *self._settings_of(run, first),
            *measured[1:],
            finish_of("FINISHED", last, None),
        ]
        spool.put_artefact(names.ARTEFACT_RUN_CONFIG, as_yaml(run.config))
        for name, file in (artefacts or {}).items():
            spool.put_artefact(name, file)
        spool.append(records)
        self._session.wake(run.node_key)
        return True

    def put_sweep_artefact(self, name: str, content: str | bytes | Path) -> None:
        """An artefact of the parent run: text, bytes, or a file, which is copied at once."""
        self._session.parent.spool.put_artefact(name, content)
        self._session.wake()

    def run_id(self, node_key: str) -> str | None:
        """MLflow's id of a run; None until the server has it (see :meth:`flush`)."""
        return self._session.run_id(node_key)

    def run_url(self, node_key: str) -> str | None:
        """The page of a run; None without a server, or until the server has the run."""
        run_id = self.run_id(node_key)
        return None if run_id is None else self.store.run_url(self.experiment_id, run_id)

    @property
    def sweep_id(self) -> str:
        """What the sweep's runs are tagged with."""
        return self._sweep_tags[names.TAG_SWEEP_ID]

    def keep_view(self, content: str, versions: Sequence[str]) -> None:
        """Have :meth:`comparison_url` open a view, where MLflow is of one of these versions.

        Another one may have another format. Never fails: the page is of use without a view.
        """
        found = version(self.store) or ""
        if not found.startswith(tuple(f"{known}." for known in versions)):
            return
        try:
            self._session.experiment.keep_view(self.sweep_id, content)
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

    def backlog(self) -> Backlog:
        """What MLflow does not have yet, and why; for a progress display."""
        return self._left or self._session.backlog()

    def flush(self, timeout: float) -> bool:
        """Wait until MLflow has everything; False where that takes more than ``timeout`` s."""
        return self._session.flush(timeout)

    def close(self, status: Status = "FINISHED", timeout: float = 20.0) -> Backlog:
        """End the sweep's run, deliver for at most ``timeout`` s, and say what is left over.

        Runs that were started and not finished are marked KILLED; a later sweep continues them.
        The second call only repeats the first one's answer.
        """
        if self._left is None:
            try:
                for node_key in list(self._open):
                    self.finish(node_key, "KILLED")
                self._session.parent.spool.append([finish_of(status, time.time(), None)])
            except TrackingError as error:  # results are in the store: this must not hide them
                self._unwritten = str(error)
            self._left = self._session.close(timeout)
        return self._left

    def undelivered_message(self) -> str | None:
        """What did not arrive, where it is kept and how to send it; None where all arrived."""
        left = self.backlog()
        if self._unwritten is not None:
            return (
                f"MLflow doesn't have everything: {self._unwritten}. Repeat the command when that "
                "is mended: what is finished is logged from the storage"
            )
        if not left:
            return None
        command = shlex.join(["python", "-m", "music_rllib.tracking", "deliver"])
        return (
            f"{left.records} records and {left.artefacts} artefacts did not reach MLflow at "
            f"{self.store.public_uri} ({left.error or 'there was no time left'}). They are kept "
            f"in {self._session.folder}; send them with:\n"
            f"  {command} {shlex.quote(str(self.sweep_folder))}"
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

    def _begin(
        self, sweep_name: str, config: Mapping[str, object], tags: Mapping[str, object]
    ) -> None:
        self._session.begin(
            Start(
                time=milliseconds(time.time()),
                name=sweep_name,
                tags={**self._provenance, **self._sweep_tags, **texts(tags)},
                params=flat_params(config),
            )
        )
        self.put_sweep_artefact(names.ARTEFACT_SWEEP_CONFIG, as_yaml(config))

    def _opening(self, run: RunInfo, when: float, more: Mapping[str, str] | None = None) -> Start:
        tags = {**self._provenance, **self._sweep_tags, **texts(run.tags), **(more or {})}
        return Start(
            time=milliseconds(when),
            name=run.name,
            tags=tags,
            params=flat_params(run.config),
            source_node=run.source_node,
        )

    def _settings_of(self, run: RunInfo, when: float) -> list[Metrics]:
        """To be logged behind the first measurement, which MLflow then has on its axes.

        Its page that compares runs takes the metric that came first: q against q says nothing.
        """
        return [self._metrics(run.settings, 0, when)] if run.settings else []

    def _append(self, node_key: str, records: Iterable[Record]) -> None:
        self._open[node_key] = self._open.get(node_key) or self._session.open_run(node_key)
        self._open[node_key].append(records)

    def _started(self, node_key: str) -> Spool:
        if node_key not in self._open:
            raise ValueError(f"start(...) must come before log and finish, for node {node_key!r}")
        return self._open[node_key]

    def _metrics(self, metrics: Mapping[str, float], env_steps: int, when: float) -> Metrics:
        for name in metrics:
            if name not in self._checked_names:
                check_metric_name(name)
                self._checked_names.add(name)
        values = {name: number_of(name, value) for name, value in metrics.items()}
        return Metrics(time=milliseconds(when), step=int(env_steps), values=values)


def _default_folder(storage: str, sweep_name: str) -> Path:
    folder = local_folder(storage)
    if folder is None:
        raise ValueError(f"sweep_folder must be given where storage is a bucket, got {storage}")
    return folder / sweep_name
