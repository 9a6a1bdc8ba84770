"""`plan`: check a sweep and show what it would run."""

from __future__ import annotations

import argparse

from music_rllib.sweep.cli_helpers import Commands, add_json, console_for, print_json
from music_rllib.sweep.commands.run import add_sweep_options

__all__ = ["register"]

EPILOG = """\
examples:
  python -m music_rllib.sweep plan tune_configs/search.yaml
  python -m music_rllib.sweep plan my.yaml --seeds 12
      what it would take with 12 seeds, as the report may advise; finished runs count as done
  python -m music_rllib.sweep plan my.yaml --measure
      how long it would take here: some seconds of training for each kind of run
  python -m music_rllib.sweep plan my.yaml --json
      every run known beforehand with its key, the same on every machine
"""


def register(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "plan",
        help="check a sweep and show what it would run",
        description="Check a sweep's file and show what it would run; no run is started. What its "
        "`analysis` states is kept as an analysis plan in the sweep's folder.",
        epilog=EPILOG,
    )
    add_sweep_options(parser)
    parser.add_argument(
        "--measure",
        action="store_true",
        help="Train each kind of run for some seconds on this machine, and say how long all of "
        "what is left would take on it.",
    )
    add_json(parser)
    parser.set_defaults(execute=_execute)


def _execute(arguments: argparse.Namespace) -> int:
    from music_rllib.sweep.driver import run_sweep

    return run_sweep(
        console_for(arguments),
        arguments.config,
        dry_run=True,
        measure=arguments.measure,
        storage=arguments.storage,
        name=arguments.name,
        seeds=arguments.seeds,
        answer=print_json if arguments.json else lambda document: None,
    )
