"""`clean`: delete what a sweep has left and nobody needs."""

from __future__ import annotations

import argparse

from music_rllib.sweep.cli_helpers import Commands, add_json, add_place, console_for, print_json

__all__ = ["register"]

EPILOG = """\
examples:
  python -m music_rllib.sweep clean results/smoke
      list the checkpoints of runs that are finished or were stopped early
  python -m music_rllib.sweep clean results/smoke --yes
      delete them
  python -m music_rllib.sweep clean results/smoke --all --yes
      the sweep's own files and every run that no other sweep in the storage has, nor any whose
      search shares its study: MLflow's records stay, and studies in a database of their own
"""


def register(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "clean",
        help="list, and delete with --yes, what a sweep has left and nobody needs",
        description="List what can go; with --yes delete it. Checkpoints of runs that a search "
        "stopped early by default, since an interrupted run may go on from its own.",
        epilog=EPILOG,
    )
    add_place(parser)
    parser.add_argument(
        "--unfinished",
        action="store_true",
        help="Checkpoints of interrupted runs too: they would begin from scratch.",
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="The whole sweep: its files, checkpoints and results that no other sweep here has.",
    )
    parser.add_argument("--yes", action="store_true", help="Delete.")
    add_json(parser)
    parser.set_defaults(execute=_execute)


def _execute(arguments: argparse.Namespace) -> int:
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.clean import delete, what_can_go

    found = find_sweep(arguments.sweep, arguments.storage)
    cleaning = what_can_go(
        found, unfinished=arguments.unfinished or arguments.all, everything=arguments.all
    )
    going = cleaning.items
    if arguments.yes:
        delete(found, cleaning)
    if arguments.json:
        print_json(
            {
                "sweep": found.name,
                "deleted": arguments.yes,
                "items": going,
                "kept": cleaning.kept,
            }
        )
        return 0
    console = console_for(arguments)
    for item in going:
        console.print(f"{item['path']}  ({item['what']})", soft_wrap=True)
    for item in cleaning.kept:
        console.print(f"kept: {item['path']}  ({item['what']})", soft_wrap=True)
    if not going:
        console.print("Nothing to delete.")
    elif not arguments.yes:
        console.print(f"{len(going)} to delete: say --yes to do it.")
    else:
        console.print(f"{len(going)} deleted.")
    return 0
