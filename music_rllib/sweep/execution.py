"""Computes what is left of an opened sweep and shows the results."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from socket import gethostname
from typing import TYPE_CHECKING, Any

from rich.console import Console

from music_rllib import names
from music_rllib.command_line import how_to_continue
from music_rllib.errors import FAILED
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Node
from music_rllib.experiment.record import configuration_of
from music_rllib.experiment.scheduler import Status
from music_rllib.experiment.sweep_files import SEARCH, as_json
from music_rllib.redaction import redact
from music_rllib.runtime.machine import cluster_address
from music_rllib.runtime.process import give_back_freed_memory, try_for, without_collections
from music_rllib.store.storage import is_remote
from music_rllib.sweep.driver_lock import Drivers, alone
from music_rllib.sweep.listeners.mlflow_view import VERSIONS, comparison_view
from music_rllib.sweep.listeners.prometheus import PrometheusListener
from music_rllib.sweep.listeners.screen import Display
from music_rllib.sweep.listeners.state_file import StateFile
from music_rllib.sweep.views.results import results_table, search_views
from music_rllib.tracking.listener import MlflowListener
from music_rllib.tracking.tracker import Tracker

if TYPE_CHECKING:
    from music_rllib.search.controller import SearchController

LAST_SECONDS = 20.0
"""Time to write the last state and to close MLflow's runs after Ray has died."""
CLOSE_SECONDS = 10.0
"""The part of it in which MLflow receives what is left."""
LISTED_REUSED_RUNS = 10


def open_tracker(opened: OpenSweep) -> Tracker:
    """The connection to MLflow, with the shared view of the sweep.

    Raises:
        BadInputError: MLflow can't be used.
    """
    give_back_freed_memory()
    tracker = Tracker(
        sweep_name=opened.config.name,
        storage=opened.storage,
        config=configuration_of(opened.config),
        tracking_uri=opened.config.mlflow.tracking_uri,
    )
    tracker.keep_view(
        comparison_view(opened.plan, opened.config.stage(), tracker.sweep_id, time.time()), VERSIONS
    )
    return tracker


def compute_and_report(
    console: Console,
    opened: OpenSweep,
    tracker: Tracker,
    plans: Sequence[dict[str, Any]],
    drivers: Drivers,
    wait_minutes: float | None,
    *,
    shares: bool,
) -> int:
    """Compute what is left, show the results and write the report; the exit code.

    `plans` are the recorded versions of the analysis plan as plain data, `wait_minutes` is the time
    to wait for a cluster's nodes, `shares` says whether another driver runs the sweep already.
    """
    if plans:
        tracker.put_sweep_artifact(names.ARTIFACT_ANALYSIS_PLAN, as_json(plans))
    with (
        Display(console, opened.plan, opened.scheduler) as display,
        StateFile(opened, drivers.stop_before) as state_file,
    ):
        mlflow_log = MlflowListener(tracker, opened.store, opened.environments.now)
        mlflow_log.postpones = shares  # the last driver logs what none of them has computed
        display.headline = state_file.headline
        _take_over_reused(opened, display, mlflow_log)
        controller = None
        if opened.plan.searched:
            controller = begin_searches(opened, display, mlflow_log, state_file, alone=not shares)
        if not shares:  # otherwise the plan lacks the trials that others are running
            tracker.keep_current(node.key for node in opened.plan.nodes)
        mlflow_log.postpones = True  # other drivers may join, and log what they compute
        stopped_by = _compute(opened, display, mlflow_log, state_file, controller, wait_minutes)
        searches = [] if controller is None else end_searches(opened, controller, tracker)
        # Trials that failed because a run failed, under earlier drivers too.
        lost = sum(t["lost"] for one in searches for arm in one["arms"] for t in arm["trials"])
        failed = (
            bool(opened.scheduler.having(Status.FAILED, Status.SKIPPED))
            or lost > 0
            or (stopped_by is None and not opened.scheduler.complete)
        )
        state_file.end("stopped" if stopped_by else "failed" if failed else "finished")

    def say_left(records: int) -> None:
        console.print(f"Sending to MLflow: {records:,} records left (Ctrl-C to send them later)")

    # A stopped driver does not wait for the report of another one.
    report = None
    with contextlib.nullcontext() if stopped_by else alone(opened.location, display.say):
        if not drivers.others():
            mlflow_log.log_postponed()
            tracker.keep_current(node.key for node in opened.plan.nodes)  # with trials since then
        tracker.close(
            "KILLED" if stopped_by else "FAILED" if failed else "FINISHED",
            say=None if stopped_by else say_left,
        )
        _show_results(console, opened, tracker, state_file, searches)
        if not stopped_by:
            report = report_at_end(opened)
    if lost:
        console.print(
            f"{lost} trials failed because a run of theirs failed. This study does not try them "
            "again; with another search.study the next command does, and reuses finished runs.",
            style="yellow",
            soft_wrap=True,
        )
    if stopped_by is not None:
        console.print(how_to_continue(), soft_wrap=True)
        return 128 + stopped_by
    if report is not None:
        console.print(report, soft_wrap=True)
    return FAILED if failed else 0


def _take_over_reused(opened: OpenSweep, display: Display, mlflow_log: MlflowListener) -> None:
    """List the reused runs, and log those that MLflow does not have."""
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
    wait_minutes: float | None,
) -> int | None:
    """Compute what is left, if anything; the signal that stopped it, or None."""
    if opened.scheduler.complete and (controller is None or controller.over):
        return None
    with without_collections():
        from music_rllib.tune.runner import compute  # Ray takes seconds to load

    address = cluster_address()
    display.say("starting a local Ray" if address is None else f"connecting to Ray at {address}")
    tracker = mlflow_log.tracker
    gauges = PrometheusListener(
        opened.config.name, opened.scheduler, tracker.pending, opened.folder
    )
    searches = [] if controller is None else [controller]

    def on_stop() -> None:
        display.say("stopping, this takes a few seconds; Ctrl-C again stops at once", "yellow")

    def on_ray_gone(cause: str | None) -> None:
        stopped = "Ray was told to stop as well, so nothing more can be saved"
        display.say(cause or stopped, "red" if cause else "yellow")
        try_for(
            LAST_SECONDS,
            lambda: state_file.end("failed" if cause else "stopped"),
            lambda: tracker.close("FAILED" if cause else "KILLED", timeout=CLOSE_SECONDS),
        )
        display.say(how_to_continue())

    try:
        listeners = [mlflow_log, display, state_file, gauges, *searches]
        return compute(opened, listeners, on_stop, on_ray_gone, controller, wait_minutes)
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
    reached = state_file.unfinished | opened.results()
    results = results_table(opened.plan, state_file.status, reached)
    if results.rows:  # a sweep may consist of searches only
        console.print(results)
    for view in search_views(searches):
        console.print(view)
    if undelivered := tracker.undelivered_message():
        console.print(undelivered, style="yellow", soft_wrap=True)
    console.print(f"Compare in MLflow: {tracker.comparison_url()}", soft_wrap=True)
    console.print(f"Open MLflow's pages with: {tracker.store.ui_command()}", soft_wrap=True)


def begin_searches(
    opened: OpenSweep,
    display: Display,
    mlflow_log: MlflowListener,
    state_file: StateFile,
    *,
    alone: bool,
) -> SearchController:
    """Open the searches, add their earlier trials, and plan the first runs."""
    # Optuna takes a third of a second to load.
    from music_rllib.search.controller import SearchController
    from music_rllib.search.outcome import outcome
    from music_rllib.search.searches import open_searches

    def reused(node: Node) -> None:
        mlflow_log.finished(node)
        state_file.reused(node)

    controller = SearchController(
        opened,
        open_searches(opened, alone=alone),
        reused=reused,
        pruned=mlflow_log.pruned,
        say=display.say,
    )
    state_file.searches = lambda: outcome(controller, thorough=False)
    controller.recall()
    controller.propose()
    return controller


def end_searches(
    opened: OpenSweep, controller: SearchController, tracker: Tracker
) -> list[dict[str, Any]]:
    """Stop the searches, and save their outcome in the sweep's folder and in MLflow."""
    from music_rllib.search.outcome import outcome

    controller.stop()
    searches = outcome(controller)
    if searches:
        text = as_json(searches)
        tracker.put_sweep_artifact(names.ARTIFACT_SEARCH, text)
        opened.location.keep(SEARCH, text)
    return searches


TIMEOUT_SECONDS = 900.0
"""After this time the sweep ends without a report."""


def report_at_end(opened: OpenSweep) -> str | None:
    """Make the report of a sweep and attach it to the sweep's run in MLflow.

    It runs in a process of its own: whatever happens in it, the results of the sweep are kept.

    Returns:
        The answer and the paths of the page and its picture, or the reason why there is no report;
        None if `MUSIC_RLLIB_REPORT=off` is set.
    """
    if os.environ.get(names.VARIABLE_REPORT, "").lower() in {"off", "0", "no", "false"}:
        return None
    config, remote, environment = opened.config, is_remote(opened.storage), dict(os.environ)
    if config.mlflow.tracking_uri is not None:
        environment[names.VARIABLE_TRACKING_URI] = config.mlflow.tracking_uri
    place = config.name if remote else str(opened.folder)
    if remote:
        # Its URI may hold a key, which everyone on the machine could read on a command line.
        environment[names.VARIABLE_STORAGE] = opened.storage
    command = [sys.executable, "-m", "music_rllib", "report", place]
    if config.path.is_file():  # its environments are recorded in videos
        command += ["--env", str(config.path.absolute())]
    try:
        done = subprocess.run(  # noqa: S603
            [*command, "--attach"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        reason = redact(str(error))
    else:
        made = [s for s in done.stdout.splitlines() if not s.startswith(("missing: ", "Attached "))]
        errors = done.stderr.strip().splitlines()
        if "RAY_JOB_CONFIG_JSON_ENV_VAR" in environment or remote:
            made = elsewhere(done.stdout, opened.location.place)
        if any(s.startswith("Report: ") for s in made):  # even if not attached, or runs are damaged
            return "\n".join(made if done.returncode == 0 else [*made, *errors[-1:]])
        reason = errors[-1] if errors else f"it ended with exit code {done.returncode}"
    return f"No report: {reason}. Make it with: music-rllib report {opened.location.place}"


def elsewhere(output: str, sweep: str) -> list[str]:
    """Lines of the report's `output` for a user who may read it on another machine."""
    lines = []
    for line in output.splitlines():
        if line.startswith("Report: "):
            lines += [
                f"On your machine: music-rllib report {sweep}",
                f"{line} (on {gethostname()})",
            ]
        elif not re.match("missing: |Picture: |Attached (?!.*: https?:)", line):
            lines.append(line)
    return lines
