"""Sensitivity to settings: the final values of a stage's runs over the settings that it varies.

A *setting* is a number or a choice that varies between a stage's runs; q is one of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from music_rllib import names
from music_rllib.report.figures.palette import styles_of
from music_rllib.report.figures.plots import RATE_LIMITS, Panel
from music_rllib.results.analysis import FinalScores, Scope, StageAnalysis
from music_rllib.results.conditions import ENTROPIC_INDEX, SEEDS, Condition
from music_rllib.results.statistics import Array

ALPHA, WEIGHT = "α", "MI weight"
FEWEST_POINTS = 4
"""Fewer points have no contours."""
MOST_PANELS = 12
"""Largest number of sensitivity panels; if there are more, those of single tasks are left out."""


def settings_of(condition: Condition) -> dict[str, str]:
    """All settings that tell a condition from others, q first."""
    return {ENTROPIC_INDEX: condition.entropic_index, **dict(condition.others)}


def varied(conditions: Sequence[Condition]) -> list[str]:
    """Settings with more than one value, q first; whether seeds are fresh is no setting."""
    values: dict[str, set[str]] = {}
    for condition in conditions:
        for name, value in settings_of(condition).items():
            values.setdefault(name, set()).add(value)
    return [name for name, found in values.items() if len(found) > 1 and name != SEEDS]


Positions = Mapping[FinalScores, tuple[float, ...]]
"""Finals with their values of the settings on a figure's axes."""


def sensitivity_panels(analysis: StageAnalysis) -> list[Panel]:
    """Final values over α and the MI reward's weight: one panel per task and q.

    It is a contour where both vary, and a line with its intervals where one does.
    """
    conditions = analysis.stage.conditions
    settings = [name for name in (ALPHA, WEIGHT) if name in varied(conditions)]
    panels: list[Panel] = []
    for scope in analysis.scopes if settings else ():
        positions = {
            final: position
            for final in scope.finals
            if (position := _position(final.condition, settings)) is not None
        }
        if len(settings) == 2:
            panels += _contours(scope, positions)
        elif len(positions) > 1:
            panels.append(_lines(scope, positions, settings[0], conditions))
    return panels if len(panels) <= MOST_PANELS else panels[: len(panels) // len(analysis.scopes)]


def _position(condition: Condition, settings: Sequence[str]) -> tuple[float, ...] | None:
    """The condition's values of the settings; None where one of them is no number."""
    texts = settings_of(condition)
    values = [value for name in settings if (value := _number(texts.get(name, ""))) is not None]
    return tuple(values) if len(values) == len(settings) else None


def _by_q(positions: Positions) -> dict[str, list[FinalScores]]:
    groups: dict[str, list[FinalScores]] = {}
    for final in positions:
        groups.setdefault(final.condition.entropic_index, []).append(final)
    return groups


def _contours(scope: Scope, positions: Positions) -> Iterator[Panel]:
    for q, finals in _by_q(positions).items():
        points: dict[tuple[float, ...], list[float]] = {}
        for final in finals:
            points.setdefault(positions[final], []).append(final.value)
        where = np.array(list(points))
        if len(where) < FEWEST_POINTS or min(len(set(axis)) for axis in where.T) < 2:
            continue
        values = np.array([np.mean(found) for found in points.values()])
        yield _contour(f"{scope.name}, q = {q}", where, values, _range(scope), scope.metric)


def _range(scope: Scope) -> tuple[float, float]:
    """[0, 1] for a rate, the range of the final values otherwise."""
    if scope.metric in names.EVAL_RATES:
        return 0.0, 1.0
    values = [final.value for final in scope.finals]
    return min(values), max(values) if max(values) > min(values) else min(values) + 1.0


def _contour(
    title: str, where: Array, values: Array, ends: tuple[float, float], metric: str
) -> Panel:
    def draw(axes: Axes) -> None:
        x, y = where.T
        levels = np.linspace(*ends, 11)
        surface = axes.tricontourf(_scaled(x), _scaled(y), values, levels=levels, cmap="cividis")
        (marks,) = axes.plot(_scaled(x), _scaled(y), "o", color="#ffffff", mec="#1a1a1a", ms=5)
        marks.set(clip_on=False, zorder=5)
        for set_ticks, at in ((axes.set_xticks, x), (axes.set_yticks, y)):
            distinct = np.unique(at)
            ticks = distinct[np.linspace(0, len(distinct) - 1, min(5, len(distinct))).astype(int)]
            set_ticks(_scaled(ticks), [f"{tick:g}" for tick in ticks])
        axes.set_xlabel("α (entropy coefficient)")
        axes.set_ylabel("MI reward weight")
        axes.grid(visible=False)
        bar = axes.figure.colorbar(surface, ax=axes, ticks=np.linspace(*ends, 5))
        bar.ax.set_title(names.word_of(metric), fontsize="small")

    return Panel(title=title, draw=draw)


def _scaled(values: Array) -> Array:
    """Logarithms where the values span more than a factor of five."""
    return np.asarray(np.log10(values) if _is_wide(values) else values)


def _is_wide(values: Array) -> bool:
    return bool(values.min() > 0 and values.max() / values.min() > 5)


def _lines(
    scope: Scope,
    positions: Positions,
    setting: str,
    conditions: tuple[Condition, ...],
) -> Panel:
    styles = styles_of(conditions)

    def draw(axes: Axes) -> None:
        for finals in _by_q(positions).values():
            ordered = sorted(finals, key=lambda final: positions[final])
            style = styles[ordered[0].condition]
            x, y = [positions[final][0] for final in ordered], [final.value for final in ordered]
            axes.plot(x, y, color=style.colour, marker=style.marker, linewidth=1.8)
            for place, final in zip(x, ordered, strict=True):
                if final.estimate.has_interval:
                    ends = [float(final.estimate.lower), float(final.estimate.upper)]
                    axes.plot([place, place], ends, color=style.colour, linewidth=4, alpha=0.35)
        log = _is_wide(np.array(list(positions.values())))
        if log:
            axes.set_xscale("log")
            # The scale's own labels are formulas, but text.parse_math is off.
            axes.xaxis.set_major_formatter(LogFormatter())
            axes.xaxis.set_minor_formatter(LogFormatter())
        if scope.metric in names.EVAL_RATES:
            axes.set_ylim(*RATE_LIMITS)
        axes.set_xlabel(f"{setting} (log scale)" if log else setting)
        axes.set_ylabel(f"final {names.word_of(scope.metric)}")

    return Panel(title=scope.name, draw=draw)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
