"""Claims of a study: tests of hypotheses that were planned before the runs, and of later ones.

Each condition's runs give a score for each seed, which comparisons take seed by seed
(:mod:`~music_rllib.results.claims.contrasts`). Planned comparisons are one family for Holm's
correction, all others that are shown another: looking afterwards costs the plan nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from music_rllib import names
from music_rllib.config.analysis import Hypothesis
from music_rllib.results import statistics as st
from music_rllib.results.claims.contrasts import Contrast, Verdict, contrast, decide
from music_rllib.results.claims.match import alike_in_the_rest, in_words, matching
from music_rllib.results.claims.plan import MARGIN_OF_A_RATE, PlanVersion
from music_rllib.results.claims.scores import Measure, Scores, ended_first, measure_on, scores_of
from music_rllib.results.comparison import ALL_TASKS
from music_rllib.results.conditions import SEEDS, Condition, Stage, find_stages
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array, Estimate

Cells = Sequence[tuple[Condition, Condition]]
"""Pairs of conditions that are alike in the rest."""

MOST_CONDITIONS = 6
"""Number of conditions up to which each is compared with each; more, with a reference."""
FEWEST_SHARED = 2
"""Least number of shared seeds for a comparison in pairs."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """One condition against another on a task, tested."""

    first: str
    second: str
    task: str
    """The task, or `ALL_TASKS` for their mean."""
    measure: Measure
    margin: float | None
    """Difference below which it does not matter; None where none was stated."""
    contrast: Contrast
    pairs: Cells = field(repr=False)
    """Pairs of conditions, alike in the rest, over which it is the mean."""
    p_value: float = 1.0
    """Adjusted p-value of no difference; it and the fields below are set by :func:`_decided`."""
    p_equivalent: float | None = None
    """Adjusted p-value of no equivalence; None without a margin."""
    verdict: Verdict = Verdict.UNDECIDED
    planned: bool = False
    """Whether it was stated before the first of its runs had finished."""
    hypothesis: Hypothesis | None = None

    @property
    def subject(self) -> tuple[object, ...]:
        """What it is about: two claims on the same subject differ in nothing but the plan."""
        pairs = frozenset(frozenset(pair) for pair in self.pairs)
        return pairs, self.task, self.measure.kind, self.measure.metric

    @property
    def p_of_verdict(self) -> float:
        """The adjusted p-value of the test that the verdict comes from."""
        if self.verdict is Verdict.EQUIVALENT and self.p_equivalent is not None:
            return self.p_equivalent
        return self.p_value

    @property
    def confirmed(self) -> bool | None:
        """Whether its hypothesis holds; None where that is undecided or nothing was expected."""
        expected = {
            "better than": Verdict.SUPERIOR,
            "worse than": Verdict.WORSE,
            "equivalent to": Verdict.EQUIVALENT,
        }.get(self.hypothesis.relation if self.hypothesis else "against")
        if expected is None or self.verdict is Verdict.UNDECIDED:
            return None
        return self.verdict is expected


@dataclass(frozen=True, kw_only=True)
class Mean:
    """A condition's primary metric on a task."""

    condition: Condition
    task: str
    measure: Measure
    estimate: Estimate
    scores: Scores = field(repr=False)
    runs: int
    """Number of runs that are planned or begun; the finished ones have scores."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """All claims of one stage and of the hypotheses."""

    stage: Stage | None
    """None where no run has begun."""
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
            task: replace(measure_on(sweep, task, _runs(chosen), kind, metric), maximised=maximised)
            for task in chosen.tasks
        }
        means += _means(sweep, chosen, measures)
        seen = {claim.subject for claim in (*planned, *afterwards)}
        pairs = [(label_of(x), label_of(y), [(x, y)]) for x, y in _pairs(chosen.compared)]
        afterwards += [
            claim for claim in _claims(sweep, pairs, measures, margin) if claim.subject not in seen
        ]
    about = [stages[name] for name in (plan.plan.stages if plan else ()) if name in stages]
    family = len(planned) + without_test if plan else len(afterwards)
    return Study(
        stage=chosen,
        plan=plan,
        latest=latest,
        means=tuple(means),
        planned=_decided(planned, planned=True, without_test=without_test),
        afterwards=_decided(afterwards, planned=False),
        untested=tuple(dict.fromkeys(untested)),
        family=family,
        runs=tuple({run: None for stage in filter(None, [chosen, *about]) for run in _runs(stage)}),
    )


def _runs(stage: Stage) -> list[int]:
    """The runs of a stage's conditions that may be compared."""
    return [run for condition in stage.compared for run in condition.runs]


def _planned(sweep: Sweep, stages: Mapping[str, Stage]) -> PlanVersion | None:
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
    stages: Mapping[str, Stage],
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
            task: _as_planned(measure_on(sweep, task, runs, version.plan.metric), task, version)
            for task in dict.fromkeys(sweep.runs[run].task for run in runs)
        }
        labelled = (in_words(hypothesis.first), in_words(hypothesis.second), cells)
        claims = list(_claims(sweep, [labelled], measures, version.plan.margin))
        if not claims:
            untested.append(f"{text}: no seed has finished in both conditions")
        yield from (replace(claim, hypothesis=hypothesis) for claim in claims)


def _as_planned(measure: Measure, task: str, version: PlanVersion) -> Measure:
    """The measure over no more than the budget that was planned."""
    return replace(measure, horizon=min(measure.horizon, version.plan.budget.get(task, np.inf)))


def _claims(
    sweep: Sweep,
    comparisons: Sequence[tuple[str, str, Cells]],
    measures: Mapping[str, Measure],
    margin: float | None,
) -> Iterator[Claim]:
    """Undecided claims over all tasks, and on each, of two labels and the cells that they name."""
    for scope, own in _scopes(measures):
        measure, *others = own.values()
        if any(other.horizon != measure.horizon for other in others):
            measure = replace(measure, horizon=np.nan)
        is_success = measure.metric == names.EVAL_SUCCESS
        own_margin = MARGIN_OF_A_RATE if margin is None and is_success else margin
        for first, second, cells in comparisons:
            columns = [
                [scores_of(sweep, pair[side], task, m) for pair in cells for task, m in own.items()]
                for side in (0, 1)
            ]
            tested = _contrast(*columns, is_rate=measure.is_rate, margin=own_margin)
            if tested is not None:
                yield Claim(
                    first=first,
                    second=second,
                    task=scope,
                    measure=measure,
                    margin=own_margin,
                    contrast=tested,
                    pairs=cells,
                )


def _scopes(measures: Mapping[str, Measure]) -> Iterator[tuple[str, Mapping[str, Measure]]]:
    """All tasks together, where they have a unit in common, and each by itself."""
    if len(measures) > 1 and all(one.is_rate for one in measures.values()):
        yield ALL_TASKS, measures
    for task, one in measures.items():
        yield task, {task: one}


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


def _contrast(
    first: Sequence[Scores], second: Sequence[Scores], *, is_rate: bool, margin: float | None
) -> Contrast | None:
    """The contrast of two sides; None where one has no seed that has finished everywhere.

    Args:
        first: scores on each task of each of several pairs that are alike in the rest.
        second: scores of the other side.
        is_rate: whether they are rates, whose episodes tell how sure seeds that tie are.
        margin: difference below which it does not matter.
    """
    sides = [_complete(first), _complete(second)]
    if not (sides[0] and sides[1]):
        return None
    shared = [seed for seed in sides[0] if seed in sides[1]]
    paired = len(shared) >= FEWEST_SHARED and 2 * len(shared) >= max(map(len, sides))
    if paired:
        sides = [{seed: side[seed] for seed in shared} for side in sides]
    matrices = [np.array(list(side.values())) for side in sides]
    apart = None
    if is_rate:
        episodes = [float(np.mean([one.episodes for one in side])) for side in (first, second)]
        apart = st.difference(*map(st.estimate, matrices, episodes))
    x, y = (matrix.mean(axis=1) for matrix in matrices)
    return contrast(x, y, paired=paired, margin=margin, apart=apart)


def _complete(columns: Sequence[Scores]) -> dict[str, Array]:
    """The scores of each seed that has finished in every column."""
    seeds = [seed for seed in columns[0].by_seed if all(seed in c.by_seed for c in columns)]
    return {seed: np.array([c.by_seed[seed] for c in columns]) for seed in seeds}


def _decided(claims: Sequence[Claim], *, planned: bool, without_test: int = 0) -> tuple[Claim, ...]:
    """The claims with adjusted p-values and verdicts, as one family with those without a test."""
    opposite = {Verdict.SUPERIOR: Verdict.WORSE, Verdict.WORSE: Verdict.SUPERIOR}
    return tuple(
        replace(
            claim,
            p_value=p_value,
            p_equivalent=p_equivalent,
            verdict=verdict if claim.measure.maximised else opposite.get(verdict, verdict),
            planned=planned,
        )
        for claim, (p_value, p_equivalent, verdict) in zip(
            claims, decide([claim.contrast for claim in claims], without_test), strict=True
        )
    )


def _means(sweep: Sweep, stage: Stage, measures: Mapping[str, Measure]) -> Iterator[Mean]:
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
