"""The driver of a sweep: `plan` shows what would be trained, `run` trains it.

Both load, open and check a sweep in the same way.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from music_rllib.command_line import console_for, how_to_continue, print_json
from music_rllib.config.load import load_config, warnings_of
from music_rllib.config.schema import MlflowSettings, SweepConfig
from music_rllib.envs.tasks import search_in
from music_rllib.errors import FAILED, BadInputError, is_stop
from music_rllib.experiment.open_sweep import (
    OpenSweep,
    accept_environments,
    changed_text,
    continued_runs_text,
    decide,
    found_runs,
    open_sweep,
    remove_damaged,
    remove_runs,
    reopened,
)
from music_rllib.experiment.plan import make_plan, remarks
from music_rllib.experiment.sweep_files import ANALYSIS_PLAN, STATE
from music_rllib.names import VARIABLE_STUDIES
from music_rllib.redaction import redact
from music_rllib.runtime.machine import (
    check_cpus,
    check_memory_and_gpus,
    check_reachable,
    cluster_address,
    ray_parent,
)
from music_rllib.runtime.process import early, without_collections
from music_rllib.store.patience import be_patient
from music_rllib.store.storage import StorageError, check_storage, is_remote, resolve_storage
from music_rllib.sweep import preflight
from music_rllib.sweep.preflight import check_demand
from music_rllib.sweep.views.plan import cluster_answer, plan_answer, plan_view

if TYPE_CHECKING:
    from music_rllib.experiment.record import Changes
    from music_rllib.runtime.ray_cluster import Capacity

DEFAULT_CONFIG = Path(__file__).with_name("default.yaml")
VARIABLE = "MLFLOW_TRACKING_URI"
"""MLflow's own variable, which is used if a sweep has no `mlflow.tracking_uri`."""


def load(
    path: Path | None,
    overrides: Sequence[str] | None = None,
    *,
    name: str | None = None,
    storage: str | None = None,
    seeds: str | None = None,
) -> SweepConfig:
    """The sweep of a file, or the packaged one, with the settings of the command line.

    A `path` with a `=` that is not a file is an override. Other arguments are as in `load_config`.
    """
    overrides = list(overrides or ())
    if path is not None and "=" in str(path) and not path.exists():
        path, overrides = None, [str(path), *overrides]
    path = path or DEFAULT_CONFIG
    search_in(path.parent)
    return load_config(path, name=name, storage=storage, seeds=seeds, overrides=overrides)


def plan(config: SweepConfig, *, measure: bool = False, as_json: bool = False) -> int:
    """Check a sweep and show its runs; train nothing. Returns the exit code.

    Raises:
        BadInputError: The sweep can't be run as it is.
    """
    console = console_for(as_json=as_json)
    try:
        opened, cluster = _open(console, config, wait_minutes=0.0)
        preflight.check_searches(opened)
        texts = filter(None, (_changes(opened), changed_text(opened, found_runs(opened))))
        changes = "\n".join(map(str, texts))
        if changes:
            _say(console, changes, "yellow")
        document = plan_answer(opened, changes)
        document["cluster"] = None if cluster is None else cluster_answer(opened, cluster)
        document["analysis_plan"] = _record_analysis_plan(console, opened, only_questions=True)
        if measure:
            document["cost"] = _measure(console, opened)
        console.print("The configuration is valid. Nothing was started.")
        if as_json:
            print_json(document)
    except (KeyboardInterrupt, SystemExit) as stopped:
        return _stopped_early(console, stopped)
    return 0


def run(
    config: SweepConfig,
    *,
    accept_changes: bool = False,
    retrain: Sequence[str] = (),
    keep_runs: bool = False,
    retrain_damaged: bool = False,
    wait_minutes: float | None = None,
    as_json: bool = False,
) -> int:
    """Train the runs of a sweep, compare them, and log them to MLflow. Returns the exit code.

    The options are those of `music-rllib run`.

    Raises:
        BadInputError: Nothing was started; other errors also name what to change.
    """
    # `plan` needs none of it.
    with without_collections():
        from music_rllib.experiment.record import keep_record, record_retraining
        from music_rllib.sweep.driver_lock import alone, driving
        from music_rllib.sweep.execution import compute_and_report, open_tracker

    console = console_for(as_json=as_json, unfailing=True)
    warn = partial(_say, console, style="yellow")
    has_begun = False
    try:
        opened, _ = _open(console, config, lenient=retrain_damaged, wait_minutes=wait_minutes)
        changes = _changes(opened)
        if changes is not None and not accept_changes:
            raise BadInputError(str(changes))
        again, kept = decide(
            opened, found_runs(opened), retrain, all_changed=accept_changes, keep=keep_runs
        )
        be_patient(config.resources.storage_minutes, warn)
        with (
            driving(opened.location) as drivers,
            contextlib.ExitStack() as stack,
            early,
        ):
            with alone(opened.location, partial(_say, console)):
                if opened.damaged or again or changes is not None:
                    drivers.check_alone()
                started = []
                if again:
                    from music_rllib.sweep import clean

                    keys = [run.key for run in again]
                    started = clean.started_from(opened.location, keys)
                    keys += [node["key"] for node in started]
                    clean.check_not_in_use(opened.location, keys)
                opened = reopened(opened)  # another command may have deleted runs
                preflight.check_searches(opened)  # nothing is deleted before
                retrained = [*(run.key for run in again), *(node["key"] for node in started)]
                record_retraining(opened.storage, {*retrained, *opened.damaged})
                remove_damaged(opened, warn)
                opened = accept_environments(remove_runs(opened, again, warn), kept, warn)
                if started:
                    clean.remove_started(opened.store, started, warn)
                _check(opened)
                tracker = stack.enter_context(open_tracker(opened))
                for key in (*retrained, *opened.damaged):
                    tracker.forget(key)
                keep_record(opened)
                has_begun = True  # what is to be retrained is recorded
                plans = _record_analysis_plan(console, opened)
                shares = bool(drivers.others())
            try:
                code = compute_and_report(
                    console, opened, tracker, plans, drivers, wait_minutes, shares=shares
                )
            except StorageError as error:  # no longer bad input
                error.exit_code = FAILED
                raise
        if as_json:
            print_json(opened.location.read(STATE) or {})
    except (KeyboardInterrupt, SystemExit) as stopped:
        return _stopped_early(console, stopped, has_begun=has_begun)
    finally:
        be_patient(0.0)
    return code


def _open(
    console: Console,
    config: SweepConfig,
    *,
    lenient: bool = False,
    wait_minutes: float | None,
) -> tuple[OpenSweep, Capacity | None]:
    """Check what can be checked without starting anything, and show the plan.

    `lenient` accepts damaged runs. Returns the sweep, and the room of the cluster that is to train
    it.
    """
    config = _with_environment(console, config)
    if config.path == DEFAULT_CONFIG:
        console.print(f"No CONFIG given: using the packaged sweep {DEFAULT_CONFIG}.")
    planned = make_plan(config)
    played = preflight.check_environments(planned, config.resources.hang_minutes)
    environments = preflight.fingerprints(planned)
    if cluster_address() is None:
        ray_parent()
    check_cpus(config.resources)
    check_memory_and_gpus(config.resources)
    storage, remark = resolve_storage(config.storage)
    check_storage(storage, config.name)
    opened = open_sweep(config, planned, storage, environments=environments, lenient=lenient)
    if config.mlflow.tracking_uri is not None or is_remote(storage):
        from music_rllib.tracking.store import resolve_store  # the default needs no check

        resolve_store(config.mlflow.tracking_uri, storage)
    console.print(plan_view(config, planned, opened.finished))
    _say(console, f"Storage: {redact(storage)}")
    cluster = preflight.find_cluster(console, opened, wait_minutes)
    if cluster is not None or cluster_address() is None:  # a Ray job connects later
        check_demand(opened, None if cluster is None else cluster.node_memory)
    warnings = (*warnings_of(config), *remarks(planned), *continued_runs_text(opened))
    for line in filter(None, (remark, *played, *warnings)):
        _say(console, line, "yellow")
    return opened, cluster


def _with_environment(console: Console, config: SweepConfig) -> SweepConfig:
    """The sweep with MLFLOW_TRACKING_URI as its `mlflow.tracking_uri`, unless it has one."""
    uri, given = os.environ.get(VARIABLE), config.document.get("mlflow") or {}
    # A task of a Slurm array has a file of its own, which `resume` must not use later.
    of_task = bool(uri and (own := os.environ.get(VARIABLE_STUDIES)) and own in uri)
    if not uri or given.get("tracking_uri") or ("tracking_uri" in given and not of_task):
        return config
    how = "mlflow.tracking_uri=null keeps a sqlite file in the storage"
    _say(console, f"MLflow: {redact(uri)}, from {VARIABLE} ({how})")
    config = replace(config, mlflow=MlflowSettings(**{**given, "tracking_uri": uri}))
    if of_task:
        return config
    return replace(config, document={**config.document, "mlflow": vars(config.mlflow)})


def _changes(opened: OpenSweep) -> Changes | None:
    if not opened.recorded:
        return None
    from music_rllib.experiment.record import changes_since

    return changes_since(opened)


def _check(opened: OpenSweep) -> None:
    """Run the other checks that can reject the sweep, before recording that it started."""
    preflight.import_checkpoints(opened.plan, opened.store)
    if (address := cluster_address()) is not None and not opened.scheduler.complete:
        check_reachable(address)


def _record_analysis_plan(
    console: Console, opened: OpenSweep, *, only_questions: bool = False
) -> list[dict[str, Any]]:
    """Keep the analysis plan before anything is trained; all of its versions as plain data."""
    if opened.config.analysis is None and opened.location.read(ANALYSIS_PLAN) is None:
        return []
    from music_rllib.results.analysis_plan import PLANS_TO_READ, as_document, record_plan

    versions, late = record_plan(opened, only_questions=only_questions)
    if versions:
        last = versions[-1]
        place = redact(f"{opened.storage}/{opened.config.name}/{PLANS_TO_READ}")
        recorded = f"version {last.version} recorded {last.recorded}, hash {last.hash[:12]}"
        _say(console, f"Analysis plan: {place}, {recorded}")
    if late:
        _say(
            console,
            f"Not planned by this version, because runs of it have finished: {'; '.join(late)}",
            "yellow",
        )
    if opened.config.analysis is not None:
        from music_rllib.results.study import untestable

        for text in untestable(opened.plan, versions[-1].plan):
            _say(console, f"No result can test {text}", "yellow")
    return as_document(versions)


def _measure(console: Console, opened: OpenSweep) -> dict[str, Any]:
    """Measure and show the cost of the runs that are left; the cost as plain data."""
    from music_rllib.sweep.views import cost

    left = cost.run_groups(opened.config, opened.plan, opened.finished)
    measured = cost.measure(opened.config, left, console.print)
    console.print(cost.cost_view(measured))
    return measured


def _stopped_early(
    console: Console, stopped: KeyboardInterrupt | SystemExit, *, has_begun: bool = False
) -> int:
    """The exit code for a signal that came while nothing was trained; raises other causes."""
    if not is_stop(stopped):
        raise stopped
    by_ray = isinstance(stopped, SystemExit)
    number = signal.SIGTERM if by_ray else early.received or signal.SIGINT
    _say(console, how_to_continue(has_begun=has_begun))
    return 128 + number


def _say(console: Console, text: str, style: str = "") -> None:
    """Print lines that the console does not wrap."""
    console.print(text, style=style, soft_wrap=True)
