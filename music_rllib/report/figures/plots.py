"""Panels of learning curves, final values, profiles and entropies (the paper's Figures 4 to 7).

A *panel* shows one task; its function `draw` draws it on given axes.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter

from music_rllib import names
from music_rllib.report.figures.palette import Style, styles_of
from music_rllib.results import statistics as st
from music_rllib.results.analysis import Curve, FinalScores, Scope
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Sweep
from music_rllib.results.scores import Measure, measure_on, scores_of
from music_rllib.results.statistics import SHOW_SEEDS_BELOW, Array, Estimate, interval_text, number

Legend = Sequence[tuple[str, Style]]
"""(label, style) pairs."""

EPOCH = 80_000
"""Environment steps of an epoch in the original MUSIC: 16 workers x 2 rollouts x 50 cycles x 50."""
PANEL = (4.3, 3.0)
"""Width and height in inches, at which 10 pt are readable on a page of 400 px."""
_TOP_WITH_EPOCHS = 0.62
SAME = 0.008
"""Share of the axis within which lines cover each other."""
_DASH = 2.5
"""Length of the dashes of lines that cover others, in line widths."""
MOST_BANDS = 8
"""Largest number of lines in a panel that have bands and lines of single seeds."""
_MOST_RANKS = 9
_CROWDED = 10
"""Largest number of lines whose dashes tell how many others they cover; of more, one kind does."""
_LABEL = 46
"""Largest number of letters in a line of a row's label."""
TARGET = 0.85
"""Success rate that Figure 4 of the paper waits for."""


@dataclass(frozen=True)
class Metric:
    """A metric that has learning curves."""

    name: str
    title: str
    axis: str
    """Label of the axis, with the unit."""
    limits: tuple[float, float] | None = None
    target: float | None = None


RATE_LIMITS = (-0.03, 1.03)
METRICS = (
    Metric(names.EVAL_SUCCESS, "Success rate", "success rate", RATE_LIMITS, TARGET),
    Metric(names.EVAL_RETURN, "Return", "return of an episode"),
    Metric(names.EVAL_SUCCESS_ANY, "Success at any step", "success at any step", RATE_LIMITS),
    Metric(names.EVAL_DISPLACEMENT, "Object displacement", "object displacement (m)"),
    Metric(names.MI_BOUND, "Mutual-information bound", "MI bound (nats)"),
    Metric(names.MI_REWARD, "Mutual-information reward", "MI reward per step"),
    Metric(names.ENTROPY, "Tsallis entropy of the policy", "Tsallis entropy"),
    Metric(names.SHANNON_ENTROPY, "Shannon entropy of the policy", "Shannon entropy (nats)"),
)


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One task's part of a figure."""

    title: str
    draw: Callable[[Axes], None]
    top: float = 0.32
    """Margin in inches for the title and for an axis above the panel."""
    height: float = PANEL[1]
    """Height in inches, margins included."""


def curve_panel(
    metric: Metric,
    title: str,
    curves: Sequence[Curve],
    styles: Mapping[Condition, Style],
    *,
    with_epochs: bool = True,
) -> Panel:
    """`metric` against environment steps, one line with its band per condition.

    A second axis counts epochs of the original MUSIC if it is wanted and the curves have at least
    one.
    """
    epochs = with_epochs and max(float(curve.steps[-1]) for curve in curves) >= EPOCH
    ranks = _ranks(curves, metric)
    numbers = {condition: number for number, condition in enumerate(styles)}
    with_bands = len(curves) <= MOST_BANDS

    def draw(axes: Axes) -> None:
        drawn = [
            _draw_curve(
                axes, curve, styles[curve.condition], rank, at / len(curves), seeds=with_bands
            )
            for at, (curve, rank) in enumerate(zip(curves, ranks, strict=True))
        ]
        axes.autoscale_view()
        # Limits are those of the lines: a band of two seeds may be many times as wide.
        axes.set_ylim(axes.get_ylim())
        for curve, artists in zip(curves, drawn, strict=True):
            if with_bands:
                colour = styles[curve.condition].colour
                artists.append(_band(axes, curve.steps, curve.estimate, colour))
            mark_condition(artists, numbers[curve.condition], curve.condition.label)
        axes.set_xlim(left=0.0)
        axes.set_ylabel(metric.axis)
        axes.set_xlabel("environment steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if metric.limits is not None:
            axes.set_ylim(*metric.limits)
        if metric.target is not None:
            ink = mpl.rcParams["axes.edgecolor"]
            axes.axhline(metric.target, color=ink, linewidth=0.8, linestyle=(0, (1, 3)))
        if epochs:
            _add_epochs(axes)

    return Panel(title=title, draw=draw, **({"top": _TOP_WITH_EPOCHS} if epochs else {}))


def profile_panel(scope: Scope, siblings: tuple[Condition, ...]) -> Panel:
    """Share of finished runs that end above each success rate."""
    styles = styles_of(siblings)
    thresholds = np.linspace(0.0, 1.0, 41)
    profiles = [(final, st.performance_profile(final.scores, thresholds)) for final in scope.finals]

    def draw(axes: Axes) -> None:
        for final, profile in profiles:
            colour, line = styles[final.condition].colour, styles[final.condition].stroke
            lines = axes.step(
                thresholds, profile.value, where="post", color=colour, linestyle=line, linewidth=1.8
            )
            band = _band(axes, thresholds, profile, colour, step="post")
            mark_condition([*lines, band], siblings.index(final.condition), final.condition.label)
        axes.set_xlabel("final success rate τ")
        axes.set_ylabel("share of runs above τ")
        axes.set_xlim(-0.02, 1.02)
        axes.set_ylim(-0.03, 1.03)

    return Panel(title=scope.name, draw=draw)


def finals_panel(
    title: str,
    scope: Scope,
    shown: Sequence[FinalScores],
    styles: Mapping[Condition, Style],
    labels: Mapping[Condition, str],
) -> Panel:
    """The final values of `shown`, some of `scope`, with their intervals and a mark for every run.

    Panels of the same scope have the same axis.
    """
    is_rate = scope.metric in names.EVAL_RATES
    numbers = {condition: number for number, condition in enumerate(styles)}
    rows, height = labelled_rows([labels[final.condition] for final in shown])

    def draw(axes: Axes) -> None:
        scores = np.concatenate([final.scores.ravel() for final in scope.finals])
        # Intervals of two or three returns may be many times as wide as the runs' range.
        room = 0.5 * (np.ptp(scores) or 1.0)
        limits = RATE_LIMITS if is_rate else (scores.min() - room, scores.max() + room)
        axes.set_ylim(len(shown) - 0.5, -0.75)
        axes.set_xlim(*limits)
        axes.locator_params(axis="x", nbins=6)
        rules_behind_rows(axes, len(shown))
        for row, (final, label) in enumerate(zip(shown, rows, strict=True)):
            artists = _draw_final(axes, row, final, styles[final.condition], label)
            result = f"{number(final.value)}, {interval_text(final.estimate)}"
            text = f"{final.condition.label}: {result}"
            mark_condition(artists, numbers[final.condition], text)
        axes.set_xlabel("final success rate" if is_rate else f"final {names.word_of(scope.metric)}")

    return Panel(title=title, draw=draw, height=height)


def entropy_panel(sweep: Sweep, task: str, styles: Mapping[Condition, Style]) -> Panel | None:
    """A point for each finished run on the task: its area under the curve over its entropy.

    Returns:
        None if fewer than two runs have an entropy.
    """
    runs = [run for condition in styles for run in condition.runs]
    measure = measure_on(sweep, task, runs, "auc")
    points = {condition: list(_by_entropy(sweep, condition, task, measure)) for condition in styles}
    if sum(map(len, points.values())) < 2:
        return None

    def draw(axes: Axes) -> None:
        for place, (condition, pairs) in enumerate(points.items()):
            style = styles[condition]
            entropies, scores = zip(*pairs, strict=True) if pairs else ((), ())
            marks = axes.plot(
                entropies, scores, style.marker,
                color=style.colour, markersize=6, alpha=0.75, mew=0,
            )  # fmt: skip
            mark_condition(marks, place, condition.label)
        axes.set_xlabel("Shannon entropy at the end (nats)")
        axes.set_ylabel(measure.words)

    return Panel(title=task, draw=draw)


def _by_entropy(
    sweep: Sweep, condition: Condition, task: str, measure: Measure
) -> Iterator[tuple[float, float]]:
    scores = scores_of(sweep, condition, task, measure).by_seed
    for run in condition.runs:
        record = sweep.runs[run]
        entropy = sweep.final(run, names.SHANNON_ENTROPY)
        if record.task == task and record.seed in scores and entropy is not None:
            yield entropy, scores[record.seed]


def labelled_rows(labels: Sequence[str]) -> tuple[list[str], float]:
    """Labels broken into lines that fit, and the height of a panel with a row per label."""
    broken = [textwrap.fill(label, _LABEL, break_long_words=True) for label in labels]
    lines = max((label.count("\n") + 1 for label in broken), default=1)
    return broken, max(PANEL[1], 1.0 + len(labels) * (0.34 + 0.18 * lines))


def rules_behind_rows(axes: Axes, rows: int, above: float = 0.14, below: float = 0.34) -> None:
    """Draw grid lines behind each row's marks, and none behind its label."""
    axes.set_yticks([])
    axes.grid(visible=False)
    low, high = axes.get_xlim()
    at = [tick for tick in axes.get_xticks() if low <= tick <= high]
    colour = mpl.rcParams["grid.color"]
    for row in range(rows):
        axes.vlines(at, row - above, row + below, color=colour, linewidth=0.8, zorder=0.5)
    axes.set_xlim(low, high)


def _ranks(curves: Sequence[Curve], metric: Metric) -> list[Array]:
    """For each point of each curve, the number of earlier curves that run through it."""
    if metric.limits is not None:
        height = metric.limits[1] - metric.limits[0]
    else:
        values = np.concatenate([curve.estimate.value for curve in curves])
        height = float(np.nanmax(values) - np.nanmin(values)) or 1.0
    ranks = []
    for place, curve in enumerate(curves):
        rank = np.zeros(len(curve.steps))
        for other in curves[:place]:
            covered = np.interp(
                curve.steps, other.steps, other.estimate.value, left=np.nan, right=np.nan
            )
            rank += np.abs(covered - curve.estimate.value) <= SAME * height
        ranks.append(np.minimum(rank, _MOST_RANKS if len(curves) <= _CROWDED else 1))
    return ranks


def _draw_curve(
    axes: Axes, curve: Curve, style: Style, rank: Array, stagger: float, *, seeds: bool
) -> list[Artist]:
    """Draw a line: thick where every run counts, thin from where the first one ended.

    With `seeds`, few of them have lines of their own. Where lines coincide the later ones are
    dashed, so that each earlier one shows in the gaps.
    """
    colour, marker, line = style.colour, style.marker, style.stroke
    value = curve.estimate.value
    artists: list[Artist] = []
    if seeds and 1 < len(curve.values) < SHOW_SEEDS_BELOW:
        artists += axes.plot(curve.steps, curve.values.T, color=colour, linewidth=0.6, alpha=0.55)
    whole = curve.runs == curve.runs.max()
    stretches = _stretches(np.column_stack([curve.steps, value]), rank, whole)
    for (covers, thick), parts in stretches.items():
        dash = (0.0, (_DASH, _DASH * covers)) if covers else line
        width = 1.8 if thick else 0.8
        lines = LineCollection(parts, colors=colour, linestyles=[dash], linewidths=width, zorder=2)
        artists.append(axes.add_collection(lines))
    every = max(1, len(curve.steps) // 8)
    marks = np.where(whole, value, np.nan)
    artists += axes.plot(
        curve.steps,
        marks,
        color=colour,
        linestyle="none",
        marker=marker,
        markevery=(int(stagger * every), every),
        markersize=5,
    )
    return artists


def _stretches(points: Array, rank: Array, whole: Array) -> dict[tuple[int, bool], list[Array]]:
    """Parts of a curve by the number of curves they cover and by whether every run counts there."""
    covers = np.minimum(rank[:-1], rank[1:])
    changes = np.flatnonzero((np.diff(covers) != 0) | (whole[1:-1] != whole[2:])) + 1
    ends = [0, *changes, len(covers)]
    stretches: dict[tuple[int, bool], list[Array]] = {}
    for first, last in itertools.pairwise(ends):
        if first < last:
            key = (int(covers[first]), bool(whole[first + 1]))
            stretches.setdefault(key, []).append(points[first : last + 1])
    return stretches


def _band(
    axes: Axes,
    at: Array,
    estimate: Estimate,
    colour: str,
    step: Literal["post"] | None = None,
) -> Artist:
    return axes.fill_between(
        at, estimate.lower, estimate.upper, color=colour, alpha=0.2, linewidth=0, step=step
    )


def _draw_final(axes: Axes, row: int, final: FinalScores, style: Style, label: str) -> list[Artist]:
    colour, marker, _ = style
    scores = final.scores.ravel()
    places = np.full(len(scores), row + 0.22)
    artists: list[Artist] = [*axes.plot(scores, places, "|", color=colour, alpha=0.6, markersize=7)]
    estimate = final.estimate
    if estimate.has_interval:
        ends = [float(estimate.lower), float(estimate.upper)]
        artists += axes.plot(ends, [row, row], color=colour, linewidth=5, alpha=0.35)
    artists += axes.plot(estimate.value, row, marker, color=colour, markersize=7)
    return [*artists, row_label(axes, row - 0.2, label)]


def row_label(axes: Axes, height: float, label: str) -> Artist:
    """Write a label above a row's marks, at a distance from the axis."""
    return axes.annotate(
        label,
        (0.0, height),
        xycoords=axes.get_yaxis_transform(),
        xytext=(3.0, 0.0),
        textcoords="offset points",
        va="bottom",
        fontsize="small",
    )


def mark_condition(artists: Sequence[Artist], condition: int, title: str) -> None:
    """Mark artists as a condition's, by its number: the page shows and hides them by it."""
    for artist in artists:
        artist.set_gid(f"condition-{condition}-{title}")


def legend_handles(legend: Legend) -> list[Line2D]:
    """A line with its marker for each entry of a legend."""
    return [
        Line2D([], [], color=style.colour, marker=style.marker, linestyle=style.stroke, label=label)
        for label, style in legend
    ]


def _add_epochs(axes: Axes) -> None:
    scales = (lambda steps: np.divide(steps, EPOCH), lambda epochs: np.multiply(epochs, EPOCH))
    above = axes.secondary_xaxis("top", functions=scales)
    above.set_xlabel("epochs of 80 000 steps", fontsize="small", labelpad=2)
    above.tick_params(labelsize="small", pad=1)
