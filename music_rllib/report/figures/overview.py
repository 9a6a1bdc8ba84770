"""The picture of a sweep: what its tasks have come to, all stages together, in one figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from music_rllib import names
from music_rllib.report.figures.palette import Style, styles_by_stage, styles_of
from music_rllib.report.figures.plots import METRICS, Panel, curve_panel
from music_rllib.results.analysis import Curve, curve
from music_rllib.results.conditions import Condition, Stage
from music_rllib.results.data import Sweep

__all__ = ["overview"]

MOST_LINES = 8
"""In a panel; more are left to the figures of the stages."""
SEEN = 0.25
"""A rate from which on it is worth a panel, where another one shows what is learnt before it."""
_METRICS = {metric.name: metric for metric in METRICS}


def overview(sweep: Sweep, stages: Sequence[Stage]) -> tuple[Panel, ...]:
    """For each task its success or return, how far objects were moved, and the MI bound.

    Success is left out where hardly any has come yet and objects have been moved.
    """
    tasks = dict.fromkeys(task for stage in stages for task in stage.tasks)
    return tuple(panel for task in tasks for panel in _of_task(sweep, stages, task))


def _of_task(sweep: Sweep, stages: Sequence[Stage], task: str) -> Iterator[Panel]:
    lines = _lines([stage for stage in stages if task in stage.tasks])
    primary = sweep.primary_metric(task)
    moved = _curves(sweep, task, names.EVAL_DISPLACEMENT, lines)
    for metric in (primary, names.EVAL_DISPLACEMENT, names.MI_BOUND):
        of_task = metric != names.MI_BOUND
        found = _curves(sweep, task, metric, lines)
        if metric == primary:
            for_it = {stage.name for stage in stages if stage.has_task_reward}
            found = [one for one in found if dict(one.condition.others)["stage"] in for_it]
            best = max((float(one.estimate.value.max()) for one in found), default=0.0)
            if primary in names.EVAL_RATES and best < SEEN and moved:
                continue
        if not of_task:  # a frozen estimator's is the one of the stage that trained it
            found = [one for one in found if one.estimate.value.max() > 0]
        if 0 < len(found) <= MOST_LINES:
            yield _panel(metric, task, found, lines)


def _lines(stages: Sequence[Stage]) -> dict[Condition, tuple[str, Style]]:
    """Label and style of each condition: by q where one stage has the task, by stage otherwise."""
    several = len(stages) > 1
    found: dict[Condition, tuple[str, Style]] = {}
    for stage in stages:
        for one, style in styles_of(stage.compared).items():
            named = replace(one, others=(("stage", stage.name), *one.others))
            parts = [stage.name] * several
            parts += [one.label] * (len(stage.compared) > 1 or not several)
            found[named] = (", ".join(parts), style)
    if not several:
        return found
    styles = styles_by_stage(tuple(found))
    return {condition: (label, styles[condition]) for condition, (label, _) in found.items()}


def _curves(
    sweep: Sweep, task: str, metric: str, lines: dict[Condition, tuple[str, Style]]
) -> list[Curve]:
    read = (curve(sweep, condition, task, metric) for condition in lines)
    return [one for one in read if one is not None]


def _panel(
    metric: str, task: str, found: Sequence[Curve], lines: dict[Condition, tuple[str, Style]]
) -> Panel:
    styles = {one.condition: lines[one.condition][1] for one in found}
    panel = curve_panel(_METRICS[metric], task, found, styles)

    def draw(axes: Axes) -> None:
        panel.draw(axes)
        if metric not in names.EVAL_RATES:  # bands of two seeds may be many times as wide
            values = np.concatenate([one.values.ravel() for one in found])
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
            room = 0.06 * (high - low or 1.0)
            axes.set_ylim(low - room, high + room)
        handles = [
            Line2D(
                [], [], color=style.colour, marker=style.marker, linestyle=style.stroke, label=label
            )
            for label, style in (lines[one.condition] for one in found)
        ]
        axes.legend(handles=handles, fontsize="small", framealpha=0.7, edgecolor="none")

    return replace(panel, draw=draw)
