"""Which figures a sweep gets."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

from music_rllib import names
from music_rllib.report.figures.entropy import entropy_panel
from music_rllib.report.figures.importance import (
    CHANCE,
    importance_panel,
    importances,
    parallel_panel,
    sensitivity_panels,
)
from music_rllib.report.figures.palette import BARS, Style, style_of, styles_by_stage, styles_of
from music_rllib.report.figures.plots import (
    METRICS,
    Legend,
    Metric,
    Panel,
    curve_panel,
    finals_panel,
    profile_panel,
)
from music_rllib.results.analysis import Curve, StageAnalysis, curve
from music_rllib.results.claims.study import MOST_CONDITIONS
from music_rllib.results.comparison import SHOW_SEEDS_BELOW, Scope
from music_rllib.results.conditions import Condition, Stage, side_by_side
from music_rllib.results.data import Sweep

__all__ = [
    "AGAINST_ENTROPY",
    "COST",
    "CURVES",
    "FINALS",
    "GROUPS",
    "INFLUENCE",
    "PERFORMANCE",
    "PRIMARY",
    "PROFILES",
    "Drawing",
    "drawings_of_stages",
    "named_by_stage",
    "slug",
    "stage_drawings",
]

FINALS = {names.EVAL_SUCCESS: "Final success rate", names.EVAL_RETURN: "Final return"}
PROFILES = "Performance profile"
AGAINST_ENTROPY = "Performance against entropy"
PERFORMANCE, EXPLORATION, INFORMATION = "Performance", "Exploration", "Information"
SETTINGS, COST = "Settings", "Cost"
GROUPS = (PERFORMANCE, EXPLORATION, INFORMATION, SETTINGS, COST)
"""Headings of the page."""
_GROUP_OF = {
    names.EVAL_DISPLACEMENT: EXPLORATION,
    names.ENTROPY: EXPLORATION,
    names.SHANNON_ENTROPY: EXPLORATION,
    names.MI_BOUND: INFORMATION,
    names.MI_REWARD: INFORMATION,
}
INFLUENCE = ("Sensitivity", "Importance of settings", "Parallel coordinates")
CURVES = tuple(metric.title for metric in METRICS)
PRIMARY = CURVES[:2]
"""Of what tasks are judged by: success, or the return."""
OF_ALL_STAGES = (*METRICS[:2], *(one for one in METRICS if one.name == names.EVAL_DISPLACEMENT))
"""What is drawn of all stages together: it shows an effect before the first success, too."""


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """One figure of one stage: a panel per task, and its values as a table."""

    stage: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    legend: Legend
    group: str = PERFORMANCE
    """Under which heading of the page it stands."""
    metric: Metric | None = None
    """Of curves: what is drawn against environment steps."""
    curves: Mapping[str, Sequence[Curve]] = field(default_factory=dict)
    """By task."""
    values: tuple[tuple[object, ...], ...] = ()
    """(stage, task, condition, metric, env_steps, runs, mean, lower, upper) rows."""

    @property
    def name(self) -> str:
        """Of its files, and of its place in the page."""
        return slug(f"{self.stage}-{self.title}")


def slug(text: str) -> str:
    """`text` as a file name."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def stage_drawings(sweep: Sweep, analysis: StageAnalysis) -> Iterator[Drawing]:
    """The figures for which there is something to draw or to compare."""
    stage = _shown(sweep, analysis.stage)
    found = _all_curves(sweep, stage)
    for metric in METRICS:
        drawing = _curves(stage, metric, found, styles_of(stage.conditions))
        if drawing is not None:
            yield drawing
    of_shown = [replace(s, finals=s.compared) if s.compared else s for s in analysis.scopes]
    scopes = [scope for scope in of_shown if len(scope.finals) > 1]
    for metric_name, title in FINALS.items():
        yield from _finals(stage, title, [one for one in scopes if one.metric == metric_name])
    yield from _against_entropy(sweep, stage)
    if any(len(scope.finals) > 1 for scope in analysis.scopes):
        yield from _influence(sweep, analysis)


def _shown(sweep: Sweep, stage: Stage) -> Stage:
    """Of a search only what is ranked, as soon as there is any: its trials are too many to see."""
    if stage.compared in ((), stage.conditions):
        return stage
    seeds = {sweep.runs[run].seed for one in stage.compared for run in one.runs}
    return replace(
        stage,
        conditions=stage.compared,
        seeds=tuple(seed for seed in stage.seeds if seed in seeds),
    )


def _finals(stage: Stage, title: str, scopes: Sequence[Scope[Condition]]) -> Iterator[Drawing]:
    if not scopes:
        return
    legend = _legend(stage)
    yield Drawing(
        stage=stage.name,
        title=title,
        caption="Large marks: mean; bars: 95 % intervals; small ticks: single runs.",
        panels=tuple(finals_panel(scope, stage.conditions) for scope in scopes),
        legend=legend,
    )
    runs = [final.scores.shape[0] for scope in scopes for final in scope.finals]
    readable = len(stage.conditions) <= MOST_CONDITIONS and max(runs) > 1
    if scopes[0].metric not in names.EVAL_RATES or not readable:
        return  # single runs' bands are as high as the figure, and those of many are one
    yield Drawing(
        stage=stage.name,
        title=PROFILES,
        caption="Share of finished runs that end above each success rate, with 95 % bands. A line "
        "that is above another everywhere is better at every standard.",
        panels=tuple(profile_panel(scope, stage.conditions) for scope in scopes),
        legend=legend,
    )


def _against_entropy(sweep: Sweep, stage: Stage) -> Iterator[Drawing]:
    """Colour by q alone: what else varies moves the points along."""
    by_q = {c.entropic_index: style_of(c, stage.conditions) for c in stage.conditions}
    styles = {condition: by_q[condition.entropic_index] for condition in stage.conditions}
    found = (entropy_panel(sweep, task, styles) for task in stage.tasks)
    panels = tuple(panel for panel in found if panel is not None)
    if panels and len(stage.conditions) > 1:
        yield Drawing(
            stage=stage.name,
            title=AGAINST_ENTROPY,
            caption="One point for each finished run. Where the values of q lie on one curve, the "
            "entropy explains what they end at; where they differ at the same entropy, q does.",
            panels=panels,
            legend=[(f"q = {q}", style._replace(line="solid")) for q, style in by_q.items()],
        )


def drawings_of_stages(sweep: Sweep, stages: Sequence[Stage]) -> Iterator[Drawing]:
    """What all stages that train for the task come to, together; none for a single one."""
    together = side_by_side(stages)
    if together is None:
        return
    found = _all_curves(sweep, together, OF_ALL_STAGES)
    styles = styles_by_stage(together.conditions)
    for metric in OF_ALL_STAGES:
        drawing = _curves(together, metric, found, styles)
        if drawing is not None:
            legend = [(named_by_stage(condition), style) for condition, style in styles.items()]
            # Each stage's own drawing has the values.
            yield replace(drawing, legend=legend, values=())


def named_by_stage(condition: Condition) -> str:
    """`music-r, q = 1.5`: of all stages together."""
    (_, stage), *others = condition.others
    rest = replace(condition, others=tuple(others))
    return f"{stage}, {rest.label}"


def _all_curves(
    sweep: Sweep, stage: Stage, metrics: Sequence[Metric] = METRICS
) -> dict[tuple[str, str], list[Curve]]:
    """By metric and task; the return of those tasks only that are judged by it."""
    curves: dict[tuple[str, str], list[Curve]] = {}
    for metric, task, condition in product(metrics, stage.tasks, stage.conditions):
        if metric.name == names.EVAL_RETURN != sweep.primary_metric(task):
            continue
        one = curve(sweep, condition, task, metric.name)
        if one is not None:
            curves.setdefault((metric.name, task), []).append(one)
    return curves


def _curves(
    stage: Stage,
    metric: Metric,
    found: Mapping[tuple[str, str], list[Curve]],
    styles: Mapping[Condition, Style],
) -> Drawing | None:
    panels, values = [], []
    shown = {task: found[metric.name, task] for task in stage.tasks if (metric.name, task) in found}
    for task, curves in shown.items():
        panels.append(curve_panel(metric, task, curves, styles))
        for one in curves:
            head = (stage.name, task, one.condition.label, metric.name)
            values += [(*head, *row) for row in _rows(one)]
    if not panels:
        return None
    return Drawing(
        stage=stage.name,
        title=metric.title,
        caption=_caption(stage, metric),
        panels=tuple(panels),
        legend=_legend(stage),
        group=_GROUP_OF.get(metric.name, PERFORMANCE),
        metric=metric,
        curves=shown,
        values=tuple(values),
    )


def _rows(one: Curve) -> Iterator[tuple[object, ...]]:
    columns = (one.steps, one.runs, one.estimate.value, one.estimate.lower, one.estimate.upper)
    for step, runs, *numbers in zip(*columns, strict=True):
        yield int(step), int(runs), *(float(number) for number in numbers)


def _caption(stage: Stage, metric: Metric) -> str:
    seeds = len(stage.seeds)
    if seeds == 1:
        band = "A single seed: each line is one run, and there is no band."
    else:
        band = f"Mean over up to {seeds} seeds with its 95 % band."
        if seeds < SHOW_SEEDS_BELOW:
            band += " The thinnest lines: single seeds."
        band += " Dashed in turn: lines that coincide."
    thin = "A line is thin where some of its runs had ended."
    target = "" if metric.target is None else f" Dotted: {metric.target * 100:.0f} %."
    return f"{band} {thin}{target}"


def _legend(stage: Stage) -> Legend:
    return [(c.label, style_of(c, stage.conditions)) for c in stage.conditions]


def _influence(sweep: Sweep, analysis: StageAnalysis) -> Iterator[Drawing]:
    """What the settings do, where more than q varies."""
    stage = analysis.stage
    by_q = {c.entropic_index: style_of(c, stage.conditions) for c in stage.conditions}
    found = importances(sweep, analysis)
    per_task = [(t, [one for one in found if one.task == t]) for t in stage.tasks]
    parallel = [parallel_panel(scope, stage.conditions) for scope in analysis.scopes]
    lines = [(f"q = {q}", style._replace(line="solid")) for q, style in by_q.items()]
    bars = [(n, Style(BARS[n == CHANCE], "s", "solid")) for n in ("setting", CHANCE)]
    drawings = (
        (sensitivity_panels(analysis), _SENSITIVITY, lines),
        ([importance_panel(task, some) for task, some in per_task if some], _IMPORTANCE, bars),
        ([panel for panel in parallel if panel is not None], _PARALLEL, lines),
    )
    for title, (panels, caption, legend) in zip(INFLUENCE, drawings, strict=True):
        if panels:
            yield Drawing(
                stage=stage.name,
                title=title,
                caption=caption,
                panels=tuple(panels),
                legend=legend,
                group=SETTINGS,
            )


_SENSITIVITY = (
    "Mean of what the runs ended at over the entropy coefficient α and the weight of "
    "the MI reward, linear between the settings that were tried (marks); nothing outside of them "
    "is known."
)
_IMPORTANCE = (
    "Functional ANOVA (Hutter et al. 2014, as in Optuna) over the finished runs. A setting matters "
    "only as far as it explains more than the seed does."
)
_PARALLEL = "A line per condition through its settings to what it ended at; the fainter, the lower."
