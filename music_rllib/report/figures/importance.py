"""Which settings matter: what a stage varies, against what its runs ended at.

A *setting* is something numeric or categorical that varies between a stage's runs, q among them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from music_rllib import names
from music_rllib.report.figures.palette import BARS, colour_of, style_of
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

__all__ = [
    "CHANCE",
    "FEWEST_RUNS",
    "Importance",
    "importance_panel",
    "importances",
    "parallel_panel",
    "sensitivity_panels",
    "varied",
]

ALPHA, WEIGHT = "α", "MI weight"
CHANCE = "seed (chance)"
"""How much the seed alone explains: what a setting must exceed to be more than luck."""
FEWEST_RUNS = 8
"""Below them a forest of trees explains nothing."""
FEWEST_POINTS = 4
"""Of a contour: fewer have no surface."""
TREES = 32
MOST_LEVELS = 4
"""Of a setting that is no number, to be treated as a choice."""
MOST_PANELS = 12
"""Of sensitivity; where there would be more, only those of all tasks together are drawn."""


@dataclass(frozen=True, kw_only=True)
class Importance:
    """Share of the variance of what runs ended at that a setting explains."""

    task: str
    setting: str
    share: float


def settings_of(condition: Condition) -> dict[str, str]:
    """Everything that tells a condition from others, q first."""
    return {ENTROPIC_INDEX: condition.entropic_index, **dict(condition.others)}


def varied(conditions: Sequence[Condition]) -> list[str]:
    """Settings that have more than one value, q first; which seeds a search used is none."""
    found: dict[str, set[str]] = {}
    for condition in conditions:
        for name, value in settings_of(condition).items():
            if name != SEEDS:
                found.setdefault(name, set()).add(value)
    return [name for name, values in found.items() if len(values) > 1]


# Sensitivity ------------------------------------------------------------------------------------


def sensitivity_panels(analysis: StageAnalysis) -> list[Panel]:
    """What runs ended at over α and the MI reward's weight: one panel per task and q.

    Where both vary it is a contour, where one does a line with its intervals.
    """
    names_ = [name for name in (ALPHA, WEIGHT) if name in varied(analysis.stage.conditions)]
    panels = []
    for scope in analysis.scopes:
        numeric = [final for final in scope.finals if _position(final.condition, names_)]
        if len(names_) == 2:
            panels += list(_contours(scope, numeric, names_))
        elif names_ and len(numeric) > 1:
            panels.append(_lines(scope, numeric, names_[0], analysis.stage.conditions))
    return panels if len(panels) <= MOST_PANELS else panels[: len(panels) // len(analysis.scopes)]


def _position(condition: Condition, wanted: Sequence[str]) -> tuple[float, ...] | None:
    values = settings_of(condition)
    numbers = [_number(values.get(name, "")) for name in wanted]
    return None if None in numbers else tuple(n for n in numbers if n is not None)


def _contours(
    scope: Scope[Condition], finals: Sequence[Final[Condition]], wanted: Sequence[str]
) -> Iterator[Panel]:
    by_q: dict[str, list[Final[Condition]]] = {}
    for final in finals:
        by_q.setdefault(final.condition.entropic_index, []).append(final)
    for q, members in by_q.items():
        points: dict[tuple[float, ...], list[float]] = {}
        for final in members:
            at = _position(final.condition, wanted)
            assert at is not None, "the caller has left the others out"
            points.setdefault(at, []).append(float(final.estimate.value))
        where = np.array(list(points))
        if len(where) < FEWEST_POINTS or min(len(set(axis)) for axis in where.T) < 2:
            continue
        values = np.array([np.mean(found) for found in points.values()])
        yield _contour(f"{scope.name}, q = {q}", where, values, _range(scope), scope.metric)


def _range(scope: Scope[Condition]) -> tuple[float, float]:
    """Of a rate all that it can be, of a return what was seen."""
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
            shown = distinct[np.linspace(0, len(distinct) - 1, min(5, len(distinct))).astype(int)]
            set_ticks(_scaled(at, shown), [f"{value:g}" for value in shown])
        axes.set_xlabel("α (entropy coefficient)")
        axes.set_ylabel("MI reward weight")
        axes.grid(visible=False)
        bar = axes.figure.colorbar(surface, ax=axes, ticks=np.linspace(*ends, 5))
        bar.ax.set_title(names.word_of(metric), fontsize="small")

    return Panel(title=title, draw=draw)


def _scaled(values: Array, shown: Array | None = None) -> Array:
    """Logarithms where the values span more than a factor of five."""
    wanted = values if shown is None else shown
    wide = values.min() > 0 and values.max() / values.min() > 5
    return np.asarray(np.log10(wanted) if wide else wanted)


def _lines(
    scope: Scope[Condition],
    finals: Sequence[Final[Condition]],
    name: str,
    siblings: tuple[Condition, ...],
) -> Panel:
    by_q: dict[str, list[Final[Condition]]] = {}
    for final in finals:
        by_q.setdefault(final.condition.entropic_index, []).append(final)

    def at(final: Final[Condition]) -> float:
        return float(settings_of(final.condition)[name])

    def draw(axes: Axes) -> None:
        for members in by_q.values():
            ordered = sorted(members, key=at)
            style = style_of(ordered[0].condition, siblings)
            x, y = [at(f) for f in ordered], [float(f.estimate.value) for f in ordered]
            axes.plot(x, y, color=style.colour, marker=style.marker, linewidth=1.8)
            for place, final in zip(x, ordered, strict=True):
                if final.estimate.has_interval:
                    ends = [float(final.estimate.lower), float(final.estimate.upper)]
                    axes.plot([place, place], ends, color=style.colour, linewidth=4, alpha=0.35)
        places = [at(final) for final in finals]
        if min(places) > 0 and max(places) / min(places) > 5:
            axes.set_xscale("log")
            # The scale's own labels are formulas, which nothing is read as.
            axes.xaxis.set_major_formatter(LogFormatter())
            axes.xaxis.set_minor_formatter(LogFormatter())
        if scope.metric in names.EVAL_RATES:
            axes.set_ylim(*RATE_LIMITS)
        axes.set_xlabel(f"{name} (log scale)" if axes.get_xscale() == "log" else name)
        axes.set_ylabel(f"final {names.word_of(scope.metric)}")

    return Panel(title=scope.name, draw=draw)


# Importance -------------------------------------------------------------------------------------


def importances(sweep: Sweep, analysis: StageAnalysis) -> list[Importance]:
    """Functional ANOVA (Hutter et al. 2014; Optuna's) over the finished runs of each task.

    The seed is one of the settings, as a yardstick. Empty where fewer than two settings vary or
    too few runs have finished.
    """
    wanted = varied(analysis.stage.conditions)
    if len(wanted) < 2:
        return []
    found = []
    for task in analysis.stage.tasks:
        rows = list(_rows(sweep, analysis, task, wanted))
        shares = _fanova(rows) if len(rows) >= FEWEST_RUNS else {}
        found += [Importance(task=task, setting=n, share=share) for n, share in shares.items()]
    return found


def _rows(
    sweep: Sweep, analysis: StageAnalysis, task: str, wanted: Sequence[str]
) -> Iterator[tuple[dict[str, str], float]]:
    for condition in analysis.stage.conditions:
        values = settings_of(condition)
        for run in condition.runs:
            record = sweep.runs[run]
            last = sweep.final(run, sweep.primary_metric(task))
            if record.task == task and record.status == "FINISHED" and last is not None:
                chosen = {name: values.get(name, "-") for name in wanted}
                yield {**chosen, CHANCE: record.seed}, last


def _fanova(rows: Sequence[tuple[Mapping[str, str], float]]) -> dict[str, float]:
    import optuna
    from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances

    if len({value for _, value in rows}) < 2:
        return {}
    columns = {name: [values[name] for values, _ in rows] for name in rows[0][0]}
    space: dict[str, BaseDistribution] = {}
    parsed: dict[str, list[object]] = {}
    for name, texts in columns.items():
        numbers = [number for text in texts if (number := _number(text)) is not None]
        if len(set(texts)) < 2:
            continue
        levels = sorted(set(texts))
        if len(numbers) == len(texts) and name != CHANCE:
            space[name] = FloatDistribution(min(numbers), max(numbers))
            parsed[name] = list(numbers)
        elif len(levels) > MOST_LEVELS:
            # Optuna's share of a choice takes time exponential in its levels: places in a row.
            space[name] = FloatDistribution(0.0, len(levels) - 1.0)
            parsed[name] = [float(levels.index(text)) for text in texts]
        else:
            space[name] = CategoricalDistribution(levels)
            parsed[name] = list(texts)
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(direction="maximize")
        for number, (_, value) in enumerate(rows):
            params = {name: values[number] for name, values in parsed.items()}
            study.add_trial(
                optuna.trial.create_trial(params=params, distributions=space, value=value)
            )
        evaluator = FanovaImportanceEvaluator(n_trees=TREES, seed=0)
        return dict(get_param_importances(study, evaluator=evaluator))
    finally:
        optuna.logging.set_verbosity(before)


def importance_panel(task: str, found: Sequence[Importance]) -> Panel:
    """A bar for each setting, the largest on top."""
    ordered = sorted(found, key=lambda one: -one.share)
    labels, height = labelled_rows([f"{one.setting}: {one.share:.2f}" for one in ordered])

    def draw(axes: Axes) -> None:
        axes.set_ylim(len(ordered) - 0.5, -0.8)
        axes.set_xlim(0.0, 1.0)
        rules_behind_rows(axes, len(ordered), above=0.24)
        for row, (one, label) in enumerate(zip(ordered, labels, strict=True)):
            chance = one.setting == CHANCE
            axes.barh(row, one.share, color=BARS[chance], height=0.48, alpha=0.8)
            row_label(axes, row - 0.28, label)
        axes.set_xlabel("share of the variance at the end")

    return Panel(title=task, draw=draw, height=height)


# Parallel coordinates ---------------------------------------------------------------------------


def parallel_panel(scope: Scope[Condition], conditions: Sequence[Condition]) -> Panel | None:
    """A line per condition through its settings and what it ended at; coloured by q."""
    wanted = varied(conditions)
    if len(wanted) < 2 or len(scope.finals) < 2:
        return None
    columns = [
        _column([settings_of(f.condition).get(n, "-") for f in scope.finals]) for n in wanted
    ]
    heights = [column for column, _ in columns]
    low, high = _range(scope)
    heights.append([(final.value - low) / (high - low) for final in scope.finals])
    ticks = [labels for _, labels in columns]
    ticks.append([(tick, f"{low + tick * (high - low):.4g}") for tick in (0.0, 0.5, 1.0)])

    def draw(axes: Axes) -> None:
        for number, final in enumerate(scope.finals):
            axes.plot(
                range(len(heights)),
                [column[number] for column in heights],
                color=colour_of(final.condition.entropic_index),
                linewidth=1.4,
                alpha=0.35 + 0.6 * heights[-1][number],
            )
        # No line of the figure runs through a label.
        behind = {"facecolor": mpl.rcParams["axes.facecolor"], "edgecolor": "none", "pad": 0.8}
        for place, labels in enumerate(ticks):
            axes.axvline(place, color=axes.spines["left"].get_edgecolor(), linewidth=0.8)
            side = {"ha": "right", "x": place - 0.04} if place else {"ha": "left", "x": 0.04}
            for height, label in labels:
                axes.text(
                    side["x"],  # type: ignore[arg-type]
                    height,
                    label,
                    ha=side["ha"],
                    va="center",
                    fontsize="small",
                    bbox=behind,
                )
        axes.set_xticks(
            range(len(heights)),
            [*(_short(n) for n in wanted), f"final\n{names.word_of(scope.metric)}"],
        )
        axes.set_yticks([])
        axes.set_ylim(-0.06, 1.06)
        axes.spines["left"].set_visible(False)
        axes.grid(visible=False)

    return Panel(title=scope.name, draw=draw)


def _column(texts: Sequence[str]) -> tuple[list[float], list[tuple[float, str]]]:
    """Heights in [0, 1] by rank, and their labels: settings are chosen by hand or by factors."""
    numbers = {text: _number(text) for text in texts}
    distinct = sorted(numbers, key=lambda t: (numbers[t] is None, numbers[t] or 0.0, t))
    height = {text: i / max(1, len(distinct) - 1) for i, text in enumerate(distinct)}
    shown = distinct
    if len(distinct) > 6:
        shown = [distinct[i] for i in np.linspace(0, len(distinct) - 1, 6).astype(int)]
    return [height[text] for text in texts], [(height[t], _tick(t)) for t in shown]


def _tick(text: str) -> str:
    """What a search draws has six digits."""
    number = _number(text)
    return f"{number:.3g}" if number is not None and len(text) > 6 and "." in text else text[:12]


def _short(name: str) -> str:
    return name.rpartition(": ")[2].rpartition(".")[2].replace("_", "\n")


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
