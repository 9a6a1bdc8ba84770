"""`clean`: delete checkpoints and results that are no longer needed."""

from __future__ import annotations

from typing import Annotated

import typer

from music_rllib.command_line import Json, console_for, print_json
from music_rllib.sweep.commands.arguments import Place, Storage

EXAMPLES = """\
Examples:
  music-rllib clean results/smoke
      list the checkpoints of runs that were stopped early, and those from
      which finished runs would go on with more env_steps
  music-rllib clean results/smoke --yes
      delete them
  music-rllib clean results/smoke --all --yes
      the sweep's own files and every run that no other sweep in the storage
      has, nor any whose search shares its study: MLflow's records stay, and
      studies in a database of their own
"""


def clean(
    sweep: Place,
    storage: Storage = None,
    unfinished: Annotated[
        bool,
        typer.Option(
            "--unfinished",
            help="Also delete checkpoints of interrupted runs, which then start from scratch.",
        ),
    ] = False,
    everything: Annotated[
        bool,
        typer.Option(
            "--all",
            help="Delete the sweep: its files, checkpoints, and results that no other one uses.",
        ),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Delete instead of listing.")] = False,
    json: Json = False,
) -> int:
    """List files that are no longer needed, or delete them with --yes.

    By default these are the checkpoints of runs that a search stopped early, and those that
    finished runs keep for longer training. An interrupted run may go on from its own.
    """
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.clean import what_can_go

    location = find_sweep(sweep, storage)
    cleaning = what_can_go(location, unfinished=unfinished or everything, everything=everything)
    going = cleaning.items
    if yes:
        cleaning.delete()
    if json:
        answer = {"sweep": location.name, "deleted": yes, "items": going, "kept": cleaning.kept}
        print_json(answer)
        return 0
    console = console_for()
    for item in going:
        console.print(f"{item['path']}  ({item['what']})", soft_wrap=True)
    for item in cleaning.kept:
        console.print(f"kept: {item['path']}  ({item['what']})", soft_wrap=True)
    if not going:
        console.print("Nothing to delete.")
    elif not yes:
        console.print(f"{len(going)} to delete: say --yes to do it.")
    else:
        console.print(f"{len(going)} deleted.")
    return 0
