"""`music-rllib`: every command of the package."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from music_rllib import __version__
from music_rllib.command_line import PROGRAM, add_command, new_app, run_app
from music_rllib.report import cli as report
from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties
from music_rllib.serve import command as serve
from music_rllib.sweep.commands import compare, evaluate, files, run, status

COMMANDS: dict[str, tuple[Callable[..., int], str]] = {
    "run": (run.run, run.RUN_EXAMPLES),
    "plan": (run.plan, run.PLAN_EXAMPLES),
    "status": (status.status, status.STATUS_EXAMPLES),
    "stop": (status.stop, status.STOP_EXAMPLES),
    "resume": (run.resume, run.RESUME_EXAMPLES),
    "compare": (compare.compare, compare.EXAMPLES),
    "best": (files.best, files.BEST_EXAMPLES),
    "evaluate": (evaluate.evaluate, evaluate.EXAMPLES),
    "clean": (files.clean, files.CLEAN_EXAMPLES),
    "init": (files.init, files.INIT_EXAMPLES),
    "presets": (files.presets, files.PRESETS_EXAMPLES),
    "schema": (files.schema, files.SCHEMA_EXAMPLES),
    "report": (report.report, report.EXAMPLES),
    "serve": (serve.serve, serve.EXAMPLES),
}
"""Name of each command to its function and the examples of its help, in the order of the help."""
EPILOG = """\
Examples:
  music-rllib init reach.yaml
  music-rllib run reach.yaml seeds=5
  music-rllib status results/reach
  music-rllib report results/reach
  ray job submit --working-dir . -- \\
    python -m music_rllib.sweep reach.yaml --storage /data/results
      as a job of a Ray cluster; without a command in front, a file is run

'music-rllib COMMAND --help' shows the arguments of a command, with examples.

Exit codes: 0 success; 1 a run failed or Ray died, the state is kept; 2 bad
input or damaged results, nothing was started; 130 stopped by Ctrl-C, 143 by
SIGTERM.
"""


app = new_app(epilog=EPILOG, add_completion=True)
for _name, (_function, _examples) in COMMANDS.items():
    add_command(app, _name, _function, _examples)


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


def main(arguments: Sequence[str] | None = None, program_name: str = PROGRAM) -> int:
    """Run the program with `arguments`, by default the process's, and return its exit code."""
    # Ray and MLflow read their environment while they are imported.
    prepare_environment()
    quiet_third_parties()
    return run_app(app, program_name, arguments)
