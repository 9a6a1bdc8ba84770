"""Colors, markers and dashes of conditions.

A q has the same color in every figure. The values of q that the paper compares have colors of Okabe
and Ito's palette for color-blind readers, adjusted until each has enough contrast on white and on
black paper. Other values of q mix the colors of their neighbors. Conditions that share a color have
different markers and dashes. Where all conditions have the same q, each has a color and a marker.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from itertools import cycle, product
from typing import Literal, NamedTuple

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
_UNKNOWN = "#808080"
_OF_EQUAL_Q = (
    *(color for _, color in _ANCHORS),
    "#b58900",
    "#e0529c",
    "#7a8a00",
    _UNKNOWN,
    "#a066e0",
)
"""Colors of conditions that differ in other settings than q, after the color of their q."""
_MARKERS = "osD^vPX"
_DASHES: tuple[tuple[float, ...], ...] = (
    (),
    (6, 3),
    (6, 2, 1.5, 2),
    (1.5, 2.5),
    (13, 3),
    (6, 2, 1.5, 2, 1.5, 2),
)
_ALIKE = 60.0
"""Distance in RGB below which two thin lines look the same, such as those of q = 1 and 1.1."""


class Style(NamedTuple):
    """How a condition is drawn."""

    color: str
    marker: str
    dashes: tuple[float, ...] = ()
    """Lengths in pixels of dashes and gaps; empty for a solid line."""

    @property
    def line(self) -> Literal["solid"] | tuple[float, tuple[float, ...]]:
        """The line style in Matplotlib, whose unit is the width of the line."""
        return (0.0, tuple(length / 1.8 for length in self.dashes)) if self.dashes else "solid"


@functools.cache
def color_of(entropic_index: str) -> str:
    """Color of a q given as text; a schedule has the color of its last value."""
    q = _number(entropic_index)
    if q is None:
        return _UNKNOWN
    at = [anchor for anchor, _ in _ANCHORS]
    channels = np.array([_channels(color) for _, color in _ANCHORS])
    mixed = [round(float(np.interp(q, at, channels[:, channel]))) for channel in range(3)]
    return "#{:02x}{:02x}{:02x}".format(*mixed)


def marker_of(entropic_index: str) -> str:
    """Marker of a q given as text, different for neighbors on a grid of quarters."""
    q = _number(entropic_index)
    return "*" if q is None else _MARKERS[(round(4 * q) - 4) % len(_MARKERS)]


@functools.cache
def styles_of(conditions: tuple[Condition, ...]) -> Mapping[Condition, Style]:
    """Styles of conditions: color and marker by q, other markers and dashes for similar colors."""
    if len({condition.entropic_index for condition in conditions}) == 1:
        return _styles_of_equal_q(conditions)
    styles: dict[Condition, Style] = {}
    for condition in conditions:
        color, marker = color_of(condition.entropic_index), marker_of(condition.entropic_index)
        alike = [style for style in styles.values() if _are_alike(color, style.color)]
        first, taken = _MARKERS.find(marker), {style.marker for style in alike}
        others = (_MARKERS[(first + turn) % len(_MARKERS)] for turn in range(1, len(_MARKERS)))
        marker = next((free for free in (marker, *others) if free not in taken), marker)
        styles[condition] = Style(color, marker, _DASHES[len(alike) % len(_DASHES)])
    return styles


def _styles_of_equal_q(conditions: Sequence[Condition]) -> Mapping[Condition, Style]:
    """The first condition has the color and marker of its q, each other one has its own."""
    index = conditions[0].entropic_index
    of_q, marker = color_of(index), marker_of(index)
    first = _MARKERS.find(marker)
    colors = [of_q, *(color for color in _OF_EQUAL_Q if not _are_alike(color, of_q))]
    markers = dict.fromkeys((marker, *_MARKERS[first:], *_MARKERS[:first]))
    rounds = product(_DASHES, markers)
    return {
        condition: Style(color, marker, dashes)
        for condition, color, (dashes, marker) in zip(conditions, cycle(colors), cycle(rounds))
    }


def _are_alike(one: str, other: str) -> bool:
    return bool(np.linalg.norm(np.subtract(_channels(one), _channels(other))) < _ALIKE)


def _number(entropic_index: str) -> float | None:
    """The number of `1.5`, the last one of `1 to 2 by steps (..)`; None for other text."""
    try:
        return float(entropic_index.split(" (")[0].split(" by ")[0].rpartition(" ")[2])
    except ValueError:
        return None


def _channels(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
