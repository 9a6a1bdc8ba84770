"""`plan`: check a sweep and show what it would run."""

from __future__ import annotations

from typing import Annotated

import typer

from music_rllib.command_line import Json
from music_rllib.sweep.cli_helpers import Config, Name, Overrides, Seeds, SweepStorage
from music_rllib.sweep.commands.run import file_and_overrides

EXAMPLES = """\
Examples:
  music-rllib plan my.yaml
  music-rllib plan my.yaml --seeds 12
      what it would take with 12 seeds; finished runs count as done
  music-rllib plan my.yaml env_steps=1e6 --measure
      how long it would take here: some seconds of training for each kind of run
  music-rllib plan my.yaml --json
      every run known beforehand with its key, the same on every machine
"""


def plan(
    config: Config = None,
    overrides: Overrides = None,
    storage: SweepStorage = None,
    name: Name = None,
    seeds: Seeds = None,
    measure: Annotated[
        bool,
        typer.Option(
            "--measure",
            help="Train each kind of run for some seconds on this machine, and say how long all "
            "of what is left would take on it.",
        ),
    ] = False,
    json: Json = False,
) -> int:
    """Check a sweep's file and show what it would run.

    No run is started. What its `analysis` states is kept as an analysis plan in the sweep's folder.
    """
    from music_rllib.sweep.driver import run_sweep

    config, overrides = file_and_overrides(config, overrides)
    return run_sweep(
        config,
        dry_run=True,
        measure=measure,
        storage=storage,
        name=name,
        seeds=seeds,
        overrides=overrides,
        as_json=json,
    )
