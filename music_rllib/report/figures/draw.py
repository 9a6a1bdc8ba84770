"""Every figure drawn: for the page, and as files. Most of a report's time goes here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from music_rllib.report.figures.choice import Drawing
from music_rllib.report.figures.plots import files, svg_inline
from music_rllib.report.parallel import forked_map

__all__ = ["Pictures", "draw_all"]

FEW = 4
"""Drawings for which more processes would cost more than they save."""


class Pictures(NamedTuple):
    """One drawing, drawn."""

    inline: tuple[str, ...]
    """An SVG element for each panel."""
    files: dict[str, bytes]
    """Content by the file's ending."""


def draw_all(drawings: Sequence[Drawing]) -> dict[str, Pictures]:
    """Draw everything; by the drawings' names."""
    drawn = forked_map(_draw, drawings, few=FEW)
    return {drawing.name: pictures for drawing, pictures in zip(drawings, drawn, strict=True)}


def _draw(drawing: Drawing) -> Pictures:
    inline = tuple(
        svg_inline(panel, f"{drawing.name}-{number}") for number, panel in enumerate(drawing.panels)
    )
    return Pictures(inline, files(drawing.panels, drawing.legend))
