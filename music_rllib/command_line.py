"""What every command has in common: how it is called, how its help looks, how it ends.

A command is a function whose parameters are its arguments (Typer) and whose number is its exit
code. It is imported for every `--help`, so that its module loads nothing heavy before it is called.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from music_rllib.errors import BAD_INPUT, BadInputError

if TYPE_CHECKING:
    from rich.console import Console, RenderHook

PROGRAM = "music-rllib"
WIDTH = 160
"""Columns where there is no terminal to ask."""

Json = Annotated[
    bool, typer.Option("--json", help="One JSON document on stdout, messages on stderr.")
]


class Command(TyperCommand):
    """Its function's number is the exit code; what the user must change is one message."""

    def invoke(self, ctx: typer.Context) -> Any:  # type: ignore[override]
        """Run the function.

        Raises:
            typer.Exit: With its exit code.
        """
        sys.excepthook = _show_unexpected
        try:
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

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Keep the lines of examples as they are."""
        _write_lines(self.epilog, formatter)


class Group(TyperGroup):
    """Commands; a sweep's file in the place of one is told where it belongs."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse what stands before the command."""
        if args and args[0].endswith((".yaml", ".yml")) and "run" in self.commands:
            ctx.fail(f"COMMAND must come first: {ctx.command_path} run {args[0]}")
        return super().parse_args(ctx, args)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Keep the lines of examples as they are."""
        _write_lines(self.epilog, formatter)


def _write_lines(text: str | None, formatter: Any) -> None:
    if text:
        formatter.write(f"\n{text.strip()}\n")


def new_app(
    *, epilog: str | None = None, cls: type[TyperGroup] = Group, **options: Any
) -> typer.Typer:
    """An application or a group of commands, without boxes or colours in its help."""
    settings: dict[str, Any] = {
        "add_completion": False,
        "context_settings": {"help_option_names": ["-h", "--help"]},
        "pretty_exceptions_enable": False,
        "rich_markup_mode": None,
    }
    return typer.Typer(cls=cls, epilog=epilog, **settings | options)


def add_command(
    app: typer.Typer, name: str, function: Callable[..., int | None], examples: str
) -> None:
    """Make `function` the command `name`; its docstring and `examples` are its help."""
    settings = {"help_option_names": ["-h", "--help"]}
    app.command(name, cls=Command, epilog=examples, context_settings=settings)(function)


def run_app(app: typer.Typer, program: str, arguments: Sequence[str] | None = None) -> int:
    """Run these arguments, or the process's; the exit code."""
    try:
        app(None if arguments is None else list(arguments), prog_name=program)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(bool(end.code))
    return 0


def called_as() -> list[str]:
    """How this process was called, up to its arguments, for commands that messages tell."""
    path = Path(sys.argv[0])
    if path.name != "__main__.py":
        return [PROGRAM]
    package = path.parent.relative_to(Path(__file__).parents[1])
    return ["python", "-m", ".".join(package.parts)]


def how_to_continue() -> str:
    """What a sweep that was stopped has kept, and the command that goes on with it."""
    command = shlex.join([*called_as(), *sys.argv[1:]])
    return f"Stopped. Finished runs and the last checkpoints are kept; continue with: {command}"


def say_stopped_at_once() -> None:
    """The same, from a signal's handler: the program ends now, whatever it was doing."""
    os.write(sys.stderr.fileno(), f"\nAt once: {how_to_continue()}\n".encode())


def _show_unexpected(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """A defect's traceback, without the passwords that an environment put into its message."""
    import traceback

    from music_rllib.redaction import for_people

    print(for_people("".join(traceback.format_exception(kind, error, trace))), file=sys.stderr)


def console_for(*, as_json: bool = False) -> Console:
    """Where text for people goes: standard output, or standard error beside a JSON document."""
    from rich.console import Console

    terminal = (sys.stderr if as_json else sys.stdout).isatty()
    console = Console(
        # No [red] in a name is a colour.
        markup=False,
        emoji=False,
        highlight=False,
        stderr=as_json,
        width=None if terminal else int(os.environ.get("COLUMNS") or WIDTH),
    )
    console.push_render_hook(_printable_hook())
    return console


def _printable_hook() -> RenderHook:
    """Escapes control characters in whatever a console prints."""
    from rich.console import ConsoleOptions, ConsoleRenderable, RenderHook, RenderResult
    from rich.segment import Segment

    from music_rllib.redaction import printable

    class Printable:
        def __init__(self, inner: ConsoleRenderable) -> None:
            self._inner = inner

        def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
            for text, style, control in console.render(self._inner, options):
                yield Segment(text if control else printable(text), style, control)

    class Hook(RenderHook):
        def process_renderables(
            self, renderables: list[ConsoleRenderable]
        ) -> list[ConsoleRenderable]:
            return [Printable(renderable) for renderable in renderables]

    return Hook()


def print_json(document: Any) -> None:
    """One JSON document on standard output; NaN and infinities, which JSON lacks, are null."""
    from music_rllib.redaction import printable

    print(printable(json.dumps(_plain(document), indent=2, ensure_ascii=False, default=str)))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    return value
