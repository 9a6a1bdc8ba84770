"""Every figure drawn: for the page, and as files. Most of a report's time goes here."""

from __future__ import annotations

import multiprocessing
import os
import threading
import warnings
from collections.abc import Sequence
from typing import NamedTuple

from music_rllib.reports.figures import files, svg_inline
from music_rllib.reports.gallery import Drawing

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
    """Draw everything, on as many CPUs as there are; by the drawings' names."""
    global _DRAWINGS
    processes = min(len(os.sched_getaffinity(0)), len(drawings))
    # Drawings hold functions, which can't be sent to another process: it must be a fork of this
    # one, which is safe only without threads.
    if len(drawings) <= FEW or processes == 1 or threading.active_count() > 1:
        return {drawing.name: _draw(drawing) for drawing in drawings}
    _DRAWINGS = drawings
    with warnings.catch_warnings():
        # Python 3.12 counts the idle threads of numerical libraries.
        warnings.simplefilter("ignore", DeprecationWarning)
        with multiprocessing.get_context("fork").Pool(processes) as pool:
            drawn = pool.map(_draw_one, range(len(drawings)), chunksize=1)
    return {drawing.name: pictures for drawing, pictures in zip(drawings, drawn, strict=True)}


_DRAWINGS: Sequence[Drawing] = ()


def _draw_one(position: int) -> Pictures:
    return _draw(_DRAWINGS[position])


def _draw(drawing: Drawing) -> Pictures:
    inline = tuple(
        svg_inline(panel, f"{drawing.name}-{number}", f"{drawing.title}, {panel.title}")
        for number, panel in enumerate(drawing.panels)
    )
    return Pictures(inline, files(drawing.panels, drawing.legend))
