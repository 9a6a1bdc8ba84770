"""Which figures a sweep gets."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

from music_rllib import names
from music_rllib.report.figures.palette import Style, styles_by_stage, styles_of
from music_rllib.report.figures.plots import (
    METRICS,
    MOST_BANDS,
    Legend,
    Metric,
    Panel,
    curve_panel,
    entropy_panel,
    finals_panel,
    profile_panel,
)
from music_rllib.report.figures.sensitivity import sensitivity_panels
from music_rllib.results.analysis import Curve, FinalScores, Scope, StageAnalysis, curve
from music_rllib.results.conditions import SIDE_BY_SIDE, Condition, StageRuns, stages_together
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import SHOW_SEEDS_BELOW
from music_rllib.results.study import MOST_CONDITIONS

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
SENSITIVITY = "Sensitivity"
PRIMARY = tuple(metric.title for metric in METRICS[:2])
"""Titles of the curves of primary metrics: success rate and return."""
OF_ALL_STAGES = tuple(
    metric
    for metric in METRICS
    if metric.title in PRIMARY or metric.name == names.EVAL_DISPLACEMENT
)
"""Curves that are drawn of all stages together; displacement shows an effect before success."""


MOST_FACETS = 8
"""Largest number of panels that the curves of one task are spread over."""


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """One figure of one stage: its panels, a legend and a caption."""

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
    """The learning curves of each panel, by its title."""
    facets: Facets | None = None
    """How conditions are spread over the panels of learning curves and of profiles."""
    number: int = 1
    """Tells drawings apart whose stages and titles are alike as file names."""

    @property
    def name(self) -> str:
        """The name of its files without their suffix, and its id in the page."""
        number = f" {self.number}" if self.number > 1 else ""
        return slug(f"{self.stage}-{self.title}{number}")

    @property
    def legend_is_of_conditions(self) -> bool:
        """Whether each entry of the legend is one condition of the stage."""
        return self.facets is not None and len(self.legend) == len(self.facets.styles)


def slug(text: str) -> str:
    """`text` as a file name: lower-case letters and digits, joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def stage_drawings(sweep: Sweep, analysis: StageAnalysis) -> Iterator[Drawing]:
    """The figures of one stage for which there is something to draw or to compare."""
    stage = _without_trials(sweep, analysis.stage)
    yield from _curves(sweep, stage, METRICS)
    scopes = [replace(s, finals=s.compared) if s.compared else s for s in analysis.scopes]
    scopes = [scope for scope in scopes if len(scope.finals) > 1]
    for metric_name, title in FINALS.items():
        yield from _finals(stage, title, [one for one in scopes if one.metric == metric_name])
    yield from _against_entropy(sweep, stage)
    if any(len(scope.finals) > 1 for scope in analysis.scopes):
        yield from _sensitivity(analysis)


def _without_trials(sweep: Sweep, stage: StageRuns) -> StageRuns:
    """The stage, or the ranked conditions of a search if there are any: its trials are too many."""
    if stage.compared in ((), stage.conditions):
        return stage
    seeds = {sweep.runs[run].seed for condition in stage.compared for run in condition.runs}
    ranked = tuple(seed for seed in stage.seeds if seed in seeds)
    return replace(stage, conditions=stage.compared, seeds=ranked)


def _finals(stage: StageRuns, title: str, scopes: Sequence[Scope]) -> Iterator[Drawing]:
    if not scopes:
        return
    yield Drawing(
        stage=stage.name,
        title=title,
        caption="Large marks: mean; bars: 95 % intervals; small ticks: single runs.",
        panels=tuple(panel for scope in scopes for panel in _finals_panels(stage, scope)),
        legend=[],  # each row has its label
    )
    facets = Facets.of(stage)
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
        legend=[(condition.label, style) for condition, style in facets.styles.items()],
        facets=facets,
    )


def _finals_panels(stage: StageRuns, scope: Scope) -> Iterator[Panel]:
    facets = Facets.of(stage)
    labels = {condition: facets.label(condition) for condition in stage.conditions}
    panels: dict[str, list[FinalScores]] = {}
    for final in scope.finals:
        panels.setdefault(facets.title(scope.name, final.condition), []).append(final)
    for title, shown in panels.items():
        yield finals_panel(title, scope, shown, facets.styles, labels)


def _against_entropy(sweep: Sweep, stage: StageRuns) -> Iterator[Drawing]:
    by_q = _styles_by_q(stage)
    # Other settings move the points, so that colour stands for q alone.
    styles = {condition: by_q[condition.entropic_index] for condition in stage.conditions}
    panels = [entropy_panel(sweep, task, styles) for task in stage.tasks]
    if any(panels) and len(stage.conditions) > 1:
        yield Drawing(
            stage=stage.name,
            title=AGAINST_ENTROPY,
            caption="One point for each finished run. Where the values of q lie on one curve, the "
            "entropy explains how they do; where they differ at the same entropy, q does.",
            panels=tuple(filter(None, panels)),
            legend=_legend_by_q(stage),
        )


def drawings_of_stages(sweep: Sweep, stages: Sequence[StageRuns]) -> Iterator[Drawing]:
    """Curves of all stages that train for the task, together; none for a single stage."""
    together = stages_together(stages)
    if together is not None:
        yield from _curves(sweep, together, OF_ALL_STAGES)


def named_by_stage(condition: Condition) -> str:
    """The label of a condition of all stages together: `music-r, q = 1.5`."""
    (_, stage), *others = condition.others
    rest = replace(condition, others=tuple(others))
    return f"{stage}, {rest.label}"


@dataclass(frozen=True)
class Facets:
    """How a stage's conditions are spread over the panels of a figure."""

    setting: str
    """The setting whose values have panels of their own; empty: the panels are tasks."""
    styles: Mapping[Condition, Style]
    """Of all conditions of the stage; the same in each panel."""

    @classmethod
    def of(cls, stage: StageRuns) -> Facets:
        """One panel for a task, unless it would have too many conditions."""
        setting = facet_of(stage.conditions)
        rest = {condition: _without(condition, setting) for condition in stage.conditions}
        styles_of_all = styles_by_stage if stage.name == SIDE_BY_SIDE else styles_of
        styles = styles_of_all(tuple(dict.fromkeys(rest.values())))
        return cls(setting, {condition: styles[rest[condition]] for condition in rest})

    def title(self, task: str, condition: Condition) -> str:
        """The title of a condition's panel."""
        value = dict(condition.others).get(self.setting)
        return f"{task}, {self.setting} = {value}" if self.setting else task

    def label(self, condition: Condition) -> str:
        """What a condition is called in its panel, whose title says the rest."""
        rest = _without(condition, self.setting)
        by_stage = any(name == "stage" for name, _ in rest.others)
        return named_by_stage(rest) if by_stage else rest.label


def _without(condition: Condition, setting: str) -> Condition:
    others = tuple(pair for pair in condition.others if pair[0] != setting)
    return replace(condition, others=others, runs=())


def facet_of(conditions: Sequence[Condition]) -> str:
    """The setting that spreads conditions over panels where one has too many of them; else empty.

    Of the settings that leave few enough panels, the one with the fewest conditions in a panel.
    """
    if len(conditions) <= MOST_CONDITIONS:
        return ""
    values: dict[str, list[str]] = {}
    for condition in conditions:
        for name, value in condition.others:
            values.setdefault(name, []).append(value)
    most = {
        name: max(Counter(found).values())
        for name, found in values.items()
        if name != "stage" and len(found) == len(conditions) and 1 < len(set(found)) <= MOST_FACETS
    }
    return min(most, key=lambda name: most[name], default="")


def _curves(sweep: Sweep, stage: StageRuns, metrics: Sequence[Metric]) -> Iterator[Drawing]:
    """The learning curves of a stage, of each metric that it has."""
    facets = Facets.of(stage)
    labels = {facets.label(condition): style for condition, style in facets.styles.items()}
    for metric in metrics:
        panels: dict[str, list[Curve]] = {}
        for task, condition in product(stage.tasks, stage.conditions):
            if metric.name == names.EVAL_RETURN != sweep.primary_metric(task):
                continue  # the return is drawn of those tasks only that are judged by it
            found = curve(sweep, condition, task, metric.name)
            if found is not None:
                panels.setdefault(facets.title(task, condition), []).append(found)
        if panels:
            yield Drawing(
                stage=stage.name,
                title=metric.title,
                caption=_caption(stage, metric, max(map(len, panels.values()))),
                panels=tuple(
                    curve_panel(
                        metric, title, curves, facets.styles, with_epochs=not facets.setting
                    )
                    for title, curves in panels.items()
                ),
                legend=list(labels.items()),
                group=_GROUP_OF.get(metric.name, PERFORMANCE),
                metric=metric,
                curves=panels,
                facets=facets,
            )


def _caption(stage: StageRuns, metric: Metric, lines: int) -> str:
    seeds = len(stage.seeds)
    if lines > MOST_BANDS:
        band = f"Mean over up to {seeds} seeds, without bands, which would hide each other."
    elif seeds == 1:
        band = "A single seed: each line is one run, and there is no band."
    else:
        band = f"Mean over up to {seeds} seeds with its 95 % band."
        if seeds < SHOW_SEEDS_BELOW:
            band += " The thinnest lines: single seeds."
        band += " Dashed in turn: lines that coincide."
    thin = "A line is thin where some of its runs had ended."
    target = "" if metric.target is None else f" Dotted: {metric.target * 100:.0f} %."
    return f"{band} {thin}{target}"


def _styles_by_q(stage: StageRuns) -> dict[str, Style]:
    return {c.entropic_index: style for c, style in styles_of(stage.conditions).items()}


def _legend_by_q(stage: StageRuns) -> Legend:
    styles = _styles_by_q(stage)
    return [(f"q = {q}", style._replace(line="solid")) for q, style in styles.items()]


def _sensitivity(analysis: StageAnalysis) -> Iterator[Drawing]:
    """The final values over settings, where more than q varies."""
    if panels := sensitivity_panels(analysis):
        yield Drawing(
            stage=analysis.stage.name,
            title=SENSITIVITY,
            caption=_SENSITIVITY,
            panels=tuple(panels),
            legend=_legend_by_q(analysis.stage),
            group=SETTINGS,
        )


_SENSITIVITY = (
    "Mean of what the runs ended at over the entropy coefficient α and the weight of "
    "the MI reward, linear between the settings that were tried (marks); nothing outside of them "
    "is known."
)
