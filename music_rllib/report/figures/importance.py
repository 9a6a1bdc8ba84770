"""Which settings matter: what a stage varies, against the final values of its runs.

A *setting* is a number or a choice that varies between a stage's runs; q is one of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from music_rllib import names
from music_rllib.report.figures.palette import BARS, colour_of, styles_of
from music_rllib.report.figures.plots import (
    RATE_LIMITS,
    Panel,
    labelled_rows,
    row_label,
    rules_behind_rows,
)
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.comparison import Final, Scope
from music_rllib.results.conditions import ENTROPIC_INDEX, SEEDS, Condition
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array

ALPHA, WEIGHT = "α", "MI weight"
CHANCE = "seed (chance)"
"""The seed as a setting: what another one must exceed to be more than luck."""
FEWEST_RUNS = 8
"""Fewer runs are not enough for a forest of trees."""
FEWEST_POINTS = 4
"""Fewer points have no contours."""
TREES = 32
MOST_LEVELS = 4
"""Largest number of values of a setting without numbers that is treated as a choice."""
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


# Sensitivity ------------------------------------------------------------------------------------

Positions = Mapping[Final[Condition], tuple[float, ...]]
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


def _by_q(positions: Positions) -> dict[str, list[Final[Condition]]]:
    groups: dict[str, list[Final[Condition]]] = {}
    for final in positions:
        groups.setdefault(final.condition.entropic_index, []).append(final)
    return groups


def _contours(scope: Scope[Condition], positions: Positions) -> Iterator[Panel]:
    for q, finals in _by_q(positions).items():
        points: dict[tuple[float, ...], list[float]] = {}
        for final in finals:
            points.setdefault(positions[final], []).append(final.value)
        where = np.array(list(points))
        if len(where) < FEWEST_POINTS or min(len(set(axis)) for axis in where.T) < 2:
            continue
        values = np.array([np.mean(found) for found in points.values()])
        yield _contour(f"{scope.name}, q = {q}", where, values, _range(scope), scope.metric)


def _range(scope: Scope[Condition]) -> tuple[float, float]:
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
    scope: Scope[Condition],
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


# Importance -------------------------------------------------------------------------------------


def importances(sweep: Sweep, analysis: StageAnalysis) -> dict[str, dict[str, float]]:
    """Share of the variance of final values that each setting explains, by task.

    It is a functional ANOVA (Hutter et al. 2014; Optuna's) over the finished runs, with the seed as
    a setting to compare with. A task with too few finished runs is left out, and there is none
    where fewer than two settings vary.
    """
    settings = varied(analysis.stage.conditions)
    shares: dict[str, dict[str, float]] = {}
    for task in analysis.stage.tasks if len(settings) > 1 else ():
        rows = list(_rows(sweep, analysis, task, settings))
        if len(rows) >= FEWEST_RUNS and len({value for _, value in rows}) > 1:
            shares[task] = _fanova(rows)
    return shares


def _rows(
    sweep: Sweep, analysis: StageAnalysis, task: str, settings: Sequence[str]
) -> Iterator[tuple[dict[str, str], float]]:
    """Settings and final value of each finished run on the task."""
    for condition in analysis.stage.conditions:
        values = settings_of(condition)
        for run in condition.runs:
            record = sweep.runs[run]
            final = sweep.final(run, sweep.primary_metric(task))
            if record.task == task and record.status == "FINISHED" and final is not None:
                chosen = {name: values.get(name, "-") for name in settings}
                yield {**chosen, CHANCE: record.seed}, final


def _fanova(rows: Sequence[tuple[Mapping[str, str], float]]) -> dict[str, float]:
    import optuna
    from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances

    space: dict[str, BaseDistribution] = {}
    columns: dict[str, Sequence[object]] = {}
    for name in rows[0][0]:
        texts = [settings[name] for settings, _ in rows]
        levels = sorted(set(texts))
        numbers = [number for text in texts if (number := _number(text)) is not None]
        if len(levels) < 2:
            continue
        if len(numbers) == len(texts) and name != CHANCE:
            space[name] = FloatDistribution(min(numbers), max(numbers))
            columns[name] = numbers
        elif len(levels) > MOST_LEVELS:
            # Optuna's time for a choice is exponential in its levels, so these become numbers.
            space[name] = FloatDistribution(0.0, len(levels) - 1.0)
            columns[name] = [float(levels.index(text)) for text in texts]
        else:
            space[name] = CategoricalDistribution(levels)
            columns[name] = texts
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(direction="maximize")
        for row, (_, value) in enumerate(rows):
            params = {name: column[row] for name, column in columns.items()}
            study.add_trial(
                optuna.trial.create_trial(params=params, distributions=space, value=value)
            )
        evaluator = FanovaImportanceEvaluator(n_trees=TREES, seed=0)
        return dict(get_param_importances(study, evaluator=evaluator))
    finally:
        optuna.logging.set_verbosity(before)


def importance_panel(task: str, shares: Mapping[str, float]) -> Panel:
    """A bar for each setting's share, the largest on top."""
    ordered = sorted(shares.items(), key=lambda item: -item[1])
    labels, height = labelled_rows([f"{setting}: {share:.2f}" for setting, share in ordered])

    def draw(axes: Axes) -> None:
        axes.set_ylim(len(ordered) - 0.5, -0.8)
        axes.set_xlim(0.0, 1.0)
        rules_behind_rows(axes, len(ordered), above=0.24)
        for row, ((setting, share), label) in enumerate(zip(ordered, labels, strict=True)):
            axes.barh(row, share, color=BARS[setting == CHANCE], height=0.48, alpha=0.8)
            row_label(axes, row - 0.28, label)
        axes.set_xlabel("share of the variance at the end")

    return Panel(title=task, draw=draw, height=height)


# Parallel coordinates ---------------------------------------------------------------------------


def parallel_panel(scope: Scope[Condition], conditions: Sequence[Condition]) -> Panel | None:
    """A line per condition through its settings and its final value, coloured by q."""
    settings = varied(conditions)
    if len(settings) < 2 or len(scope.finals) < 2:
        return None
    columns = [
        _column([settings_of(final.condition).get(name, "-") for final in scope.finals])
        for name in settings
    ]
    low, high = _range(scope)
    columns.append(
        (
            [(final.value - low) / (high - low) for final in scope.finals],
            [(height, f"{low + height * (high - low):.4g}") for height in (0.0, 0.5, 1.0)],
        )
    )
    lines = list(zip(*(heights for heights, _ in columns), strict=True))

    def draw(axes: Axes) -> None:
        for final, heights in zip(scope.finals, lines, strict=True):
            colour, alpha = colour_of(final.condition.entropic_index), 0.35 + 0.6 * heights[-1]
            axes.plot(range(len(heights)), heights, color=colour, linewidth=1.4, alpha=alpha)
        # Labels have a background, so that no line runs through their text.
        behind = {"facecolor": mpl.rcParams["axes.facecolor"], "edgecolor": "none", "pad": 0.8}
        style: dict[str, Any] = {"va": "center", "fontsize": "small", "bbox": behind}
        for place, (_, ticks) in enumerate(columns):
            axes.axvline(place, color=axes.spines["left"].get_edgecolor(), linewidth=0.8)
            x, side = (place - 0.04, "right") if place else (0.04, "left")
            for height, label in ticks:
                axes.text(x, height, label, ha=side, **style)
        labels = [
            name.rpartition(": ")[2].rpartition(".")[2].replace("_", "\n") for name in settings
        ]
        axes.set_xticks(range(len(columns)), [*labels, f"final\n{names.word_of(scope.metric)}"])
        axes.set_yticks([])
        axes.set_ylim(-0.06, 1.06)
        axes.spines["left"].set_visible(False)
        axes.grid(visible=False)

    return Panel(title=scope.name, draw=draw)


def _column(texts: Sequence[str]) -> tuple[list[float], list[tuple[float, str]]]:
    """Heights of a setting's values in [0, 1] by rank, and (height, label) of at most six ticks."""
    numbers = {text: _number(text) for text in texts}
    distinct = sorted(numbers, key=lambda t: (numbers[t] is None, numbers[t] or 0.0, t))
    height = {text: i / max(1, len(distinct) - 1) for i, text in enumerate(distinct)}
    ticks = np.linspace(0, len(distinct) - 1, min(6, len(distinct))).astype(int)
    labels = [(height[distinct[i]], _tick_label(distinct[i])) for i in ticks]
    return [height[text] for text in texts], labels


def _tick_label(text: str) -> str:
    """Three digits of a number, as a search samples six; the first letters of a word."""
    number = _number(text)
    return f"{number:.3g}" if number is not None and len(text) > 6 and "." in text else text[:12]


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
