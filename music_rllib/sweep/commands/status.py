"""`status`, `stop` and `compare`: the state of a sweep, a request to stop it, and its answer."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from music_rllib.command_line import Json, console_for, print_json, time_option
from music_rllib.errors import FAILED, BadInputError
from music_rllib.sweep.commands import Place, Storage

if TYPE_CHECKING:
    from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.sweep.commands import StageName

STATUS_EXAMPLES = """\
Examples:
  music-rllib status results/smoke
  music-rllib status results/smoke --watch
      update the view until the sweep ends
  music-rllib status s3://bucket/sweeps/smoke --json
"""
STOP_EXAMPLES = """\
Examples:
  music-rllib stop results/smoke
      runs save their state and the sweep ends, as with Ctrl-C
  music-rllib stop s3://bucket/sweeps/smoke --wait 0
      from any machine, without waiting for the end
"""


def status(
    sweep: Place,
    storage: Storage = None,
    watch: Annotated[
        bool,
        typer.Option("--watch", help="Update the view every few seconds until the sweep ends."),
    ] = False,
    interval: Annotated[
        float,
        typer.Option(
            metavar="SECONDS", parser=time_option, help="Time between updates of --watch."
        ),
    ] = 3.0,
    json: Json = False,
) -> int:
    """Show the progress of a sweep: stages, trials, runs, budget and best result so far."""
    from rich.live import Live

    from music_rllib.experiment.sweep_files import find_sweep
    from music_rllib.sweep.views.results import status_view

    location = find_sweep(sweep, storage)
    if json and watch:
        raise BadInputError("--json must be given without --watch, got both")
    console = console_for(as_json=json)
    state = state_of(location)
    if json:
        print_json(state)
    elif not watch:
        console.print(status_view(state, _labels(location)))
    else:
        with Live(console=console, auto_refresh=False) as live:
            live.update(status_view(state, _labels(location)), refresh=True)
            while state["state"] == "running":
                time.sleep(max(interval, 0.2))
                state = state_of(location)
                live.update(status_view(state, _labels(location)), refresh=True)
        if not console.is_terminal:  # where `Live` leaves out the last line's end
            console.print()
    return FAILED if state.get("damaged") else 0


def _labels(location: SweepLocation) -> list[str]:
    return [node["label"] for node in location.nodes()]


def state_of(location: SweepLocation) -> dict[str, Any]:
    """The sweep's `state.json`, with its present state and its damaged runs."""
    from music_rllib.config.schema import IMPORTED
    from music_rllib.experiment import sweep_files
    from music_rllib.experiment.record import earlier_text
    from music_rllib.experiment.scheduler import DONE
    from music_rllib.store.node_store import NodeStore
    from music_rllib.sweep.driver_lock import others_drive

    state = location.read(sweep_files.STATE)
    if state is None:
        return {"sweep": location.name, "place": location.place, "state": "not started"}
    outcome = state["driver"]["outcome"]
    if not sweep_files.is_alive(state):
        outcome = "interrupted" if outcome == "running" else outcome
        if others_drive(location, state):
            outcome = "running"  # another driver computes, and writes the state in a moment
        else:
            _mark_interrupted(state)
    store, nodes = NodeStore(location.storage), location.nodes()
    labels = {node["key"]: node["label"] for node in nodes}
    sources = {str(node["input"]) for node in nodes} - labels.keys()
    labels |= {key: key for key in sources if key.startswith(IMPORTED)}
    finished = store.finished(labels)
    labels = {key: label for key, label in labels.items() if key in finished}
    damaged = [
        {"run": labels[key], "cause": str(error)} for key, error in store.damage(labels).items()
    ]
    counted = (stage["runs"].get(name, 0) for stage in state["stages"] for name in DONE)
    since = sum(node["key"] in finished for node in nodes) - sum(counted)
    return {
        "place": location.place,
        "state": outcome,
        **state,
        "finished_since": 0 if outcome == "running" else max(since, 0),
        "damaged": damaged,
        "earlier": earlier_text(location),
    }


def _mark_interrupted(state: dict[str, Any]) -> None:
    """Mark the runs as interrupted that were running when the driver last wrote its state."""
    state["interrupted"] = [*state.get("interrupted", ()), *state["running"]]
    state["running"] = []
    for stage in state["stages"]:
        if "started" in stage["runs"]:
            stage["runs"]["interrupted"] = stage["runs"].pop("started")
    for search in state["searches"]:
        for arm in search["arms"] if search["storage"] is None else ():
            arm["running"] = 0  # a study of the sweep's own has no other driver


def stop(
    sweep: Place,
    storage: Storage = None,
    wait: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            parser=time_option,
            help="Time to wait for the end; the exit code is 1 if the sweep still runs then.",
        ),
    ] = 120.0,
    json: Json = False,
) -> int:
    """Ask a running sweep to save its state and stop.

    The request goes through the storage, so the sweep can run on another machine.
    """
    from music_rllib.experiment import sweep_files
    from music_rllib.experiment.sweep_files import find_sweep
    from music_rllib.sweep.driver_lock import others_drive

    location = find_sweep(sweep, storage)
    name = location.name
    console = console_for(as_json=json)

    def runs() -> bool:
        """Whether a driver computes runs, or is starting and has no state yet."""
        state = location.read(sweep_files.STATE)
        return sweep_files.is_alive(state) or others_drive(location, state)

    deadline = time.monotonic() + wait
    is_running = was_running = runs()
    if was_running:
        location.write(sweep_files.STOP, sweep_files.as_json({"stop": time.time_ns()}))
        while is_running and time.monotonic() < deadline:
            time.sleep(0.5)
            is_running = runs()
    state = state_of(location)["state"]
    if was_running:
        console.print(f"{name}: {'was told to stop' if is_running else 'has stopped'}")
    else:
        console.print(f"{name}: is not running ({state})")
    if json:
        print_json({"sweep": name, "was_running": was_running, "state": state})
    return FAILED if is_running and wait > 0 else 0


COMPARE_EXAMPLES = """\
Examples:
  music-rllib compare results/smoke
  music-rllib compare results/smoke --metric evaluation/object_displacement
  music-rllib compare results/search --stage finetune --json

The answer comes first. It compares the areas under the learning curves (the
mean over the budget), paired by seed if conditions share seeds: superior,
worse, equivalent within a margin, or undecided (docs/comparing_q.md).
Comparisons that the sweep's 'analysis' planned before the runs are marked.

Tables of final values and entropies follow, without a test: the mean over the
seeds that have finished on every task with its 95% CI (docs/reports.md). Runs
on fresh seeds of a search are never mixed with the runs of its trials. The
report has the same tables, and the differences of final values.
"""


def compare(
    sweep: Place,
    storage: Storage = None,
    stage: StageName = None,
    metric: Annotated[
        str | None,
        typer.Option(
            metavar="METRIC",
            help="Metric to compare, by its area under the curve and its final values. Default: "
            "the primary metric of each task (success rate, or return without success); a search "
            "shows final values of its objective.",
        ),
    ] = None,
    minimize: Annotated[
        bool, typer.Option("--minimize", help="Lower values of --metric are better.")
    ] = False,
    json: Json = False,
) -> int:
    """Compare values of q, or of other settings, with 95% confidence intervals."""
    from music_rllib.experiment.sweep_files import find_sweep
    from music_rllib.sweep.views.compare import compare_stage

    if minimize and metric is None:
        raise BadInputError("--minimize must be given with the --metric whose lower values count")
    found = find_sweep(sweep, storage)
    document, view = compare_stage(found, stage, metric, minimize=minimize)
    if json:
        print_json(document)
    else:
        console_for().print(view)
    return 0
