"""A study in sentences and as rows: for the report, `compare`, the results pages and CSV files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from music_rllib import names
from music_rllib.results.analysis_plan import AnalysisPlan, PlannedHypothesis, is_controlled
from music_rllib.results.claims import FEWEST_SEEDS, Claim, Verdict
from music_rllib.results.conditions import ALL_TASKS, MOST_CONDITIONS, Condition
from music_rllib.results.data import Sweep
from music_rllib.results.scores import has_failed
from music_rllib.results.statistics import (
    MAX_SEEDS,
    SIGNIFICANCE,
    Estimate,
    difference_text,
    interval_text,
    number,
    p_text,
    seeds_needed,
    value_text,
)
from music_rllib.results.study import Mean, Study

MOST_CLAIMS = 4
"""Number of claims with a sentence of their own; the others are in the table."""
FEWEST_FOR_SPREAD = 3
"""Smallest number of seeds whose spread counts; the spread of two can be ten times too small."""


def answer(sweep: Sweep, study: Study) -> list[str]:
    """At most eleven sentences: question, verdicts, metric, seeds and control."""
    planned = planned_in_words(study)
    sentences = [f"{planned[0].upper()}{planned[1:]}."]
    if study.question is not None:
        sentences = [f"Question: {study.question} ({planned})."]
    if reason := _without_result(sweep, study):
        return [*sentences, reason]
    shown = [claim for claim in study.claims if claim.task == ALL_TASKS] or list(study.claims)
    sentences += [f"{claim_in_words(claim)}." for claim in shown[:MOST_CLAIMS]]
    if not shown and study.unplanned:
        sentences.append(
            "No planned comparison can be tested yet; the table has the exploratory ones."
        )
    elif not shown:
        sentences.append(_single_means(study.means))
    if rest := [claim for claim in study.claims if claim not in shown[:MOST_CLAIMS]]:
        counts = Counter(str(claim.verdict) for claim in rest)
        verdicts = ", ".join(f"{n} {verdict}" for verdict, n in counts.items())
        sentences.append(f"Further comparisons: {verdicts}.")
    sentences += [_metric(study, shown), _seeds(sweep, study, shown)]
    sentences.append(f"Control: {_control(sweep, study)}.")
    undecided = (Verdict.UNDECIDED, Verdict.NONE)
    alike = _alike(shown)
    own = (claim for claim in study.claims if not alike or _test_of(claim) == _test_of(alike[0]))
    if any(claim.verdict in undecided and not claim.unfinished for claim in own):
        means = [one for one in study.means if _is_alike(one, alike)]
        sentences += filter(None, [power_in_words(alike, means, study.family)])
    return [*sentences, *(f"Not tested: {text}." for text in study.untested[:1])]


def _without_result(sweep: Sweep, study: Study) -> str | None:
    """Why there is nothing to compare; None if a run has a result."""
    if any(mean.scores.finished for mean in study.means):
        return None
    results = (sweep.runs[i].is_finished and not has_failed(sweep, i) for i in study.runs)
    if study.claims and any(results):
        return None
    if study.stage is None and any(run.status != "SCHEDULED" for run in sweep.runs):
        return "No stage trains for the task: no comparison."
    if study.runs and all(sweep.runs[run].status in ("FINISHED", "FAILED") for run in study.runs):
        if not all(has_failed(sweep, run) for run in study.runs):
            return "No finished run has reported the metric."
        return f"No run has a result: {len(study.runs)} failed or diverged."
    if study.stage is not None and study.stage.is_search:
        why = "trials are not compared on the seeds that select them"
        return f"No run on fresh seeds has finished: {why}."
    return "No run that may be compared has finished yet."


def planned_in_words(study: Study) -> str:
    """Whether there was a plan before the results."""
    plan, latest = study.plan, study.latest
    if plan is not None:
        first = "the first run of each new hypothesis" if study.before else "its first run"
        text = (
            f"planned {plan.recorded}, before {first} finished; version {plan.version}, "
            f"hash {plan.hash[:12]}"
        )
        for number, count in Counter(one.version for one in study.before.values()).items():
            text += f"; {count} already in version {number}"
        if study.late:
            text += f"; not planned, because runs of it had finished: {', '.join(study.late)}"
        if study.dropped:
            text += f"; dropped after results: {', '.join(study.dropped)}"
        changed: list[str] = []
        if latest is not None:
            changed += _changed(plan.plan, latest.plan)
            for hypothesis, one in study.before.items():
                changed += _changed_tests(hypothesis, one.plan, latest.plan)
        names_of_fields = ", ".join(dict.fromkeys(changed))
        return f"{text}; changed afterwards: {names_of_fields}" if changed else text
    if latest is not None:
        return f"recorded {latest.recorded}, after the first run had finished: not planned"
    which = "all pairs of conditions are compared"
    if study.stage is not None and len(study.stage.compared) > MOST_CONDITIONS:
        which = "each condition is compared with a reference"
    return f"no comparison was planned in advance: {which}"


def _changed(before: AnalysisPlan, after: AnalysisPlan) -> list[str]:
    """Fields that a later version of a plan has changed, such as the seeds."""
    known, now = before.model_dump(), after.model_dump()
    return [name.replace("_", " ") for name in known if known[name] != now[name]]


def _changed_tests(
    hypothesis: PlannedHypothesis, before: AnalysisPlan, after: AnalysisPlan
) -> Iterator[str]:
    """What a later version changes in the test of a hypothesis; further stages change nothing."""
    if any(before.seeds_of(stage) != after.seeds_of(stage) for stage in hypothesis.stages):
        yield "seeds"
    yield from (
        name for name in ("metric", "margin") if getattr(before, name) != getattr(after, name)
    )


def claim_in_words(claim: Claim) -> str:
    """`q = 1.5 against q = 1 on FetchPush: superior, +0.12 (95% CI 0.05 to 0.19; p = 0.002)`."""
    where = "over all tasks" if claim.task == ALL_TASKS else f"on {claim.task}"
    count = len(claim.pairs)
    mean = f", averaged over the {count} settings that both have" if count > 1 else ""
    held = {True: ", as expected", False: ", not as expected", None: ""}[claim.confirmed]
    return (
        f"{claim.first} against {claim.second} {where}{mean}: {verdict_in_words(claim)}, "
        f"{numbers_in_words(claim)}{held}{not_excluded(claim)}"
    )


def verdict_in_words(claim: Claim) -> str:
    """`equivalent within 0.05`, or the reason for having no verdict."""
    if claim.verdict is Verdict.EQUIVALENT:
        return f"equivalent within {claim.margin:g}"
    return claim.why if claim.verdict is Verdict.NONE else str(claim.verdict)


def not_excluded(claim: Claim) -> str:
    """The rate of collapses that a verdict does not exclude; empty if it is small."""
    if claim.collapses is None:
        return ""
    return f"; collapses in up to {100 * claim.collapses:.0f}% of seeds are not excluded"


def interval_in_words(claim: Claim) -> str:
    """The interval that belongs to the verdict: `95% CI 0.05 to 0.19`."""
    if claim.verdict is Verdict.EQUIVALENT:
        return f"90% CI {interval_text(claim.contrast.within)}"
    return mean_interval(claim.contrast.difference)


def p_in_words(claim: Claim) -> str:
    """The p-value of the verdict and the one adjusted for the family; empty without a test.

    The p-value of an equivalence test is named: `TOST p = 0.01, adjusted 0.03`.
    """
    raw, adjusted, name = claim.contrast.p_value, claim.p_value, ""
    if claim.verdict is Verdict.EQUIVALENT and claim.contrast.p_equivalent is not None:
        raw, adjusted, name = claim.contrast.p_equivalent, claim.p_equivalent, "TOST "
    if min(claim.contrast.seeds) < FEWEST_SEEDS or not claim.contrast.difference.has_interval:
        return ""
    if claim.verdict is Verdict.NONE:
        return "" if claim.p_value is not None else f"unadjusted {p_text(float(raw))}"
    own, family = p_text(float(raw)), p_text(float(raw) if adjusted is None else adjusted)
    more = "" if own == family else f", adjusted {family.removeprefix('p = ')}"
    return f"{name}{own}{more}"


def numbers_in_words(claim: Claim) -> str:
    """`+0.12 (95% CI 0.05 to 0.19; p = 0.002)`."""
    is_equivalent = claim.verdict is Verdict.EQUIVALENT
    gap = difference_text(claim.contrast.within if is_equivalent else claim.contrast.difference)
    return f"{gap} ({'; '.join(filter(None, (interval_in_words(claim), p_in_words(claim))))})"


def _single_means(means: Sequence[Mean]) -> str:
    """The results of conditions of which no two can be compared on a task."""
    tasks = dict.fromkeys(mean.task for mean in means)
    start = "Only one condition has a result"
    if len({mean.condition for mean in means}) > 1:
        start = "No two conditions have results on the same task"
    texts = (
        f"{mean.condition.short_label}{f' on {mean.task}' if len(tasks) > 1 else ''}, "
        f"{mean.measure.words} {value_text(mean.estimate)} ({mean_interval(mean.estimate)})"
        for mean in means[:MOST_CLAIMS]
    )
    return f"{start}: {'; '.join(texts)}."


def _metric(study: Study, shown: Sequence[Claim]) -> str:
    tasks: dict[str, dict[str, None]] = {}
    for one in shown or study.means:
        area = " (area under the learning curve)" if one.measure.kind != "final" else ""
        tasks.setdefault(f"{one.measure.words}{area}", {})[one.task] = None
    several = len(tasks) > 1
    text = "Metric: " + "; ".join(
        f"{words} on {' and '.join(of)}" if several else words for words, of in tasks.items()
    )
    # A margin of success rates does not apply to returns.
    margins = {one.margin for one in shown if _is_alike(one, shown) and one.margin is not None}
    if margins:
        text += f"; equivalence margin {' or '.join(f'{margin:g}' for margin in sorted(margins))}"
    if study.family > 1:
        text += f"; p-values adjusted for {study.family} comparisons (Holm)"
    return f"{text}."


def _is_alike(one: Claim | Mean, shown: Sequence[Claim]) -> bool:
    return not shown or one.measure.metric == shown[0].measure.metric


def _test_of(claim: Claim) -> tuple[str, str, float | None]:
    """What two claims have in common whose seeds needed are one number."""
    return claim.measure.metric, claim.measure.kind, claim.margin


def _alike(shown: Sequence[Claim]) -> list[Claim]:
    """The claims with the test of the first one."""
    return [claim for claim in shown if _test_of(claim) == _test_of(shown[0])]


def _seeds(sweep: Sweep, study: Study, shown: Sequence[Claim]) -> str:
    finished = sum(sweep.runs[run].is_finished for run in study.runs)
    metrics = {mean.task: mean.measure.metric for mean in study.means}
    ends = [run for run in study.runs if has_failed(sweep, run, metrics.get(sweep.runs[run].task))]
    counts = sorted({n for one in shown for n in one.contrast.seeds})
    if not counts:
        counts = sorted({len(one.scores.by_seed) for one in study.means})
    text = f"Seeds: {' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} per condition"
    if counts[-1] < 2:
        text += ", too few for an interval or a test"
    elif shown:
        paired = all(one.contrast.paired for one in shown)
        text += ", paired" if paired else ", not all shared between conditions"
    if study.stage is not None and study.stage.is_search:
        text += ", not used for selection"
    text += f"; {finished} of {len(study.runs)} runs finished."
    if ends:
        how = "failed or diverged" if any(sweep.runs[run].is_finished for run in ends) else "failed"
        runs = "run counts" if len(ends) == 1 else "runs count"
        text += f" {len(ends)} {how} {runs} with the worst value of the metric."
    return text


def _control(sweep: Sweep, study: Study) -> str:
    """What is held equal so that different q can be compared."""
    version, stage = study.plan or study.latest, study.stage
    if version is not None or stage is None:
        return version.plan.control if version else "none"
    of_tasks: dict[str, set[tuple[str, str]]] = {}
    for one in stage.compared:
        for record in (sweep.runs[run] for run in one.runs):
            pair = (one.entropic_index, record.tags.get(names.TAG_ALPHA, ""))
            of_tasks.setdefault(record.task, set()).add(pair)
    alphas = set[tuple[str, str]]().union(*of_tasks.values())
    words = sorted({alpha for _, alpha in alphas})
    if stage.is_search:
        return f"settings were searched on other seeds; α is {', '.join(words)}"
    indices = len({q for q, _ in alphas})
    of_each = {task: sorted({alpha for _, alpha in pairs}) for task, pairs in of_tasks.items()}
    if len(words) > 1 and all(len(own) == 1 for own in of_each.values()):
        texts = ", ".join(f"{own[0]} on {task}" for task, own in of_each.items())
        return f"α of its own for each task: {texts}"
    if len(words) > 1:
        with_q = " with q" if len(alphas) == indices else ""
        return f"α varies{with_q} ({', '.join(words)})"
    if indices == 1 or is_controlled(words[0]):
        return f"α {words[0]}"
    return f"none, one α ({words[0]}) for all: policies of different q differ in entropy"


def power_in_words(claims: Sequence[Claim], means: Sequence[Mean], family: int) -> str | None:
    """How many seeds would decide; None without a margin or a known spread.

    Conditions within the margin of a bound are left out: their seeds differ less than others.
    Holm's method tests the first of `family` comparisons at 0.05 / family.
    """
    margin = max((claim.margin for claim in claims if claim.margin is not None), default=None)
    if margin is None:
        return None
    compared = {one.runs for claim in claims for pair in claim.pairs for one in pair}
    means = [mean for mean in means if mean.condition.runs in compared]
    if means and all(_at_a_bound(mean, margin) for mean in means):
        return (
            f"All conditions are within {margin:g} of a bound, where seeds differ less than "
            "elsewhere: their spread does not show how many seeds are needed."
        )
    # By their runs: of stages side by side, a condition of a mean has the stage, too.
    bounded = {(mean.condition.runs, mean.task) for mean in means if _at_a_bound(mean, margin)}
    tasks = {mean.task for mean in means}

    def is_bounded(side: Iterable[Condition], task: str) -> bool:
        over = tasks if task == ALL_TASKS else {task}
        return all((one.runs, each) in bounded for one in side for each in over)

    clear = [
        claim.contrast
        for claim in claims
        if claim.margin is not None
        and np.isfinite(claim.contrast.spread)
        and min(claim.contrast.seeds) >= FEWEST_FOR_SPREAD
        and not any(is_bounded(side, claim.task) for side in zip(*claim.pairs, strict=True))
    ]
    if not clear:
        return None
    paired = all(contrast.paired for contrast in clear)
    spread = float(np.sqrt(np.mean([float(contrast.spread) ** 2 for contrast in clear])))
    needed = seeds_needed(margin, spread, paired=paired, level=SIGNIFICANCE / family)
    to_detect, to_exclude = map(_seeds_text, needed)
    return (
        f"The standard deviation of {'paired' if paired else 'single-seed'} differences is "
        f"{number(spread)}: for 80% power, a difference of {margin:g} needs "
        f"{to_detect}, and equivalence within it needs "
        f"{to_exclude}."
    )


def mean_interval(estimate: Estimate) -> str:
    """`95% CI 0.62 to 0.81`, or `no interval`."""
    return f"95% CI {interval_text(estimate)}" if estimate.has_interval else "no interval"


def _at_a_bound(mean: Mean, margin: float) -> bool:
    value = float(mean.estimate.value)
    return mean.measure.is_rate and not margin <= value <= 1 - margin


def _seeds_text(needed: int | None) -> str:
    if needed is None:
        return f"more than {MAX_SEEDS} seeds"
    return f"{max(needed, FEWEST_SEEDS)} seeds"


# As rows ------------------------------------------------------------------------------------------


def mean_rows(study: Study) -> list[dict[str, Any]]:
    """The mean score of each condition on each task, with the score of each seed."""
    return [
        {
            "stage": study.stage.name if study.stage else "",
            "task": mean.task,
            "condition": mean.condition.short_label,
            "metric": mean.measure.metric,
            "measure": mean.measure.words,
            "seeds": mean.scores.finished,
            "failed": mean.scores.failed,
            "runs": mean.runs,
            "value": float(mean.estimate.value),
            "lower": float(mean.estimate.lower),
            "upper": float(mean.estimate.upper),
            "by_seed": dict(mean.scores.by_seed),
        }
        for mean in study.means
    ]


def claim_rows(study: Study) -> list[dict[str, Any]]:
    """Every comparison, the planned ones first."""
    return [
        {
            "task": claim.task,
            "first": claim.first,
            "second": claim.second,
            "measure": claim.measure.words,
            "difference": float(claim.contrast.difference.value),
            "lower": float(claim.contrast.difference.lower),
            "upper": float(claim.contrast.difference.upper),
            "lower_90": float(claim.contrast.within.lower),
            "upper_90": float(claim.contrast.within.upper),
            "p_value": float(claim.contrast.p_value),
            "p_value_adjusted": claim.p_value,
            "margin": claim.margin,
            "p_tost": claim.contrast.p_values[1],
            "p_tost_adjusted": claim.p_equivalent,
            "verdict": str(claim.verdict),
            "why": claim.why,
            "collapses_not_excluded": claim.collapses,
            "planned": claim.planned,
            "hypothesis": claim.hypothesis.text if claim.hypothesis else None,
            "as_expected": claim.confirmed,
            "paired": claim.contrast.paired,
            "seeds": list(claim.contrast.seeds),
            "pairs_of_conditions": len(claim.pairs),
        }
        for claim in (*study.planned, *study.unplanned)
    ]


def study_data(study: Study) -> dict[str, Any]:
    """The study as plain data."""
    version = study.plan or study.latest
    plan = None
    if version is not None:
        plan = {name: getattr(version, name) for name in ("version", "recorded", "hash")}
        plan["before_the_first_result"] = study.plan is not None
    return {
        "plan": plan,
        "conditions": mean_rows(study),
        "comparisons": claim_rows(study),
        "not_tested": list(study.untested),
    }
