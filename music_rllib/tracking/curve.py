"""The figure of one run's learning curve."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from music_rllib import names
from music_rllib.store.history import Report

# Okabe and Ito's colours, told apart by colour-blind readers; line styles tell them apart in grey.
BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"


class Line(NamedTuple):
    """How a panel draws one metric."""

    metric: str
    label: str
    colour: str
    style: str = "-"
    marker: str = "o"


class Panel(NamedTuple):
    """Metrics that share a y axis; `limits` if the axis has natural ones."""

    ylabel: str
    lines: Sequence[Line]
    limits: tuple[float, float] | None = None


SUCCESS = Panel(
    "success rate",
    (
        Line(names.EVAL_SUCCESS, "at the last step", BLUE),
        Line(names.EVAL_SUCCESS_ANY, "at any step", VERMILION, "--", "s"),
    ),
    limits=(-0.03, 1.03),
)
RETURN = Panel("return of an episode", [Line(names.EVAL_RETURN, "return", BLUE)])
MI_BOUND = Panel("MI bound (nats)", [Line(names.MI_BOUND, "MI bound", GREEN)])
MI_REWARD = Panel("MI reward per step", [Line(names.MI_REWARD, "MI reward", PURPLE)])


def learning_curve(history: Sequence[Report], *, title: str) -> Figure:
    """Success rate (or return), MI bound and MI reward against environment steps.

    The return has a panel only if the task has no success rate, which says the same in other
    units. Panels without data are left out; a history without any says so. Works in any thread
    and without a display, as pyplot is not involved.
    """
    panels = [
        panel
        for panel in (SUCCESS, RETURN, MI_BOUND, MI_REWARD)
        if any(_points(history, line) for line in panel.lines)
    ]
    if SUCCESS in panels and RETURN in panels:
        panels.remove(RETURN)
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
    """`learning_curve` as a PNG file."""
    buffer = io.BytesIO()
    learning_curve(history, title=title).savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


def _draw(axes: Axes, panel: Panel, history: Sequence[Report]) -> None:
    for line in panel.lines:
        points = _points(history, line)
        if points:
            axes.plot(
                *zip(*points, strict=True),
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
