"""`music-rllib`: every command of the package, its help, exit codes and errors.

A command is a function whose parameters are its arguments (Typer) and which returns its exit code.
Every `--help` imports all commands: their modules load heavy libraries only inside functions.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from music_rllib import __version__
from music_rllib.command_line import PROGRAM
from music_rllib.errors import FAILED, BadInputError
from music_rllib.redaction import for_people
from music_rllib.report import cli as report
from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties
from music_rllib.serve import command as serve
from music_rllib.sweep.commands import evaluate, files, run, slurm, status

COMMANDS: dict[str, tuple[Callable[..., int], str]] = {
    "run": (run.run, run.RUN_EXAMPLES),
    "plan": (run.plan, run.PLAN_EXAMPLES),
    "status": (status.status, status.STATUS_EXAMPLES),
    "stop": (status.stop, status.STOP_EXAMPLES),
    "resume": (run.resume, run.RESUME_EXAMPLES),
    "compare": (status.compare, status.COMPARE_EXAMPLES),
    "best": (files.best, files.BEST_EXAMPLES),
    "evaluate": (evaluate.evaluate, evaluate.EXAMPLES),
    "slurm": (slurm.slurm, slurm.EXAMPLES),
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
      run the file as a job of a Ray cluster (`run` may be omitted)

'music-rllib COMMAND --help' shows the arguments of a command, with examples.

Exit codes: 0 success; 1 a run failed, or Ray or the storage died, the state
is kept; 2 bad input or damaged results, nothing was started; 130 stopped by
Ctrl-C, 143 by SIGTERM.
"""


class _KeepsExamples:
    """A help page whose examples keep their line breaks."""

    epilog: str | None

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        if self.epilog:
            formatter.write(f"\n{self.epilog.strip()}\n")


class Command(_KeepsExamples, TyperCommand):
    """A command whose function returns its exit code; a `BadInputError` becomes one message."""

    def invoke(self, ctx: typer.Context) -> Any:  # type: ignore[override]
        """Run the function and exit with its code."""
        sys.excepthook = _print_unexpected
        try:
            _check_current_folder()
            code = super().invoke(ctx)
        except BadInputError as error:
            print(f"error: {for_people(error)}", file=sys.stderr)
            code = error.exit_code
        except KeyboardInterrupt:
            code = 128 + signal.SIGINT
        except BrokenPipeError:
            _discard_output()  # the reader has closed the pipe (`| head`)
            code = 0
        except OSError:
            code = _end_output()
            if not code:
                raise
        else:
            code = code or _end_output()
        raise typer.Exit(int(code or 0))


def _end_output() -> int:
    """Write what standard output still holds; `FAILED` if that is impossible (a full disk).

    Python itself would do it at its end, print an ignored exception, and exit with 120.
    """
    try:
        sys.stdout.flush()
    except OSError as error:
        _discard_output()
        if not isinstance(error, BrokenPipeError):
            print(f"error: the output can't be written: {error.strerror}", file=sys.stderr)
            return FAILED
    return 0


def _discard_output() -> None:
    """Avoid a second error at the end of the process."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Group(_KeepsExamples, TyperGroup):
    """The program, which explains that `run` is missing before a sweep's file."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0].endswith((".yaml", ".yml")):
            ctx.fail(f"COMMAND must come first: {ctx.command_path} run {args[0]}")
        return super().parse_args(ctx, args)


def _check_current_folder() -> None:
    """Reject a deleted or unreadable current folder, which Ray and relative paths need."""
    try:
        Path.cwd()
    except OSError as error:
        raise BadInputError(
            f"the current folder must exist and be readable: {error.strerror}. "
            "Change to another folder"
        ) from error


def _print_unexpected(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Print the traceback of a defect without passwords that its message may contain."""
    import traceback

    print(for_people("".join(traceback.format_exception(kind, error, trace))), file=sys.stderr)


_HELP = {"help_option_names": ["-h", "--help"]}
app = typer.Typer(
    cls=Group,
    epilog=EPILOG,
    context_settings=_HELP,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for _name, (_function, _examples) in COMMANDS.items():
    app.command(_name, cls=Command, epilog=_examples, context_settings=_HELP)(_function)


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
        # Without a command, print the help to standard output and exit with 0.
        typer.echo(context.get_help())


def main(arguments: Sequence[str] | None = None, program_name: str = PROGRAM) -> int:
    """Run the program with `arguments`, by default the process's, and return its exit code."""
    # Ray and MLflow read their environment while they are imported.
    prepare_environment()
    quiet_third_parties()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by what started the program
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115 - to the end
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without α shows it as \u03b1
            stream.reconfigure(errors="backslashreplace")
    try:
        app(None if arguments is None else list(arguments), prog_name=program_name)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(bool(end.code))
    return 0
