"""The driver of a sweep: checks, plans, computes, and shows what came of it."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from music_rllib import names
from music_rllib.command_line import how_to_continue
from music_rllib.config.load import load_sweep
from music_rllib.config.remarks import remarks
from music_rllib.config.schema import SweepConfig
from music_rllib.errors import FAILED, BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.changes import changes_since, check_begun, keep_settings, longer
from music_rllib.experiment.demand import check_demand
from music_rllib.experiment.listener import Listener
from music_rllib.experiment.plan import make_plan
from music_rllib.experiment.scheduler import Status
from music_rllib.experiment.session import Sweep, keep_record, open_sweep
from music_rllib.experiment.sweep_files import as_json
from music_rllib.redaction import redact
from music_rllib.results.claims.plan import PlanVersion, as_document
from music_rllib.results.claims.record import PLANS_TO_READ, record_plan
from music_rllib.runtime.allocator import give_back_freed_memory
from music_rllib.runtime.ending import try_for
from music_rllib.runtime.machine import (
    check_cpus,
    check_memory_and_gpus,
    cluster_address,
)
from music_rllib.runtime.signals import early
from music_rllib.store.paths import check_storage, resolve_storage, sweep_folder
from music_rllib.sweep.driver_lock import hold_driver_lock
from music_rllib.sweep.listeners.state_file import StateFile
from music_rllib.sweep.preflight import (
    check_environments,
    check_hardware,
    check_ray,
    check_searches,
    import_checkpoints,
    verify_inputs,
)
from music_rllib.sweep.report_at_end import report_at_end
from music_rllib.sweep.views.alpha import adaptive_rows, adaptive_text, alpha_rows, alpha_table
from music_rllib.sweep.views.plan_json import plan_answer
from music_rllib.sweep.views.tables import plan_view, results_table, search_views

if TYPE_CHECKING:
    from music_rllib.experiment.location import SweepLocation
    from music_rllib.search.controller import SearchController
    from music_rllib.sweep.listeners.mlflow import MlflowListener
    from music_rllib.sweep.listeners.screen import Display
    from music_rllib.tracking.tracker import Tracker

__all__ = ["DEFAULT_CONFIG", "resume_sweep", "run_sweep"]

DEFAULT_CONFIG = Path(__file__).with_name("default.yaml")
LAST_SECONDS = 20.0
"""For what is left to say where Ray has died."""
NAMED = 10
"""Reused runs that are listed by name."""


def run_sweep(
    console: Console,
    config: Path | None,
    *,
    dry_run: bool = False,
    measure: bool = False,
    storage: str | None = None,
    name: str | None = None,
    seeds: str | None = None,
    overrides: Sequence[str] = (),
    accept_changes: bool = False,
    retrain_damaged: bool = False,
    must_exist: bool = False,
    answer: Callable[[dict[str, Any]], None] = lambda document: None,
) -> int:
    """Train every run of a sweep, compare them, and log them to MLflow.

    Args:
        console: Where progress and results are shown.
        config: The sweep's file; None for the packaged one.
        dry_run: Check everything and show the plan; run nothing.
        measure: In a dry run, train each kind of run for some seconds and say what all of it takes.
        storage: Replaces the file's `storage`.
        name: Replaces the file's `name`.
        seeds: Replaces the file's `seeds`: how many, or a list with commas.
        overrides: `KEY=VALUE` each, laid over the file.
        accept_changes: Train runs anew whose settings are others than the last time.
        retrain_damaged: Delete finished runs that are damaged, and train them again.
        must_exist: Refuse to begin a sweep; only go on with one.
        answer: Takes the plan of a dry run, or the sweep's last `state.json`, as plain data.

    Returns:
        The exit code.

    Raises:
        BadInputError: Nothing was started; as other errors that say what to change.
    """
    try:
        path = config or DEFAULT_CONFIG
        loaded = load_sweep(path, name=name, storage=storage, seeds=seeds, overrides=overrides)
        if must_exist:
            check_begun(loaded)
        if dry_run:
            return _show(console, loaded, answer, measure=measure)
        return _sweep(
            console,
            loaded,
            answer,
            accept_changes=accept_changes,
            retrain_damaged=retrain_damaged,
        )
    except (KeyboardInterrupt, SystemExit) as stopped:
        return _code_of(console, stopped)


def _code_of(console: Console, stopped: KeyboardInterrupt | SystemExit) -> int:
    """The exit code after a signal that came while nothing was trained."""
    if isinstance(stopped, KeyboardInterrupt):
        number = early.received or signal.SIGINT
    elif stopped.code == signal.SIGTERM:  # how Ray's handler, which `ray.init` sets, ends it
        number = signal.SIGTERM
    else:
        raise stopped
    _say_how_to_continue(console)
    return 128 + number


def resume_sweep(
    console: Console,
    found: SweepLocation,
    *,
    seeds: str | None = None,
    accept_changes: bool = False,
    retrain_damaged: bool = False,
    answer: Callable[[dict[str, Any]], None] = lambda document: None,
) -> int:
    """Go on with a sweep by the configuration in its storage; the exit code.

    Raises:
        BadInputError: Nothing was started; as other errors that say what to change.
    """
    try:
        loaded = found.config(seeds)
        return _sweep(
            console,
            loaded,
            answer,
            accept_changes=accept_changes,
            retrain_damaged=retrain_damaged,
        )
    except (KeyboardInterrupt, SystemExit) as stopped:
        return _code_of(console, stopped)


def _sweep(
    console: Console,
    config: SweepConfig,
    answer: Callable[[dict[str, Any]], None],
    *,
    accept_changes: bool,
    retrain_damaged: bool,
) -> int:
    """Run the whole program.

    Returns:
        The exit code.

    Raises:
        BadInputError: Nothing was started.
    """
    opened = _open(console, config, retrain_damaged=retrain_damaged)
    changes = changes_since(opened)
    if changes is not None and not accept_changes:
        raise BadInputError(str(changes))
    with hold_driver_lock(opened, lambda text: console.print(Text(text), soft_wrap=True)), early:
        code = _drive(console, opened)
    answer(sweep_files.read(opened.storage, f"{config.name}/{sweep_files.STATE}") or {})
    return code


def _show(
    console: Console,
    config: SweepConfig,
    answer: Callable[[dict[str, Any]], None],
    *,
    measure: bool,
) -> int:
    """Check everything and show the plan, and if asked what it takes."""
    opened = _open(console, config)
    check_searches(opened)
    changes = changes_since(opened)
    if changes is not None:
        console.print(Text(str(changes), style="yellow"), soft_wrap=True)
    document = plan_answer(opened, changes)
    document["analysis_plan"] = as_document(_record_plan(console, opened))
    if measure:
        from music_rllib.sweep import cost

        left = cost.kinds(config, opened.plan, opened.finished)
        costs, slots = cost.measure(config, left, console.print)
        console.print(cost.cost_table(costs, slots))
        document["cost"] = cost.cost_document(costs, slots)
    console.print("Dry run: the configuration is sound, nothing was started.")
    answer(document)
    return 0


def _drive(console: Console, opened: Sweep) -> int:
    """Run a sweep that nobody else drives."""
    give_back_freed_memory()
    # All that may refuse it comes before it is recorded as a sweep that was begun.
    import_checkpoints(opened.plan, opened.store)
    verify_inputs(opened.scheduler, opened.store)
    check_searches(opened)
    check_ray(console, opened)
    tracker = _open_tracker(opened)
    with tracker:
        keep_record(opened)
        keep_settings(opened)
        if versions := _record_plan(console, opened):
            plans = as_json(as_document(versions))
            tracker.put_sweep_artefact(names.ARTEFACT_ANALYSIS_PLAN, plans)
        return _compute_and_report(console, opened, tracker)


def _record_plan(console: Console, opened: Sweep) -> Sequence[PlanVersion]:
    """Keep the analysis plan before anything runs, and say which one it is."""
    versions = record_plan(opened)
    if versions:
        last = versions[-1]
        place = redact(f"{opened.storage}/{opened.config.name}/{PLANS_TO_READ}")
        console.print(
            Text(
                f"Analysis plan: {place}, version {last.version} recorded {last.recorded}, hash "
                f"{last.hash[:12]}"
            ),
            soft_wrap=True,
        )
    return versions


def _open(console: Console, config: SweepConfig, *, retrain_damaged: bool = False) -> Sweep:
    """Check what can be checked without starting anything, and show the plan."""
    if config.path == DEFAULT_CONFIG:
        console.print(f"No CONFIG given: running the packaged sweep {DEFAULT_CONFIG}.")
    plan = make_plan(config)
    check_environments(plan, config.resources.hang_minutes)
    if cluster_address() is None:
        check_hardware(plan)
    check_cpus(config.resources)
    check_memory_and_gpus(config.resources)
    storage, remark = resolve_storage(config.storage)
    check_storage(storage, config.name)
    opened = open_sweep(
        config,
        plan,
        storage,
        sweep_folder(storage, config.name),
        (lambda text: console.print(Text(text, style="yellow"))) if retrain_damaged else None,
    )
    console.print(plan_view(config, plan, opened.finished))
    if rows := alpha_rows(plan):
        console.print(alpha_table(rows))
    for row in adaptive_rows(plan):
        console.print(Text(adaptive_text(row)), soft_wrap=True)
    console.print(Text(f"Storage: {redact(storage)}"), soft_wrap=True)
    for line in filter(None, (remark, *remarks(config), *check_demand(opened), *longer(opened))):
        console.print(Text(line, style="yellow"), soft_wrap=True)
    return opened


def _open_tracker(opened: Sweep) -> Tracker:
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


def _compute_and_report(console: Console, opened: Sweep, tracker: Tracker) -> int:
    from music_rllib.sweep.listeners.mlflow import MlflowListener
    from music_rllib.sweep.listeners.screen import Display

    with (
        Display(console, opened.plan, opened.scheduler) as display,
        StateFile(opened) as state_file,
    ):
        mlflow_log = MlflowListener(tracker, opened.store)
        display.headline = state_file.headline
        _take_over(opened, display, mlflow_log)
        controller = None
        if opened.plan.searched:
            from music_rllib.sweep.searches import begin_searches, end_searches

            controller = begin_searches(opened, display, mlflow_log, state_file)
        stopped_by = _compute(opened, display, mlflow_log, state_file, controller)
        failed = bool(opened.scheduler.having(Status.FAILED, Status.SKIPPED)) or (
            stopped_by is None and not opened.scheduler.complete
        )
        searches = [] if controller is None else end_searches(opened, controller, tracker)
        state_file.end("stopped" if stopped_by else "failed" if failed else "finished")
    tracker.close("KILLED" if stopped_by else "FAILED" if failed else "FINISHED")
    results = results_table(
        opened.plan,
        opened.scheduler.__getitem__,
        state_file.reached() | opened.results(),
        tracker.run_id,
        console.width,
    )
    if results.rows:  # a sweep may consist of searches only
        console.print(results)
    for view in search_views(searches):
        console.print(view)
    if undelivered := tracker.undelivered_message():
        console.print(Text(undelivered, style="yellow"), soft_wrap=True)
    console.print(Text(f"Compare in MLflow: {tracker.comparison_url()}"), soft_wrap=True)
    console.print(Text(f"Open MLflow's pages with: {tracker.store.ui_command()}"), soft_wrap=True)
    if stopped_by is None:
        config = opened.config
        report = report_at_end(opened.storage, config.name, config.mlflow.tracking_uri, config.path)
        if report is not None:
            console.print(Text(report), soft_wrap=True)
    if stopped_by is not None:
        _say_how_to_continue(console)
        return 128 + stopped_by
    return FAILED if failed else 0


def _take_over(opened: Sweep, display: Display, mlflow_log: MlflowListener) -> None:
    """Say which runs are reused, and give MLflow those that it doesn't have."""
    reused = opened.scheduler.having(Status.REUSED)
    for node in reused[:NAMED]:
        display.say(f"{display.short(node.label)}: finished earlier, reused")
    if len(reused) > NAMED:
        display.say(f"{len(reused) - NAMED} more: finished earlier, reused")
    for node in reused:
        mlflow_log.finished(node)


def _compute(
    opened: Sweep,
    display: Display,
    mlflow_log: MlflowListener,
    state_file: StateFile,
    controller: SearchController | None,
) -> int | None:
    """Compute what is left, if anything; the signal that stopped it."""
    if opened.scheduler.complete and (controller is None or controller.over):
        return None
    from music_rllib.sweep.listeners.prometheus import PrometheusListener
    from music_rllib.sweep.tune.runner import compute

    address = cluster_address()
    display.say("starting a local Ray" if address is None else f"connecting to Ray at {address}")

    gauges = PrometheusListener(
        opened.config.name, opened.scheduler, mlflow_log.pending, opened.folder
    )
    listeners: list[Listener] = [mlflow_log, display, state_file, gauges]
    if controller is not None:
        listeners.append(controller)

    def on_stop() -> None:
        display.say("stopping, this takes a few seconds; Ctrl-C again stops at once", "yellow")

    def on_ray_gone(cause: str | None) -> None:
        told = "Ray was told to stop as well, so no more can be saved now"
        display.say(cause or told, "red" if cause else "yellow")
        outcome = "failed" if cause else "stopped"
        try_for(
            LAST_SECONDS, lambda: state_file.end(outcome), lambda: mlflow_log.end(killed=not cause)
        )
        display.say(how_to_continue())

    try:
        return compute(opened, listeners, on_stop, on_ray_gone, controller).stopped_by
    finally:
        gauges.close()


def _say_how_to_continue(console: Console) -> None:
    console.print(Text(how_to_continue()), soft_wrap=True)
