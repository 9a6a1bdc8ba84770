"""The answer at the top of the results page: a sentence and a table of verdicts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from matplotlib.axes import Axes

from docs.result_pages.exports import is_complete, progress_text, sweep_called
from docs.result_pages.totals import AtEqualTotal, at_equal_total
from docs.result_pages.words import percent, row, rule
from music_rllib import names
from music_rllib.report.figures.choice import Drawing
from music_rllib.report.figures.plots import Subplot, differences_subplot
from music_rllib.results.answer import numbers_in_words, verdict_in_words
from music_rllib.results.claims import (
    Claim,
    Contrast,
    Verdict,
    claims_of,
    contrast,
    decided,
    exploratory,
)
from music_rllib.results.data import Sweep
from music_rllib.results.scores import counted
from music_rllib.results.study import Study, study_of

JOINT = "joint entropy, HER alone"
MUSIC = "per-dimension entropy, MUSIC-r"
STUDIES = {
    "joint-music": "joint entropy, MUSIC-r",
    "equal-entropy-fixed": "joint entropy, 1.5 nats by a fixed α, MUSIC-r",
    "equal-entropy": "joint entropy, 1.5 nats by a learned α, MUSIC-r",
    "joint-her": JOINT,
    "claims-push": MUSIC,
    "joint-pick-fresh": "joint entropy, MUSIC-r",
    "joint-pick": "joint entropy, MUSIC-r, first study",
    "pick-and-place-in-80000-steps": "q = 1, 80,000 steps in all",
    "claims-pick-and-place": MUSIC,
    "joint-slide": "joint entropy, MUSIC-r",
    "equal-entropy-slide": "joint entropy, 1.5 nats by a fixed α, MUSIC-r",
    "claims-slide": MUSIC,
}
"""Setting of each study."""
PAPER = {
    ("FetchPush", "q = 1.5", "q = 1"): "Figure 4: faster to 85%",
    ("FetchPickAndPlace", "q = 1.5", "q = 1"): "Figure 5: better",
    ("FetchSlide", "q = 1.5", "q = 1"): "Figure 6: comparable; text: better",
}
COMPARED = ("q = 1.5", "q = 2")
"""Values that are compared with q = 1."""
FEWEST_TASKS = 3
"""Smallest number of tasks for a mean over them."""
BETWEEN_STAGES = "stage = "
"""Start of the labels of a comparison of two stages."""


@cache
def complete_studies() -> list[tuple[Sweep, Study]]:
    """The studies whose runs have all finished."""
    sweeps = map(sweep_called, STUDIES)
    return [(sweep, study_of(sweep)) for sweep in sweeps if sweep and is_complete(sweep)]


def compared(study: Study) -> list[Claim]:
    """The comparisons of the plan, the late ones last."""
    late = [c for c in study.unplanned if c.hypothesis and c.hypothesis.text in study.late]
    return [*study.planned, *late]


def sampled(sweep: Sweep, study: Study) -> tuple[Claim, ...]:
    """The plan's comparisons by the success of training episodes, whose actions are sampled."""
    first, *_ = claims = compared(study)
    pairs = [(claim.first, claim.second, claim.pairs) for claim in claims]
    measures = {first.task: replace(first.measure, metric=names.TRAIN_SUCCESS)}
    sweep = counted(sweep, first.measure.kind)
    return exploratory(list(claims_of(sweep, pairs, measures, first.margin)))


def between_q(claims: Sequence[Claim]) -> list[Claim]:
    """Comparisons of two q."""
    return [claim for claim in claims if not claim.first.startswith(BETWEEN_STAGES)]


def headline() -> str:
    """Whether q = 1.5 is better than q = 1 anywhere, counts of verdicts, and mean differences."""
    claims = [
        (STUDIES[sweep.name], claim)
        for sweep, study in complete_studies()
        for claim in between_q(study.planned)
    ]
    asked = ("q = 1.5", "q = 1")
    better = [
        f"{claim.task} ({setting})"
        for setting, claim in claims
        if (claim.first, claim.second) == asked and claim.verdict is Verdict.SUPERIOR
    ]
    answer = "No study here shows that q = 1.5 is better than q = 1."
    if better:
        answer = f"q = 1.5 is better than q = 1 on {' and '.join(better)}."
    found = [claim for _, claim in claims]
    decided = {claim.task for claim in found if claim.verdict is not Verdict.UNDECIDED}
    undecided = [task for task in dict.fromkeys(c.task for c in found) if task not in decided]
    open_tasks = (
        f" No comparison of q is decided on {' and '.join(undecided)}." if undecided else ""
    )
    counts = _counts((claim, str(claim.verdict)) for claim in found)
    return f"**{answer}** Verdicts on {counts}.{open_tasks}{_averages(found)}"


def average(claims: Sequence[Claim]) -> Contrast:
    """The mean difference of tasks, each the mean of its settings; their spread is the error."""
    by_task: dict[str, list[float]] = {}
    for claim in claims:
        by_task.setdefault(claim.task, []).append(float(claim.contrast.difference.value))
    gaps = np.array([np.mean(own) for own in by_task.values()])
    return contrast(gaps, 0.0 * gaps, paired=True)


def _averages(claims: Sequence[Claim]) -> str:
    """The mean over tasks of each q against q = 1; empty if a task has no such comparison."""
    of_q = {q: [c for c in claims if (c.first, c.second) == (q, "q = 1")] for q in COMPARED}
    tasks = {claim.task for claim in claims}
    if len(tasks) < FEWEST_TASKS or any({c.task for c in own} != tasks for own in of_q.values()):
        return ""
    gaps = ((q, average(own).difference) for q, own in of_q.items())
    parts = (
        f"{q} minus q = 1, {g.value:+.2f} (95% CI {g.lower:.2f} to {g.upper:.2f})" for q, g in gaps
    )
    return (
        f" Mean difference of the area under the success curve over the {len(tasks)} tasks, each "
        f"the mean of its settings (not planned): {'; '.join(parts)}."
    )


def one_family() -> str:
    """The verdicts if all planned comparisons of two q were one family."""
    studies = complete_studies()
    claims = [claim for _, study in studies for claim in between_q(study.planned)]
    counts = Counter(claim.verdict for claim in decided(claims, planned=True))
    differences = counts[Verdict.SUPERIOR] + counts[Verdict.WORSE]
    return (
        f"With all {len(claims)} comparisons of q as one family, {differences} differences and "
        f"{counts[Verdict.EQUIVALENT]} equivalences would be decided."
    )


def collapses() -> str:
    """Rates of collapses that decided verdicts do not exclude, by the number of seeds."""
    shares: dict[int, float] = {}
    for claim in (claim for _, study in complete_studies() for claim in study.planned):
        if claim.verdict is not Verdict.UNDECIDED and claim.collapses is not None:
            seeds = claim.contrast.seeds[0]
            shares[seeds] = max(claim.collapses, shares.get(seeds, 0.0))
    parts = (f"{percent(shares[seeds])} ({seeds} seeds)" for seeds in sorted(shares, reverse=True))
    return f"Collapses in up to {', '.join(parts)} of the seeds are not excluded by a verdict."


def differences_figure(figures: dict[str, Drawing]) -> str:
    """The planned comparisons with q = 1 of all studies."""
    claims = [
        (f"{claim.task}: {STUDIES[sweep.name]}", claim)
        for sweep, study in complete_studies()
        for claim in between_q(compared(study))
        if claim.second == "q = 1"
    ]
    ends = [
        (claim.contrast.difference.lower, claim.contrast.difference.upper) for _, claim in claims
    ]
    subplots: list[Subplot] = []
    for q in COMPARED:
        own = [(label, claim) for label, claim in claims if claim.first == q]
        mean = replace(own[-1][1], contrast=average([claim for _, claim in own]))
        own.append(("mean of the tasks (not planned)", mean))
        rows = [("" if subplots else label, claim) for label, claim in own]
        subplot = differences_subplot(f"{q} minus q = 1", rows, "difference of the area")

        def draw(axes: Axes, subplot: Subplot = subplot) -> None:
            subplot.draw(axes)
            axes.set_xlim(1.05 * np.min(ends), 1.05 * np.max(ends))

        subplots.append(replace(subplot, draw=draw))
    figures["differences.svg"] = Drawing(
        stage="all studies", title="Differences", caption="", subplots=tuple(subplots), legend=[]
    )
    return "![Differences of the area between q, with intervals](results/figures/differences.svg)"


def sampled_sentence() -> str:
    """How many comparisons of two q by the sampled policy have a CI that excludes 0."""
    claims = [
        claim for sweep, study in complete_studies() for claim in between_q(sampled(sweep, study))
    ]
    counts = _counts(
        (claim, "above 0" if gap.lower > 0 else "below 0" if gap.upper < 0 else "include 0")
        for claim in claims
        for gap in [claim.contrast.difference]
    )
    return (
        f"95% intervals of the sampled policy (exploratory, not adjusted) for {counts}."
        f"{_averages(claims)}"
    )


def _counts(results: Iterable[tuple[Claim, str]]) -> str:
    """`q = 1.5 against q = 1: 3 undecided, 1 worse; ...`, for each q against q = 1."""
    of_pair: dict[str, Counter[str]] = {}
    for claim, result in results:
        if claim.second == "q = 1":
            of_pair.setdefault(f"{claim.first} against q = 1", Counter())[result] += 1
    return "; ".join(
        f"{pair}: " + ", ".join(f"{n} {result}" for result, n in counter.most_common())
        for pair, counter in of_pair.items()
    )


def summary_table() -> Iterator[str]:
    """One row per task and comparison: verdicts on the mean action and on the sampled policy."""
    columns = (
        "task",
        "setting",
        "comparison",
        "the paper",
        "mean action",
        "sampled policy",
        "seeds",
    )
    yield row(*columns)
    yield rule(len(columns))
    for sweep, study in complete_studies():
        setting = STUDIES[sweep.name]
        for claim, other in zip(compared(study), sampled(sweep, study), strict=True):
            figure = "text" if claim.second == "q = 1" else "Figure 7"
            paper = PAPER.get((claim.task, claim.first, claim.second), f"{figure}: worse")
            if setting == JOINT:
                paper = paper.replace(":", " (with MUSIC):")
            comparison = f"{claim.first} against {claim.second}"
            if claim.first.startswith(BETWEEN_STAGES):
                counted = "" if claim.measure.kind == "auc_total" else "not "
                paper = ""
                comparison = f"MUSIC-r, q = 1, against HER alone, pretraining {counted}counted"
            cells = (verdict_cell(claim), verdict_cell(other), claim.contrast.seeds[0])
            yield row(claim.task, setting, comparison, paper, *cells)
        for found in equal_totals(sweep, study):
            mean, other = (one.claim for one in found)
            comparison = f"the same at {found[0].total:,.0f} steps in all, pretraining counted"
            cells = (verdict_cell(mean), verdict_cell(other), mean.contrast.seeds[0])
            yield row(mean.task, setting, comparison, "", *cells)


def equal_totals(sweep: Sweep, study: Study) -> Iterator[tuple[AtEqualTotal, AtEqualTotal]]:
    """Planned comparisons of stages, at equal total steps instead: mean action, sampled policy."""
    for claim in study.planned:
        if claim.first.startswith(BETWEEN_STAGES) and claim.measure.kind != "auc_total":
            ((first, second),) = claim.pairs
            mean, other = (
                at_equal_total(sweep, first, second, claim.task, metric)
                for metric in (names.EVAL_SUCCESS, names.TRAIN_SUCCESS)
            )
            if mean and other:
                yield mean, other


def verdict_cell(claim: Claim) -> str:
    """`**worse**, -0.05 (95% CI -0.08 to -0.02; p = 0.003, adjusted 0.0089)`."""
    verdict = "" if claim.verdict is Verdict.NONE else f"**{verdict_in_words(claim)}**, "
    return f"{verdict}{numbers_in_words(claim)}"


def equal_total_text(name: str) -> str:
    """MUSIC-r against HER alone at equal total steps, in words."""
    sweep = sweep_called(name)
    if sweep is None or not is_complete(sweep):
        return progress_text(name)
    mean, _ = next(equal_totals(sweep, study_of(sweep)))
    first, second = map(percent, mean.finals)
    text = (
        f"At {mean.total:,.0f} environment steps in all, pretraining counted, the area of MUSIC-r "
        f"at q = 1 differs from that of HER alone by {numbers_in_words(mean.claim)}; success at "
        f"the end is {first} against {second}"
    )
    if mean.crossing:
        low, high = sorted(mean.crossing)
        text += f", and the mean curves cross between {low:,} and {high:,} steps"
    return f"{text}."
