"""Computes the runs of a sweep as trials of one Tune run."""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any, Protocol

from ray import tune
from ray.tune.experiment import Trial
from ray.tune.schedulers import FIFOScheduler
from ray.tune.search import Searcher

from music_rllib.errors import FAILED, one_line
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Node
from music_rllib.experiment.scheduler import Listener, Scheduler, Status
from music_rllib.runtime.machine import cluster_address, own_folder
from music_rllib.runtime.ray_cluster import cluster
from music_rllib.store.lease import LeaseFile
from music_rllib.store.storage import StorageError, is_remote
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


LOCAL_SECONDS, REMOTE_SECONDS = 5.0, 15.0
"""Seconds between two looks at the runs of other processes, in a folder and in a bucket."""
WAIT_SECONDS = 1.0
"""Time between two looks for a run of a driver that has none to compute."""


class SharedRuns:
    """The runs of a sweep that other processes compute in the same storage, or have finished."""

    def __init__(self, sweep: OpenSweep, listeners: Sequence[Listener]) -> None:
        """Tell `listeners` about runs of `sweep` that other processes have."""
        self._sweep, self._listeners = sweep, listeners
        self._leases: dict[str, LeaseFile] = {}
        """Leases of others by node key; each remembers since when it has not been renewed."""
        self._seconds = REMOTE_SECONDS if is_remote(sweep.storage) else LOCAL_SECONDS
        self._looked = time.monotonic()

    def look(self) -> None:
        """Regularly look for runs that other processes have finished, or have left."""
        scheduler, now = self._sweep.scheduler, time.monotonic()
        if now - self._looked < self._seconds:
            return
        self._looked = now
        waiting = scheduler.having(Status.WAITING)
        finished = self._sweep.store.finished(node.key for node in waiting)
        for node in waiting:
            # The results of others may have ended the trial that wanted it.
            if node.key in finished and scheduler[node.key] is Status.WAITING:
                self._take_over(node)
        for node in scheduler.elsewhere:
            if self.is_free(node):
                scheduler.take_back(node.key)

    def is_free(self, node: Node) -> bool:
        """Whether no other process computes a waiting node or has finished it."""
        if self._sweep.store.is_finished(node.key) and self._take_over(node):
            return False
        work = self._sweep.store.work_folder(node.key)
        lease = self._leases.setdefault(node.key, work.lease)
        if (holder := lease.holder()) is None:
            lease.remove_invalid()
            del self._leases[node.key]
            return True
        if node not in self._sweep.scheduler.elsewhere:
            self._sweep.scheduler.leave(node.key)
            for listener in self._listeners:
                listener.left(node, str(holder))
        return False

    def _take_over(self, node: Node) -> bool:
        """Use the result of another process; False if a worker has to report what is wrong."""
        store, code = self._sweep.store, node.run.code
        if not store.is_sound(node.key):
            return False
        result = store.result(node.key)
        differences = self._sweep.environments.differences(code, store.environment(node.key))
        if result is None or differences:
            return False
        self._leases.pop(node.key, None)
        self._sweep.scheduler.finish(node.key)
        for listener in self._listeners:
            listener.finished(node, result)
        return True


class DagSearcher(Searcher):
    """Suggests each waiting node of a plan to Tune, once its input is published.

    Tune asks whenever it has room for a trial. After `None` it continues with its trials, after
    `FINISHED` it never asks again. A driver with no trials waits outside Tune, which would keep
    the processes of ended trials. A failed run does not stop the others.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        config_of: Callable[[Node], dict[str, Any]],
        searches: Searches | None = None,
        stopped: Callable[[], bool] = lambda: False,
        shared: SharedRuns | None = None,
    ) -> None:
        super().__init__()
        self._scheduler = scheduler
        self._config_of = config_of
        self._searches = searches
        self._stopped = stopped
        self._shared = shared

    @property
    def over(self) -> bool:
        """Whether no node is left to compute, here or elsewhere."""
        searched = self._searches is None or self._searches.over
        return self._scheduler.all_handed_out and searched

    def next(self) -> Node | None:
        """The next node that this process can compute; None if there is none now."""
        if self._shared is not None:
            self._shared.look()
        while True:
            if self._searches is not None:
                self._searches.propose()
            node = self._scheduler.next_ready()
            if node is None or self._shared is None or self._shared.is_free(node):
                return node

    def suggest(self, trial_id: str) -> dict[str, Any] | str | None:
        """The config of a node that can run, None for "not now", or `FINISHED`."""
        if self._stopped():
            return str(Searcher.FINISHED)
        node = self.next()
        if node is None:
            waits = not self.over and self._scheduler.having(Status.STARTED)
            return None if waits else str(Searcher.FINISHED)
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
    wait_minutes: float | None = None,
) -> int | None:
    """Compute the waiting nodes, and those that searches ask for.

    Args:
        sweep: Afterwards, its scheduler has the status of each node.
        on_stop: Called, in a signal handler, when the user asks to stop.
        on_ray_gone: Called, in a thread, before the process ends because Ray has ended: with the
            cause, or None if the user's signal ended Ray too.
        wait_minutes: Time to wait for a cluster's nodes, as in `cluster`.

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
        shared=SharedRuns(sweep, listeners),
    )

    def remark(text: str) -> None:
        for listener in listeners:
            listener.remarked(text)

    with (
        cluster(resources, wait_minutes, remark) as capacity,
        # Tune's files are never read. Not in the storage: if that is full, or does not answer,
        # Tune must not stop the runs.
        own_folder("music-tune-") as folder,
        _quiet_tune(capacity.waiting),
        stopping,
    ):
        if capacity.remark is not None:
            remark(capacity.remark)
        for number in count():
            try:
                if not _wait_for_a_run(searcher, stopping, listeners):
                    break
                tuner = tune.Tuner(
                    RunTrainable,
                    tune_config=tune.TuneConfig(
                        search_alg=searcher,
                        num_samples=-1,  # as many as the searcher suggests
                        scheduler=_Scheduler(),
                        reuse_actors=_may_share_processes(sweep),
                        trial_name_creator=_trial_name,
                        trial_dirname_creator=_trial_name,
                    ),
                    run_config=tune.RunConfig(
                        name=f"tune{number}",
                        storage_path=folder,
                        verbose=0,
                        callbacks=[events, stopping],
                        # For workers that die; errors of a run are in its result.
                        failure_config=tune.FailureConfig(max_failures=RESTARTS),
                        # The trainable writes its own checkpoints.
                        checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
                    ),
                )
                tuner.fit()
            except Exception as error:
                if stopping.received is not None and not _has_working_folder():
                    # Ray deletes the folder of a stopped job before its driver has ended, and Tune
                    # needs one for a summary that is never read.
                    break
                if (cause := _file_error(error)) is None:
                    raise
                on_ray_gone(
                    "the storage and the folder for temporary files must answer, got "
                    f"{one_line(cause)}"
                )
                raise SystemExit(FAILED) from error
    done = sweep.scheduler.complete and (searches is None or searches.over)
    return None if done else stopping.received


def _wait_for_a_run(
    searcher: DagSearcher, stopping: StopSignals, listeners: Sequence[Listener]
) -> bool:
    """Wait until this process can compute a run; False if none is left, or after a signal."""
    while not searcher.over and stopping.received is None:
        if searcher.next() is not None:
            return True
        time.sleep(WAIT_SECONDS)
        for listener in listeners:
            listener.tick()
    return False


def _file_error(error: BaseException | None) -> BaseException | None:
    """The error of a file system that led to an error of Tune, if there is one."""
    while error is not None and not isinstance(error, OSError | StorageError):
        error = error.__cause__ or error.__context__
    return error


class _Scheduler(FIFOScheduler):
    """Tune's order, without the idle process that Tune keeps for a next trial.

    On a cluster, another driver may wait for its CPUs.
    """

    def choose_trial_to_run(self, tune_controller: Any) -> Trial | None:
        _forget_ended(tune_controller._tune_controller._actor_manager)
        chosen = super().choose_trial_to_run(tune_controller)
        if chosen is None and cluster_address() is not None:
            tune_controller._tune_controller._cleanup_cached_actors(force_all=True)
        return chosen


def _forget_ended(actors: Any) -> None:
    """Free what Tune keeps of each run whose process is reused: its results, and a request."""
    waiting = actors._actor_task_events.get_futures()
    for futures in actors._tracked_actors_to_task_futures.values():
        futures.intersection_update(waiting)
    tasks = actors._pending_actors_to_enqueued_actor_tasks
    for actor in tasks.keys() - actors._pending_actors_to_attrs.keys():
        del tasks[actor]


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
