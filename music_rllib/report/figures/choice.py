"""Which figures a sweep gets."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, product

from music_rllib import names
from music_rllib.report.figures.plots import (
    MOST_BANDS,
    Legend,
    Style,
    Styles,
    Subplot,
    alpha_subplot,
    curve_subplot,
    differences_subplot,
    entropy_subplot,
    exploration_subplot,
    finals_subplot,
    lines_of,
    profile_subplot,
    styles_of,
)
from music_rllib.results.analysis import (
    METRICS,
    Curve,
    FinalScores,
    Metric,
    Scope,
    StageAnalysis,
    alpha_lines,
    curve,
)
from music_rllib.results.claims import Claim
from music_rllib.results.conditions import (
    ALPHA,
    MOST_CONDITIONS,
    OF_TASK,
    Condition,
    StageRuns,
    stages_together,
)
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import SHOW_SEEDS_BELOW
from music_rllib.results.study import Study

FINALS = {names.EVAL_SUCCESS: "Final success rate", names.EVAL_RETURN: "Final return"}
AGAINST_ENTROPY = "Performance against entropy"
EXPLORATION_AGAINST_ENTROPY = "Exploration against entropy"
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
PRIMARY = tuple(metric.title for metric in METRICS[:2])
"""Titles of the curves of primary metrics: success rate and return."""
OF_ALL_STAGES = tuple(
    one for one in METRICS if one.title in PRIMARY or one.name == names.EVAL_DISPLACEMENT
)
"""Curves that are drawn of all stages together; displacement shows an effect before success."""
MOST_FACETS = 8
"""Largest number of subplots that the curves of one task are spread over."""
MOST_LINES = 10
"""Largest number of lines in a subplot of the overview."""
MOST_IN_LEGEND = 4
"""Largest number of lines of text in a legend of each subplot of the overview."""
MOST_DIFFERENCES = 20
"""Largest number of comparisons on a task that have a figure."""


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """One figure of one stage: its subplots, a legend and a caption."""

    stage: str
    title: str
    caption: str
    subplots: tuple[Subplot, ...]
    legend: Legend
    group: str = PERFORMANCE
    """The heading of the page under which it stands."""
    metric: Metric | None = None
    """The metric that learning curves show; None for other figures."""
    curves: Mapping[str, Sequence[Curve]] = field(default_factory=dict)
    """The learning curves of each subplot, by its title."""
    facets: Facets | None = None
    """How the conditions of learning curves are spread over subplots."""
    number: int = 1
    """Distinguishes drawings whose stages and titles are the same as file names."""

    @property
    def name(self) -> str:
        """The name of its files without their suffix, and its id in the page."""
        number = f" {self.number}" if self.number > 1 else ""
        return slug(f"{self.stage}-{self.title}{number}")


def slug(text: str) -> str:
    """`text` as a file name: lower-case letters and digits, joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def stage_drawings(sweep: Sweep, analysis: StageAnalysis) -> Iterator[Drawing]:
    """The figures of one stage for which there is something to draw or to compare."""
    stage = _without_trials(sweep, analysis.stage)
    yield from _curves(sweep, stage, METRICS)
    scopes = [
        replace(scope, finals=tuple(f for f in scope.finals if f.condition in stage.conditions))
        for scope in analysis.scopes
    ]
    scopes = [scope for scope in scopes if len(scope.finals) > 1]
    for metric, title in FINALS.items():
        if of_metric := [scope for scope in scopes if scope.metric == metric]:
            yield _finals(stage, title, of_metric)
    yield from _against_entropy(sweep, stage)


def _without_trials(sweep: Sweep, stage: StageRuns) -> StageRuns:
    """The stage, or the ranked conditions of a search if there are any: its trials are too many."""
    if stage.compared in ((), stage.conditions):
        return stage
    seeds = {sweep.runs[run].seed for condition in stage.compared for run in condition.runs}
    ranked = tuple(seed for seed in stage.seeds if seed in seeds)
    return replace(stage, conditions=stage.compared, seeds=ranked)


def drawings_of_stages(sweep: Sweep, stages: Sequence[StageRuns]) -> Iterator[Drawing]:
    """Curves of all stages that train for the task, together; none for a single stage."""
    together = stages_together([_without_trials(sweep, stage) for stage in stages])
    if together is not None:
        yield from _curves(sweep, together, OF_ALL_STAGES)


# Curves -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Facets:
    """How a stage's conditions are spread over the subplots of a figure."""

    setting: str
    """The setting whose values have subplots of their own; empty: only tasks have."""
    styles: Mapping[Condition, Style]
    """Style of each condition of the stage; the same in each subplot."""

    @classmethod
    def of(cls, stage: StageRuns) -> Facets:
        """One subplot for a task, unless it would have too many conditions."""
        setting = facet_of(stage.conditions)
        rest = {condition: without(condition, setting) for condition in stage.conditions}
        styles = styles_of(tuple(dict.fromkeys(rest.values())))
        return cls(setting, {condition: styles[rest[condition]] for condition in rest})

    def title(self, task: str, condition: Condition) -> str:
        value = dict(condition.others).get(self.setting)
        return f"{task}, {self.setting} = {value}" if self.setting else task

    def label(self, condition: Condition) -> str:
        """The condition's label in its subplot, `music-r, q = 1.5` in one of several stages."""
        rest = without(without(condition, self.setting), "stage")
        return ", ".join(filter(None, (dict(condition.others).get("stage"), rest.label)))


def without(condition: Condition, setting: str) -> Condition:
    """The condition without one of its settings, and without runs."""
    others = tuple(pair for pair in condition.others if pair[0] != setting)
    return replace(condition, others=others, runs=())


def facet_of(conditions: Sequence[Condition]) -> str:
    """The setting whose values have a subplot each if there are too many conditions; else empty.

    Of the settings with few enough values, it leaves the fewest conditions in a subplot.
    """
    if len(conditions) <= MOST_CONDITIONS:
        return ""
    most = {}
    for name in dict.fromkeys(name for one in conditions for name, _ in one.others):
        values = Counter(dict(one.others).get(name) for one in conditions)
        if name != "stage" and None not in values and 1 < len(values) <= MOST_FACETS:
            most[name] = max(values.values())
    return min(most, key=lambda name: most[name], default="")


def _curves(sweep: Sweep, stage: StageRuns, metrics: Sequence[Metric]) -> Iterator[Drawing]:
    facets = Facets.of(stage)
    labels = {facets.label(condition): style for condition, style in facets.styles.items()}
    for metric in metrics:
        by_title: dict[str, list[Curve]] = {}
        for task, condition in product(stage.tasks, stage.conditions):
            if metric.name == names.EVAL_RETURN != sweep.primary_metric(task):
                continue  # the return is drawn only of tasks whose primary metric it is
            found = curve(sweep, condition, task, metric.name)
            if found is not None:
                by_title.setdefault(facets.title(task, condition), []).append(found)
        if by_title:
            yield Drawing(
                stage=stage.name,
                title=metric.title,
                caption=_caption(metric, [*by_title.values()]),
                subplots=tuple(
                    curve_subplot(metric, title, curves, facets.styles)
                    for title, curves in by_title.items()
                ),
                legend=list(labels.items()),
                group=_GROUP_OF.get(metric.name, PERFORMANCE),
                metric=metric,
                curves=by_title,
                facets=facets,
            )


def _caption(metric: Metric, subplots: Sequence[Sequence[Curve]]) -> str:
    lines = max(map(len, subplots))
    counts = {len(curve.values) for curves in subplots for curve in curves}
    seeds = max(counts)
    if seeds == 1:
        text = "Each line is a single run."
    else:
        band = "" if lines > MOST_BANDS else " with its 95% confidence band"
        text = f"Mean over up to {seeds} seeds{band}."
        if band and any(1 < count < SHOW_SEEDS_BELOW for count in counts):
            text += " Very thin lines are single seeds."
    text += " A line gets thinner where some of its runs have ended."
    return text + (f" Dotted: {metric.target:.0%}." if metric.target is not None else "")


# Final values, entropy --------------------------------------------------------------------------


def _finals(stage: StageRuns, title: str, scopes: Sequence[Scope]) -> Drawing:
    facets, subplots = Facets.of(stage), []
    labels = {condition: facets.label(condition) for condition in stage.conditions}
    for scope in scopes:
        by_title: dict[str, list[FinalScores]] = {}
        for final in scope.finals:
            by_title.setdefault(facets.title(scope.name, final.condition), []).append(final)
        for name, shown in by_title.items():
            subplots.append(finals_subplot(name, scope, shown, facets.styles, labels))
    return Drawing(
        stage=stage.name,
        title=title,
        caption="Large marks: mean. Bars: 95% CI. Small ticks: single runs.",
        subplots=tuple(subplots),
        legend=[],  # each row has its label
    )


def _against_entropy(sweep: Sweep, stage: StageRuns) -> Iterator[Drawing]:
    """Performance and exploration, which entropy alone may explain."""
    # Other settings move the points, so that color and marker stand for q alone.
    by_q = _styles_by_q(stage.conditions)
    styles = {condition: by_q[condition.entropic_index] for condition in stage.conditions}
    for title, group, subplot_of, caption in (
        (
            AGAINST_ENTROPY,
            PERFORMANCE,
            entropy_subplot,
            "One point for each finished run. If all q fall on one curve, entropy explains "
            "performance; if they differ at equal entropy, q itself matters.",
        ),
        (
            EXPLORATION_AGAINST_ENTROPY,
            EXPLORATION,
            exploration_subplot,
            "Training episodes in the first quarter of the steps, with the entropy of the policy "
            "in the same steps. Small points: finished runs. Large points: means over the seeds.",
        ),
    ):
        subplots = tuple(filter(None, (subplot_of(sweep, task, styles) for task in stage.tasks)))
        if subplots and len(stage.conditions) > 1:
            yield Drawing(
                stage=stage.name,
                title=title,
                caption=caption,
                subplots=subplots,
                legend=[(f"q = {q}" if q else OF_TASK, style) for q, style in by_q.items()],
                group=group,
            )


def _styles_by_q(conditions: Sequence[Condition]) -> dict[str, Style]:
    """A style for each q, whatever other settings its conditions have."""
    indices = dict.fromkeys(condition.entropic_index for condition in conditions)
    alone = tuple(Condition(entropic_index=q, others=(), runs=()) for q in indices)
    return {one.entropic_index: style for one, style in styles_of(alone).items()}


# The study --------------------------------------------------------------------------------------


def study_drawings(study: Study, title: str = "") -> Iterator[Drawing]:
    """Differences with intervals, the profile of the primary metric, and its dependence on α.

    Stages begin with `title`.
    """
    if study.stage is None or not study.means:
        return
    stage = f"{title}{study.stage.name}"
    yield from _differences(study, stage)
    styles, kind = styles_of(study.stage.compared), study.means[0].measure.kind_in_words
    shown = {mean.condition: styles[mean.condition] for mean in study.means}
    rates = [mean for mean in study.means if mean.measure.is_rate]
    by_task = [(task, list(found)) for task, found in groupby(rates, lambda mean: mean.task)]
    if profiles := [
        profile_subplot(task, means, styles)
        for task, means in by_task
        if 1 < len(means) <= MOST_CONDITIONS
    ]:
        yield Drawing(
            stage=stage,
            title=f"Performance profile of the {kind}",
            caption="Share of runs above each value, with pointwise 95% bands. A failed run counts "
            "with 0.",
            subplots=tuple(profiles),
            legend=[(condition.short_label, style) for condition, style in shown.items()],
        )
    if lines := alpha_lines(study.means):
        alike = [without(line[0][1].condition, ALPHA) for line in lines]
        of_lines = styles_of(tuple(dict.fromkeys(alike)))
        drawn = [(line, of_lines[one]) for line, one in zip(lines, alike, strict=True)]
        yield Drawing(
            stage=stage,
            title=f"{kind.capitalize()} against α",
            group=SETTINGS,
            caption="Mean over the seeds with its 95% band. A comparison at one value of α is the "
            "comparison of the lines at this α.",
            subplots=tuple(
                alpha_subplot(task, list(found))
                for task, found in groupby(drawn, lambda pair: pair[0][0][1].task)
            ),
            legend=[(condition.short_label, style) for condition, style in of_lines.items()],
        )


def _differences(study: Study, stage: str) -> Iterator[Drawing]:
    """The comparisons that answer the question of a study."""
    rows: dict[str, list[tuple[str, Claim]]] = {}
    for claim in study.claims:
        if claim.contrast.difference.has_interval:
            rows.setdefault(claim.task, []).append((claim.pair_among(study.claims), claim))
    has_margin = any(claim.margin is not None for found in rows.values() for _, claim in found)
    margin = ", which must lie in the shaded margin for equivalence" if has_margin else ""
    if rows and max(map(len, rows.values())) <= MOST_DIFFERENCES:
        yield Drawing(
            stage=stage,
            title="Differences",
            caption="First condition minus second. Thin lines are 95% CIs, thick lines 90% CIs"
            f"{margin}.",
            subplots=tuple(
                differences_subplot(task, found, f"difference of the {' or '.join(words)}")
                for task, found in rows.items()
                for words in [dict.fromkeys(claim.measure.words for _, claim in found)]
            ),
            legend=[],
        )


# The overview -----------------------------------------------------------------------------------


def overview(sweep: Sweep, stages: Sequence[StageRuns]) -> tuple[tuple[Subplot, ...], Legend]:
    """For each task its primary metric, the displacement of objects, and the MI bound.

    Returns:
        The subplots, and the legend of all of them; empty if each has its own.
    """
    tasks = dict.fromkeys(task for stage in stages for task in stage.tasks)
    parts = [part for task in tasks for part in _of_task(sweep, stages, task)]
    entries = [entry for *_, legend in parts for entry in legend]
    together = dict(entries)
    # Within a subplot, a legend of many lines would hide them.
    lines = (sum(map(lines_of, dict(legend))) for *_, legend in parts)
    below = max(lines, default=0) > MOST_IN_LEGEND and all(
        together[label] == style for label, style in entries
    )
    subplots = tuple(
        curve_subplot(metric, task, curves, styles, () if below else legend)
        for metric, task, curves, styles, legend in parts
    )
    return subplots, list(together.items()) if below else []


def _of_task(
    sweep: Sweep, stages: Sequence[StageRuns], task: str
) -> Iterator[tuple[Metric, str, Sequence[Curve], Styles, Legend]]:
    stages = [stage for stage in stages if task in stage.tasks]
    shown = {condition: stage for stage in stages for condition in stage.compared}
    styles, primary = styles_of(tuple(shown)), sweep.primary_metric(task)
    for metric in METRICS:
        if metric.name not in (primary, names.EVAL_DISPLACEMENT, names.MI_BOUND):
            continue
        curves = [
            found
            for condition, stage in shown.items()
            # Without the task's reward, success is chance. A frozen estimator has no bound.
            if (stage.has_task_reward or metric.name != primary)
            and (found := curve(sweep, condition, task, metric.name)) is not None
            and (metric.name != names.MI_BOUND or found.estimate.value.max() > 0)
        ]
        if 0 < len(curves) <= MOST_LINES:
            legend = []
            for condition in (one.condition for one in curves):
                stage = shown[condition]
                parts = [stage.name] if len(stages) > 1 else []
                if len(stage.compared) > 1 or not parts:
                    parts.append(condition.label)
                legend.append((", ".join(parts), styles[condition]))
            yield metric, task, curves, styles, legend
