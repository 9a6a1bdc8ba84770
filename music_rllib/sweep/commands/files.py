"""`best`, `clean`, `init`, `presets` and `schema`: write and delete files."""

from __future__ import annotations

import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from music_rllib.command_line import Json, console_for, folder_option, print_json
from music_rllib.errors import BadInputError
from music_rllib.sweep.commands import Place, StageName, Storage

BEST_EXAMPLES = """\
Examples:
  music-rllib best results/smoke
      export to results/smoke/best
  music-rllib best s3://bucket/sweeps/search --output policy
      export from a bucket to a local folder
  music-rllib evaluate policy --episodes 100
"""
CLEAN_EXAMPLES = """\
Examples:
  music-rllib clean results/smoke
      list checkpoints of runs that were stopped early, and the checkpoints
      from which finished runs could be trained longer
  music-rllib clean results/smoke --yes
      delete them
  music-rllib clean results/smoke --all --yes
      delete the sweep's files and every run that no other sweep in the
      storage uses; runs in MLflow and studies in a database are kept
"""
INIT_EXAMPLES = """\
Examples:
  music-rllib init
  music-rllib init reach.yaml
  music-rllib run reach.yaml
"""
PRESETS_EXAMPLES = """\
Examples:
  music-rllib presets
  music-rllib plan my.yaml preset=paper
"""
SCHEMA_EXAMPLES = """\
Examples:
  music-rllib schema > sweep.schema.json

Editors with the YAML language server read it if a file begins with
# yaml-language-server: $schema=sweep.schema.json
"""


def best(
    sweep: Place,
    storage: Storage = None,
    stage: StageName = None,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            parser=folder_option,
            help="Target folder; by default 'best' in the folder of the sweep. With several "
            "tasks, each has its own folder inside.",
        ),
    ] = None,
    json: Json = False,
) -> int:
    """Export the best policy with its configuration, and print how it was chosen.

    After a search, the best policy is the first of the ranking on fresh seeds; before the ranking
    is complete, it is the best trial.
    """
    from music_rllib.experiment.record import earlier_text
    from music_rllib.experiment.sweep_files import find_sweep
    from music_rllib.sweep.export import export_best

    found = find_sweep(sweep, storage)
    folder = output or found.folder / "best"
    chosen = export_best(found, stage, folder)
    if json:
        print_json(chosen)
        return 0
    console = console_for()
    lines = [chosen["why"], earlier_text(found)]
    lines += [f"{policy['task']}: {policy['folder']}" for policy in chosen["policies"]]
    for line in filter(None, lines):
        console.print(line, soft_wrap=True)
    return 0


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
            help="Delete the sweep: its files, checkpoints, and results that no other sweep uses.",
        ),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Delete instead of listing.")] = False,
    json: Json = False,
) -> int:
    """List files that are no longer needed, or delete them with --yes.

    By default these are the checkpoints of runs that a search stopped early, and the checkpoints
    that finished runs keep for longer training. Interrupted runs keep theirs.
    """
    from music_rllib.experiment.sweep_files import find_sweep
    from music_rllib.sweep.clean import find_deletable
    from music_rllib.sweep.driver_lock import alone

    location = find_sweep(sweep, storage)
    say = console_for(as_json=json).print
    # No driver may start meanwhile.
    with alone(location, say) if yes else nullcontext():
        cleaning = find_deletable(
            location, unfinished=unfinished or everything, everything=everything
        )
        if yes:
            cleaning.delete()
    items = cleaning.items
    if json:
        answer = {"sweep": location.name, "deleted": yes, "items": items, "kept": cleaning.kept}
        print_json(answer)
        return 0
    console = console_for()
    for item in items:
        console.print(f"{item['path']}  ({item['what']})", soft_wrap=True)
    for item in cleaning.kept:
        console.print(f"kept: {item['path']}  ({item['what']})", soft_wrap=True)
    if not items:
        console.print("Nothing to delete.")
    elif yes:
        console.print(f"{len(items)} deleted.")
    else:
        console.print(f"{len(items)} to delete: use --yes to delete them.")
    return 0


def init(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="File to create; an existing file is never overwritten."
        ),
    ] = Path("sweep.yaml"),
) -> int:
    """Write a commented sweep file to start from."""
    from music_rllib.config.document import starter

    text = starter(file)
    try:
        with file.open("x", encoding="utf-8") as sink:
            sink.write(text)
    except FileExistsError:
        raise BadInputError(f"FILE must not exist yet, got {file}") from None
    except OSError as error:
        raise BadInputError(f"FILE must be writable, got {file}: {error.strerror}") from error
    command = shlex.join(["music-rllib", "plan", str(file)])
    typer.echo(f"{file} is written. Check it with: {command}")
    return 0


def presets(json: Json = False) -> int:
    """List the presets: sets of settings for 'preset: NAME' in a sweep file."""
    from music_rllib.config.document import SHIPPED, shipped_presets

    shipped = shipped_presets()
    if json:
        print_json([{"name": name, "about": about} for name, about in shipped.items()])
        return 0
    width = max(map(len, shipped))
    for name, about in shipped.items():
        typer.echo(f"{name:{width}}  {about}")
    typer.echo(f"\nThe files, with the sources of their numbers, are in {SHIPPED}")
    return 0


def schema() -> int:
    """Print the JSON Schema of sweep files, for editors."""
    from music_rllib.config.document import SCHEMA

    typer.echo(SCHEMA.read_text(encoding="utf-8"), nl=False)
    return 0
