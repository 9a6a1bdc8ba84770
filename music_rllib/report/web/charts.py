"""The curves of a report as data for its page's script."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from music_rllib import names
from music_rllib.report.figures.choice import Drawing, named_by_stage
from music_rllib.report.figures.palette import DASHES
from music_rllib.report.figures.plots import EPOCH
from music_rllib.results.analysis import Curve
from music_rllib.results.comparison import SHOW_SEEDS_BELOW
from music_rllib.results.conditions import SIDE_BY_SIDE, Condition
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array

__all__ = ["chart_data"]

_FIGURES = 4
"""Significant ones: more cannot be seen."""


def chart_data(sweep: Sweep, drawings: Sequence[Drawing]) -> dict[str, Any]:
    """What can be drawn: stages with their conditions, metrics, curves with every x axis.

    Curves are by the stage's number and the metric's name; NaN is None.
    """
    drawn = [drawing for drawing in drawings if drawing.metric is not None]
    stages = list(dict.fromkeys(drawing.stage for drawing in drawn))
    metrics = {drawing.metric.name: drawing.metric for drawing in drawn if drawing.metric}
    curves: dict[str, dict[str, list[Any]]] = {}
    found = [_stage(name, [d for d in drawn if d.stage == name]) for name in stages]
    x_axes: dict[tuple[Any, ...], Mapping[str, Any]] = {}
    for drawing in drawn:
        stage = found[stages.index(drawing.stage)]
        labels = [one["label"] for one in stage["conditions"]]
        rows = curves.setdefault(str(stages.index(drawing.stage)), {})
        assert drawing.metric is not None
        rows[drawing.metric.name] = [
            {
                "task": stage["tasks"].index(task),
                "condition": labels.index(_label(drawing, curve.condition)),
                **_x_axes(sweep, task, curve, x_axes),
                **_values(curve),
            }
            for task, of_task in drawing.curves.items()
            for curve in of_task
        ]
    return {
        "stages": found,
        "main": _main(stages),
        "metrics": [
            {
                "name": metric.name,
                "title": metric.title,
                "axis": metric.axis,
                "limits": metric.limits,
                "target": metric.target,
            }
            for metric in metrics.values()
        ],
        "curves": curves,
        "epoch": EPOCH,
    }


def _main(stages: Sequence[str]) -> int:
    """The stage whose figure stands on top: all together, or what came of the sweep at last."""
    return stages.index(SIDE_BY_SIDE) if SIDE_BY_SIDE in stages else max(0, len(stages) - 1)


def _stage(name: str, drawings: Sequence[Drawing]) -> dict[str, Any]:
    tasks = list(dict.fromkeys(task for drawing in drawings for task in drawing.curves))
    legend = drawings[0].legend
    together = name == SIDE_BY_SIDE
    return {
        "name": name,
        "together": together,
        "tasks": tasks,
        "primary": [_primary(task, drawings) for task in tasks],
        "conditions": [
            {
                "label": label,
                # Of all stages together a label begins with its stage: the same condition.
                "key": label if together else f"{name}, {label}",
                "colour": style.colour,
                "dash": DASHES[style.line],
            }
            for label, style in legend
        ],
    }


def _primary(task: str, drawings: Sequence[Drawing]) -> str:
    """Success, or the return, which is drawn of those tasks only that are judged by it."""
    drawn = [d.metric.name for d in drawings if d.metric is not None and task in d.curves]
    if names.EVAL_RETURN in drawn:
        return names.EVAL_RETURN
    return names.EVAL_SUCCESS if names.EVAL_SUCCESS in drawn else drawn[0]


def _label(drawing: Drawing, condition: Condition) -> str:
    if drawing.stage != SIDE_BY_SIDE:
        return condition.label
    return named_by_stage(condition)


def _values(curve: Curve) -> dict[str, Any]:
    few = 1 < len(curve.values) < SHOW_SEEDS_BELOW
    return {
        "mean": _plain(curve.estimate.value),
        "lower": _plain(curve.estimate.lower),
        "upper": _plain(curve.estimate.upper),
        "runs": curve.runs.tolist(),
        "seeds": [_plain(values) for values in curve.values] if few else [],
    }


def _x_axes(
    sweep: Sweep, task: str, curve: Curve, known: dict[tuple[Any, ...], Mapping[str, Any]]
) -> Mapping[str, Any]:
    """Steps, and the means over the runs of the updates and of the seconds until then."""
    runs = tuple(run for run in curve.condition.runs if sweep.runs[run].task == task)
    key = (runs, curve.steps.tobytes())
    if key not in known:
        known[key] = {
            "steps": curve.steps.astype(int).tolist(),
            "updates": _mean_at(
                curve.steps, (sweep.finite(run, names.GRAD_UPDATES) for run in runs)
            ),
            "seconds": _mean_at(curve.steps, (sweep.seconds_at(run) for run in runs)),
        }
    return known[key]


def _mean_at(steps: Array, series: Iterable[tuple[Array, Array]]) -> list[float | None] | None:
    """Mean over runs that have got that far; None where no run has any of it."""
    rows = [
        np.interp(steps, at, values, left=np.nan, right=np.nan) for at, values in series if len(at)
    ]
    if not rows:
        return None
    there = ~np.isnan(rows)
    count = there.sum(axis=0)
    total = np.where(there, rows, 0.0).sum(axis=0)
    return _plain(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _plain(values: Array) -> list[float | None]:
    return [
        float(f"{value:.{_FIGURES}g}") if there else None
        for value, there in zip(values.tolist(), np.isfinite(values).tolist(), strict=True)
    ]
