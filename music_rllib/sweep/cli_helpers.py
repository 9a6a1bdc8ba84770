"""What sub-commands have in common: their parsers, what they write where."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console, RenderHook

__all__ = [
    "Commands",
    "Formatter",
    "add_json",
    "add_place",
    "console_for",
    "print_json",
]

WIDTH = 160
"""Columns where there is no terminal to ask."""

Commands = Any  # argparse._SubParsersAction, which is private


class Formatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the lines of examples as they are."""


def add_json(parser: argparse.ArgumentParser) -> None:
    """`--json`: one document on standard output, everything else on standard error."""
    parser.add_argument(
        "--json", action="store_true", help="One JSON document on stdout, messages on stderr."
    )


def add_place(parser: argparse.ArgumentParser, what: str = "A sweep") -> None:
    """`SWEEP` and the options that say where it lies."""
    parser.add_argument(
        "sweep",
        metavar="SWEEP",
        help=f"{what}: its folder (results/smoke, s3://bucket/results/smoke), its name in "
        "--storage, or its YAML file.",
    )
    parser.add_argument(
        "--storage", metavar="PLACE", help="Folder or URI of results, where SWEEP is a name."
    )


def console_for(arguments: argparse.Namespace) -> Console:
    """Where text for people goes: standard output, or standard error beside a JSON document."""
    from rich.console import Console

    stderr = bool(getattr(arguments, "json", False))
    terminal = (sys.stderr if stderr else sys.stdout).isatty()
    console = Console(
        # No [red] in a name is a colour.
        markup=False,
        emoji=False,
        highlight=False,
        stderr=stderr,
        width=None if terminal else WIDTH,
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
