"""`status`: how far a sweep is."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from music_rllib.errors import FAILED, BadInputError
from music_rllib.sweep.cli_helpers import Commands, add_json, add_place, console_for, print_json

if TYPE_CHECKING:
    from music_rllib.experiment.location import Found

__all__ = ["register", "state_of"]

EPILOG = """\
examples:
  python -m music_rllib.sweep status results/smoke
  python -m music_rllib.sweep status results/smoke --watch
      again and again, until the sweep ends
  python -m music_rllib.sweep status s3://bucket/sweeps/smoke --json
"""


def register(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "status",
        help="how far a sweep is: stages, trials, runs, budget, best so far",
        description="How far a sweep is: stages, trials, runs, budget spent and left, best so far.",
        epilog=EPILOG,
    )
    add_place(parser)
    parser.add_argument(
        "--watch", action="store_true", help="Show it again every few seconds until it ends."
    )
    parser.add_argument(
        "--interval", type=float, default=3.0, metavar="SECONDS", help="Of --watch (default 3)."
    )
    add_json(parser)
    parser.set_defaults(execute=_execute)


def _execute(arguments: argparse.Namespace) -> int:
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.views.status import status_view

    found = find_sweep(arguments.sweep, arguments.storage)
    if arguments.json and arguments.watch:
        raise BadInputError("--json must be given without --watch, got both")
    console = console_for(arguments)
    state = state_of(found)
    if arguments.json:
        print_json(state)
        return _code(state)
    if not arguments.watch:
        console.print(status_view(state))
        return _code(state)
    from rich.live import Live

    with Live(console=console, auto_refresh=False) as live:
        while True:
            live.update(status_view(state), refresh=True)
            if state["state"] != "running":
                return _code(state)
            time.sleep(max(arguments.interval, 0.2))
            state = state_of(found)


def _code(state: dict[str, Any]) -> int:
    return FAILED if state.get("damaged") else 0


def state_of(found: Found) -> dict[str, Any]:
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
    state["running"] = []
    for stage in state["stages"]:
        if "started" in stage["runs"]:
            stage["runs"]["interrupted"] = stage["runs"].pop("started")
    for search in state["searches"]:
        for arm in search["arms"] if search["storage"] is None else ():
            arm["running"] = 0  # nobody else can be at a study of the sweep's own
