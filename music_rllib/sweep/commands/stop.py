"""`stop`: ask a running sweep to stop in good order."""

from __future__ import annotations

import argparse
import time

from music_rllib.errors import FAILED
from music_rllib.sweep.cli_helpers import Commands, add_json, add_place, console_for, print_json

__all__ = ["register"]

EPILOG = """\
examples:
  python -m music_rllib.sweep stop results/smoke
      runs save their state, and the sweep ends as by Ctrl-C
  python -m music_rllib.sweep stop s3://bucket/sweeps/smoke --wait 0
      from any machine; don't wait for the end
"""


def register(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "stop",
        help="ask a running sweep to save its state and stop",
        description="Ask a running sweep, wherever it runs, to save its state and stop.",
        epilog=EPILOG,
    )
    add_place(parser)
    parser.add_argument(
        "--wait",
        type=float,
        default=120.0,
        metavar="SECONDS",
        help="How long to wait for its end (default 120); the exit code is 1 if it still runs.",
    )
    add_json(parser)
    parser.set_defaults(execute=_execute)


def _execute(arguments: argparse.Namespace) -> int:
    from music_rllib.experiment import sweep_files
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.commands.status import state_of

    found = find_sweep(arguments.sweep, arguments.storage)
    console = console_for(arguments)
    state = state_of(found)["state"]
    asked = state == "running"
    if asked:
        sweep_files.write(found.storage, f"{found.name}/{sweep_files.STOP}", '{"stop": true}')
        deadline = time.monotonic() + arguments.wait
        while state == "running" and time.monotonic() < deadline:
            time.sleep(0.5)
            state = state_of(found)["state"]
        stopped = state != "running"
        console.print(f"{found.name}: {'has stopped' if stopped else 'was told to stop'}")
    else:
        console.print(f"{found.name}: is not running ({state})")
    if arguments.json:
        print_json({"sweep": found.name, "was_running": asked, "state": state})
    return FAILED if state == "running" and arguments.wait > 0 else 0
