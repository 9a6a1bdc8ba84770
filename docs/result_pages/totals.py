"""Comparisons at equal total environment steps, with pretraining."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from docs.result_pages.exports import is_complete, progress_text
from docs.result_pages.words import percent, rate_cells, row, rule, spread
from music_rllib import names
from music_rllib.results.analysis import analyse_stage
from music_rllib.results.analysis_plan import MARGIN_OF_A_RATE
from music_rllib.results.answer import not_excluded, numbers_in_words, verdict_in_words
from music_rllib.results.claims import Claim, contrast, exploratory
from music_rllib.results.conditions import Condition, find_stages
from music_rllib.results.data import RunRecord, Sweep
from music_rllib.results.scores import Measure, area_under_curve, with_pretraining
from music_rllib.results.study import study_of


@dataclass(frozen=True)
class AtEqualTotal:
    """A pretrained condition against one from scratch, over the same total number of steps."""

    claim: Claim
    finals: tuple[float, float]
    """Mean success rates at the total, the pretrained condition first."""
    crossing: tuple[int, int] | None
    """First total at which the pretrained condition is ahead, and last at which it is not."""

    @property
    def total(self) -> float:
        """Environment steps, pretraining included."""
        return self.claim.measure.horizon


def at_equal_total(
    sweep: Sweep, pretrained: Condition, scratch: Condition, task: str, metric: str
) -> AtEqualTotal | None:
    """Compare two conditions on their shared seeds; None where they share fewer than two."""
    sides = [
        {sweep.runs[i].seed: i for i in condition.runs if sweep.runs[i].task == task}
        for condition in (pretrained, scratch)
    ]
    seeds = [seed for seed in sides[0] if seed in sides[1]]
    if len(seeds) < 2:
        return None
    runs = [[side[seed] for seed in seeds] for side in sides]
    own = sweep.least_budget(task, runs[0])
    sweep = with_pretraining(sweep)
    before = sweep.least_budget(task, runs[0]) - own
    total = sweep.least_budget(task, [*runs[0], *runs[1]])
    x, y = (
        np.array([area_under_curve(*sweep.finite(i, metric), total) for i in side]) for side in runs
    )
    claim = Claim(
        first=pretrained.label,
        second=scratch.label,
        task=task,
        measure=Measure(kind="auc_total", metric=metric, horizon=total),
        margin=MARGIN_OF_A_RATE,
        contrast=contrast(x, y, paired=True, margin=MARGIN_OF_A_RATE),
        pairs=[(pretrained, scratch)],
    )
    (claim,) = exploratory([claim])
    grid = sweep.finite(runs[0][0], metric)[0]
    grid = grid[(grid >= before) & (grid <= total)]
    means = [
        np.mean([np.interp(grid, *sweep.finite(i, metric)) for i in side], axis=0) for side in runs
    ]
    ahead = means[0] > means[1]
    crossing = None
    if ahead.any() and not ahead.all():
        crossing = int(grid[ahead.argmax()]), int(grid[~ahead][-1])
    return AtEqualTotal(claim, (float(means[0][-1]), float(means[1][-1])), crossing)


def totals_table(sweep: Sweep, first: str, second: str) -> Iterator[str]:
    """Conditions of a pretrained stage against the same conditions of one from scratch."""
    stages = {stage.name: stage for stage in find_stages(sweep)}
    yield row("task", "condition", "total steps", "area: difference", "at the end", "seeds")
    yield rule(6)
    for task in stages[first].tasks:
        for pretrained in stages[first].conditions:
            for scratch in stages[second].conditions:
                if scratch.entropic_index != pretrained.entropic_index:
                    continue
                found = at_equal_total(sweep, pretrained, scratch, task, names.EVAL_SUCCESS)
                if found is not None:
                    q = f"q = {pretrained.entropic_index}"
                    ends = " against ".join(map(percent, found.finals))
                    seeds = found.claim.contrast.seeds[0]
                    yield row(
                        task, q, f"{found.total:,.0f}", numbers_in_words(found.claim), ends, seeds
                    )


def _seconds(sweep: Sweep, run: RunRecord) -> float:
    """Training time of a run and of those that it starts from."""
    source = next((one for one in sweep.runs if one.node_key == run.source), None)
    return (run.seconds or 0.0) + (_seconds(sweep, source) if source else 0.0)


def arms_table(sweep: Sweep) -> Iterator[str]:
    """One row per stage of a plan that compares stages with one of them; the progress until then.

    Times include the pretraining, which several runs share.
    """
    study = study_of(sweep)
    if study.stage is None or not is_complete(sweep):
        yield f"**{progress_text(sweep.name).capitalize()}.**"
        return
    claims = {claim.hypothesis.first["stage"]: claim for claim in study.planned if claim.hypothesis}
    finals = {
        final.condition: final
        for scope in analyse_stage(sweep, study.stage).scopes
        for final in scope.finals
    }
    yield row(
        "stage", "verdict, difference", "area over all steps [95% CI]", "success at the end",
        "core-minutes", "seeds",
    )  # fmt: skip
    yield rule(6)
    for mean in study.means:
        name = dict(mean.condition.others)["stage"]
        claim = claims.get(name)
        against = ""
        if claim:
            numbers = numbers_in_words(claim)
            against = f"**{verdict_in_words(claim)}**, {numbers}{not_excluded(claim)}"
        minutes = np.mean([_seconds(sweep, sweep.runs[run]) for run in mean.condition.runs]) / 60
        yield row(
            name, against, spread(mean.estimate), rate_cells(finals[mean.condition])[0],
            f"{minutes:.1f}", len(mean.scores.by_seed),
        )  # fmt: skip
