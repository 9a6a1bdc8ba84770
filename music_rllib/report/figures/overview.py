"""The overview of a sweep: the learning curves of all its tasks and stages in one figure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes

from music_rllib import names
from music_rllib.report.figures.palette import Style, styles_by_stage, styles_of
from music_rllib.report.figures.plots import METRICS, Panel, curve_panel, legend_handles
from music_rllib.results.analysis import Curve, curve
from music_rllib.results.conditions import Condition, StageRuns
from music_rllib.results.data import Sweep

MOST_LINES = 8
"""Largest number of lines in a panel; more are left to the figures of the stages."""
SEEN = 0.25
"""Lowest success rate that has a panel where displacement shows what is learnt before it."""
_METRICS = {metric.name: metric for metric in METRICS}


def overview(sweep: Sweep, stages: Sequence[StageRuns]) -> tuple[Panel, ...]:
    """For each task its primary metric, the displacement of objects, and the MI bound.

    The success rate is left out while it is below `SEEN` and objects have been moved.
    """
    tasks = dict.fromkeys(task for stage in stages for task in stage.tasks)
    return tuple(panel for task in tasks for panel in _task_panels(sweep, stages, task))


def _task_panels(sweep: Sweep, stages: Sequence[StageRuns], task: str) -> Iterator[Panel]:
    legend = _legend([stage for stage in stages if task in stage.tasks])
    primary = sweep.primary_metric(task)
    curves = {
        metric: [one for condition in legend if (one := curve(sweep, condition, task, metric))]
        for metric in (primary, names.EVAL_DISPLACEMENT, names.MI_BOUND)
    }
    aiming = {stage.name for stage in stages if stage.has_task_reward}
    of_stages = [one for one in curves[primary] if dict(one.condition.others)["stage"] in aiming]
    best = max((float(one.estimate.value.max()) for one in of_stages), default=0.0)
    hidden = primary in names.EVAL_RATES and best < SEEN and curves[names.EVAL_DISPLACEMENT]
    curves[primary] = [] if hidden else of_stages
    # A frozen estimator has no bound of its own: that of the stage that trained it is drawn.
    curves[names.MI_BOUND] = [c for c in curves[names.MI_BOUND] if c.estimate.value.max() > 0]
    for metric, found in curves.items():
        if 0 < len(found) <= MOST_LINES:
            yield _panel(metric, task, found, legend)


def _legend(stages: Sequence[StageRuns]) -> dict[Condition, tuple[str, Style]]:
    """Label and style of each condition: by q if one stage has the task, otherwise by stage."""
    several = len(stages) > 1
    legend: dict[Condition, tuple[str, Style]] = {}
    for stage in stages:
        for condition, style in styles_of(stage.compared).items():
            with_stage = replace(condition, others=(("stage", stage.name), *condition.others))
            parts = [stage.name] if several else []
            if len(stage.compared) > 1 or not several:
                parts.append(condition.label)
            legend[with_stage] = (", ".join(parts), style)
    if not several:
        return legend
    styles = styles_by_stage(tuple(legend))
    return {condition: (label, styles[condition]) for condition, (label, _) in legend.items()}


def _panel(
    metric: str, task: str, curves: Sequence[Curve], legend: Mapping[Condition, tuple[str, Style]]
) -> Panel:
    entries = [legend[one.condition] for one in curves]
    styles = {one.condition: style for one, (_, style) in zip(curves, entries, strict=True)}
    panel = curve_panel(_METRICS[metric], task, curves, styles)

    def draw(axes: Axes) -> None:
        panel.draw(axes)
        if metric not in names.EVAL_RATES:  # bands of two seeds may be many times as wide
            values = np.concatenate([one.values.ravel() for one in curves])
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
            room = 0.06 * (high - low or 1.0)
            axes.set_ylim(low - room, high + room)
        handles = legend_handles(entries)
        axes.legend(handles=handles, fontsize="small", framealpha=0.7, edgecolor="none")

    return replace(panel, draw=draw)
