"""Colors and markers of values of q."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from music_rllib.report.figures.plots import DARK, LIGHT, color_of, marker_of, styles_of
from music_rllib.results.conditions import Condition

COMPARED = ("0.5", "1", "1.5", "2", "3")
# Machado, Oliveira and Fernandes 2009, severity 1.0, on linear RGB.
VISION = {
    "ordinary": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.01182, 0.04294, 0.968881],
        ]
    ),
}


def linear(color: str) -> np.ndarray:
    channels = np.array([int(color[at : at + 2], 16) / 255 for at in (1, 3, 5)])
    return np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)


def lab(rgb: np.ndarray) -> np.ndarray:
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    x, y, z = np.cbrt(np.clip(np.array(to_xyz) @ rgb, 0, None) / [0.9505, 1.0, 1.089])
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def contrast(one: str, other: str) -> float:
    light, dark = sorted(float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (one, other))[::-1]
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("vision", VISION)
def test_color_blind_readers_can_distinguish_the_paper_s_values_of_q(vision: str) -> None:
    seen = {q: lab(np.clip(VISION[vision] @ linear(color_of(q)), 0, 1)) for q in COMPARED}
    for one, other in combinations(COMPARED, 2):
        assert np.linalg.norm(seen[one] - seen[other]) > 15, (one, other)


@pytest.mark.parametrize("q", [*COMPARED, "1.25", "1.75", "learned"])
@pytest.mark.parametrize("paper", [LIGHT, DARK])
def test_every_color_has_enough_contrast(q: str, paper: str) -> None:
    """WCAG 2.1 requires 3:1 for graphics."""
    assert contrast(color_of(q), paper) >= 3


def test_a_color_depends_on_q_alone() -> None:
    assert color_of("1.5") == color_of("1.50") == color_of("1 to 1.5")
    assert len({color_of(str(q)) for q in np.arange(0.5, 3.01, 0.25)}) == 11
    grid = ("1", "1.25", "1.5", "1.75", "2")
    assert len({marker_of(q) for q in grid}) == len(grid)
    for q in ("inf", "nan", "-1e308"):  # of a stranger's export
        assert (color_of(q), marker_of(q)) == (color_of("learned"), marker_of("learned"))


def test_conditions_with_the_same_q_differ_with_and_without_color() -> None:
    conditions = tuple(
        Condition(entropic_index="1", others=(("α", str(a)),), runs=()) for a in range(10)
    )
    styles = styles_of(conditions).values()
    assert len({style.color for style in styles}) == 10
    assert len({(style.marker, style.line) for style in styles}) == 10
    assert min(contrast(style.color, paper) for style in styles for paper in (LIGHT, DARK)) >= 3
