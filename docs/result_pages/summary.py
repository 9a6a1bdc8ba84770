"""The answer at the top of the results page: a sentence and a table of verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

from docs.result_pages.exports import is_complete, progress_text, sweep_called
from docs.result_pages.totals import AtEqualTotal, at_equal_total
from docs.result_pages.words import percent, row, rule
from music_rllib import names
from music_rllib.results.answer import not_excluded, numbers_in_words, verdict_in_words
from music_rllib.results.claims import Claim, Verdict, claims_of, exploratory
from music_rllib.results.data import Sweep
from music_rllib.results.scores import counted
from music_rllib.results.study import Study, study_of

JOINT = "joint entropy, HER alone"
MUSIC = "per-dimension entropy, MUSIC-r"
STUDIES = {
    "joint-music": "joint entropy, MUSIC-r",
    "equal-entropy": "joint entropy at 1.5 nats, MUSIC-r",
    "joint-her": JOINT,
    "claims-push": MUSIC,
    "claims-pick-and-place": MUSIC,
    "claims-slide": MUSIC,
}
"""Setting of each study; studies of one setting share a sentence."""
PAPER = {
    ("FetchPush", "q = 1.5", "q = 1"): "Figure 4: faster",
    ("FetchPickAndPlace", "q = 1.5", "q = 1"): "Figure 5: better",
    ("FetchSlide", "q = 1.5", "q = 1"): "Figure 6: comparable; text: better",
}
SEEDS_FOR_COLLAPSES = 16
"""Seeds that show a collapse of one in ten runs with 80% probability: 1 - 0.9^16 = 0.81."""
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
    """Whether q = 1.5 is better than q = 1 anywhere; then a sentence per setting.

    The sentences state the effect of q on each task, by the verdicts on the mean action.
    """
    settings: dict[str, list[Claim]] = {}
    for sweep, study in complete_studies():
        settings.setdefault(STUDIES[sweep.name], []).extend(between_q(study.planned))
    better = [
        f"{claim.task} ({setting})"
        for setting, claims in settings.items()
        for claim in claims
        if (claim.first, claim.second) == ("q = 1.5", "q = 1") and claim.verdict is Verdict.SUPERIOR
    ]
    answer = "In no setting tested here is q = 1.5 better than q = 1."
    if better:
        answer = f"q = 1.5 is better than q = 1 on {' and '.join(better)}."
    sentences = (f"{setting}: {_effects(claims)}." for setting, claims in settings.items())
    return f"**{answer}** {' '.join(text[0].upper() + text[1:] for text in sentences)}"


def _effects(claims: Sequence[Claim]) -> str:
    """The effect of q on each task."""
    tasks = dict.fromkeys(claim.task for claim in claims)
    decided = list(filter(None, map(winner_and_loser, claims)))
    better = [pair for pair in decided if pair[0] == "q = 1.5"]
    parts = [f"q = 1.5 needs fewer steps than {loser} on {task}" for _, loser, task in better]
    worse: dict[tuple[str, str], list[str]] = {}
    for winner, loser, task in decided:
        if winner != "q = 1.5":
            worse.setdefault((loser, task), []).append(winner)
    where = "any task here" if len(tasks) > 1 else next(iter(tasks))
    if not better and not any(loser == "q = 1.5" for loser, _ in worse):
        parts = [f"q = 1.5 beats neither q = 1 nor q = 2 on {where}"]
    parts += [
        f"{loser} needs more steps than {' and '.join(winners)} on {task}"
        for (loser, task), winners in worse.items()
    ]
    for task in tasks:
        verdicts = {claim.verdict for claim in claims if claim.task == task}
        if verdicts == {Verdict.UNDECIDED}:
            parts.append(f"{task} is open")
        elif Verdict.EQUIVALENT in verdicts:
            parts.append(_alike([claim for claim in claims if claim.task == task]))
    return "; ".join(parts)


def winner_and_loser(claim: Claim) -> tuple[str, str, str] | None:
    """Better and worse condition of a decided comparison, and its task."""
    if claim.verdict is Verdict.SUPERIOR:
        return claim.first, claim.second, claim.task
    return (claim.second, claim.first, claim.task) if claim.verdict is Verdict.WORSE else None


def _alike(claims: Sequence[Claim]) -> str:
    """The q that are equivalent on a task."""
    alike = [claim for claim in claims if claim.verdict is Verdict.EQUIVALENT]
    seeds = min(claim.contrast.seeds[0] for claim in claims)
    pairs = " and ".join(f"{claim.first} to {claim.second}" for claim in alike)
    single = f"{alike[0].first} and {alike[0].second}" if len(alike) == 1 else pairs
    who = f"{'all three q' if len(alike) == len(claims) else single} are equivalent"
    within = f"on {claims[0].task} {who} within {claims[0].margin:g}"
    few = ", too few to exclude rare collapses" if seeds < SEEDS_FOR_COLLAPSES else ""
    return f"{within} ({seeds} seeds{few})"


def sampled_sentence() -> str:
    """Comparisons of two q by the sampled policy whose CI excludes 0, in words."""
    where: dict[tuple[str, str, str], list[str]] = {}
    for sweep, study in complete_studies():
        for claim in between_q(sampled(sweep, study)):
            gap = claim.contrast.difference
            if gap.lower > 0 or gap.upper < 0:
                side = "above" if gap.value > 0 else "below"
                where.setdefault((claim.first, side, claim.second), []).append(
                    f"{claim.task} ({STUDIES[sweep.name]})"
                )
    parts = [
        f"{first} is {side} {second} on {' and '.join(tasks)}"
        for (first, side, second), tasks in where.items()
    ]
    return (
        "For the sampled policy, these 95% intervals exclude 0 (exploratory, not adjusted): "
        f"{'; '.join(parts) or 'none'}."
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
            paper = PAPER.get((claim.task, claim.first, claim.second), "Figure 7: worse")
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
    return f"{verdict}{numbers_in_words(claim)}{not_excluded(claim)}"


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
