"""`status`: how far a sweep is."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from music_rllib.command_line import Json, console_for, print_json
from music_rllib.errors import FAILED, BadInputError
from music_rllib.sweep.cli_helpers import Place, Storage

if TYPE_CHECKING:
    from music_rllib.experiment.location import SweepLocation

__all__ = ["EXAMPLES", "state_of", "status"]

EXAMPLES = """\
Examples:
  music-rllib status results/smoke
  music-rllib status results/smoke --watch
      again and again, until the sweep ends
  music-rllib status s3://bucket/sweeps/smoke --json
"""


def status(
    sweep: Place,
    storage: Storage = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show it again every few seconds until it ends.")
    ] = False,
    interval: Annotated[float, typer.Option(metavar="SECONDS", help="Of --watch.")] = 3.0,
    json: Json = False,
) -> int:
    """How far a sweep is.

    Stages, trials, runs, budget spent and left, the best so far.
    """
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.views.status import status_view

    found = find_sweep(sweep, storage)
    if json and watch:
        raise BadInputError("--json must be given without --watch, got both")
    console = console_for(as_json=json)
    state = state_of(found)
    if json:
        print_json(state)
        return _code(state)
    if not watch:
        console.print(status_view(state, labels_of(found)))
        return _code(state)
    from rich.live import Live

    with Live(console=console, auto_refresh=False) as live:
        while True:
            live.update(status_view(state, labels_of(found)), refresh=True)
            if state["state"] != "running":
                return _code(state)
            time.sleep(max(interval, 0.2))
            state = state_of(found)


def labels_of(found: SweepLocation) -> list[str]:
    """The labels of the sweep's runs, as far as they are known."""
    from music_rllib.experiment import sweep_files

    return [node["label"] for node in (found.read(sweep_files.PLAN) or {"nodes": []})["nodes"]]


def _code(state: dict[str, Any]) -> int:
    return FAILED if state.get("damaged") else 0


def state_of(found: SweepLocation) -> dict[str, Any]:
    """`state.json`, with what became of its driver and of its finished runs."""
    from music_rllib.experiment import sweep_files
    from music_rllib.store.node_store import NodeStore

    state = found.read(sweep_files.STATE)
    if state is None:
        return {"sweep": found.name, "place": found.place, "state": "not started"}
    outcome = state["driver"]["outcome"]
    if not sweep_files.is_alive(state):
        outcome = "interrupted" if outcome == "running" else outcome
        _nothing_runs(state)
    store, nodes = (
        NodeStore(found.storage),
        (found.read(sweep_files.PLAN) or {"nodes": []})["nodes"],
    )
    labels = {node["key"]: node["label"] for node in nodes if store.is_finished(node["key"])}
    damaged = [
        {"run": labels[key], "cause": str(error)} for key, error in store.damage(labels).items()
    ]
    return {"place": found.place, "state": outcome, **state, "damaged": damaged}


def _nothing_runs(state: dict[str, Any]) -> None:
    """A driver that crashed or was killed has left its runs as they were when it last spoke."""
    state["interrupted"] = [*state.get("interrupted", ()), *state["running"]]
    state["running"] = []
    for stage in state["stages"]:
        if "started" in stage["runs"]:
            stage["runs"]["interrupted"] = stage["runs"].pop("started")
    for search in state["searches"]:
        for arm in search["arms"] if search["storage"] is None else ():
            arm["running"] = 0  # nobody else can be at a study of the sweep's own
