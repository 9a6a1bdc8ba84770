"""`init`, `presets` and `schema`: help to write a sweep file."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from music_rllib.command_line import Json, print_json
from music_rllib.errors import BadInputError

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

Editors with the YAML language server read it where a file begins with
# yaml-language-server: $schema=sweep.schema.json
"""


def init(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="File to create; an existing file is never overwritten."
        ),
    ] = Path("sweep.yaml"),
) -> int:
    """Write a commented sweep file to start from."""
    from music_rllib.config.presets import starter

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
    """List the presets: sets of settings that a sweep file can use.

    By 'preset: NAME' in it.
    """
    from music_rllib.config.presets import SHIPPED, shipped_presets

    shipped = shipped_presets()
    if json:
        print_json([{"name": name, "about": about} for name, about in shipped.items()])
        return 0
    width = max(map(len, shipped))
    for name, about in shipped.items():
        typer.echo(f"{name:{width}}  {about}")
    typer.echo(f"\nEach file says where its numbers come from: {SHIPPED}")
    return 0


def schema() -> int:
    """Print the JSON Schema of sweep files, for editors."""
    from music_rllib.config.presets import SCHEMA

    typer.echo(SCHEMA.read_text(encoding="utf-8"), nl=False)
    return 0
