"""What all commands share: arguments, help pages, exit codes, output for people and as JSON.

A command is a function whose parameters are its arguments (Typer) and which returns its exit code.
Every `--help` imports all commands: their modules load heavy libraries inside of functions only.
"""

from __future__ import annotations

import io
import json
import math
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from music_rllib.errors import BAD_INPUT, BadInputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.segment import Segment

PROGRAM = "music-rllib"
WIDTH = 160
"""Columns of output that goes elsewhere than to a terminal."""
HELP_OPTIONS = {"help_option_names": ["-h", "--help"]}

Json = Annotated[
    bool, typer.Option("--json", help="One JSON document on stdout, messages on stderr.")
]


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
            from music_rllib.redaction import for_people

            print(f"error: {for_people(error)}", file=sys.stderr)
            code = BAD_INPUT
        except KeyboardInterrupt:
            code = 128 + signal.SIGINT
        except BrokenPipeError:
            # The reader has gone (`| head`); without this Python complains again at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            code = 0
        raise typer.Exit(int(code or 0))


class Group(_KeepsExamples, TyperGroup):
    """A group of commands, which explains that `run` is missing before a sweep's file."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0].endswith((".yaml", ".yml")) and "run" in self.commands:
            ctx.fail(f"COMMAND must come first: {ctx.command_path} run {args[0]}")
        return super().parse_args(ctx, args)


def new_app(**options: Any) -> typer.Typer:
    """An application or a group of commands, without boxes or colours in its help."""
    defaults: dict[str, Any] = {
        "cls": Group,
        "add_completion": False,
        "context_settings": HELP_OPTIONS,
        "pretty_exceptions_enable": False,
        "rich_markup_mode": None,
    }
    return typer.Typer(**defaults | options)


def add_command(
    app: typer.Typer, name: str, function: Callable[..., int | None], examples: str
) -> None:
    """Make `function` the command `name`; its docstring and `examples` are its help."""
    app.command(name, cls=Command, epilog=examples, context_settings=HELP_OPTIONS)(function)


def run_app(app: typer.Typer, program: str, arguments: Sequence[str] | None = None) -> int:
    """Run the command of `arguments`, by default the process's, and return its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without α shows it as \u03b1
            stream.reconfigure(errors="backslashreplace")
    try:
        app(None if arguments is None else list(arguments), prog_name=program)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(bool(end.code))
    return 0


def _check_current_folder() -> None:
    """Refuse a current folder that is gone, which Ray and relative paths need.

    Raises:
        BadInputError: The folder was deleted, or may not be read.
    """
    try:
        Path.cwd()
    except OSError as error:
        raise BadInputError(
            f"the current folder must exist and be readable: {error.strerror}. "
            "Change to another folder"
        ) from error


def called_as() -> list[str]:
    """The words that start this program, without arguments, for commands shown in messages."""
    path, root = Path(sys.argv[0]), Path(__file__).parents[1]
    if path.name != "__main__.py" or not path.is_relative_to(root):
        return [PROGRAM]
    package = path.parent.relative_to(root)
    return ["python", "-m", ".".join(package.parts)]


def how_to_continue() -> str:
    """The message of a stopped sweep: what is kept, and the command that continues it."""
    command = shlex.join([*called_as(), *sys.argv[1:]])
    return f"Stopped. Finished runs and the last checkpoints are kept; continue with: {command}"


def say_stopped_at_once() -> None:
    """Print `how_to_continue` from a signal handler, just before the process ends."""
    os.write(sys.stderr.fileno(), f"\nAt once: {how_to_continue()}\n".encode())


def _print_unexpected(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Print the traceback of a defect without the passwords that its message may hold."""
    import traceback

    from music_rllib.redaction import for_people

    print(for_people("".join(traceback.format_exception(kind, error, trace))), file=sys.stderr)


def console_for(*, as_json: bool = False) -> Console:
    """The console for people: standard output, or standard error where JSON goes to the former."""
    from rich.console import Console
    from rich.segment import Segment

    from music_rllib.redaction import printable

    class PrintableConsole(Console):
        """A console that escapes control characters in everything it prints."""

        def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else printable(text), style, control)

    terminal = (sys.stderr if as_json else sys.stdout).isatty()
    return PrintableConsole(
        # No [red] in a name is a colour.
        markup=False,
        emoji=False,
        highlight=False,
        stderr=as_json,
        # Rich follows a terminal, but would take a COLUMNS of 0 at its word.
        width=None
        if terminal and "COLUMNS" not in os.environ
        else shutil.get_terminal_size((WIDTH, 24)).columns,
    )


def print_json(document: Any) -> None:
    """Print one JSON document; NaN and infinities, which JSON lacks, become null."""
    from music_rllib.redaction import printable

    only_ascii = "utf" not in (sys.stdout.encoding or "utf-8").lower()
    print(printable(json.dumps(_finite(document), indent=2, ensure_ascii=only_ascii, default=str)))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
