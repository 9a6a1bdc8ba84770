"""`music-rllib`: every command of the package."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

from music_rllib import __version__
from music_rllib.command_line import PROGRAM, add_command, new_app, run_app
from music_rllib.report import cli as report
from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties
from music_rllib.serve import command as serve
from music_rllib.sweep.cli import COMMANDS, EXIT_CODES
from music_rllib.tracking import cli as tracking

EPILOG = f"""\
Examples:
  music-rllib init reach.yaml
  music-rllib run reach.yaml seeds=5
  music-rllib status results/reach
  music-rllib report results/reach

'music-rllib COMMAND --help' shows the arguments of a command, with examples.

{EXIT_CODES}"""


app = new_app(epilog=EPILOG, add_completion=True)
for _name, (_function, _examples) in COMMANDS.items():
    add_command(app, _name, _function, _examples)
add_command(app, "report", report.report, report.EXAMPLES)
add_command(app, "serve", serve.serve, serve.EXAMPLES)
app.add_typer(tracking.app, name="tracking")


@app.callback(invoke_without_command=True)
def program(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Train, compare and search with TAC and MUSIC on RLlib; report and serve the results."""
    if version:
        typer.echo(f"{PROGRAM} {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        # Without a command the help is an answer, not an error: on standard output, exit code 0.
        typer.echo(context.get_help())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program with `arguments`, by default the process's, and return its exit code."""
    # Ray and MLflow read their environment while they are imported.
    prepare_environment()
    quiet_third_parties()
    return run_app(app, PROGRAM, arguments)
