"""`stop`: ask a running sweep to save its state and stop."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from music_rllib.command_line import Json, console_for, print_json
from music_rllib.errors import FAILED
from music_rllib.sweep.commands.arguments import Place, Storage

EXAMPLES = """\
Examples:
  music-rllib stop results/smoke
      runs save their state and the sweep ends, as with Ctrl-C
  music-rllib stop s3://bucket/sweeps/smoke --wait 0
      from any machine, without waiting for the end
"""


def stop(
    sweep: Place,
    storage: Storage = None,
    wait: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            help="Time to wait for the end; the exit code is 1 if the sweep still runs then.",
        ),
    ] = 120.0,
    json: Json = False,
) -> int:
    """Ask a running sweep to save its state and stop.

    The request goes through the storage, so the sweep can run on another machine.
    """
    from music_rllib.experiment import sweep_files
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.commands.status import state_of
    from music_rllib.sweep.driver_lock import has_driver

    location = find_sweep(sweep, storage)
    name = location.name
    console = console_for(as_json=json)
    state = state_of(location)["state"]
    deadline = time.monotonic() + wait
    while state != "running" and has_driver(location.storage, name) and time.monotonic() < deadline:
        time.sleep(0.5)  # it is being started
        state = state_of(location)["state"]
    was_running = state == "running"
    if was_running:
        sweep_files.write(location.storage, f"{name}/{sweep_files.STOP}", '{"stop": true}')
        while state == "running" and time.monotonic() < deadline:
            time.sleep(0.5)
            state = state_of(location)["state"]
        console.print(f"{name}: {'was told to stop' if state == 'running' else 'has stopped'}")
    else:
        console.print(f"{name}: is not running ({state})")
    if json:
        print_json({"sweep": name, "was_running": was_running, "state": state})
    return FAILED if state == "running" and wait > 0 else 0
