"""Conditions of a sweep that a hypothesis is about.

Claims of a study: tests of hypotheses that were planned before the runs, and of later ones.

Each condition's runs give a score for each seed, which comparisons take seed by seed
(:mod:`~music_rllib.results.claims`). The planned comparisons are one family, and only
they have verdicts; without a plan all pairs of conditions are the family. Other comparisons are
exploratory: they have a difference, an interval and an unadjusted p-value.


The primary metric against α, a line for each q: what a comparison at one α would have found.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from music_rllib.config.analysis import Hypothesis, parsed
from music_rllib.config.problems import same
from music_rllib.results import statistics as st
from music_rllib.results.analysis_plan import PlanVersion
from music_rllib.results.claims import Claim, claims_of, decided, exploratory
from music_rllib.results.conditions import (
    ALPHA,
    ENTROPIC_INDEX,
    IN_WORDS,
    SEEDS,
    Condition,
    StageRuns,
    Values,
    find_stages,
    whole_setting,
)
from music_rllib.results.data import RunRecord, Sweep
from music_rllib.results.scores import (
    Measure,
    Scores,
    ended_first,
    measure_on,
    scores_of,
)
from music_rllib.results.statistics import Array, Estimate


def in_words(side: Mapping[str, str]) -> str:
    """One side of a hypothesis as labels have it: `q = 1.5, α = 0.1`."""
    return ", ".join(f"{_label(name)} = {value}" for name, value in side.items())


def _label(name: str) -> str:
    """The label of a setting or of a part of it: `tac.alpha.value` is α."""
    return IN_WORDS.get(whole_setting(name), (name, ""))[0]


def matching(
    sweep: Sweep, stages: Mapping[str, StageRuns], side: Mapping[str, str], stage: str
) -> list[Condition]:
    """Conditions that may be compared and have all settings of one side of a hypothesis."""
    settings = dict(side)
    chosen = stages.get(settings.pop("stage", stage))
    return [
        condition
        for condition in (chosen.compared if chosen else ())
        if all(_has(sweep.runs[condition.runs[0]], *setting) for setting in settings.items())
    ]


def _has(run: RunRecord, name: str, value: str) -> bool:
    _, tag = IN_WORDS.get(name, ("", ""))
    known = (run.params.get(name), run.tags.get(tag))
    return any(_same(value, other) for other in known if other is not None)


def _same(one: str, other: str) -> bool:
    return one == other or same(parsed(one), parsed(other))


def alike_in_the_rest(
    first: Sequence[Condition], second: Sequence[Condition], hypothesis: Hypothesis
) -> list[tuple[Condition, Condition]] | str:
    """Pairs of conditions that differ only in what the hypothesis names.

    One against one is a pair, whatever else they differ in: each value of q may have been given
    its own α.

    Returns:
        The pairs, or in words why there are none.
    """
    for side, settings in ((first, hypothesis.first), (second, hypothesis.second)):
        if not side:
            return f"no run of {in_words(settings)} has begun that may be compared"
    if len(first) == len(second) == 1:
        return [(first[0], second[0])]
    named = {_label(name) for name in (*hypothesis.first, *hypothesis.second)}
    firsts, seconds = (
        {_rest(condition, named): condition for condition in side} for side in (first, second)
    )
    pairs = [(one, seconds[rest]) for rest, one in firsts.items() if rest in seconds]
    if not pairs or len(firsts) < len(first) or len(seconds) < len(second):
        return (
            f"{len(first)} and {len(second)} conditions have these settings, and no pairs of them "
            "are alike in the rest: it must name more"
        )
    return pairs


def _rest(condition: Condition, named: set[str]) -> Values:
    """The condition's settings that the hypothesis does not name."""
    settings = ((ENTROPIC_INDEX, condition.entropic_index), *condition.others)
    return tuple(pair for pair in settings if pair[0] not in named)


MOST_CONDITIONS = 6
"""Number of conditions up to which each is compared with each; more, with a reference."""


@dataclass(frozen=True, kw_only=True)
class Mean:
    """A condition's primary metric on a task."""

    condition: Condition
    task: str
    measure: Measure
    estimate: Estimate
    scores: Scores = field(repr=False)
    runs: int
    """Number of runs that are planned or begun; finished and failed ones have scores."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """All claims of one stage and of the hypotheses."""

    stage: StageRuns | None
    """None before a run has begun, and without a stage that trains for the task."""
    plan: PlanVersion | None
    """The last version recorded before the first of its runs had finished; None without one."""
    latest: PlanVersion | None
    """The last version; None without a plan."""
    means: tuple[Mean, ...]
    planned: tuple[Claim, ...]
    """Claims of the hypotheses of `plan`."""
    afterwards: tuple[Claim, ...]
    """Other claims: hypotheses that are only in `latest`, and other pairs of the stage."""
    untested: tuple[str, ...]
    """Hypotheses that can't be tested, with the reason."""
    runs: tuple[int, ...]
    """Positions in `Sweep.runs` of what may be compared, of the stage and those of `plan`."""
    family: int
    """Number of comparisons that `claims` are corrected for, with those that can't be tested."""

    @property
    def question(self) -> str | None:
        """The plan's question, or its hypotheses where it has none; None without a plan."""
        version = self.plan or self.latest
        if version is None:
            return None
        return version.plan.question or "; ".join(version.plan.hypotheses)

    @property
    def claims(self) -> tuple[Claim, ...]:
        """Claims that answer the question: the planned ones, or without a plan all there are.

        While no planned claim can be tested there are none: other claims are no substitute.
        """
        return self.planned if self.plan is not None else self.afterwards


def study_of(
    sweep: Sweep, stage: str | None = None, *, metric: str | None = None, maximised: bool = True
) -> Study:
    """Test the planned hypotheses, and compare the other conditions of a stage.

    Args:
        sweep: its runs, with the metrics that are read.
        stage: of the comparisons that nobody planned; None: the plan's, or the last that trains
            for the task.
        metric: of those; None: each task's primary one, measured as the plan says.
        maximised: whether more of `metric` is better.
    """
    stages = {found.name: found for found in find_stages(sweep)}
    latest = sweep.plans[-1] if sweep.plans else None
    plan = _planned(sweep, stages)
    chosen = stages.get(stage or (latest.plan.stage if latest else ""))
    if chosen is None and stage is None:
        chosen = next((s for s in reversed(stages.values()) if s.has_task_reward), None)
    untested: list[str] = []
    planned = list(_of_plan(sweep, stages, plan, (), untested)) if plan else []
    without_test = len(untested)
    afterwards: list[Claim] = []
    if latest is not None and latest != plan:
        known = plan.plan.hypotheses if plan and _same_test(plan, latest) else ()
        afterwards += _of_plan(sweep, stages, latest, known, untested)
    means: list[Mean] = []
    if chosen is not None:
        kind, margin = "auc", None
        if latest is not None and metric is None:
            kind, margin = latest.plan.metric, latest.plan.margin
        measures = {
            task: measure_on(sweep, task, _runs(chosen), kind, metric, maximised=maximised)
            for task in chosen.tasks
        }
        means += _means(sweep, chosen, measures)
        afterwards += _of_stage(sweep, chosen, measures, margin, (*planned, *afterwards))
    about = [stages[name] for name in (plan.plan.stages if plan else ()) if name in stages]
    family = len(planned) + without_test if plan else len(afterwards)
    return Study(
        stage=chosen,
        plan=plan,
        latest=latest,
        means=tuple(means),
        planned=decided(planned, planned=True, without_test=without_test),
        afterwards=exploratory(afterwards) if plan else decided(afterwards, planned=False),
        untested=tuple(dict.fromkeys(untested)),
        family=family,
        runs=tuple({run: None for stage in filter(None, [chosen, *about]) for run in _runs(stage)}),
    )


def _runs(stage: StageRuns) -> list[int]:
    """The runs of a stage's conditions that may be compared."""
    return [run for condition in stage.compared for run in condition.runs]


def _planned(sweep: Sweep, stages: Mapping[str, StageRuns]) -> PlanVersion | None:
    """The last version of the plan that was recorded before any result."""
    for version in reversed(sweep.plans):
        runs = [run for name in version.plan.stages & stages.keys() for run in stages[name].runs]
        if version.recorded_ms < ended_first(sweep, runs):
            return version
    return None


def _same_test(one: PlanVersion, other: PlanVersion) -> bool:
    return (one.plan.metric, one.plan.margin) == (other.plan.metric, other.plan.margin)


def _of_plan(
    sweep: Sweep,
    stages: Mapping[str, StageRuns],
    version: PlanVersion,
    known: Sequence[str],
    untested: list[str],
) -> Iterator[Claim]:
    """The undecided claims of a plan's hypotheses without the `known` ones; fills `untested`."""
    for text in version.plan.hypotheses:
        if text in known:
            continue
        hypothesis = Hypothesis.of(text)
        sides = (hypothesis.first, hypothesis.second)
        first, second = (matching(sweep, stages, side, version.plan.stage) for side in sides)
        cells = alike_in_the_rest(first, second, hypothesis)
        if isinstance(cells, str):
            untested.append(f"{text}: {cells}")
            continue
        runs = [run for pair in cells for condition in pair for run in condition.runs]
        measures = {
            task: measure_on(
                sweep,
                task,
                runs,
                version.plan.metric,
                horizon=version.plan.budget.get(task, np.inf),
            )
            for task in dict.fromkeys(sweep.runs[run].task for run in runs)
        }
        labelled = (in_words(hypothesis.first), in_words(hypothesis.second), cells)
        claims = list(
            claims_of(sweep, [labelled], measures, version.plan.margin, version.plan.seed_count)
        )
        if not claims:
            untested.append(f"{text}: no seed has finished in both conditions")
        yield from (replace(claim, hypothesis=hypothesis) for claim in claims)


def _of_stage(
    sweep: Sweep,
    stage: StageRuns,
    measures: Mapping[str, Measure],
    margin: float | None,
    others: Sequence[Claim],
) -> Iterator[Claim]:
    """The undecided claims of a stage's pairs of conditions, on what no other claim is about."""
    known = {claim.subject for claim in others}
    pairs = [(x.short_label, y.short_label, [(x, y)]) for x, y in _pairs(stage.compared)]
    for claim in claims_of(sweep, pairs, measures, margin):
        if claim.subject not in known:
            yield claim


def label_of(condition: Condition) -> str:
    """The condition's label without the seeds of a search: only fresh ones are compared."""
    others = tuple(pair for pair in condition.others if pair[0] != SEEDS)
    return replace(condition, others=others).label


def _pairs(conditions: Sequence[Condition]) -> list[tuple[Condition, Condition]]:
    """Pairs of a later condition and an earlier one; of many conditions, each and its reference.

    The reference is the condition alike in the rest with q = 1, or with the smallest q; where no
    two conditions are alike in the rest, the first of those with this q.
    """
    if len(conditions) <= MOST_CONDITIONS:
        return [(second, first) for first, second in combinations(conditions, 2)]
    indices = [one.entropic_index for one in conditions]
    reference = "1" if "1" in indices else indices[0]
    references = {one.others: one for one in conditions if one.entropic_index == reference}
    pairs = [(one, references[one.others]) for one in conditions if one.others in references]
    if all(one is other for one, other in pairs):
        first = conditions[indices.index(reference)]
        pairs = [(one, first) for one in conditions]
    return [(one, other) for one, other in pairs if one is not other]


def _means(sweep: Sweep, stage: StageRuns, measures: Mapping[str, Measure]) -> Iterator[Mean]:
    for task, measure in measures.items():
        for condition in stage.compared:
            scores = scores_of(sweep, condition, task, measure)
            if scores.by_seed:
                matrix = np.array(list(scores.by_seed.values()))[:, np.newaxis]
                yield Mean(
                    condition=condition,
                    task=task,
                    measure=measure,
                    estimate=st.estimate(matrix, scores.episodes if measure.is_rate else None),
                    scores=scores,
                    runs=sum(sweep.runs[run].task == task for run in condition.runs),
                )


@dataclass(frozen=True, kw_only=True)
class AlphaLine:
    """Conditions on a task that differ in α only, by rising α."""

    task: str
    entropic_index: str
    others: Values
    """Other settings that tell the line from the others."""
    means: tuple[Mean, ...]
    alphas: Array
    """`[points]`."""
    estimate: Estimate
    """`[points]`, of the primary metric over the seeds."""


def alpha_sensitivity(means: Sequence[Mean]) -> list[AlphaLine]:
    """Lines of at least two values of α; a condition whose α is no number is on none."""
    groups: defaultdict[tuple[str, str, Values], list[tuple[float, Mean]]] = defaultdict(list)
    for mean in means:
        others = dict(mean.condition.others)
        try:
            alpha = float(others.pop(ALPHA, ""))
        except ValueError:
            continue
        key = (mean.task, mean.condition.entropic_index, tuple(others.items()))
        groups[key].append((alpha, mean))
    return [_line(*key, points) for key, points in groups.items() if len(points) > 1]


def _line(
    task: str, entropic_index: str, others: Values, points: Sequence[tuple[float, Mean]]
) -> AlphaLine:
    alphas, means = zip(*sorted(points, key=lambda point: point[0]), strict=True)
    value, lower, upper = (
        np.array([float(getattr(mean.estimate, end)) for mean in means])
        for end in ("value", "lower", "upper")
    )
    return AlphaLine(
        task=task,
        entropic_index=entropic_index,
        others=others,
        means=means,
        alphas=np.array(alphas),
        estimate=Estimate(value=value, lower=lower, upper=upper),
    )
