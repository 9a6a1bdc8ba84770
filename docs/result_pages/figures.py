"""Figures as files of their own."""

from __future__ import annotations

from collections.abc import Iterator

from music_rllib.report.figures.choice import Drawing, slug
from music_rllib.results.data import Sweep


def figure(sweep: Sweep, drawing: Drawing, figures: dict[str, Drawing]) -> Iterator[str]:
    """Add a drawing to `figures` and show it."""
    name = f"{slug(sweep.name)}-{drawing.name}.svg"
    figures[name] = drawing
    yield f"![{drawing.title} of {sweep.name}, {drawing.stage}](results/figures/{name})"
