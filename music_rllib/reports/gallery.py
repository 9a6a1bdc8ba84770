"""Which figures a sweep gets."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from music_rllib.reports.figures import (
    METRICS,
    Legend,
    Metric,
    Panel,
    curve_panel,
    finals_panel,
    profile_panel,
)
from music_rllib.reports.influence import (
    CHANCE,
    importance_panel,
    importances,
    parallel_panel,
    sensitivity_panels,
)
from music_rllib.reports.palette import BARS, Style, style_of, styles_by_stage, styles_of
from music_rllib.reports.parallel import forked_map
from music_rllib.results.analysis import Curve, Scope, StageAnalysis, curve
from music_rllib.results.conditions import Condition, Stage, side_by_side
from music_rllib.results.data import Sweep

__all__ = [
    "CURVES",
    "FINALS",
    "INFLUENCE",
    "PROFILES",
    "Drawing",
    "drawing_of_stages",
    "slug",
    "stage_drawings",
]

FINALS, PROFILES = "Final success rate", "Performance profile"
INFLUENCE = ("Sensitivity", "Importance of settings", "Parallel coordinates")
FEW_CURVES = 60
"""Curves for which more processes would cost more than they save."""
CURVES = tuple(metric.title for metric in METRICS)


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """One figure of one stage: a panel per task, and its values as a table."""

    stage: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    legend: Legend
    values: tuple[tuple[object, ...], ...] = ()
    """(stage, task, condition, metric, env_steps, runs, iqm, lower, upper) rows."""

    @property
    def name(self) -> str:
        """Of its files, and of its place in the page."""
        return slug(f"{self.stage}-{self.title}")


def slug(text: str) -> str:
    """`text` as a file name."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def stage_drawings(
    sweep: Sweep, analysis: StageAnalysis, rng: np.random.Generator
) -> Iterator[Drawing]:
    """The figures for which there is something to draw or to compare."""
    stage = _shown(sweep, analysis.stage)
    found = _all_curves(sweep, stage, rng)
    for metric in METRICS:
        drawing = _curves(stage, metric, found, styles_of(stage.conditions))
        if drawing is not None:
            yield drawing
    of_shown = [replace(s, finals=s.compared) if s.compared else s for s in analysis.scopes]
    scopes = [scope for scope in of_shown if len(scope.finals) > 1]
    if scopes:
        yield from _finals(stage, scopes, rng)
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


def _finals(stage: Stage, scopes: Sequence[Scope], rng: np.random.Generator) -> Iterator[Drawing]:
    legend = _legend(stage)
    yield Drawing(
        stage=stage.name,
        title=FINALS,
        caption="Large marks: interquartile mean; bars: 95 % intervals; small ticks: single runs.",
        panels=tuple(finals_panel(scope, stage.conditions) for scope in scopes),
        legend=legend,
    )
    yield Drawing(
        stage=stage.name,
        title=PROFILES,
        caption="Share of finished runs that end above each success rate, with 95 % bands. A line "
        "that is above another everywhere is better at every standard.",
        panels=tuple(profile_panel(scope, stage.conditions, rng) for scope in scopes),
        legend=legend,
    )


def drawing_of_stages(
    sweep: Sweep, stages: Sequence[Stage], rng: np.random.Generator
) -> Drawing | None:
    """Success rates of all stages that train for the task in one figure; None for a single one."""
    together = side_by_side(stages)
    if together is None:
        return None
    found = _all_curves(sweep, together, rng, METRICS[:1])
    styles = styles_by_stage(together.conditions)
    drawing = _curves(together, METRICS[0], found, styles)
    if drawing is None:
        return None
    legend = [(_named_by_stage(condition), style) for condition, style in styles.items()]
    # Each stage's own drawing has the values.
    return replace(drawing, legend=legend, values=())


def _named_by_stage(condition: Condition) -> str:
    (_, stage), *others = condition.others
    rest = replace(condition, others=tuple(others))
    return f"{stage}, {rest.label}"


def _all_curves(
    sweep: Sweep, stage: Stage, rng: np.random.Generator, metrics: Sequence[Metric] = METRICS
) -> dict[tuple[str, str], list[Curve]]:
    """By metric and task."""
    jobs = list(product(metrics, stage.tasks, stage.conditions))
    # Each has its own randomness, so that it is the same in whatever process and order.
    seeded = list(zip(jobs, rng.spawn(len(jobs)), strict=True))

    def make(job: tuple[tuple[Metric, str, Condition], np.random.Generator]) -> Curve | None:
        (metric, task, condition), own = job
        return curve(sweep, condition, task, metric.name, own)

    curves: dict[tuple[str, str], list[Curve]] = {}
    made = forked_map(make, seeded, few=FEW_CURVES)
    for (metric, task, _), one in zip(jobs, made, strict=True):
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
    for task in stage.tasks:
        curves = found.get((metric.name, task), [])
        if not curves:
            continue
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
        band = f"Interquartile mean over up to {seeds} seeds with its 95 % bootstrap band."
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
            )


_SENSITIVITY = (
    "Interquartile mean of the final success rate over the entropy coefficient α and the weight of "
    "the MI reward, linear between the settings that were tried (marks); nothing outside of them "
    "is known."
)
_IMPORTANCE = (
    "Functional ANOVA (Hutter et al. 2014, as in Optuna) over the finished runs. A setting matters "
    "only as far as it explains more than the seed does."
)
_PARALLEL = (
    "A line per condition through its settings to its final success rate; the fainter, the lower."
)
