"""Runs a sweep: what is left of its plan as trials of one Tune run, and what came of it."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ray import tune
from ray.tune.experiment import Trial

from music_rllib.experiment.listener import Listener
from music_rllib.experiment.scheduler import Status
from music_rllib.experiment.session import Sweep
from music_rllib.runtime.machine import cluster_address
from music_rllib.runtime.ray_cluster import cluster
from music_rllib.sweep.tune.dag_searcher import DagSearcher
from music_rllib.sweep.tune.events import RESTARTS, TuneEvents
from music_rllib.sweep.tune.stopping import StopSignals
from music_rllib.training.job import NodeJob
from music_rllib.training.worker import RunTrainable

if TYPE_CHECKING:
    from music_rllib.search.controller import SearchController

__all__ = ["Outcome", "compute"]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How computing ended."""

    stopped_by: int | None
    """The signal that stopped it; None if it went to its end."""


def compute(
    sweep: Sweep,
    listeners: Sequence[Listener],
    on_stop: Callable[[], None],
    on_ray_gone: Callable[[str | None], None],
    controller: SearchController | None = None,
) -> Outcome:
    """Compute the waiting nodes, and those that searches ask for.

    Args:
        sweep: Its scheduler says afterwards what became of each node.
        listeners: Are told what happens.
        on_stop: Called, in a signal handler, when the user asks to stop.
        on_ray_gone: Called, in a thread, before the process ends because Ray has: with the cause,
            or None where the user's signal has ended that as well.
        controller: The searches; None where there are none.

    Raises:
        ClusterError: Ray can't be reached or can't hold a run.
    """
    resources = sweep.config.resources
    grace = sweep.config.checkpoints.grace_seconds
    stopping = StopSignals(on_stop, grace, on_ray_gone=on_ray_gone)
    events = TuneEvents(sweep.scheduler, sweep.store, listeners, sweep.folder / "failures")
    searcher = DagSearcher(
        sweep.scheduler,
        lambda node: NodeJob.of(
            node,
            sweep.storage,
            resources.cpus_per_run,
            gpus=resources.gpus_per_run,
            memory=int(resources.bundle.get("memory", 0)),
            until=sweep.scheduler.until(node.key),
            checkpoints=sweep.config.checkpoints,
            sweep=sweep.plan.name,
            stop_key=stopping.flag.key,
            hang_minutes=resources.hang_minutes,
        ).to_tune(),
        **({} if controller is None else {"advance": controller.advance}),
        stopped=lambda: stopping.received is not None,
    )
    with (
        cluster(resources) as room,
        _tune_folder(sweep) as place,
        _quiet_tune(room.waiting),
        stopping,
    ):
        for listener in listeners:
            if room.remark is not None:
                listener.remarked(room.remark)
        tuner = tune.Tuner(
            RunTrainable,
            tune_config=tune.TuneConfig(
                search_alg=searcher,
                # As many as the searcher says; -1 is without an end.
                num_samples=-1 if controller else len(sweep.scheduler.having(Status.WAITING)),
                trial_name_creator=_trial_name,
                trial_dirname_creator=_trial_name,
            ),
            run_config=tune.RunConfig(
                name="tune",
                storage_path=place,
                verbose=0,
                callbacks=[events, stopping],
                # For workers that die; one that raises says so in its result.
                failure_config=tune.FailureConfig(max_failures=RESTARTS),
                # Checkpoints are the trainable's own; Tune's would hold nothing.
                checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
            ),
        )
        tuner.fit()
    done = sweep.scheduler.complete and (controller is None or controller.over)
    return Outcome(stopped_by=None if done else stopping.received)


def _trial_name(trial: Trial) -> str:
    # A node that a search continues is a second trial of Tune's.
    return f"{NodeJob.from_tune(trial.config).key}-{trial.trial_id}"


@contextlib.contextmanager
def _tune_folder(sweep: Sweep) -> Iterator[str]:
    """Where all nodes of the cluster can write what Tune wants to write and nobody reads."""
    if cluster_address() is None:
        # Not in the storage: a full one must not end the runs that have no need of it.
        with tempfile.TemporaryDirectory(prefix="music-tune-", ignore_cleanup_errors=True) as place:
            yield place
        return
    if "://" in sweep.storage:
        yield f"{sweep.storage.rstrip('/')}/{sweep.plan.name}"
        return
    yield str(sweep.folder)
    shutil.rmtree(sweep.folder / "tune", ignore_errors=True)


class _Expected(logging.Filter):
    """What Tune says when it is stopped or a trial failed; the sweep says it itself."""

    BEGINNINGS = (
        "Stop signal received",
        "Experiment has been interrupted",
        "Trials did not complete",
        "Could not fetch metrics",
        "Failed to fetch metrics",
    )

    def filter(self, record: logging.LogRecord) -> bool:
        return not record.getMessage().startswith(self.BEGINNINGS)


class _quiet_tune:  # noqa: N801
    """Settings that Tune takes from the environment only, for one run, and its log filtered."""

    LOGGERS = ("ray.tune.tune", "ray.tune.analysis.experiment_analysis")

    def __init__(self, waiting: int) -> None:
        self._settings = {
            # Trials that wait for an actor: as many as can run start side by side, and an
            # autoscaler adds nodes for those that wait.
            "TUNE_MAX_PENDING_TRIALS_PG": str(waiting),
            "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
            "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
            # Relative paths in a user's environment keep their meaning.
            "RAY_CHDIR_TO_TRIAL_DIR": "0",
            # Nobody reads Tune's snapshots.
            "TUNE_GLOBAL_CHECKPOINT_S": "3600",
        }
        self._filter = _Expected()

    def __enter__(self) -> None:
        self._before = {name: os.environ.get(name) for name in self._settings}
        os.environ.update(self._settings)
        for name in self.LOGGERS:
            logging.getLogger(name).addFilter(self._filter)

    def __exit__(self, *_: object) -> None:
        for name, value in self._before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        for name in self.LOGGERS:
            logging.getLogger(name).removeFilter(self._filter)
