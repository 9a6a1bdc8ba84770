"""`resume`: go on with a sweep from what its storage knows of it."""

from __future__ import annotations

import argparse

from music_rllib.sweep.cli_helpers import Commands, add_json, add_place, console_for, print_json

__all__ = ["register"]

EPILOG = """\
examples:
  python -m music_rllib.sweep resume results/smoke
      no file needed: the configuration is in the storage
  ray job submit --working-dir . -- python -m music_rllib.sweep resume s3://bucket/sweeps/smoke
      in a new job, after the head of a cluster has died
  python -m music_rllib.sweep resume results/smoke --seeds 10
      extended by seeds: only the new ones are trained
"""


def register(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "resume",
        help="go on with a sweep that was stopped, killed, or is to be extended",
        description="Go on with a sweep by the configuration that it has left in its storage.",
        epilog=EPILOG,
    )
    add_place(parser)
    parser.add_argument("--seeds", metavar="N", help="As of 'run'.")
    parser.add_argument("--accept-changes", action="store_true", help="As of 'run'.")
    parser.add_argument("--retrain-damaged", action="store_true", help="As of 'run'.")
    add_json(parser)
    parser.set_defaults(execute=_execute)


def _execute(arguments: argparse.Namespace) -> int:
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.driver import resume_sweep

    return resume_sweep(
        console_for(arguments),
        find_sweep(arguments.sweep, arguments.storage),
        seeds=arguments.seeds,
        accept_changes=arguments.accept_changes,
        retrain_damaged=arguments.retrain_damaged,
        answer=print_json if arguments.json else lambda document: None,
    )
