"""A sweep's spools on one side and its MLflow experiment on the other.

Below the sweep's folder::

    tracking/sweep.json          the sweep's name and id, and where its runs go
    tracking/lock                held by the one process that delivers
    tracking/parent/             spool of the parent run
    tracking/runs/<node key>/    spool of each child run
"""

from __future__ import annotations

import os
import re
import uuid
from pathlib import Path

from filelock import FileLock, Timeout

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.tracking.delivery import Delivery
from music_rllib.tracking.mlflow_client import Experiment, first_line
from music_rllib.tracking.sender import Backlog, Sender
from music_rllib.tracking.spool import Spool, Start, has_undelivered
from music_rllib.tracking.store import (
    SweepRecord,
    TrackingStore,
    check_reachable,
    local_folder,
    resolve_store,
    tracking_folder,
)

_NODE_KEY = re.compile(r"[\w\-]+")


def relative_storage(storage: str, sweep_folder: Path) -> str:
    """``storage`` as :class:`SweepRecord` keeps it."""
    folder = local_folder(storage)
    return storage if folder is None else os.path.relpath(folder, sweep_folder)


def new_sweep_id() -> str:
    """A fresh id for a sweep that was never tracked before."""
    return uuid.uuid4().hex[:16]


class Session:
    """Delivers a sweep's spools while it is open. One at a time per sweep."""

    def __init__(self, sweep_folder: Path, store: TrackingStore, record: SweepRecord) -> None:
        """Lock the sweep, connect, and take up whatever an earlier process left undelivered.

        Raises:
            TrackingError: where another process delivers this sweep, the folder is not writable,
                or the store refuses.
        """
        self.folder = tracking_folder(sweep_folder)
        self.store = store
        self._record = record
        self._runs: dict[str, Delivery] = {}
        self._lock = _locked(self.folder)
        try:
            record.write(sweep_folder)
            self.experiment = Experiment(store, record.sweep_name)
            self.parent = Delivery(
                Spool(self.folder / "parent"),
                self.experiment,
                {names.TAG_KIND: names.KIND_SWEEP, names.TAG_SWEEP_ID: record.sweep_id},
            )
            self._sender = Sender(store.public_uri)
        except OSError as error:
            self._lock.release()
            raise TrackingError(f"{self.folder} must be writable: {error}") from error
        except BaseException:
            self._lock.release()
            raise

    def begin(self, start: Start | None = None) -> None:
        """Create or find the parent run, then deliver in the background.

        Args:
            start: the sweep begins or continues; None to deliver only.

        Raises:
            TrackingError: where the store does not accept the parent run.
        """
        try:
            if start is not None:
                self.parent.spool.append([start])
            if self.parent.spool.start is not None:
                self.parent.attach()
        except TrackingError:
            raise
        except Exception as error:
            raise TrackingError(
                f"MLflow at {self.store.public_uri} must accept the sweep's run, "
                f"it answered: {first_line(error)}"
            ) from error
        self._sender.add(self.parent)
        for folder in sorted((self.folder / "runs").glob("*")):
            if has_undelivered(folder):
                self.open_run(folder.name)
                self.wake(folder.name)
        self._sender.start()

    def open_run(self, node_key: str) -> Spool:
        """The spool of a node's run, delivered from now on.

        Raises:
            ValueError: where ``node_key`` is no key.
            TrackingError: where the spool cannot be read or written.
        """
        if not _NODE_KEY.fullmatch(node_key):
            raise ValueError(f"a node key is letters, digits, - and _, got {node_key!r}")
        if node_key not in self._runs:
            delivery = Delivery(
                Spool(self.folder / "runs" / node_key),
                self.experiment,
                self._identity(node_key),
                self.parent.run_id,
                self._find_source,
            )
            self._runs[node_key] = delivery
        return self._runs[node_key].spool

    def run_id(self, node_key: str) -> str | None:
        """MLflow's id of a node's run; None until it is known there."""
        delivery = self._runs.get(node_key)
        return None if delivery is None else delivery.run_id

    def wake(self, node_key: str | None = None) -> None:
        """Say that a run's spool has something new; without a key, that of the sweep's own run."""
        self._sender.add(self.parent if node_key is None else self._runs[node_key])

    def backlog(self) -> Backlog:
        """What MLflow does not have yet."""
        return self._sender.backlog()

    def flush(self, timeout: float) -> bool:
        """Wait for the delivery of everything; False where it took more than ``timeout`` s."""
        return self._sender.flush(timeout)

    def close(self, timeout: float) -> Backlog:
        """Deliver for at most ``timeout`` s, then let go of the sweep; what is left over."""
        self._sender.flush(timeout)
        self.abandon()
        return self._sender.backlog()

    def abandon(self) -> None:
        """Let go of the sweep at once. A request under way ends by itself, and is harmless."""
        self._sender.stop()
        if self._sender.is_alive():
            self._sender.join(1.0)
        self._lock.release()

    def _identity(self, node_key: str) -> dict[str, str]:
        return {
            names.TAG_KIND: names.KIND_RUN,
            names.TAG_SWEEP_ID: self._record.sweep_id,
            names.TAG_NODE_KEY: node_key,
        }

    def _find_source(self, node_key: str) -> str | None:
        return self.run_id(node_key) or self.experiment.find_run(self._identity(node_key))


def deliver(sweep_folder: Path, tracking_uri: str | None, timeout: float) -> Backlog:
    """Send what a sweep's spools still hold.

    Args:
        sweep_folder: the folder that holds ``tracking/``.
        tracking_uri: where to, in place of the sweep's own (which is kept without its password).
        timeout: seconds to try for.

    Returns:
        What is left over.

    Raises:
        TrackingError: where there is no tracked sweep, another process has it, or the store is
            not reachable.
    """
    folder = sweep_folder.absolute()
    record = SweepRecord.read(folder)
    if record is None:
        raise TrackingError(
            f"{folder} must be the folder of a tracked sweep, with tracking/sweep.json in it"
        )
    store = resolve_store(tracking_uri or record.tracking_uri, record.resolve_storage(folder))
    check_reachable(store)
    session = Session(folder, store, record)
    try:
        session.begin()
    except BaseException:
        session.abandon()
        raise
    return session.close(timeout)


def _locked(folder: Path) -> FileLock:
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
