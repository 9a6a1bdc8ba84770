"""Colours, markers and lines of conditions: a q has the same colour and marker in every figure.

The values that the paper compares have colours of Okabe and Ito's palette, which colour-blind
readers tell apart, darkened or lightened until each stands out from white and from black paper.
The colour of any other q is mixed from its neighbours' and depends on q alone. Only in figures of
stages side by side does the colour stand for the stage.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np

from music_rllib.results.conditions import Condition

LIGHT, DARK = "#ffffff", "#14171c"
"""Background of the page in light and in dark mode."""

_ANCHORS = (
    (0.5, "#b07aa1"),
    (1.0, "#1f7fc4"),
    (1.5, "#d55e00"),
    (2.0, "#009e73"),
    (3.0, "#a0522d"),
)
_BY_STAGE = tuple(colour for _, colour in (*_ANCHORS[1:], _ANCHORS[0]))
_UNKNOWN = "#808080"
_MARKERS = "osD^vPX"
_ALIKE = 60.0
"""Distance in RGB below which thin lines look the same, as those of q = 1 and 1.1 do."""

Line = Literal["solid", "dashed", "dashdot", "dotted", "long", "dashdotdot"]
Stroke = Literal["solid", "dashed", "dashdot", "dotted"] | tuple[float, tuple[float, ...]]
_LINES: tuple[Line, ...] = get_args(Line)
DASHES: Mapping[Line, str] = {
    "solid": "",
    "dashed": "6 3",
    "dashdot": "6 2 1.5 2",
    "dotted": "1.5 2.5",
    "long": "13 3",
    "dashdotdot": "6 2 1.5 2 1.5 2",
}
"""Dash patterns in SVG, in pixels."""


class Style(NamedTuple):
    """How a condition is drawn."""

    colour: str
    marker: str
    line: Line

    @property
    def stroke(self) -> Stroke:
        """The line style in Matplotlib, which has names for four of them."""
        if self.line == "long" or self.line == "dashdotdot":
            return 0.0, tuple(float(dash) / 1.5 for dash in DASHES[self.line].split())
        return self.line


@functools.cache
def colour_of(entropic_index: str) -> str:
    """Colour of a q given as text; a schedule has the colour of its last value."""
    q = _number(entropic_index)
    if q is None:
        return _UNKNOWN
    at = [anchor for anchor, _ in _ANCHORS]
    channels = np.array([_channels(colour) for _, colour in _ANCHORS])
    mixed = [round(float(np.interp(q, at, channels[:, channel]))) for channel in range(3)]
    return "#{:02x}{:02x}{:02x}".format(*mixed)


def marker_of(entropic_index: str) -> str:
    """Marker of a q given as text, different for neighbours on a grid of quarters."""
    q = _number(entropic_index)
    return "*" if q is None else _MARKERS[(round(4 * q) - 4) % len(_MARKERS)]


@functools.cache
def styles_of(conditions: tuple[Condition, ...]) -> Mapping[Condition, Style]:
    """Styles of a stage's conditions: colour and marker by q, other lines for similar colours."""
    styles: dict[Condition, Style] = {}
    for condition in conditions:
        colour, marker = colour_of(condition.entropic_index), marker_of(condition.entropic_index)
        alike = [style for style in styles.values() if _alike(colour, style.colour)]
        line = _LINES[len(alike) % len(_LINES)]
        first = _MARKERS.find(marker)
        turned = (_MARKERS[(first + turn) % len(_MARKERS)] for turn in range(1, len(_MARKERS)))
        taken = {style.marker for style in alike}
        marker = next((free for free in (marker, *turned) if free not in taken), marker)
        styles[condition] = Style(colour=colour, marker=marker, line=line)
    return styles


def _alike(one: str, other: str) -> bool:
    """Whether two colours are hard to tell apart in thin lines."""
    differences = np.subtract(_channels(one), _channels(other))
    return bool(np.linalg.norm(differences) < _ALIKE)


def styles_by_stage(conditions: tuple[Condition, ...]) -> dict[Condition, Style]:
    """Styles of conditions of several stages: colour by stage, marker and line by q."""
    stages = list(dict.fromkeys(condition.others[0] for condition in conditions))
    indices = list(dict.fromkeys(condition.entropic_index for condition in conditions))
    return {
        condition: Style(
            colour=_BY_STAGE[stages.index(condition.others[0]) % len(_BY_STAGE)],
            marker=marker_of(condition.entropic_index),
            line=_LINES[indices.index(condition.entropic_index) % len(_LINES)],
        )
        for condition in conditions
    }


def _number(entropic_index: str) -> float | None:
    """The number of `1.5`, the last one of `1 to 2 by steps (..)`; None for other text."""
    try:
        return float(entropic_index.split(" (")[0].split(" by ")[0].rpartition(" ")[2])
    except ValueError:
        return None


def _channels(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
