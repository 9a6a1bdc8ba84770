"""Computes the runs of a sweep as trials of one Tune run."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

from ray import tune
from ray.tune.experiment import Trial
from ray.tune.search import Searcher

from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Node
from music_rllib.experiment.scheduler import Listener, Scheduler, Status
from music_rllib.runtime.machine import cluster_address, own_folder
from music_rllib.runtime.ray_cluster import cluster
from music_rllib.store.storage import below, encoded
from music_rllib.training.job import NodeJob
from music_rllib.training.worker import RunTrainable
from music_rllib.tune.events import RESTARTS, TuneEvents
from music_rllib.tune.stopping import StopSignals


class Searches(Protocol):
    """The searches of a sweep, which decide on new runs."""

    def propose(self) -> None:
        """Add the next runs to the scheduler if it has none that is ready."""

    @property
    def over(self) -> bool:
        """Whether no more runs will be added."""


class DagSearcher(Searcher):
    """Suggests each waiting node of a plan to Tune, once its input is published.

    Tune asks whenever it has room for a trial. After `None` it continues with its trials; without
    any it asks again after a second, which only happens while a search waits for the trials of
    another driver. After `FINISHED` it never asks again. A failed run does not stop the others.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        config_of: Callable[[Node], dict[str, Any]],
        searches: Searches | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Suggest the nodes of `scheduler`.

        Args:
            scheduler: Has the nodes and their statuses.
            config_of: Makes the Tune config of a node.
            searches: Add nodes to the scheduler.
            stopped: Returns whether the sweep was stopped.
        """
        super().__init__()
        self._scheduler = scheduler
        self._config_of = config_of
        self._searches = searches
        self._stopped = stopped

    def suggest(self, trial_id: str) -> dict[str, Any] | str | None:
        """The config of a node that can run, None for "not now", or `FINISHED`."""
        if self._stopped():
            return str(Searcher.FINISHED)
        if self._searches is not None:
            self._searches.propose()
        node = self._scheduler.next_ready()
        if node is None:
            over = self._searches is None or self._searches.over
            return str(Searcher.FINISHED) if self._scheduler.all_handed_out and over else None
        self._scheduler.start(node.key)
        return self._config_of(node)

    def on_trial_complete(
        self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False
    ) -> None:
        """Do nothing: the callback `TuneEvents` updates the node before the next suggestion."""

    def save_to_dir(self, checkpoint_dir: str, session_str: str = "default") -> None:
        """Save nothing."""

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles the searcher into a snapshot that is never read.
        return {}


def compute(
    sweep: OpenSweep,
    listeners: Sequence[Listener],
    on_stop: Callable[[], None],
    on_ray_gone: Callable[[str | None], None],
    searches: Searches | None,
) -> int | None:
    """Compute the waiting nodes, and those that searches ask for.

    Args:
        sweep: Afterwards, its scheduler has the status of each node.
        listeners: Receive the events of runs.
        on_stop: Called, in a signal handler, when the user asks to stop.
        on_ray_gone: Called, in a thread, before the process ends because Ray has ended: with the
            cause, or None if the user's signal ended Ray too.
        searches: The controller of the searches, if there are any.

    Returns:
        The signal that stopped the sweep; None if everything was computed.

    Raises:
        ClusterError: Ray can't be reached or can't hold a run.
    """
    resources = sweep.config.resources
    grace = sweep.config.checkpoints.grace_seconds
    stopping = StopSignals(on_stop, grace, on_ray_gone)
    events = TuneEvents(sweep.scheduler, sweep.store, listeners, sweep.folder / "failures")
    searcher = DagSearcher(
        sweep.scheduler,
        lambda node: NodeJob.of(
            node,
            sweep.storage,
            resources=resources,
            until=sweep.scheduler.until(node.key),
            checkpoints=sweep.config.checkpoints,
            sweep=sweep.plan.name,
            stop_key=stopping.flag.key,
            environment=sweep.environments.now.get(node.run.code),
            same_environments=sweep.environments.same(node.run.code),
        ).to_tune(),
        searches=searches,
        stopped=lambda: stopping.received is not None,
    )
    with (
        cluster(resources) as capacity,
        _tune_folder(sweep) as folder,
        _quiet_tune(capacity.waiting),
        stopping,
    ):
        if capacity.remark is not None:
            for listener in listeners:
                listener.remarked(capacity.remark)
        tuner = tune.Tuner(
            RunTrainable,
            tune_config=tune.TuneConfig(
                search_alg=searcher,
                # As many as the searcher suggests; -1 means no limit.
                num_samples=-1 if searches else len(sweep.scheduler.having(Status.WAITING)),
                reuse_actors=_may_share_processes(sweep),
                trial_name_creator=_trial_name,
                trial_dirname_creator=_trial_name,
            ),
            run_config=tune.RunConfig(
                name="tune",
                storage_path=folder,
                verbose=0,
                callbacks=[events, stopping],
                # For workers that die; errors of a run are in its result.
                failure_config=tune.FailureConfig(max_failures=RESTARTS),
                # The trainable writes its own checkpoints.
                checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
            ),
        )
        try:
            tuner.fit()
        except FileNotFoundError:
            # Ray deletes the working folder of a stopped job before its driver has ended, and Tune
            # needs one for a summary that is never read.
            if stopping.received is None or _has_working_folder():
                raise
    done = sweep.scheduler.complete and (searches is None or searches.over)
    return None if done else stopping.received


def _may_share_processes(sweep: OpenSweep) -> bool:
    """Whether a process may compute several runs, which saves seconds of imports for each.

    A user's environment may keep state in its module, so each of its runs has a new process.
    """
    from music_rllib.envs.make import known_environment

    return all(known_environment(run.task) is not None for run in sweep.plan.settings)


def _has_working_folder() -> bool:
    try:
        Path.cwd()
    except FileNotFoundError:
        return False
    return True


def _trial_name(trial: Trial) -> str:
    # A node that a search continues is another trial of Tune.
    return f"{NodeJob.from_tune(trial.config).key}-{trial.trial_id}"


@contextlib.contextmanager
def _tune_folder(sweep: OpenSweep) -> Iterator[str]:
    """A folder for Tune's files, which are never read; every machine of the cluster reaches it."""
    if cluster_address() is None:
        # Not in the storage: if that is full, Tune must not stop the runs.
        with own_folder("music-tune-") as folder:
            yield folder
        return
    if "://" in sweep.storage:
        yield encoded(below(sweep.storage, sweep.plan.name))
        return
    yield str(sweep.folder)
    shutil.rmtree(sweep.folder / "tune", ignore_errors=True)


_LOGGERS = ("ray.tune.tune", "ray.tune.analysis.experiment_analysis")
_EXPECTED_MESSAGES = (
    "Stop signal received",
    "Experiment has been interrupted",
    "Trials did not complete",
    "Could not fetch metrics",
    "Failed to fetch metrics",
)
"""Beginnings of Tune's messages about stops and failed trials, which the sweep prints itself."""


def _is_unexpected(record: logging.LogRecord) -> bool:
    return not record.getMessage().startswith(_EXPECTED_MESSAGES)


@contextlib.contextmanager
def _quiet_tune(waiting: int) -> Iterator[None]:
    """Set options that Tune reads from the environment only, and filter its log.

    Args:
        waiting: Number of trials that may wait for an actor. An autoscaler adds machines for them.
    """
    settings = {
        "TUNE_MAX_PENDING_TRIALS_PG": str(waiting),
        "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
        "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
        # Keep the working folder for relative paths in a user's environment.
        "RAY_CHDIR_TO_TRIAL_DIR": "0",
        # Tune's snapshots are never read.
        "TUNE_GLOBAL_CHECKPOINT_S": "3600",
    }
    before = {name: os.environ[name] for name in settings if name in os.environ}
    os.environ.update(settings)
    for name in _LOGGERS:
        logging.getLogger(name).addFilter(_is_unexpected)
    try:
        yield
    finally:
        for name in settings:
            os.environ.pop(name, None)
        os.environ.update(before)
        for name in _LOGGERS:
            logging.getLogger(name).removeFilter(_is_unexpected)
