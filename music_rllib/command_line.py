"""Output that all commands share: tables for people, JSON, and how to continue a sweep."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shlex
import shutil
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO, cast

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.segment import Segment
    from rich.table import Table

PROGRAM = "music-rllib"
WIDTH = 160
"""Columns of output that does not go to a terminal."""

Json = Annotated[
    bool, typer.Option("--json", help="One JSON document on stdout, messages on stderr.")
]


def time_option(text: str | float) -> float:
    """Parser of an option that is a time: a float accepts NaN, infinity and negative numbers.

    Raises:
        typer.BadParameter: The value is not a number from 0 to 1,000,000.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1e6:
        raise typer.BadParameter(f"must be a number from 0 to 1,000,000, got {text}")
    return value


def folder_option(text: str | Path) -> Path:
    """Parser of an option that is a folder: a Path of '' would be the current folder.

    Raises:
        typer.BadParameter: The text is empty, as that of a variable without a value.
    """
    if text == "":
        raise typer.BadParameter("must name a folder, got ''")
    return Path(text)


def called_as() -> list[str]:
    """The words that start this program, without arguments, for commands shown in messages."""
    spec = sys.modules["__main__"].__spec__
    if spec is None or spec.parent not in {"music_rllib", "music_rllib.sweep"}:
        return [PROGRAM]
    return ["python", "-m", spec.parent]


def how_to_continue(*, has_begun: bool = True) -> str:
    """The message of a stopped sweep: what is kept, and the command that continues it.

    Before a sweep `has_begun`, what it is to retrain may not be recorded yet.
    """
    from music_rllib.redaction import redact

    arguments = _without_retrain(sys.argv[1:]) if has_begun else sys.argv[1:]
    command = redact(shlex.join([*called_as(), *arguments]))
    return f"Stopped. Finished runs and the last checkpoints are kept; continue with: {command}"


def _without_retrain(arguments: Sequence[str]) -> list[str]:
    """Arguments that may be repeated: the sweep has recorded what remains to be retrained."""
    pairs = zip(["", *arguments], arguments, strict=False)
    return [
        word
        for before, word in pairs
        if "--retrain" not in (before, word) and not word.startswith("--retrain=")
    ]


def say_stopped_at_once() -> None:
    """Print `how_to_continue` from a signal handler, just before the process ends."""
    with contextlib.suppress(OSError):
        os.write(sys.stderr.fileno(), f"\nAt once: {how_to_continue()}\n".encode())


class _Unfailing:
    """An output stream that loses text when its reader has ended or its disk is full."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except BrokenPipeError:  # otherwise Python fails with exit code 120 at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
        except OSError:
            pass


def console_for(*, as_json: bool = False, unfailing: bool = False) -> Console:
    """The console for people: standard output, or standard error if JSON goes to the former.

    An `unfailing` one is for work that must not end because its output can't be written.
    """
    from rich.console import Console
    from rich.segment import Segment

    from music_rllib.redaction import printable

    class PrintableConsole(Console):
        """A console that escapes control characters in everything it prints."""

        def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else printable(text), style, control)

        def on_broken_pipe(self) -> None:
            """Let the command end with 0, as with `print`; rich would exit with 1."""
            raise BrokenPipeError

    stream = sys.stderr if as_json else sys.stdout
    terminal = stream.isatty()
    return PrintableConsole(
        file=cast("TextIO", _Unfailing(stream)) if unfailing else None,
        markup=False,  # [red] in a name is not a color
        emoji=False,
        highlight=False,
        stderr=as_json,
        width=None if terminal else shutil.get_terminal_size((WIDTH, 24)).columns,
    )


def new_table(title: str, heads: Iterable[str], left: Collection[str] = ()) -> Table:
    """A table whose cells are folded and never cut; columns of text, `left`, are left-aligned."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for head in heads:
        table.add_column(head, justify="left" if head in left else "right", overflow="fold")
    return table


def percent(value: float | None) -> str:
    """`35 %`, or `-` for None."""
    return "-" if value is None else f"{100 * value:.0f} %"


def clock(seconds: float | None) -> str:
    """`1:02:03`, `2:03`, or `-` for None."""
    if seconds is None:
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def print_json(document: Any) -> None:
    """Print one JSON document; NaN and infinities become null."""
    from music_rllib.redaction import printable

    only_ascii = "utf" not in (sys.stdout.encoding or "utf-8").lower()
    print(printable(json.dumps(plain(document), indent=2, ensure_ascii=only_ascii, default=str)))


def plain(value: Any) -> Any:
    """`value` as JSON can hold it: null in place of NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
