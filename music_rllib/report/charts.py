"""The learning curves of a report as data: for the page's script, and as a CSV file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from music_rllib import names
from music_rllib.report.figures.choice import PRIMARY, Drawing, Facets, without
from music_rllib.results.analysis import Curve
from music_rllib.results.conditions import SIDE_BY_SIDE
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import SHOW_SEEDS_BELOW, Array
from music_rllib.results.tables import to_csv

EPOCH = 80_000
"""Environment steps of an epoch in the original MUSIC: 16 workers x 2 rollouts x 50 cycles x 50."""
_DIGITS = 4
"""Number of significant digits in the page."""
_POINT = ("env_steps", "runs", "mean", "lower", "upper")

KnownAxes = dict[tuple[tuple[int, ...], bytes], Mapping[str, Any]]
"""x axes by the runs and steps of a curve: all its metrics share them."""


def chart_data(sweep: Sweep, drawings: Sequence[Drawing]) -> dict[str, Any]:
    """Stages with their conditions, metrics, and curves with every x axis, for JSON.

    Curves are by the number of their stage and the name of their metric; NaN is None.
    """
    metrics = {}
    by_stage: dict[str, list[Drawing]] = {}
    for drawing in drawings:
        if drawing.metric is not None:
            metrics[drawing.metric.name] = drawing.metric
            by_stage.setdefault(drawing.stage, []).append(drawing)
    together = by_stage.get(SIDE_BY_SIDE)
    setting = _facets(together[0]).setting if together else ""
    stages = [_stage(name, drawn, setting) for name, drawn in by_stage.items()]
    # A condition has the same style in all figures, because the page has one legend.
    styles = {
        one["key"]: {"color": one["color"], "dashes": one["dashes"]}
        for stage in stages
        for one in stage["conditions"]
        if stage["together"]
    }
    for one in (one for stage in stages for one in stage["conditions"]):
        one |= styles.get(one["key"], {})
    large = [
        number
        for number, drawn in enumerate(by_stage.values())
        if any(drawing.title in PRIMARY for drawing in drawn)
    ]
    known: KnownAxes = {}
    return {
        "stages": stages,
        # The stage of the large figure: all together, or the last one that trains for the task.
        "main": next((n for n in large if stages[n]["together"]), large[-1] if large else 0),
        "metrics": [asdict(metric) for metric in metrics.values()],
        "curves": {
            str(number): {
                drawing.metric.name: _curves(sweep, drawing, drawn, known)
                for drawing in drawn
                if drawing.metric is not None
            }
            for number, drawn in enumerate(by_stage.values())
        },
        "epoch": EPOCH,
    }


def curves_csv(drawings: Iterable[Drawing]) -> str:
    """The points of the learning curves of each stage."""
    rows: list[dict[str, object]] = []
    for drawing in drawings:
        if drawing.metric is None or drawing.stage == SIDE_BY_SIDE:
            continue
        for curve in (one for curves in drawing.curves.values() for one in curves):
            about = {
                "stage": drawing.stage,
                "task": curve.task,
                "condition": curve.condition.label,
                "metric": drawing.metric.name,
            }
            mean = curve.estimate
            columns = (curve.steps.astype(int), curve.runs, mean.value, mean.lower, mean.upper)
            points = zip(*(column.tolist() for column in columns), strict=True)
            rows += [about | dict(zip(_POINT, point, strict=True)) for point in points]
    return to_csv(rows)


def _facets(drawing: Drawing) -> Facets:
    assert drawing.facets is not None, "learning curves have them"
    return drawing.facets


def _subplots(drawings: Sequence[Drawing]) -> list[str]:
    return list(dict.fromkeys(title for drawing in drawings for title in drawing.curves))


def _stage(name: str, drawings: Sequence[Drawing], setting: str) -> dict[str, Any]:
    """A stage; `setting` has subplots of its own where all stages are together."""
    titles, facets = _subplots(drawings), _facets(drawings[0])
    together = name == SIDE_BY_SIDE
    # Labels of all stages together begin with the stage: a condition has one key.
    keys = [facets.label(one) for one in facets.styles]
    if not together:
        alike = [f"{name}, {facets.label(without(one, setting))}" for one in facets.styles]
        unique = len(set(alike)) == len(alike)
        keys = alike if unique else [f"{name}, {key}" for key in keys]
    return {
        "name": name,
        "together": together,
        "subplots": titles,
        "faceted": bool(facets.setting),
        "primary": [_primary(title, drawings) for title in titles],
        "conditions": [
            {
                "label": facets.label(condition),
                "key": key,
                "color": style.color,
                "dashes": " ".join(map(str, style.dashes)),
            }
            for key, (condition, style) in zip(keys, facets.styles.items(), strict=True)
        ],
    }


def _primary(title: str, drawings: Sequence[Drawing]) -> str:
    """The return, which is drawn only for tasks whose primary metric it is, or success."""
    drawn = [d.metric.name for d in drawings if d.metric is not None and title in d.curves]
    primary = (names.EVAL_RETURN, names.EVAL_SUCCESS)
    return next((metric for metric in primary if metric in drawn), drawn[0])


def _curves(
    sweep: Sweep, drawing: Drawing, drawings: Sequence[Drawing], known: KnownAxes
) -> list[Mapping[str, Any]]:
    titles, conditions = _subplots(drawings), list(_facets(drawing).styles)
    return [
        {
            "subplot": titles.index(title),
            "condition": conditions.index(curve.condition),
            **_x_axes(sweep, curve, known),
            "mean": _plain(curve.estimate.value),
            "lower": _plain(curve.estimate.lower),
            "upper": _plain(curve.estimate.upper),
            "runs": curve.runs.tolist(),
            "seeds": [_plain(values) for values in curve.values]
            if 1 < len(curve.values) < SHOW_SEEDS_BELOW
            else [],
        }
        for title, found in drawing.curves.items()
        for curve in found
    ]


def _x_axes(sweep: Sweep, curve: Curve, known: KnownAxes) -> Mapping[str, Any]:
    """Steps, and means over the runs of the updates and the seconds until these steps."""
    runs = tuple(run for run in curve.condition.runs if sweep.runs[run].task == curve.task)
    key = (runs, curve.steps.tobytes())
    if key not in known:
        updates = (sweep.finite(run, names.GRAD_UPDATES) for run in runs)
        known[key] = {
            "steps": curve.steps.astype(int).tolist(),
            "updates": _mean_at(curve.steps, updates),
            "seconds": _mean_at(curve.steps, (sweep.seconds_at(run) for run in runs)),
        }
    return known[key]


def _mean_at(steps: Array, series: Iterable[tuple[Array, Array]]) -> list[float | None] | None:
    """Mean over the runs that have got as far; None if no run has any value.

    It never decreases, although the mean of fewer runs may be smaller than the mean of all.
    """
    rows = [np.interp(steps, at, own, left=np.nan, right=np.nan) for at, own in series if len(at)]
    if not rows:
        return None
    values, means = np.array(rows), np.full(len(steps), np.nan)
    reached = ~np.isnan(values).all(axis=0)
    means[reached] = np.maximum.accumulate(np.nanmean(values[:, reached], axis=0))
    return _plain(means)


def _plain(values: Array) -> list[float | None]:
    return [
        float(f"{value:.{_DIGITS}g}") if finite else None
        for value, finite in zip(values.tolist(), np.isfinite(values).tolist(), strict=True)
    ]
