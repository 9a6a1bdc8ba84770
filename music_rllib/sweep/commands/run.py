"""`run`: train every run of a sweep."""

from __future__ import annotations

import argparse
from pathlib import Path

from music_rllib.sweep.cli_helpers import Commands, add_json, console_for

__all__ = ["add_sweep_options", "register"]

EPILOG = """\
examples:
  python -m music_rllib.sweep run tune_configs/smoke.yaml
  python -m music_rllib.sweep run my.yaml --storage /data/results --name first-try
  python -m music_rllib.sweep run my.yaml --seeds 10
      the same with seeds 0 to 9: only the new ones are trained
"""


def register(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "run",
        help="train every run of a sweep (the default command)",
        description="Train every run of a sweep, compare them, and log them to MLflow.",
        epilog=EPILOG,
    )
    add_sweep_options(parser)
    parser.add_argument(
        "--dry-run", action="store_true", help="Check everything and show the plan; run nothing."
    )
    parser.add_argument(
        "--accept-changes",
        action="store_true",
        help="Where settings are others than the last time under this name: train anew what they "
        "touch. Without it the command says what would be lost, and starts nothing.",
    )
    parser.add_argument(
        "--retrain-damaged",
        action="store_true",
        help="Where finished runs are not what they were when they ended: delete them and train "
        "them again. Without it the command names them, and starts nothing.",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="Start only where there is an earlier run of this sweep to go on with. Without it a "
        "repeated command goes on just the same.",
    )
    add_json(parser)
    parser.set_defaults(execute=_execute)


def add_sweep_options(parser: argparse.ArgumentParser) -> None:
    """The file of a sweep, and what replaces parts of it."""
    parser.add_argument(
        "config",
        nargs="?",
        type=Path,
        metavar="CONFIG",
        help="The sweep, a YAML file. Without one, a small packaged sweep is taken.",
    )
    parser.add_argument(
        "--storage",
        metavar="PLACE",
        help="Folder, or s3:// or gs:// URI, for results; replaces the file's 'storage'. "
        "Sweeps with the same storage share finished runs.",
    )
    parser.add_argument("--name", help="Name of the sweep; replaces the file's 'name'.")
    parser.add_argument(
        "--seeds",
        metavar="N",
        help="So many seeds, or a list like 0,1,7; replaces the file's 'seeds'. The report says "
        "how many would likely decide; those that have run are reused.",
    )


def _execute(arguments: argparse.Namespace) -> int:
    from music_rllib.sweep.cli_helpers import print_json
    from music_rllib.sweep.driver import run_sweep

    return run_sweep(
        console_for(arguments),
        arguments.config,
        dry_run=arguments.dry_run,
        storage=arguments.storage,
        name=arguments.name,
        seeds=arguments.seeds,
        answer=print_json if arguments.json else lambda document: None,
        accept_changes=arguments.accept_changes,
        retrain_damaged=arguments.retrain_damaged,
        must_exist=arguments.resume,
    )
