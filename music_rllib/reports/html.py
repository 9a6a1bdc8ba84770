"""The few pieces of HTML that the page is made of. Every text is escaped here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from music_rllib.reports.palette import Style

__all__ = ["Cell", "bullets", "document", "facts", "legend", "link", "paragraph", "table", "text"]

# Nothing may be fetched, whatever finds its way into a page.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:"
_DASHES = {"solid": "", "dashed": "6 3", "dashdot": "6 2 1.5 2", "dotted": "1.5 2.5"}

_MARKS = {"o": "●", "s": "■", "D": "◆", "^": "▲", "v": "▼", "P": "✚", "X": "✖", "*": "★"}


@dataclass(frozen=True)
class Cell:
    """A table's cell that is more than short text."""

    html: str
    kind: str = ""
    """`number` or `long`."""


def text(value: object) -> str:
    """`value` as HTML."""
    return escape(str(value))


def paragraph(value: str, kind: str = "") -> str:
    """One paragraph of text."""
    return f"<p{_class(kind)}>{text(value)}</p>"


def bullets(lines: Iterable[str]) -> str:
    """A list of texts."""
    return "<ul>" + "".join(f"<li>{text(line)}</li>" for line in lines) + "</ul>"


def link(label: str, url: str | None) -> str:
    """A link, or the label alone where there is nowhere to go."""
    return text(label) if url is None else f'<a href="{escape(url)}">{text(label)}</a>'


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """Short facts, side by side where there is room."""
    items = (f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="facts">{"".join(items)}</dl>'


def table(header: Sequence[str], rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """A table that scrolls by itself where it is too wide; numbers stand right."""
    body = [[cell if isinstance(cell, Cell) else _cell(cell) for cell in row] for row in rows]
    kinds = [cell.kind for cell in body[0]] if body else [""] * len(header)
    heads = "".join(
        f'<th scope="col"{_class(kind)}>{text(name)}</th>'
        for name, kind in zip(header, kinds, strict=True)
    )
    lines = "".join(
        "<tr>" + "".join(f"<td{_class(cell.kind)}>{cell.html}</td>" for cell in row) + "</tr>"
        for row in body
    )
    # Not a <caption>, which would be as wide as the table and scroll with it.
    title = paragraph(caption, "soft") if caption else ""
    return (
        f'{title}<div class="wide"><table><thead><tr>{heads}</tr></thead>'
        f"<tbody>{lines}</tbody></table></div>"
    )


def legend(entries: Iterable[tuple[str, Style]]) -> str:
    """Which line is which."""
    items = []
    for label, style in entries:
        dash = _DASHES[style.line]
        pattern = f' stroke-dasharray="{dash}"' if dash else ""
        items.append(
            '<li><svg width="30" height="10" aria-hidden="true"><line x1="1" y1="5" x2="29" y2="5" '
            f'stroke="{style.colour}" stroke-width="3"{pattern}/></svg>'
            f'<span style="color:{style.colour}" aria-hidden="true">{_MARKS[style.marker]}</span>'
            f"{text(label)}</li>"
        )
    return f'<ul class="legend">{"".join(items)}</ul>'


def document(title: str, body: str) -> str:
    """The whole page, with its style inside."""
    style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title><style>{style}</style></head>\n<body>{body}</body></html>\n"
    )


def _cell(value: object) -> Cell:
    return Cell(text(value), "number" if isinstance(value, int | float) else "")


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
