"""What a sweep's runs say of hypotheses: those planned before the runs, and those thought of since.

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
from music_rllib.results.claims.plan import PlanVersion
from music_rllib.results.claims.scores import Measure, Scores, ended_first, measure_on, scores_of
from music_rllib.results.comparison import ALL_TASKS
from music_rllib.results.conditions import SEEDS, Condition, Stage, find_stages
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array, Estimate

MARGIN = 0.05
"""Of a success rate, where nobody says another."""
MOST_CONDITIONS = 6
"""So many are compared each with each; more of them, each with the reference."""
FEWEST_SHARED = 2
"""Seeds, for pairs."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """One condition against another on a task, tested."""

    first: str
    second: str
    task: str
    """`ALL_TASKS` for their mean."""
    measure: Measure
    margin: float | None
    """Within which a difference does not matter; None: none was stated."""
    contrast: Contrast
    p_value: float
    """Adjusted for what is shown beside it, as is `p_equivalent`."""
    p_equivalent: float | None
    verdict: Verdict
    planned: bool
    """Whether it was stated before the first of its runs had finished."""
    hypothesis: Hypothesis | None = None
    cells: int = 1
    """Pairs of conditions, alike in the rest, over which it is the mean."""

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
    """Planned or begun, of which the finished ones have scores."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """All that is claimed of one stage, and of the hypotheses."""

    stage: Stage | None
    """None where nothing has begun."""
    plan: PlanVersion | None
    """The last version that was there before the first of its runs had finished; None: none was."""
    latest: PlanVersion | None
    means: tuple[Mean, ...]
    planned: tuple[Claim, ...]
    afterwards: tuple[Claim, ...]
    untested: tuple[str, ...]
    """Hypotheses that can't be tested, with the reason."""

    @property
    def question(self) -> str | None:
        """The plan's; its hypotheses where it has none; None without a plan."""
        version = self.plan or self.latest
        if version is None:
            return None
        return version.plan.question or "; ".join(version.plan.hypotheses)

    @property
    def claims(self) -> tuple[Claim, ...]:
        """What answers the study's question: what was planned, or where nothing was, all there is.

        Nothing, while nothing that was planned can be tested: the rest is no substitute for it.
        """
        waits = self.plan is not None and bool(self.plan.plan.hypotheses)
        return self.planned if self.planned or waits else self.afterwards


def study_of(
    sweep: Sweep, stage: str | None = None, *, metric: str | None = None, maximised: bool = True
) -> Study:
    """Test what was planned, and what else there is to compare in a stage.

    Args:
        sweep: its runs, with the metrics that are read.
        stage: of the comparisons that nobody planned; None: the plan's, or the last that trains
            for the task.
        metric: of those; None: each task's primary one.
        maximised: whether more of `metric` is better.
    """
    stages = {one.name: one for one in find_stages(sweep)}
    latest = sweep.plans[-1] if sweep.plans else None
    plan = _planned(sweep, stages)
    chosen = stages.get(stage or (latest.plan.stage if latest else ""))
    if chosen is None and stage is None:
        chosen = next((s for s in reversed(stages.values()) if s.has_task_reward), None)
    untested: list[str] = []
    planned = list(_of_plan(sweep, stages, plan, (), untested)) if plan else []
    known = plan.plan.hypotheses if plan and latest and _same_test(plan, latest) else ()
    later = list(_of_plan(sweep, stages, latest, known, untested)) if latest != plan else []
    measured = {} if chosen is None else _measures(sweep, chosen, metric, maximised)
    margin = latest.plan.margin if latest else None
    seen = {(one.first, one.second, one.task) for one in (*planned, *later)}
    pairs = [] if chosen is None else list(_pairs_of(sweep, chosen, measured, margin))
    pairs = [
        one
        for one in pairs
        if not {(one.first, one.second, one.task), (one.second, one.first, one.task)} & seen
    ]
    return Study(
        stage=chosen,
        plan=plan,
        latest=latest,
        means=() if chosen is None else tuple(_means(sweep, chosen, measured)),
        planned=_decided(planned, planned=True),
        afterwards=_decided([*later, *pairs], planned=False),
        untested=tuple(dict.fromkeys(untested)),
    )


def _planned(sweep: Sweep, stages: Mapping[str, Stage]) -> PlanVersion | None:
    """The last version of the plan that did not know of a result."""
    for version in reversed(sweep.plans):
        runs = [run for name in version.plan.stages for run in _runs(stages, name)]
        if version.recorded_ms < ended_first(sweep, runs):
            return version
    return None


def _runs(stages: Mapping[str, Stage], name: str) -> Sequence[int]:
    return stages[name].runs if name in stages else ()


def _same_test(one: PlanVersion, other: PlanVersion) -> bool:
    return (one.plan.metric, one.plan.margin) == (other.plan.metric, other.plan.margin)


def _of_plan(
    sweep: Sweep,
    stages: Mapping[str, Stage],
    version: PlanVersion | None,
    known: Sequence[str],
    untested: list[str],
) -> Iterator[Claim]:
    """The claims of a plan's hypotheses, but for those that are `known`; not decided yet."""
    for text in version.plan.hypotheses if version else ():
        if version is None or text in known:
            continue
        hypothesis = Hypothesis.of(text)
        first, second = (
            matching(sweep, stages, side, version.plan.stage)
            for side in (hypothesis.first, hypothesis.second)
        )
        cells = alike_in_the_rest(first, second, hypothesis)
        if isinstance(cells, str):
            untested.append(f"{text}: {cells}")
            continue
        found = list(_claims(sweep, cells, version.plan.metric, version.plan.margin, hypothesis))
        if not found:
            untested.append(f"{text}: no seed has finished in both conditions")
        yield from found


def _claims(
    sweep: Sweep,
    cells: Sequence[tuple[Condition, Condition]],
    kind: str,
    margin: float | None,
    hypothesis: Hypothesis,
) -> Iterator[Claim]:
    conditions = [one for pair in cells for one in pair]
    tasks = list(dict.fromkeys(sweep.runs[r].task for one in conditions for r in one.runs))
    runs = [run for one in conditions for run in one.runs]
    measures = {task: measure_on(sweep, task, runs, kind) for task in tasks}
    label = tuple(in_words(side) for side in (hypothesis.first, hypothesis.second))
    for name, own in _scopes(measures):
        columns = [
            [scores_of(sweep, pair[side], task, m) for pair in cells for task, m in own.items()]
            for side in (0, 1)
        ]
        one = _claim(columns, _common(own), margin)
        if one is not None:
            yield replace(
                one,
                first=label[0],
                second=label[1],
                task=name,
                hypothesis=hypothesis,
                cells=len(cells),
            )


def _measures(
    sweep: Sweep, stage: Stage, metric: str | None, maximised: bool
) -> dict[str, Measure]:
    """Of each task, over the smallest budget of what may be compared."""
    runs = [run for one in stage.compared for run in one.runs]
    return {
        task: replace(measure_on(sweep, task, runs, "auc", metric), maximised=maximised)
        for task in stage.tasks
    }


def _scopes(measures: Mapping[str, Measure]) -> Iterator[tuple[str, dict[str, Measure]]]:
    """All tasks together, where they have a unit in common, and each by itself."""
    if len(measures) > 1 and all(one.is_rate for one in measures.values()):
        yield ALL_TASKS, dict(measures)
    for task, one in measures.items():
        yield task, {task: one}


def _common(measures: Mapping[str, Measure]) -> Measure:
    """What a scope's tasks have in common."""
    first, *others = measures.values()
    if all(one.horizon == first.horizon for one in others):
        return first
    return replace(first, horizon=np.nan)


def _pairs_of(
    sweep: Sweep, stage: Stage, measures: Mapping[str, Measure], margin: float | None
) -> Iterator[Claim]:
    for name, own in _scopes(measures):
        for first, second in _pairs(stage.compared):
            columns = [
                [scores_of(sweep, side, task, m) for task, m in own.items()]
                for side in (first, second)
            ]
            one = _claim(columns, _common(own), margin)
            if one is not None:
                yield replace(one, first=label_of(first), second=label_of(second), task=name)


def label_of(condition: Condition) -> str:
    """Without which seeds a search used: only fresh ones are compared."""
    others = tuple(pair for pair in condition.others if pair[0] != SEEDS)
    return replace(condition, others=others).label


def _pairs(conditions: Sequence[Condition]) -> list[tuple[Condition, Condition]]:
    """Each with each, a later one against an earlier one; of many each with its reference.

    The reference is the condition alike in the rest with q = 1, or with the smallest q.
    """
    if len(conditions) <= MOST_CONDITIONS:
        return [(second, first) for first, second in combinations(conditions, 2)]
    indices = [one.entropic_index for one in conditions]
    reference = "1" if "1" in indices else indices[0]
    references = {one.others: one for one in conditions if one.entropic_index == reference}
    return [
        (one, references[one.others])
        for one in conditions
        if one.others in references and one is not references[one.others]
    ]


def _claim(
    columns: Sequence[Sequence[Scores]], measure: Measure, margin: float | None
) -> Claim | None:
    """Two sides, of which each column is a task or one of several alike pairs; not decided yet."""
    if margin is None and measure.metric == names.EVAL_SUCCESS:
        margin = MARGIN
    sides = [_complete(scores) for scores in columns]
    if not (sides[0] and sides[1]):
        return None
    shared = [seed for seed in sides[0] if seed in sides[1]]
    most = max(map(len, sides))
    paired = len(shared) >= FEWEST_SHARED and 2 * len(shared) >= most
    if paired:
        sides = [{seed: side[seed] for seed in shared} for side in sides]
    matrices = [np.array(list(side.values())) for side in sides]
    apart = None
    if measure.is_rate:
        episodes = [np.mean([scores.episodes for scores in side]) for side in columns]
        apart = st.difference(
            *(st.estimate(m, float(n)) for m, n in zip(matrices, episodes, strict=True))
        )
    x, y = (matrix.mean(axis=1) for matrix in matrices)
    return Claim(
        first="",
        second="",
        task="",
        measure=measure,
        margin=margin,
        contrast=contrast(x, y, paired=paired, margin=margin, apart=apart),
        p_value=1.0,
        p_equivalent=None,
        verdict=Verdict.UNDECIDED,
        planned=False,
    )


def _complete(columns: Sequence[Scores]) -> dict[str, Array]:
    """Of each seed that has finished in every column its scores there."""
    seeds = [seed for seed in columns[0].by_seed if all(seed in c.by_seed for c in columns)]
    return {seed: np.array([c.by_seed[seed] for c in columns]) for seed in seeds}


def _decided(claims: Sequence[Claim], *, planned: bool) -> tuple[Claim, ...]:
    opposite = {Verdict.SUPERIOR: Verdict.WORSE, Verdict.WORSE: Verdict.SUPERIOR}
    return tuple(
        replace(
            one,
            p_value=p_value,
            p_equivalent=p_equivalent,
            verdict=verdict if one.measure.maximised else opposite.get(verdict, verdict),
            planned=planned,
        )
        for one, (p_value, p_equivalent, verdict) in zip(
            claims, decide([one.contrast for one in claims]), strict=True
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
