"""The learning-curve picture of one run: success or return above, mutual information below."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from music_rllib import names
from music_rllib.store.run_record import Report

# Okabe and Ito's colours, told apart by colour-blind readers; line styles tell them apart in grey.
BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"


@dataclass(frozen=True, kw_only=True)
class Line:
    """One metric of a panel."""

    metric: str
    label: str
    colour: str
    style: str
    marker: str


@dataclass(frozen=True, kw_only=True)
class Panel:
    """Metrics that share a y axis; ``limits`` where the axis has natural ones."""

    ylabel: str
    lines: Sequence[Line]
    limits: tuple[float, float] | None = None


def _line(metric: str, label: str, colour: str, style: str, marker: str) -> Line:
    return Line(metric=metric, label=label, colour=colour, style=style, marker=marker)


PANELS = (
    Panel(
        ylabel="success rate",
        limits=(-0.03, 1.03),
        lines=(
            _line(names.EVAL_SUCCESS, "at the last step", BLUE, "-", "o"),
            _line(names.EVAL_SUCCESS_ANY, "at any step", VERMILION, "--", "s"),
        ),
    ),
    Panel(
        ylabel="return of an episode",
        lines=(_line(names.EVAL_RETURN, "return", BLUE, "-", "o"),),
    ),
    Panel(
        ylabel="MI bound (nats)",
        lines=(_line(names.MI_BOUND, "MI bound", GREEN, "-", "o"),),
    ),
    Panel(
        ylabel="MI reward per step",
        lines=(_line(names.MI_REWARD, "MI reward", PURPLE, "-", "o"),),
    ),
)


def learning_curve(history: Sequence[Report], *, title: str) -> Figure:
    """Success rate (or return), MI bound and MI reward against environment steps.

    The return of a task that has a success says the same in other units, and has no panel. Panels
    without a value are left out; a history with none of the metrics says so. Draws on its own
    figure, never through pyplot, so that it is safe in a thread and needs no display.
    """
    panels = [panel for panel in PANELS if any(_points(history, line) for line in panel.lines)]
    if PANELS[0] in panels:
        panels = [panel for panel in panels if panel.lines[0].metric != names.EVAL_RETURN]
    figure = Figure(figsize=(6.4, 1.2 + 2.1 * max(1, len(panels))), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11)
    rows = figure.subplots(max(1, len(panels)), 1, sharex=True, squeeze=False)[:, 0]
    for axes, panel in zip(rows, panels, strict=False):
        _draw(axes, panel, history)
    if not panels:
        rows[0].text(0.5, 0.5, "nothing was evaluated", ha="center", transform=rows[0].transAxes)
        rows[0].set_ylabel("evaluation")
    rows[-1].set_xlabel("environment steps")
    rows[-1].xaxis.set_major_formatter(EngFormatter(sep=""))
    return figure


def learning_curve_png(history: Sequence[Report], *, title: str) -> bytes:
    """:func:`learning_curve` as a PNG."""
    buffer = io.BytesIO()
    learning_curve(history, title=title).savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


def _draw(axes: Axes, panel: Panel, history: Sequence[Report]) -> None:
    for line in panel.lines:
        points = _points(history, line)
        if points:
            axes.plot(
                [step for step, _ in points],
                [value for _, value in points],
                color=line.colour,
                linestyle=line.style,
                marker=line.marker if len(points) <= 60 else "",
                markersize=4,
                label=line.label,
            )
    axes.set_ylabel(panel.ylabel)
    axes.grid(alpha=0.3)
    if panel.limits is not None:
        axes.set_ylim(*panel.limits)
    if len(panel.lines) > 1:
        axes.legend(loc="best", fontsize=9)


def _points(history: Sequence[Report], line: Line) -> list[tuple[int, float]]:
    return [
        (report.env_steps, report.metrics[line.metric])
        for report in history
        if line.metric in report.metrics
    ]
