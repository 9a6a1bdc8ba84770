"""The driver of a sweep: checks and plans it, computes its runs, and shows their results."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from music_rllib import names
from music_rllib.command_line import console_for, how_to_continue, print_json
from music_rllib.config.load import load_sweep
from music_rllib.config.remarks import remarks
from music_rllib.config.schema import MlflowSettings, SweepConfig
from music_rllib.envs.modules import search_in
from music_rllib.errors import FAILED, BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.changes import (
    changes_since,
    check_begun,
    keep_settings,
    longer,
)
from music_rllib.experiment.demand import check_demand
from music_rllib.experiment.environments import Answer, changed_text, old_runs
from music_rllib.experiment.listener import Listener
from music_rllib.experiment.location import SweepLocation
from music_rllib.experiment.open_sweep import OpenSweep, keep_record, open_sweep, remove_damaged
from music_rllib.experiment.plan import make_plan, shared_runs
from music_rllib.experiment.scheduler import Status
from music_rllib.experiment.sweep_files import as_json
from music_rllib.redaction import redact
from music_rllib.results.analysis_plan import PLANS_TO_READ, PlanVersion, as_document, record_plan
from music_rllib.runtime.machine import (
    check_cpus,
    check_memory_and_gpus,
    cluster_address,
    ray_parent,
)
from music_rllib.runtime.process import early, give_back_freed_memory, try_for
from music_rllib.store.storage import check_storage, resolve_storage, sweep_folder
from music_rllib.sweep.driver_lock import hold_driver_lock
from music_rllib.sweep.listeners.state_file import StateFile
from music_rllib.sweep.preflight import (
    check_environments,
    check_ray,
    check_searches,
    fingerprints,
    import_checkpoints,
    verify_inputs,
)
from music_rllib.sweep.report_at_end import report_at_end
from music_rllib.sweep.views.alpha import adaptive_rows, adaptive_text, alpha_rows, alpha_table
from music_rllib.sweep.views.plan_json import plan_answer
from music_rllib.sweep.views.tables import plan_view, results_table, search_views
from music_rllib.tracking.store import VARIABLE, resolve_store

if TYPE_CHECKING:
    from music_rllib.search.controller import SearchController
    from music_rllib.sweep.listeners.screen import Display
    from music_rllib.tracking.listener import MlflowListener
    from music_rllib.tracking.tracker import Tracker

DEFAULT_CONFIG = Path(__file__).with_name("default.yaml")
LAST_SECONDS = 20.0
"""Time to write the last state and to close MLflow's runs after Ray has died."""
CLOSE_SECONDS = 10.0
"""The part of it in which MLflow receives what is left."""
LISTED_REUSED_RUNS = 10


def run_sweep(
    config: Path | SweepLocation | None,
    *,
    dry_run: bool = False,
    measure: bool = False,
    storage: str | None = None,
    name: str | None = None,
    seeds: str | None = None,
    overrides: Sequence[str] = (),
    accept_changes: bool = False,
    retrain: Sequence[str] = (),
    keep_runs: bool = False,
    retrain_damaged: bool = False,
    must_exist: bool = False,
    as_json: bool = False,
) -> int:
    """Train every run of a sweep, compare them, and log them to MLflow.

    Args:
        config: The sweep's file; a sweep in its storage, whose own configuration is used; None for
            the packaged file.
        dry_run: Check everything and show the plan; run nothing.
        measure: In a dry run, train each kind of run for some seconds and estimate the whole time.
        storage: Replaces the file's `storage`.
        name: Replaces the file's `name`.
        seeds: Replaces `seeds`: how many, or a list with commas.
        overrides: `KEY=VALUE` each, laid over the file.
        accept_changes: Train runs anew whose settings have changed since the sweep ran last, or
            whose environment has.
        retrain: Tasks or labels of runs whose results are deleted, and which are trained again.
        keep_runs: Use runs whose environment has changed.
        retrain_damaged: Delete finished runs that are damaged, and train them again.
        must_exist: Refuse to begin a sweep; only continue one.
        as_json: Print the plan of a dry run, or the sweep's last `state.json`, on standard output.

    Returns:
        The exit code.

    Raises:
        BadInputError: Nothing was started; as other errors that say what to change.
    """
    console = console_for(as_json=as_json)
    try:
        if isinstance(config, SweepLocation):
            loaded = config.config(seeds)
        else:
            path = config or DEFAULT_CONFIG
            search_in(path.parent)
            loaded = load_sweep(path, name=name, storage=storage, seeds=seeds, overrides=overrides)
        loaded = _with_environment(console, loaded)
        if must_exist:
            check_begun(loaded)
        opened = _open(console, loaded, lenient=retrain_damaged and not dry_run)
        if dry_run:
            check_searches(opened)
        changes, old = changes_since(opened), old_runs(opened)
        if dry_run:
            texts = [str(changes or ""), changed_text(opened, old)]
            document = _show_plan(console, opened, "\n".join(filter(None, texts)), measure=measure)
            code = 0
        else:
            if changes is not None and not accept_changes:
                raise BadInputError(str(changes))
            answer = Answer.to(opened, old, retrain, all_changed=accept_changes, keep=keep_runs)
            with hold_driver_lock(opened, partial(_say, console)), early:
                say = partial(_say, console, style="yellow")
                remove_damaged(opened, say)
                opened = answer.carry_out(opened, say)
                code = _drive(console, opened, [run.key for run in answer.again])
            document = sweep_files.read(opened.storage, f"{loaded.name}/{sweep_files.STATE}") or {}
        if as_json:
            print_json(document)
    except (KeyboardInterrupt, SystemExit) as stopped:
        number = _signal_of(stopped)
        _say(console, how_to_continue())
        return 128 + number
    return code


def _with_environment(console: Console, config: SweepConfig) -> SweepConfig:
    """The sweep with MLFLOW_TRACKING_URI for its `mlflow.tracking_uri`, unless that is given."""
    uri, given = os.environ.get(VARIABLE), config.document.get("mlflow") or {}
    if not uri or "tracking_uri" in given:
        return config
    how = "mlflow.tracking_uri=null keeps a sqlite file in the storage"
    _say(console, f"MLflow: {redact(uri)}, from {VARIABLE} ({how})")
    mlflow = MlflowSettings(**given, tracking_uri=uri)
    return replace(config, mlflow=mlflow, document={**config.document, "mlflow": vars(mlflow)})


def _say(console: Console, text: str, style: str = "") -> None:
    """Print lines that the console does not wrap."""
    console.print(text, style=style, soft_wrap=True)


def _signal_of(stopped: KeyboardInterrupt | SystemExit) -> int:
    """The signal that has raised an exception while nothing was trained.

    Raises:
        SystemExit: It was no signal.
    """
    if isinstance(stopped, KeyboardInterrupt):
        return early.received or signal.SIGINT
    if stopped.code == signal.SIGTERM:  # raised by the handler that `ray.init` sets
        return signal.SIGTERM
    raise stopped


def _open(console: Console, config: SweepConfig, *, lenient: bool) -> OpenSweep:
    """Check what can be checked without starting anything, and show the plan.

    Args:
        lenient: Whether finished runs may be damaged, which are to be trained again.
    """
    if config.path == DEFAULT_CONFIG:
        console.print(f"No CONFIG given: running the packaged sweep {DEFAULT_CONFIG}.")
    plan = make_plan(config)
    played = check_environments(plan, config.resources.hang_minutes)
    environments = fingerprints(plan)
    if cluster_address() is None:
        ray_parent()
    check_cpus(config.resources)
    check_memory_and_gpus(config.resources)
    storage, remark = resolve_storage(config.storage)
    check_storage(storage, config.name)
    warn = partial(_say, console, style="yellow")
    folder = sweep_folder(storage, config.name)
    opened = open_sweep(config, plan, storage, folder, environments=environments, lenient=lenient)
    resolve_store(config.mlflow.tracking_uri, storage)
    console.print(plan_view(config, plan, opened.finished))
    if rows := alpha_rows(plan):
        console.print(alpha_table(rows))
    for row in adaptive_rows(plan):
        _say(console, adaptive_text(row))
    _say(console, f"Storage: {redact(storage)}")
    notes = (
        remark,
        *played,
        *remarks(config),
        *shared_runs(plan),
        *check_demand(opened),
        *longer(opened),
    )
    for line in filter(None, notes):
        warn(line)
    return opened


def _show_plan(
    console: Console, opened: OpenSweep, changes: str, *, measure: bool
) -> dict[str, Any]:
    """Record the analysis plan and, if asked, measure the cost; the plan as plain data."""
    if changes:
        _say(console, changes, "yellow")
    document = plan_answer(opened, changes)
    document["analysis_plan"] = as_document(_record_analysis_plan(console, opened))
    if measure:
        from music_rllib.sweep import cost

        left = cost.kinds(opened.config, opened.plan, opened.finished)
        costs, slots = cost.measure(opened.config, left, console.print)
        console.print(cost.cost_table(costs, slots))
        document["cost"] = cost.cost_document(costs, slots)
    console.print("Dry run: the configuration is sound, nothing was started.")
    return document


def _drive(console: Console, opened: OpenSweep, again: Sequence[str]) -> int:
    """Run a sweep whose lock this process holds; the exit code.

    MLflow's runs of the keys `again` are out of date, because their results were deleted.
    """
    give_back_freed_memory()
    # All that may refuse it comes before it is recorded as a sweep that was begun.
    import_checkpoints(opened.plan, opened.store)
    verify_inputs(opened.scheduler, opened.store)
    check_searches(opened)
    check_ray(console, opened)
    with _open_tracker(opened) as tracker:
        for key in again:
            tracker.forget(key)
        keep_record(opened)
        keep_settings(opened)
        if versions := _record_analysis_plan(console, opened):
            plans = as_json(as_document(versions))
            tracker.put_sweep_artifact(names.ARTEFACT_ANALYSIS_PLAN, plans)
        return _compute_and_report(console, opened, tracker)


def _record_analysis_plan(console: Console, opened: OpenSweep) -> Sequence[PlanVersion]:
    """Keep the analysis plan before anything runs; all of its versions."""
    versions = record_plan(opened)
    if versions:
        last = versions[-1]
        place = redact(f"{opened.storage}/{opened.config.name}/{PLANS_TO_READ}")
        recorded = f"version {last.version} recorded {last.recorded}, hash {last.hash[:12]}"
        _say(console, f"Analysis plan: {place}, {recorded}")
    return versions


def _open_tracker(opened: OpenSweep) -> Tracker:
    from music_rllib.sweep.listeners.mlflow_view import VERSIONS, comparison_view
    from music_rllib.tracking.tracker import Tracker

    tracker = Tracker(
        sweep_name=opened.config.name,
        storage=opened.storage,
        config=opened.config.document,
        tracking_uri=opened.config.mlflow.tracking_uri,
    )
    tracker.keep_view(comparison_view(opened.plan, tracker.sweep_id, time.time()), VERSIONS)
    return tracker


def _compute_and_report(console: Console, opened: OpenSweep, tracker: Tracker) -> int:
    """Compute what is left and show the results; the exit code."""
    from music_rllib.sweep.listeners.screen import Display
    from music_rllib.tracking.listener import MlflowListener

    with (
        Display(console, opened.plan, opened.scheduler) as display,
        StateFile(opened) as state_file,
    ):
        mlflow_log = MlflowListener(tracker, opened.store, opened.environments.now)
        display.headline = state_file.headline
        _take_over_reused(opened, display, mlflow_log)
        controller = None
        if opened.plan.searched:
            from music_rllib.sweep.searches import begin_searches, end_searches

            controller = begin_searches(opened, display, mlflow_log, state_file)
        tracker.keep_current(node.key for node in opened.plan.nodes)
        stopped_by = _compute(opened, display, mlflow_log, state_file, controller)
        searches = [] if controller is None else end_searches(opened, controller, tracker)
        tracker.keep_current(node.key for node in opened.plan.nodes)  # with trials since then
        failed = (
            bool(opened.scheduler.having(Status.FAILED, Status.SKIPPED))
            or bool(_lost_trials(searches))
            or (stopped_by is None and not opened.scheduler.complete)
        )
        state_file.end("stopped" if stopped_by else "failed" if failed else "finished")
    tracker.close("KILLED" if stopped_by else "FAILED" if failed else "FINISHED")
    _show_results(console, opened, tracker, state_file, searches)
    if lost := _lost_trials(searches):
        text = (
            f"Trials that failed because a run did: {lost}. In this study nothing tries them "
            "again; with another search.study the next command does, and reuses what is finished."
        )
        _say(console, text, "yellow")
    if stopped_by is not None:
        _say(console, how_to_continue())
        return 128 + stopped_by
    config = opened.config
    report = report_at_end(opened.storage, config.name, config.mlflow.tracking_uri, config.path)
    if report is not None:
        _say(console, report)
    return FAILED if failed else 0


def _lost_trials(searches: Sequence[Mapping[str, Any]]) -> int:
    """Number of trials that failed because a run did, also under earlier drivers."""
    return sum(t["lost"] for one in searches for arm in one["arms"] for t in arm["trials"])


def _take_over_reused(opened: OpenSweep, display: Display, mlflow_log: MlflowListener) -> None:
    """List the reused runs, and log to MLflow those that it does not have."""
    reused = opened.scheduler.having(Status.REUSED)
    for node in reused[:LISTED_REUSED_RUNS]:
        display.say(f"{display.short(node.label)}: finished earlier, reused")
    if len(reused) > LISTED_REUSED_RUNS:
        display.say(f"{len(reused) - LISTED_REUSED_RUNS} more: finished earlier, reused")
    for node in reused:
        mlflow_log.finished(node)


def _compute(
    opened: OpenSweep,
    display: Display,
    mlflow_log: MlflowListener,
    state_file: StateFile,
    controller: SearchController | None,
) -> int | None:
    """Compute what is left, if anything; the signal that stopped it, or None."""
    if opened.scheduler.complete and (controller is None or controller.over):
        return None
    from music_rllib.sweep.listeners.prometheus import PrometheusListener
    from music_rllib.tune.runner import compute

    address = cluster_address()
    display.say("starting a local Ray" if address is None else f"connecting to Ray at {address}")
    tracker = mlflow_log.tracker
    gauges = PrometheusListener(
        opened.config.name, opened.scheduler, tracker.pending, opened.folder
    )
    listeners: list[Listener] = [mlflow_log, display, state_file, gauges]
    if controller is not None:
        listeners.append(controller)

    def on_stop() -> None:
        display.say("stopping, this takes a few seconds; Ctrl-C again stops at once", "yellow")

    def on_ray_gone(cause: str | None) -> None:
        stopped = "Ray was told to stop as well, so no more can be saved now"
        display.say(cause or stopped, "red" if cause else "yellow")
        try_for(
            LAST_SECONDS,
            lambda: state_file.end("failed" if cause else "stopped"),
            lambda: tracker.close("FAILED" if cause else "KILLED", timeout=CLOSE_SECONDS),
        )
        display.say(how_to_continue())

    try:
        return compute(opened, listeners, on_stop, on_ray_gone, controller)
    finally:
        gauges.close()


def _show_results(
    console: Console,
    opened: OpenSweep,
    tracker: Tracker,
    state_file: StateFile,
    searches: Sequence[dict[str, Any]],
) -> None:
    """Print the results of runs and searches, and where MLflow shows them."""
    results = results_table(
        opened.plan,
        state_file.status,
        state_file.unfinished | opened.results(),
        tracker.run_id,
        console.width,
    )
    if results.rows:  # a sweep may consist of searches only
        console.print(results)
    for view in search_views(searches):
        console.print(view)
    if undelivered := tracker.undelivered_message():
        _say(console, undelivered, "yellow")
    _say(console, f"Compare in MLflow: {tracker.comparison_url()}")
    _say(console, f"Open MLflow's pages with: {tracker.store.ui_command()}")
