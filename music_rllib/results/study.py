"""The study of a sweep: planned hypotheses with verdicts, and comparisons outside the plan.

The planned comparisons are one family, and only they have verdicts. Without a plan, all pairs of
conditions are the family. Other comparisons are exploratory: they have a difference, an interval
and an unadjusted p-value.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np

from music_rllib import names
from music_rllib.config.schema import Hypothesis
from music_rllib.experiment.plan import Plan
from music_rllib.results import statistics as st
from music_rllib.results.analysis_plan import AnalysisPlan, PlannedHypothesis, PlanVersion
from music_rllib.results.claims import Claim, claims_of, decided, exploratory
from music_rllib.results.conditions import (
    Condition,
    StageRuns,
    find_stages,
    matching,
    pairs_of,
    pairs_of_hypothesis,
    settings_in_words,
    stages_together,
)
from music_rllib.results.data import LastValues, Sweep
from music_rllib.results.scores import Measure, Scores, counted, first_result, measure_on, scores_of
from music_rllib.results.statistics import Estimate


@dataclass(frozen=True, kw_only=True)
class Mean:
    """Mean score of a condition on a task."""

    condition: Condition
    task: str
    measure: Measure
    estimate: Estimate
    scores: Scores = field(repr=False)
    runs: int


@dataclass(frozen=True, kw_only=True)
class Study:
    """Mean scores of the conditions of one stage, and all comparisons with their verdicts."""

    stage: StageRuns | None
    """None before a run has started, and without a stage that trains for the task."""
    plan: PlanVersion | None
    """The last version that planned a hypothesis in time; None without one."""
    before: Mapping[PlannedHypothesis, PlanVersion]
    """Hypotheses that an earlier version planned in time, and this version."""
    latest: PlanVersion | None
    means: tuple[Mean, ...]
    planned: tuple[Claim, ...]
    """Claims of the hypotheses that were planned in time."""
    unplanned: tuple[Claim, ...]
    """Other claims: late hypotheses, planned ones with a later metric or margin, other pairs."""
    late: tuple[str, ...]
    """Hypotheses of `latest` that were not planned in time."""
    dropped: tuple[str, ...]
    """Hypotheses that were planned in time, and that `latest` lacks since their results."""
    untested: tuple[str, ...]
    """Hypotheses that can't be tested, with the reason."""
    runs: tuple[int, ...]
    """Positions in `Sweep.runs` of the runs that may be compared, in the stage and in `plan`."""
    family: int
    """Number of comparisons for which p-values are adjusted, with those that can't be tested."""

    @property
    def question(self) -> str | None:
        """The question of the plan, or its hypotheses without one; None without a plan."""
        version = self.plan or self.latest
        if version is None:
            return None
        return version.plan.question or "; ".join(version.plan.hypotheses)

    @property
    def claims(self) -> tuple[Claim, ...]:
        """The claims that answer the question: the planned ones, or all without a plan.

        While no planned claim can be tested, there are none.
        """
        return self.planned if self.plan is not None else self.unplanned


def study_of(
    sweep: Sweep, stage: str | None = None, *, metric: str | None = None, maximised: bool = True
) -> Study:
    """Test the planned hypotheses, and compare the other conditions of a stage.

    Args:
        sweep: The runs.
        stage: Stage of the comparisons outside the plan; None: the plan's, or the last stage that
            trains for the task. If this one has a single condition, all stages of the plan.
        metric: Metric of the comparisons outside the plan; None: each task's primary one.
        maximised: Whether higher values of `metric` are better.
    """
    stages = {found.name: found for found in find_stages(sweep)}
    latest = sweep.plans[-1] if sweep.plans else None
    of_plans = _PlannedClaims(sweep, stages)
    in_time, planned = of_plans.in_time, of_plans.claims
    plan = max(in_time.values(), key=lambda one: one.recorded_ms, default=None)
    chosen, pairs = _chosen(stages, stage, latest)
    without_test, unplanned = of_plans.without_test, list(of_plans.others)
    means: list[Mean] = []
    if chosen is not None:
        kind, margin = "auc", None
        if latest is not None and metric is None:
            kind, margin = latest.plan.metric, latest.plan.margin
        counted_sweep = counted(sweep, kind)
        measures = {
            task: measure_on(
                counted_sweep, task, chosen.compared_runs, kind, metric, maximised=maximised
            )
            for task in chosen.tasks
        }
        means += _means(counted_sweep, chosen, measures)
        labelled = [(x.short_label, y.short_label, [(x, y)]) for x, y in pairs]
        known_subjects = {claim.subject for claim in (*planned, *unplanned)}
        of_stage = list(claims_of(counted_sweep, labelled, measures, margin))
        unplanned += [claim for claim in of_stage if claim.subject not in known_subjects]
        if plan is None:
            rates = {measure.metric for measure in measures.values()}
            without_test = len(pairs) * _number_of_scopes(chosen.tasks, rates) - len(of_stage)
    late = [one for one in latest.plan.planned if one not in in_time] if latest else []
    names_of_plan = {name for one in (*in_time, *late) for name in one.stages}
    of_plan = [found for name, found in stages.items() if name in names_of_plan]
    compared = [run for one in filter(None, [chosen, *of_plan]) for run in one.compared_runs]
    return Study(
        stage=chosen,
        plan=plan,
        before={key: one for key, one in in_time.items() if one is not plan},
        latest=latest,
        means=tuple(means),
        late=tuple(one.text for one in late),
        dropped=tuple(
            _in_full(key.text, one, latest).text
            for key, one in in_time.items()
            if latest is not None and key not in latest.plan.planned
        ),
        planned=decided(planned, planned=True, without_test=without_test),
        unplanned=(
            exploratory(unplanned)
            if plan
            else decided(unplanned, planned=False, without_test=without_test)
        ),
        untested=tuple(of_plans.untested),
        family=len(planned if plan else unplanned) + without_test,
        runs=tuple(dict.fromkeys(compared)),
    )


def _chosen(
    stages: dict[str, StageRuns], stage: str | None, latest: PlanVersion | None
) -> tuple[StageRuns | None, list[tuple[Condition, Condition]]]:
    """The stage of the comparisons outside the plan, and its pairs of conditions."""
    chosen = stages.get(stage or (latest.plan.stage if latest else ""))
    if chosen is None and stage is None:
        chosen = next((s for s in reversed(stages.values()) if s.has_task_reward), None)
    pairs = pairs_of(chosen.compared) if chosen else []
    if latest and not pairs and stage in (None, latest.plan.stage):
        of_hypotheses = [found for name, found in stages.items() if name in latest.plan.stages]
        chosen = stages_together(of_hypotheses) or chosen
    return chosen, pairs


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


class _PlannedClaims:
    """The undecided claims about the hypotheses of a sweep's plans."""

    in_time: dict[PlannedHypothesis, PlanVersion]
    """The hypotheses that were planned, with the version by which they are tested: the last one
    before the first result of their stages. A hypothesis that it lacks was withdrawn in time, or
    came too late."""
    claims: list[Claim]
    """Claims of the hypotheses in `in_time`."""
    without_test: int
    """Number of their comparisons that can't be tested."""
    others: list[Claim]
    """Claims of the last version that are late, or were planned with another test or fewer
    steps."""
    untested: dict[str, int]
    """Hypotheses that can't be tested, with the reason, and their number of comparisons."""

    def __init__(self, sweep: Sweep, stages: Mapping[str, StageRuns]) -> None:
        self._sweep = sweep
        self._stages = stages
        self.in_time = {
            one: version
            for key in dict.fromkeys(key for one in sweep.plans for key in one.plan.planned)
            for version in self._before_results(key)[-1:]
            for one in version.plan.planned
            if one == key
        }
        self.untested = {}
        self.claims = []
        for version in sweep.plans:
            own = [key for key, planned_by in self.in_time.items() if planned_by is version]
            self.claims += self._claims(version, own)
        self.without_test = sum(self.untested.values())
        self.others = [claim for latest in sweep.plans[-1:] for claim in self._outside(latest)]

    def _before_results(self, key: PlannedHypothesis, task: str | None = None) -> list[PlanVersion]:
        """The versions from before the first result of its stages, on a task or on any."""
        sweep, stages = self._sweep, key.stages & self._stages.keys()
        runs = (run for name in stages for run in self._stages[name].runs)
        time = first_result(sweep, (run for run in runs if task in (None, sweep.runs[run].task)))
        return [version for version in sweep.plans if version.recorded_ms < time]

    def _outside(self, latest: PlanVersion) -> Iterator[Claim]:
        before = {one: self.in_time.get(one) for one in latest.plan.planned}
        late = [one for one, by in before.items() if by is None]
        why = "exploratory: runs of it had finished before the plan" if self.in_time else ""
        for claim in self._claims(latest, late):
            yield replace(claim, why=why)
        again = [one for one, by in before.items() if by and not latest.plan.has_same_test(by.plan)]
        yield from self._claims(latest, again)
        longer = [one for one, by in before.items() if by and self._is_longer(latest, by, one)]
        known = [_result(claim) for claim in self.claims]
        for claim in self._claims(latest, longer):
            if _result(claim) not in known:
                yield replace(claim, why="exploratory: over more steps than planned")

    def _is_longer(self, latest: PlanVersion, before: PlanVersion, key: PlannedHypothesis) -> bool:
        """Whether `latest` has the same test over more steps of a task, and no fewer of another."""
        tasks = _tasks_of_all(self._sweep, key.stages, before.plan.budget.keys())
        # Areas end at the same steps in all stages, final values at those of their own.
        groups = [[one] for one in key.stages] if latest.plan.metric == "final" else [key.stages]
        steps = [
            (latest.plan.steps(group, task), planned.steps(group, task))
            for task in tasks & latest.plan.budget.keys()
            for planned in [self._plan_on(task, before, key)]
            if task in planned.budget
            for group in groups
        ]
        more = any(own > planned for own, planned in steps)
        none_fewer = all(own >= planned for own, planned in steps)
        return latest.plan.has_same_test(before.plan) and more and none_fewer

    def _plan_on(self, task: str, version: PlanVersion, key: PlannedHypothesis) -> AnalysisPlan:
        """The plan whose steps count on a task.

        If the task was added later, it is the last one before the results there.
        """
        if task in version.plan.budget:
            return version.plan
        added = [
            one.plan
            for one in self._before_results(key, task)
            if one.plan.metric == version.plan.metric
            and task in one.plan.budget
            and key.stages <= one.plan.stages
        ]
        return added[-1] if added else version.plan

    def _claims(
        self, version: PlanVersion, hypotheses: Sequence[PlannedHypothesis]
    ) -> Iterator[Claim]:
        """The claims of some of a version's hypotheses; adds to `untested`."""
        plan = version.plan
        sweep = counted(self._sweep, plan.metric) if hypotheses else self._sweep
        for key in hypotheses:
            hypothesis = _in_full(key.text, version, sweep.plans[-1])
            tasks = _tasks_of_all(sweep, key.stages, plan.budget.keys())
            scopes = _number_of_scopes(tasks, {sweep.primary_metric(task) for task in tasks})
            sides = (hypothesis.first, hypothesis.second)
            # `counted` changes the runs' env_steps, which a hypothesis can name.
            first, second = (matching(self._sweep, self._stages, one, plan.stage) for one in sides)
            pairs = pairs_of_hypothesis(first, second, hypothesis)
            if isinstance(pairs, str):
                self.untested[f"{hypothesis.text}: {pairs}"] = scopes
                continue
            runs = [run for pair in pairs for condition in pair for run in condition.runs]
            plans = {task: self._plan_on(task, version, key) for task in tasks}
            steps = {task: plans[task].steps(key.stages, task) for task in tasks}
            measures = {
                task: measure_on(
                    sweep,
                    task,
                    runs,
                    plan.metric,
                    horizon=steps[task],
                    until=self._ends(sweep, plans[task], key, task),
                )
                for task in dict.fromkeys(sweep.runs[run].task for run in runs)
                if task in tasks
            }
            searched = any(names.TAG_PART in sweep.runs[run].tags for run in runs)
            if not searched and any(
                one.horizon < steps[task] < np.inf for task, one in measures.items()
            ):
                reason = "its runs have fewer env_steps than planned"
                self.untested[f"{hypothesis.text}: {reason}"] = scopes
                continue
            first_label, second_label = map(settings_in_words, sides)
            labelled = (first_label, second_label, pairs)
            claims = list(claims_of(sweep, [labelled], measures, plan.margin, plan.seed_count))
            if len(claims) < scopes:
                left = sorted(tasks - {claim.task for claim in claims})
                where = f" on {', '.join(left)}" if left else " over all tasks"
                where = f"{where if claims else ''}: no seed has finished in both conditions"
                self.untested[f"{hypothesis.text}{where}"] = scopes - len(claims)
            yield from (replace(claim, hypothesis=hypothesis) for claim in claims)

    def _ends(
        self, sweep: Sweep, plan: AnalysisPlan, key: PlannedHypothesis, task: str
    ) -> dict[str, float]:
        """By stage, the steps of final values; empty if no stage has more steps than planned."""
        found = [self._stages[name] for name in key.stages & self._stages.keys()]
        if len(plan.stages) > 1 and not plan.more_steps:
            # Plans of earlier versions of the package do not have the steps of each stage.
            tags = (sweep.runs[run].tags for stage in found for run in stage.runs)
            if not any(names.TAG_EARLIER_RESULT in own for own in tags):
                return {}
        ends = {}
        for stage in found:
            planned = plan.steps([stage.name], task)
            least = sweep.least_budget(task, stage.compared_runs)
            ends[stage.name] = planned if planned < least < np.inf else np.inf
        return ends if any(map(np.isfinite, ends.values())) else {}


def _result(claim: Claim) -> tuple[object, ...]:
    """What a claim compares, with the difference: words about several tasks do not name steps."""
    return claim.subject, claim.measure.words, str(claim.contrast.difference.value)


def _tasks_of_all(sweep: Sweep, stages: Collection[str], planned: Set[str]) -> Set[str]:
    """The tasks that all stages have, or will have: runs that have not begun may be unknown."""
    unknown = planned - {run.task for run in sweep.runs}
    known = [{run.task for run in sweep.runs if run.stage == stage} for stage in stages]
    return frozenset[str].intersection(*(frozenset(one or planned) | unknown for one in known))


def _in_full(text: str, version: PlanVersion, latest: PlanVersion | None) -> Hypothesis:
    """The hypothesis, with the default stage of its version if a later one has another."""
    hypothesis, stage = Hypothesis.of(text), version.plan.stage
    if latest is None or stage == latest.plan.stage:
        return hypothesis
    sides = [
        ", ".join(f"{k} = {v}" for k, v in {"stage": stage, **side}.items())
        for side in hypothesis.sides
    ]
    return Hypothesis.of(f"{sides[0]} {hypothesis.relation} {sides[1]}")


def _number_of_scopes(tasks: Collection[str], metrics: Collection[str]) -> int:
    """Number of comparisons of two conditions: on each task, and on all if they have rates."""
    return len(tasks) + (len(tasks) > 1 and names.EVAL_RATES.issuperset(metrics))


def untestable(planned: Plan, plan: AnalysisPlan) -> Iterator[str]:
    """The hypotheses that no results of the planned runs can test, with the reason.

    Those about a search are left out: its runs on fresh seeds are not known yet.
    """
    sweep = LastValues(planned).sweep({})
    stages = {found.name: found for found in find_stages(sweep)}
    searched = {stage.name for stage in planned.searched}
    for key in plan.planned:
        if key.stages & searched:
            continue
        hypothesis = Hypothesis.of(key.text)
        first, second = (matching(sweep, stages, side, plan.stage) for side in hypothesis.sides)
        for side, settings in zip((first, second), hypothesis.sides, strict=True):
            if not side:
                yield f"{key.text}: no condition of its own has {settings_in_words(settings)}"
                break
        else:
            pairs = pairs_of_hypothesis(first, second, hypothesis)
            if isinstance(pairs, str):
                yield f"{key.text}: {pairs}"
