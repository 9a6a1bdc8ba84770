"""The report's figures: the paper's Figures 4 to 7 and what explains them.

Every figure is drawn on its own canvas, never through pyplot, so no display is needed. A *panel* is
one task's; on the page each panel is an SVG of its own, so that a narrow window stacks them, and
takes its ink from the page, so that it follows light and dark. The files have all panels together.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter

from music_rllib import names
from music_rllib.report.figures.palette import Style, style_of
from music_rllib.results import statistics as st
from music_rllib.results.analysis import Curve
from music_rllib.results.comparison import SHOW_SEEDS_BELOW, Final, Scope
from music_rllib.results.conditions import Condition
from music_rllib.results.statistics import Array, Estimate

__all__ = [
    "METRICS",
    "Legend",
    "Metric",
    "Panel",
    "curve_panel",
    "files",
    "finals_panel",
    "profile_panel",
    "svg_inline",
]

Legend = Sequence[tuple[str, Style]]
"""(label, style) pairs."""

EPOCH = 80_000
"""Environment steps of an epoch in the original MUSIC: 16 workers x 2 rollouts x 50 cycles x 50."""
PANEL = (4.3, 3.0)
"""Width and height in inches, at which 10 pt are readable on a page of 400 px."""
_LEFT, _RIGHT, _BOTTOM, _TOP_WITH_EPOCHS = 0.84, 0.2, 0.52, 0.62
"""A panel's margins in inches."""
_HANDLE, _LETTER = 0.6, 0.08
"""Widths in inches in a legend."""
TARGET = 0.85
"""Success rate that Figure 4 of the paper waits for."""

# Stand for "the page's own colour" in an SVG, and are replaced by it.
_INK, _GRID = "#010203", "#040506"
_PAPER_INK, _PAPER_GRID = "#1a1a1a", "#d9d9d9"
_FONT = ("DejaVu Sans", "Verdana", "sans-serif")


@dataclass(frozen=True, kw_only=True)
class Metric:
    """What one kind of figure shows."""

    name: str
    title: str
    axis: str
    """With its unit."""
    limits: tuple[float, float] | None = None
    target: float | None = None


RATE_LIMITS = (-0.03, 1.03)
METRICS = (
    Metric(
        name=names.EVAL_SUCCESS,
        title="Success rate",
        axis="success rate",
        limits=RATE_LIMITS,
        target=TARGET,
    ),
    Metric(name=names.EVAL_RETURN, title="Return", axis="return of an episode"),
    Metric(
        name=names.EVAL_SUCCESS_ANY,
        title="Success at any step",
        axis="success at any step",
        limits=RATE_LIMITS,
    ),
    Metric(
        name=names.EVAL_DISPLACEMENT,
        title="Object displacement",
        axis="object displacement (m)",
    ),
    Metric(name=names.MI_BOUND, title="Mutual-information bound", axis="MI bound (nats)"),
    Metric(name=names.MI_REWARD, title="Mutual-information reward", axis="MI reward per step"),
    Metric(name=names.ENTROPY, title="Tsallis entropy of the policy", axis="Tsallis entropy"),
    Metric(
        name=names.SHANNON_ENTROPY,
        title="Shannon entropy of the policy",
        axis="Shannon entropy (nats)",
    ),
)


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One task's part of a figure."""

    title: str
    draw: Callable[[Axes], None]
    top: float = 0.32
    """Margin in inches for the title, and for an axis above the panel."""


def curve_panel(
    metric: Metric, task: str, curves: Sequence[Curve], styles: Mapping[Condition, Style]
) -> Panel:
    """`metric` against environment steps, one line with its band per condition.

    The original's epochs stand above where the budget is at least one of them.
    """
    epochs = max(float(curve.steps[-1]) for curve in curves) >= EPOCH

    def draw(axes: Axes) -> None:
        for curve in curves:
            _draw_curve(axes, curve, styles[curve.condition])
        axes.set_ylabel(metric.axis)
        axes.set_xlabel("environment steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if metric.limits is not None:
            axes.set_ylim(*metric.limits)
        if metric.target is not None:
            axes.axhline(metric.target, color=_ink(), linewidth=0.8, linestyle=(0, (1, 3)))
        if epochs:
            _add_epochs(axes)

    return Panel(title=task, draw=draw, **({"top": _TOP_WITH_EPOCHS} if epochs else {}))


def profile_panel(scope: Scope[Condition], siblings: tuple[Condition, ...]) -> Panel:
    """Share of finished runs above each success rate."""
    thresholds = np.linspace(0.0, 1.0, 41)
    profiles = [(final, st.performance_profile(final.scores, thresholds)) for final in scope.finals]

    def draw(axes: Axes) -> None:
        for final, profile in profiles:
            colour, _, line = style_of(final.condition, siblings)
            axes.step(
                thresholds, profile.value, where="post", color=colour, linestyle=line, linewidth=1.8
            )
            _band(axes, thresholds, profile, colour, step="post")
        axes.set_xlabel("final success rate τ")
        axes.set_ylabel("share of runs above τ")
        axes.set_xlim(-0.02, 1.02)
        axes.set_ylim(-0.03, 1.03)

    return Panel(title=scope.name, draw=draw)


def finals_panel(scope: Scope[Condition], siblings: tuple[Condition, ...]) -> Panel:
    """How conditions ended, with their intervals, and every run as a point."""
    is_rate = scope.metric in names.EVAL_RATES

    def draw(axes: Axes) -> None:
        scores = np.concatenate([final.scores.ravel() for final in scope.finals])
        # Intervals of two or three returns may be many times as wide as what was seen.
        room = 0.5 * (np.ptp(scores) or 1.0)
        limits = RATE_LIMITS if is_rate else (scores.min() - room, scores.max() + room)
        for row, final in enumerate(scope.finals):
            _draw_final(axes, row, final, siblings, limits[0])
        axes.set_yticks([])
        axes.set_ylim(len(scope.finals) - 0.5, -0.7)
        axes.set_xlim(*limits)
        axes.locator_params(axis="x", nbins=6)
        axes.set_xlabel("final success rate" if is_rate else f"final {names.word_of(scope.metric)}")

    return Panel(title=scope.name, draw=draw)


def svg_inline(panel: Panel, name: str) -> str:
    """A panel as an SVG element for the page; ids begin with `name`, to be the page's only ones.

    Matplotlib escapes the texts in it.
    """
    with mpl.rc_context(_settings(_INK, _GRID)):
        drawn = _drawn([panel], [], opaque=False)
        buffer = io.StringIO()
        drawn.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = re.sub(r'\b(id="|xlink:href="#|url\(#)', rf"\g<1>{name}-", text[text.index("<svg") :])
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = text.replace(_INK, "currentColor").replace(_GRID, "var(--grid)")
    size = re.search(r'width="([\d.]+)pt" height="([\d.]+)pt"', text)
    assert size is not None, "matplotlib gives an SVG a size in points"
    text = text.replace(size[0], "")
    return re.sub(r">\s+<", "><", text)


def files(panels: Sequence[Panel], legend: Legend) -> dict[str, bytes]:
    """All panels side by side on white paper, with a legend, as ``svg`` and ``png`` (150 dpi).

    Drawn once for both.
    """
    made = {}
    with mpl.rc_context(_settings(_PAPER_INK, _PAPER_GRID)):
        drawn = _drawn(panels, legend, opaque=True)
        for kind, metadata in (("svg", {"Date": None}), ("png", {})):
            buffer = io.BytesIO()
            drawn.savefig(buffer, format=kind, dpi=150, metadata=metadata)
            made[kind] = buffer.getvalue()
    return made


def _settings(ink: str, grid: str) -> Any:
    colours = ("axes.edgecolor", "axes.labelcolor", "axes.titlecolor", "text.color")
    return {
        **dict.fromkeys((*colours, "xtick.color", "ytick.color"), ink),
        "grid.color": grid,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "font.family": "sans-serif",
        "font.sans-serif": list(_FONT),
        "font.size": 10,
        "xtick.labelsize": 9,
        "ytick.labelsize": 9,
        "svg.fonttype": "none",
        # A task may be called $x_{1$.
        "text.parse_math": False,
        # The same figure is the same file.
        "svg.hashsalt": "music_rllib",
    }


def _drawn(panels: Sequence[Panel], legend: Legend, *, opaque: bool) -> Figure:
    """Margins are fixed: matplotlib's own layout takes longer than everything else together."""
    longest = max((len(label) for label, _ in legend), default=0)
    columns = max(1, int(PANEL[0] * len(panels) / (_HANDLE + _LETTER * longest)))
    below = 0.28 * math.ceil(len(legend) / columns)
    width, height = PANEL[0] * len(panels), PANEL[1] + below
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    figure.patch.set_alpha(1.0 if opaque else 0.0)
    for number, panel in enumerate(panels):
        left = number * PANEL[0]
        axes = figure.add_axes(
            (
                (left + _LEFT) / width,
                (below + _BOTTOM) / height,
                (PANEL[0] - _LEFT - _RIGHT) / width,
                (PANEL[1] - _BOTTOM - panel.top) / height,
            )
        )
        axes.patch.set_alpha(0.0)
        middle = left + _LEFT + (PANEL[0] - _LEFT - _RIGHT) / 2
        figure.text(middle / width, 1 - 0.07 / height, panel.title, ha="center", va="top", size=11)
        panel.draw(axes)
    if legend:
        handles = [
            Line2D(
                [], [], color=style.colour, marker=style.marker, linestyle=style.line, label=label
            )
            for label, style in legend
        ]
        figure.legend(handles=handles, loc="lower center", ncols=columns, frameon=False)
    return figure


def _draw_curve(axes: Axes, curve: Curve, style: Style) -> None:
    """Thick where every run counts, thin from where the first one ended; few seeds each apart."""
    colour, marker, line = style
    value = curve.estimate.value
    every = max(1, len(curve.steps) // 8)
    axes.plot(curve.steps, value, color=colour, linestyle=line, linewidth=0.8)
    whole = np.where(curve.runs == curve.runs.max(), value, np.nan)
    axes.plot(
        curve.steps,
        whole,
        color=colour,
        linestyle=line,
        linewidth=1.8,
        marker=marker,
        markevery=every,
        markersize=5,
    )
    if 1 < len(curve.values) < SHOW_SEEDS_BELOW:
        axes.plot(curve.steps, curve.values.T, color=colour, linewidth=0.6, alpha=0.55)
    limits = axes.get_ylim()  # of what was seen: a band of two seeds may be many times as wide
    _band(axes, curve.steps, curve.estimate, colour)
    axes.set_ylim(*limits)
    axes.set_autoscaley_on(True)


def _band(
    axes: Axes,
    at: Array,
    estimate: Estimate,
    colour: str,
    step: Literal["post"] | None = None,
) -> None:
    axes.fill_between(
        at, estimate.lower, estimate.upper, color=colour, alpha=0.2, linewidth=0, step=step
    )


def _draw_final(
    axes: Axes, row: int, final: Final[Condition], siblings: tuple[Condition, ...], left: float
) -> None:
    colour, marker, _ = style_of(final.condition, siblings)
    scores = final.scores.ravel()
    axes.plot(scores, np.full(len(scores), row + 0.22), "|", color=colour, alpha=0.6, markersize=7)
    estimate = final.estimate
    if estimate.has_interval:
        axes.plot(
            [estimate.lower, estimate.upper], [row, row], color=colour, linewidth=5, alpha=0.35
        )
    axes.plot(estimate.value, row, marker, color=colour, markersize=7)
    axes.text(left, row - 0.2, f" {final.condition.label}", va="bottom", fontsize=9)


def _add_epochs(axes: Axes) -> None:
    def epochs(steps: Any) -> Any:
        return steps / EPOCH

    def steps(epochs: Any) -> Any:
        return epochs * EPOCH

    above = axes.secondary_xaxis("top", functions=(epochs, steps))
    above.set_xlabel("epochs of 80 000 steps", fontsize=8, labelpad=2)
    above.tick_params(labelsize=8, pad=1)


def _ink() -> str:
    return str(mpl.rcParams["axes.edgecolor"])
