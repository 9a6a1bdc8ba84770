"""The command line of the sweeper."""

from __future__ import annotations

import shlex
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.text import Text

from music_rllib.experiment.config import ConfigError, load_sweep
from music_rllib.experiment.handoff import HandoffError
from music_rllib.experiment.model import SweepConfig
from music_rllib.experiment.plan import make_plan
from music_rllib.experiment.sealed import StorageError
from music_rllib.sweep.board import Status
from music_rllib.sweep.local import (
    ClusterError,
    check_cpus,
    check_reachable,
    cluster_address,
)
from music_rllib.sweep.places import resolve_storage, sweep_folder
from music_rllib.sweep.preflight import (
    TaskError,
    check_environments,
    import_checkpoints,
    verify_inputs,
)
from music_rllib.sweep.session import Sweep, keep_record, open_sweep
from music_rllib.sweep.tables import plan_view, results_table
from music_rllib.tracking.errors import TrackingError
from music_rllib.tracking.redaction import redact

if TYPE_CHECKING:
    from music_rllib.sweep.display import Display
    from music_rllib.sweep.logbook import Logbook
    from music_rllib.tracking.tracker import Tracker

__all__ = ["app"]

DEFAULT_CONFIG = Path(__file__).with_name("default.yaml")
FAILED, BAD_INPUT = 1, 2
NAMED = 10
"""Reused runs that are listed by name."""
WIDTH = 160
"""Columns where there is no terminal to ask."""

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)

EPILOG = """
**Examples**

    python -m music_rllib.sweep
        the packaged sweep: MUSIC-u, then MUSIC-r over q, on FetchPush, a few minutes

    python -m music_rllib.sweep tune_configs/smoke.yaml --dry-run
        check the file and show what would run

    python -m music_rllib.sweep my.yaml --storage /data/results --name first-try
        the same sweep under another name; runs that are finished there are reused

    RAY_ADDRESS=10.0.0.1:6379 python -m music_rllib.sweep my.yaml
        on a Ray cluster

    ray job submit --working-dir . -- python -m music_rllib.sweep my.yaml --storage /data/results
        as a job of a Ray cluster

**Running a command again** continues: finished runs are reused, others go on from their last
checkpoint.

**Exit codes**: 0 all runs are finished, 1 a run failed, 2 bad input (nothing was started),
130 stopped by Ctrl-C, 143 by SIGTERM (state kept).
"""


@app.command(epilog=EPILOG)
def sweep(
    config: Annotated[
        Path | None,
        typer.Argument(help="The sweep, a YAML file. Without one, a small packaged sweep runs."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check everything and show the plan; run nothing.")
    ] = False,
    storage: Annotated[
        str | None,
        typer.Option(
            help="Folder, or s3:// or gs:// URI, for results; replaces the file's `storage`. "
            "Sweeps with the same storage share finished runs."
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the sweep; replaces the file's `name`.")
    ] = None,
) -> None:
    """Train every run of a sweep, compare them, and log them to MLflow."""
    terminal = sys.stdout.isatty()
    console = Console(highlight=False, width=None if terminal else WIDTH)
    try:
        code = _sweep(
            console, config or DEFAULT_CONFIG, dry_run=dry_run, storage=storage, name=name
        )
    except BadInputError as error:
        Console(stderr=True, highlight=False).print(Text(f"error: {error}"), soft_wrap=True)
        code = BAD_INPUT
    except KeyboardInterrupt:
        _say_how_to_continue(console)
        code = 128 + signal.SIGINT
    raise typer.Exit(code)


class BadInputError(Exception):
    """Something that the user must change; nothing has been started."""


def _sweep(
    console: Console, path: Path, *, dry_run: bool, storage: str | None, name: str | None
) -> int:
    """Run the whole program.

    Returns:
        The exit code.

    Raises:
        BadInputError: Nothing was started.
    """
    try:
        opened = _open(console, load_sweep(path, name=name, storage=storage))
        if dry_run:
            console.print("Dry run: the configuration is sound, nothing was started.")
            return 0
        keep_record(opened)
        import_checkpoints(opened.plan, opened.store)
        verify_inputs(opened.board, opened.store)
        if not opened.board.complete and (address := cluster_address()) is not None:
            check_reachable(address)
        tracker = _open_tracker(opened)
    except (
        ClusterError,
        ConfigError,
        HandoffError,
        StorageError,
        TaskError,
        TrackingError,
    ) as error:
        raise BadInputError(str(error)) from error
    with tracker:
        return _compute_and_report(console, opened, tracker)


def _open(console: Console, config: SweepConfig) -> Sweep:
    """Check what can be checked without starting anything, and show the plan."""
    if config.path == DEFAULT_CONFIG:
        console.print(f"No CONFIG given: running the packaged sweep {DEFAULT_CONFIG}.")
    plan = make_plan(config)
    check_environments(plan)
    check_cpus(config.resources)
    storage, remark = resolve_storage(config.storage)
    opened = open_sweep(config, plan, storage, sweep_folder(storage, config.name))
    console.print(plan_view(config, plan, opened.finished))
    console.print(Text(f"Storage: {redact(storage)}"), soft_wrap=True)
    if remark:
        console.print(Text(remark, style="yellow"), soft_wrap=True)
    return opened


def _open_tracker(opened: Sweep) -> Tracker:
    from music_rllib.tracking.tracker import Tracker

    return Tracker(
        sweep_name=opened.config.name,
        storage=opened.storage,
        config=opened.config.document,
        tracking_uri=opened.config.mlflow.tracking_uri,
        sweep_folder=opened.folder,
    )


def _compute_and_report(console: Console, opened: Sweep, tracker: Tracker) -> int:
    from music_rllib.sweep.display import Display
    from music_rllib.sweep.logbook import Logbook

    with Display(console, opened.plan, opened.board) as display:
        logbook = Logbook(tracker, lambda text: display.say(text, "yellow"))
        _take_over(opened, display, logbook)
        stopped_by = _compute(opened, display, logbook)
    failed = bool(opened.board.having(Status.FAILED, Status.SKIPPED)) or (
        stopped_by is None and not opened.board.complete
    )
    tracker.close("KILLED" if stopped_by else "FAILED" if failed else "FINISHED")
    console.print(
        results_table(opened.plan, opened.board.__getitem__, opened.results(), tracker.run_id)
    )
    if undelivered := tracker.undelivered_message():
        console.print(Text(undelivered, style="yellow"), soft_wrap=True)
    console.print(Text(f"Open MLflow's pages with: {tracker.ui_command()}"), soft_wrap=True)
    if stopped_by is not None:
        _say_how_to_continue(console)
        return 128 + stopped_by
    return FAILED if failed else 0


def _take_over(opened: Sweep, display: Display, logbook: Logbook) -> None:
    """Say which runs are reused, and give MLflow those that it doesn't have."""
    reused = opened.board.having(Status.REUSED)
    for node in reused[:NAMED]:
        display.say(f"{node.label}: finished earlier, reused")
    if len(reused) > NAMED:
        display.say(f"{len(reused) - NAMED} more: finished earlier, reused")
    for node in reused:
        logbook.reused(node, opened.store)


def _compute(opened: Sweep, display: Display, logbook: Logbook) -> int | None:
    """Compute what is left, if anything; the signal that stopped it."""
    if opened.board.complete:
        return None
    from music_rllib.sweep.runner import compute

    address = cluster_address()
    display.say("starting a local Ray" if address is None else f"connecting to Ray at {address}")

    def on_stop() -> None:
        display.say("stopping, this takes a few seconds; Ctrl-C again stops at once", "yellow")

    try:
        return compute(opened, [logbook, display], on_stop).stopped_by
    except ClusterError as error:
        raise BadInputError(str(error)) from error


def _say_how_to_continue(console: Console) -> None:
    command = shlex.join(["python", "-m", "music_rllib.sweep", *sys.argv[1:]])
    text = f"Stopped. Finished runs and the last checkpoints are kept; continue with: {command}"
    console.print(Text(text), soft_wrap=True)
