"""Which figures a sweep gets."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

from music_rllib import names
from music_rllib.report.figures.importance import (
    CHANCE,
    importance_panel,
    importances,
    parallel_panel,
    sensitivity_panels,
)
from music_rllib.report.figures.palette import BARS, Style, styles_by_stage, styles_of
from music_rllib.report.figures.plots import (
    METRICS,
    Legend,
    Metric,
    Panel,
    curve_panel,
    entropy_panel,
    finals_panel,
    profile_panel,
)
from music_rllib.results.analysis import Curve, StageAnalysis, curve
from music_rllib.results.claims.study import MOST_CONDITIONS
from music_rllib.results.comparison import SHOW_SEEDS_BELOW, Scope
from music_rllib.results.conditions import Condition, Stage, side_by_side
from music_rllib.results.data import Sweep

FINALS = {names.EVAL_SUCCESS: "Final success rate", names.EVAL_RETURN: "Final return"}
PROFILES = "Performance profile"
AGAINST_ENTROPY = "Performance against entropy"
PERFORMANCE, EXPLORATION, INFORMATION = "Performance", "Exploration", "Information"
SETTINGS, COST = "Settings", "Cost"
GROUPS = (PERFORMANCE, EXPLORATION, INFORMATION, SETTINGS, COST)
"""Headings of the page, in their order."""
_GROUP_OF = {
    names.EVAL_DISPLACEMENT: EXPLORATION,
    names.ENTROPY: EXPLORATION,
    names.SHANNON_ENTROPY: EXPLORATION,
    names.MI_BOUND: INFORMATION,
    names.MI_REWARD: INFORMATION,
}
INFLUENCE = ("Sensitivity", "Importance of settings", "Parallel coordinates")
PRIMARY = tuple(metric.title for metric in METRICS[:2])
"""Titles of the curves of primary metrics: success rate and return."""
OF_ALL_STAGES = tuple(
    metric
    for metric in METRICS
    if metric.title in PRIMARY or metric.name == names.EVAL_DISPLACEMENT
)
"""Curves that are drawn of all stages together; displacement shows an effect before success."""


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """One figure of one stage: a panel per task, a legend and a caption."""

    stage: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    legend: Legend
    group: str = PERFORMANCE
    """The heading of the page under which it stands."""
    metric: Metric | None = None
    """The metric that learning curves show; None for other figures."""
    curves: Mapping[str, Sequence[Curve]] = field(default_factory=dict)
    """The learning curves of each task."""

    @property
    def name(self) -> str:
        """The name of its files without their suffix, and its id in the page."""
        return slug(f"{self.stage}-{self.title}")


def slug(text: str) -> str:
    """`text` as a file name: lower-case letters and digits, joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def stage_drawings(sweep: Sweep, analysis: StageAnalysis) -> Iterator[Drawing]:
    """The figures of one stage for which there is something to draw or to compare."""
    stage = _without_trials(sweep, analysis.stage)
    curves = _all_curves(sweep, stage, METRICS)
    for metric in METRICS:
        yield from _curves(stage, metric, curves, styles_of(stage.conditions))
    scopes = [replace(s, finals=s.compared) if s.compared else s for s in analysis.scopes]
    scopes = [scope for scope in scopes if len(scope.finals) > 1]
    for metric_name, title in FINALS.items():
        yield from _finals(stage, title, [one for one in scopes if one.metric == metric_name])
    yield from _against_entropy(sweep, stage)
    if any(len(scope.finals) > 1 for scope in analysis.scopes):
        yield from _influence(sweep, analysis)


def _without_trials(sweep: Sweep, stage: Stage) -> Stage:
    """The stage, or the ranked conditions of a search if there are any: its trials are too many."""
    if stage.compared in ((), stage.conditions):
        return stage
    seeds = {sweep.runs[run].seed for condition in stage.compared for run in condition.runs}
    ranked = tuple(seed for seed in stage.seeds if seed in seeds)
    return replace(stage, conditions=stage.compared, seeds=ranked)


def _finals(stage: Stage, title: str, scopes: Sequence[Scope[Condition]]) -> Iterator[Drawing]:
    if not scopes:
        return
    yield Drawing(
        stage=stage.name,
        title=title,
        caption="Large marks: mean; bars: 95 % intervals; small ticks: single runs.",
        panels=tuple(finals_panel(scope, stage.conditions) for scope in scopes),
        legend=_legend(stage),
    )
    runs = [final.scores.shape[0] for scope in scopes for final in scope.finals]
    readable = len(stage.conditions) <= MOST_CONDITIONS and max(runs) > 1
    if scopes[0].metric not in names.EVAL_RATES or not readable:
        return  # bands of single runs fill the figure, and those of many conditions overlap
    yield Drawing(
        stage=stage.name,
        title=PROFILES,
        caption="Share of finished runs that end above each success rate, with 95 % bands. A line "
        "that is above another everywhere is better at every standard.",
        panels=tuple(profile_panel(scope, stage.conditions) for scope in scopes),
        legend=_legend(stage),
    )


def _against_entropy(sweep: Sweep, stage: Stage) -> Iterator[Drawing]:
    by_q = _styles_by_q(stage)
    # Other settings move the points, so that colour stands for q alone.
    styles = {condition: by_q[condition.entropic_index] for condition in stage.conditions}
    panels = [entropy_panel(sweep, task, styles) for task in stage.tasks]
    if any(panels) and len(stage.conditions) > 1:
        yield Drawing(
            stage=stage.name,
            title=AGAINST_ENTROPY,
            caption="One point for each finished run. Where the values of q lie on one curve, the "
            "entropy explains what they end at; where they differ at the same entropy, q does.",
            panels=tuple(filter(None, panels)),
            legend=_legend_by_q(stage),
        )


def drawings_of_stages(sweep: Sweep, stages: Sequence[Stage]) -> Iterator[Drawing]:
    """Curves of all stages that train for the task, together; none for a single stage."""
    together = side_by_side(stages)
    if together is None:
        return
    curves = _all_curves(sweep, together, OF_ALL_STAGES)
    styles = styles_by_stage(together.conditions)
    legend = [(named_by_stage(condition), style) for condition, style in styles.items()]
    for metric in OF_ALL_STAGES:
        for drawing in _curves(together, metric, curves, styles):
            yield replace(drawing, legend=legend)


def named_by_stage(condition: Condition) -> str:
    """The label of a condition of all stages together: `music-r, q = 1.5`."""
    (_, stage), *others = condition.others
    rest = replace(condition, others=tuple(others))
    return f"{stage}, {rest.label}"


def _all_curves(
    sweep: Sweep, stage: Stage, metrics: Sequence[Metric]
) -> dict[tuple[str, str], list[Curve]]:
    """Curves by metric and task, with the return of only those tasks that are judged by it."""
    curves: dict[tuple[str, str], list[Curve]] = {}
    for metric, task, condition in product(metrics, stage.tasks, stage.conditions):
        if metric.name == names.EVAL_RETURN != sweep.primary_metric(task):
            continue
        found = curve(sweep, condition, task, metric.name)
        if found is not None:
            curves.setdefault((metric.name, task), []).append(found)
    return curves


def _curves(
    stage: Stage,
    metric: Metric,
    curves: Mapping[tuple[str, str], list[Curve]],
    styles: Mapping[Condition, Style],
) -> Iterator[Drawing]:
    """The learning curves of a metric, if there are any."""
    by_task = {t: curves[metric.name, t] for t in stage.tasks if (metric.name, t) in curves}
    if by_task:
        yield Drawing(
            stage=stage.name,
            title=metric.title,
            caption=_caption(stage, metric),
            panels=tuple(curve_panel(metric, t, found, styles) for t, found in by_task.items()),
            legend=_legend(stage),
            group=_GROUP_OF.get(metric.name, PERFORMANCE),
            metric=metric,
            curves=by_task,
        )


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
    return [(condition.label, style) for condition, style in styles_of(stage.conditions).items()]


def _styles_by_q(stage: Stage) -> dict[str, Style]:
    return {c.entropic_index: style for c, style in styles_of(stage.conditions).items()}


def _legend_by_q(stage: Stage) -> Legend:
    styles = _styles_by_q(stage)
    return [(f"q = {q}", style._replace(line="solid")) for q, style in styles.items()]


def _influence(sweep: Sweep, analysis: StageAnalysis) -> Iterator[Drawing]:
    """The effect of settings, where more than q varies."""
    stage = analysis.stage
    shares = importances(sweep, analysis)
    parallel = [parallel_panel(scope, stage.conditions) for scope in analysis.scopes]
    by_q = _legend_by_q(stage)
    bars = [(n, Style(BARS[n == CHANCE], "s", "solid")) for n in ("setting", CHANCE)]
    drawings = (
        (sensitivity_panels(analysis), _SENSITIVITY, by_q),
        ([importance_panel(*item) for item in shares.items()], _IMPORTANCE, bars),
        ([panel for panel in parallel if panel is not None], _PARALLEL, by_q),
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
