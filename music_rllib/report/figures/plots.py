"""Subplots of figures: curves, final values, differences, profiles, entropies and α.

A q has the same color in every figure. The values of q that the paper compares have colors of Okabe
and Ito's palette for color-blind readers, adjusted until each has enough contrast on white and on
black paper. Other values of q mix the colors of their neighbors. Conditions that share a color have
different markers and dashes. Where all conditions have the same q, each has a color and a marker.
"""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, product
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, LogFormatter

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.analysis import RATE_LIMITS, AlphaLine, Curve, FinalScores, Metric, Scope
from music_rllib.results.claims import Claim
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Sweep
from music_rllib.results.scores import measure_on, scores_of
from music_rllib.results.statistics import SHOW_SEEDS_BELOW, Array, Estimate
from music_rllib.results.study import Mean

LIGHT, DARK = "#ffffff", "#14171c"
"""Background of the page in light and in dark mode."""
_ANCHORS = (
    (0.5, "#b07aa1"), (1.0, "#1f7fc4"), (1.5, "#d55e00"), (2.0, "#009e73"), (3.0, "#a0522d")
)  # fmt: skip
_UNKNOWN = "#808080"
_OF_EQUAL_Q = (
    *(color for _, color in _ANCHORS), "#b58900", "#e0529c", "#7a8a00", _UNKNOWN, "#a066e0"
)  # fmt: skip
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
_LARGEST_Q = 1e6
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
    """The number of `1.5`, the last one of `1 to 2 by steps (..)`; None for other text.

    Also None for NaN and numbers that no run can have, as an export of a stranger can contain.
    """
    try:
        q = float(entropic_index.split(" (")[0].split(" by ")[0].rpartition(" ")[2])
    except ValueError:
        return None
    return q if abs(q) < _LARGEST_Q else None


def _channels(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


# Subplots ----------------------------------------------------------------------------------------

Legend = Sequence[tuple[str, Style]]
"""(label, style) pairs."""
Styles = Mapping[Condition, Style]
Point = tuple[float | None, float | None]

HEIGHT = 3.0
"""Height of a subplot in inches."""
MOST_BANDS = 8
"""Largest number of lines in a subplot that have bands and lines of single seeds."""
_LABEL = 26
"""Largest number of letters in a line of a label inside a subplot."""
MOST_TICKS = 8
"""Largest number of values of α that each have a tick."""


@dataclass(frozen=True, kw_only=True)
class Subplot:
    """One task's part of a figure."""

    title: str
    draw: Callable[[Axes], None]
    height: float = HEIGHT
    """Height in inches."""
    plot_width: float = 1.0
    """Share of its width that labels of rows leave."""


def curve_subplot(
    metric: Metric, title: str, curves: Sequence[Curve], styles: Styles, legend: Legend = ()
) -> Subplot:
    """`metric` against environment steps: a line with its band for each condition."""
    with_bands = len(curves) <= MOST_BANDS

    def draw(axes: Axes) -> None:
        for place, curve in enumerate(curves):
            style = styles[curve.condition]
            if with_bands and 1 < len(curve.values) < SHOW_SEEDS_BELOW:
                axes.plot(curve.steps, curve.values.T, color=style.color, lw=0.6, alpha=0.55)
            _draw_curve(axes, curve, style, place / len(curves))
        axes.autoscale_view()
        # The lines set the limits: a band of two seeds may be many times as wide.
        axes.set_ylim(metric.limits or axes.get_ylim())
        for curve in curves if with_bands else ():
            _band(axes, curve.steps, curve.estimate, styles[curve.condition].color)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("environment steps")
        axes.set_ylabel(metric.axis)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if metric.target is not None:
            axes.axhline(metric.target, color=mpl.rcParams["axes.edgecolor"], lw=0.8, ls="dotted")
        if legend:
            handles = legend_handles([(textwrap.fill(one, _LABEL), style) for one, style in legend])
            look: dict[str, Any] = {"fontsize": "small", "framealpha": 0.7, "edgecolor": "none"}
            axes.legend(handles=handles, **look).set_in_layout(False)

    return Subplot(title=title, draw=draw)


def lines_of(label: str) -> int:
    """Number of lines of a label inside a subplot."""
    return len(textwrap.wrap(label, _LABEL))


def _draw_curve(axes: Axes, curve: Curve, style: Style, stagger: float) -> None:
    """Draw the mean: thick where every run counts, thin after the first of them has ended."""
    mean = curve.estimate.value
    of_all_runs = np.where(curve.runs == curve.runs.max(), mean, np.nan)
    every = max(1, len(curve.steps) // 8)
    look: dict[str, Any] = {"color": style.color, "linestyle": style.line}
    axes.plot(curve.steps, mean, lw=0.8, **look)
    axes.plot(
        curve.steps,
        of_all_runs,
        **look,
        lw=1.8,
        marker=style.marker,
        # Markers of lines that coincide are at different points, or smaller on top of larger ones.
        markevery=(int(stagger * every), every),
        markersize=7.5 - 3 * stagger,
    )


def _band(
    axes: Axes, at: Array, estimate: Estimate, color: str, step: Literal["post"] | None = None
) -> None:
    ends = (estimate.lower, estimate.upper)
    axes.fill_between(at, *ends, color=color, alpha=0.2, linewidth=0, step=step)


def finals_subplot(
    title: str,
    scope: Scope,
    shown: Sequence[FinalScores],
    styles: Styles,
    labels: Mapping[Condition, str],
) -> Subplot:
    """Final values of `shown`, some of `scope`, with their intervals and a tick for each run.

    Subplots of the same scope have the same axis.
    """
    is_rate = scope.metric in names.EVAL_RATES

    def draw(axes: Axes) -> None:
        scores = np.concatenate([final.scores.ravel() for final in scope.finals])
        # Intervals of two or three returns may be many times as wide as the runs' range.
        room = 0.5 * (np.ptp(scores) or 1.0)
        axes.set_xlim(*(RATE_LIMITS if is_rate else (scores.min() - room, scores.max() + room)))
        for row, final in enumerate(shown):
            color, marker, _ = styles[final.condition]
            runs = final.scores.ravel()
            axes.plot(runs, np.full(len(runs), row + 0.25), "|", color=color, alpha=0.6, ms=7)
            if final.estimate.has_interval:
                ends = [float(final.estimate.lower), float(final.estimate.upper)]
                axes.plot(ends, [row, row], color=color, lw=5, alpha=0.35)
            axes.plot(final.estimate.value, row, marker, color=color, ms=7)
        axes.set_xlabel("final success rate" if is_rate else f"final {names.word_of(scope.metric)}")

    return _with_rows(title, [labels[final.condition] for final in shown], draw)


def differences_subplot(title: str, rows: Sequence[tuple[str, Claim]], axis: str) -> Subplot:
    """Differences of labelled claims with their 95% and 90% CIs, over the equivalence margin."""

    def draw(axes: Axes) -> None:
        ink = mpl.rcParams["axes.edgecolor"]
        axes.axvline(0.0, color=ink, lw=0.8)
        for row, (_, claim) in enumerate(rows):
            q, gap = claim.pairs[0][0].entropic_index, claim.contrast.difference
            if claim.margin is not None:
                axes.barh(row, 2 * claim.margin, 1, -claim.margin, color=_UNKNOWN, alpha=0.15, lw=0)
            for one, width in ((gap, 1.5), (claim.contrast.within, 5)):
                ends = [float(one.lower), float(one.upper)]
                axes.plot(ends, [row, row], color=color_of(q), lw=width, alpha=0.6)
            axes.plot(float(gap.value), row, marker_of(q), color=ink)
        axes.set_xlabel(textwrap.fill(axis, _LABEL))  # labels of rows take half of the width

    return _with_rows(title, [label for label, _ in rows], draw)


def _with_rows(title: str, labels: Sequence[str], draw: Callable[[Axes], None]) -> Subplot:
    """A subplot with a labelled row for each of the things that `draw` draws at 0, 1, ..."""
    rows = [textwrap.fill(label, _LABEL) for label in labels]
    lines = sum(row.count("\n") + 1.5 for row in rows)

    def whole(axes: Axes) -> None:
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_yticks(range(len(rows)), rows)
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
        draw(axes)

    height = max(HEIGHT, 1.0 + 0.2 * lines)
    return Subplot(title=title, draw=whole, height=height, plot_width=0.5)


def profile_subplot(task: str, means: Sequence[Mean], styles: Styles) -> Subplot:
    """Share of runs above each value of a task's primary metric, which is a rate."""
    thresholds = np.linspace(0.0, 1.0, 101)

    def draw(axes: Axes) -> None:
        for mean in means:
            style = styles[mean.condition]
            scores = np.array(list(mean.scores.by_seed.values()))[:, np.newaxis]
            profile = st.performance_profile(scores, thresholds)
            axes.step(
                thresholds, profile.value, where="post", color=style.color, linestyle=style.line
            )
            _band(axes, thresholds, profile, style.color, step="post")
        axes.set_xlabel(f"{means[0].measure.words} τ")
        axes.set_ylabel("share of runs above τ")
        axes.set_ylim(*RATE_LIMITS)

    return Subplot(title=task, draw=draw)


def entropy_subplot(sweep: Sweep, task: str, styles: Styles) -> Subplot | None:
    """A point for each finished run on the task: its area under the curve over its entropy.

    Returns:
        None if fewer than two runs have an entropy.
    """
    runs = [run for condition in styles for run in condition.runs]
    measure = measure_on(sweep, task, runs, "auc")
    scores = {one: scores_of(sweep, one, task, measure).by_seed for one in styles}

    def point(condition: Condition, run: int) -> Point:
        score = scores[condition].get(sweep.runs[run].seed)
        return sweep.final(run, names.SHANNON_ENTROPY), score

    labels = "final Shannon entropy (nats)", measure.words
    return _over_entropy(sweep, task, styles, point, labels)


def exploration_subplot(sweep: Sweep, task: str, styles: Styles) -> Subplot | None:
    """The displacement of the object in early training episodes over the entropy in these steps.

    A point for each finished run, and a larger one for the mean of each condition.

    Returns:
        None if fewer than two runs have both.
    """

    def point(_: Condition, run: int) -> Point:
        entropy = sweep.early(run, names.SHANNON_ENTROPY)
        return entropy, sweep.early(run, names.TRAIN_DISPLACEMENT)

    labels = "Shannon entropy (nats)", "object displacement (m)"
    return _over_entropy(sweep, task, styles, point, labels, with_means=True)


def _over_entropy(
    sweep: Sweep,
    task: str,
    styles: Styles,
    point: Callable[[Condition, int], Point],
    labels: tuple[str, str],
    *,
    with_means: bool = False,
) -> Subplot | None:
    """The points of finished runs without None; no subplot for fewer than two."""
    points = {}
    for condition in styles:
        runs = [run for run in condition.runs if sweep.runs[run].task == task]
        found = [point(condition, run) for run in runs if sweep.runs[run].is_finished]
        points[condition] = np.array([p for p in found if None not in p], float).reshape(-1, 2)
    if sum(map(len, points.values())) < 2:
        return None

    def draw(axes: Axes) -> None:
        for condition, own in points.items():
            color, marker, _ = styles[condition]
            if with_means and len(own):
                axes.plot(*own.T, marker, color=color, ms=3, alpha=0.35, mew=0)
                own = own.mean(axis=0, keepdims=True)
            axes.plot(*own.T, marker, color=color, ms=6, alpha=0.75, mew=0)
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])

    return Subplot(title=task, draw=draw)


def alpha_subplot(task: str, lines: Sequence[tuple[AlphaLine, Style]]) -> Subplot:
    """The primary metric of a task against α, each line with its 95% band."""

    def draw(axes: Axes) -> None:
        for line, style in lines:
            own = [alpha for alpha, _ in line]
            value, lower, upper = (
                [float(getattr(mean.estimate, end)) for _, mean in line]
                for end in ("value", "lower", "upper")
            )
            axes.plot(own, value, color=style.color, linestyle=style.line, marker=style.marker)
            axes.fill_between(own, lower, upper, color=style.color, alpha=0.2, linewidth=0)
        alphas = np.unique([alpha for line, _ in lines for alpha, _ in line])
        positive = alphas[alphas > 0]
        if alphas[0] >= 0 and len(positive) and positive[-1] / positive[0] > 5:
            of_zero = {} if alphas[0] > 0 else {"linthresh": positive[0]}
            axes.set_xscale("symlog" if of_zero else "log", **of_zero)
        if len(alphas) <= MOST_TICKS:
            axes.set_xticks(alphas, [f"{alpha:g}" for alpha in alphas], minor=False)
            axes.set_xticks([], minor=True)
        elif axes.get_xscale() != "linear":
            # The scale's own labels are formulas, but text.parse_math is off.
            axes.xaxis.set_major_formatter(LogFormatter())
            axes.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1, 0.4)))
        axes.set_xlabel("α (entropy coefficient)")
        axes.set_ylabel(lines[0][0][0][1].measure.words)

    return Subplot(title=task, draw=draw)


def legend_handles(legend: Legend) -> list[Line2D]:
    """A line with its marker for each entry of a legend."""
    return [
        Line2D([], [], color=style.color, marker=style.marker, linestyle=style.line, label=label)
        for label, style in legend
    ]
