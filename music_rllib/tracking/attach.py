"""Files that are added to a sweep's own run in MLflow after the sweep."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.tracking.store import SweepRecord, TrackingStore, check_reachable, resolve_store


@dataclass(frozen=True, kw_only=True)
class SweepRun:
    """The MLflow run of a sweep's current plan."""

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
                "run in MLflow: run it again, which reuses what is finished"
            )
        # The record has no password; the driver of a sweep passes the whole URI on.
        uri = os.environ.get(names.VARIABLE_TRACKING_URI) or record.tracking_uri
        store = resolve_store(uri, sweep.storage)
        return cls(store=store, experiment_id=record.experiment_id, run_id=record.run_id)

    @property
    def page(self) -> str:
        """The address of the run's page, or its id where no server shows it."""
        if not self.store.is_server:
            return f"run {self.run_id}"
        pages = f"{self.store.pages}/#/experiments/{self.experiment_id}"
        return f"{pages}/runs/{self.run_id}"

    def attach(self, folder: Path, files: Iterable[str], name: str, note: str) -> None:
        """Log `files` of `folder` as artefacts below `name`, and show `note` on the run's page.

        Raises:
            TrackingError: MLflow does not answer, or does not take them.
        """
        check_reachable(self.store)
        from music_rllib.tracking.mlflow_client import attach, mlflow_reason

        try:
            with tempfile.TemporaryDirectory() as copy:  # all at once, and nothing else there
                for file in files:
                    target = Path(copy, file)
                    target.parent.mkdir(exist_ok=True)
                    shutil.copyfile(folder / file, target)
                attach(self.store, self.run_id, copy, name, note)
        except TrackingError:
            raise
        except Exception as error:
            raise TrackingError(
                f"MLflow at {self.store.public_uri} must take the report, it answered: "
                f"{mlflow_reason(error)}"
            ) from error
