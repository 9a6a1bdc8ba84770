"""Planned studies: answers, tables and figures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from docs.result_pages.exports import is_complete, progress_text
from docs.result_pages.figures import figure
from docs.result_pages.runs import last_value
from docs.result_pages.words import percent, rate_cells, row, rule, spread, wait_text
from music_rllib import names
from music_rllib.report.figures.choice import Drawing, slug, stage_drawings, study_drawings
from music_rllib.results import statistics as st
from music_rllib.results.analysis import THRESHOLDS, StageAnalysis, analyse
from music_rllib.results.answer import answer
from music_rllib.results.data import Sweep
from music_rllib.results.scores import counted, scores_of
from music_rllib.results.study import Mean, study_of


def answer_text(sweep: Sweep) -> Iterator[str]:
    """The answer of a study; before all runs have finished only its progress."""
    yield f"**{progress_text(sweep.name).capitalize()}.**"
    if is_complete(sweep):
        yield ""
        yield from (f"- {sentence}" for sentence in answer(sweep, study_of(sweep)))


def outcomes_table(sweep: Sweep, *stages: str) -> Iterator[str]:
    """One column per condition: the planned metric, and below it other numbers."""
    pretrained = any(names.TAG_SOURCE_NODE in run.tags for run in sweep.runs)
    steps = "steps after pretraining" if pretrained else "steps"
    rates = (f"{steps} to {percent(rate)}: median [95% CI]" for rate in THRESHOLDS)
    columns = [
        [
            "",
            "**area under the curve, mean action: mean [95% CI]**",
            "the same, sampled policy",
            "success at the end: mean [95% CI]",
            *rates,
            "Shannon entropy at the end, nats",
            "S_q at the end",
        ]
    ]
    for analysis in analyse(sweep):
        if analysis.stage.name in stages:
            prefix = f"{analysis.stage.name}, " if len(stages) > 1 else ""
            means = study_of(sweep, analysis.stage.name).means
            columns += [list(_outcomes(sweep, analysis, mean, prefix)) for mean in means]
    header, *lines = zip(*columns, strict=True)
    yield row(*header)
    yield rule(len(header))
    yield from (row(*line) for line in lines)


def _outcomes(sweep: Sweep, analysis: StageAnalysis, mean: Mean, prefix: str) -> Iterator[str]:
    key = (mean.condition, mean.task)
    (final,) = (
        final
        for scope in analysis.scopes
        for final in scope.finals
        if (final.condition, scope.name) == key
    )
    yield f"{prefix}{mean.condition.short_label}"
    yield spread(mean.estimate)
    measure = replace(mean.measure, metric=names.TRAIN_SUCCESS)
    sampled = scores_of(counted(sweep, measure.kind), mean.condition, mean.task, measure)
    yield spread(st.estimate(np.array([*sampled.by_seed.values()])[:, np.newaxis], np.inf))
    yield rate_cells(final)[0]
    for wait in analysis.times:
        if (wait.condition, wait.task) == key:
            yield wait_text(wait.median)
    for entropy in analysis.entropies[mean.task, mean.condition]:
        yield spread(entropy) if entropy else ""


def seeds_table(sweep: Sweep) -> Iterator[str]:
    """The area under the curve of each seed."""
    means = study_of(sweep).means
    yield row("seed", *(mean.condition.short_label for mean in means))
    yield rule(1 + len(means))
    for seed in sorted({seed for mean in means for seed in mean.scores.by_seed}, key=int):
        scores = (mean.scores.by_seed.get(seed) for mean in means)
        yield row(seed, *("" if score is None else f"{score:.3f}" for score in scores))


def cells(sweep: Sweep) -> Iterator[str]:
    """A row for each α and a column for each q: area under the curve, final entropy, seeds."""
    means = study_of(sweep).means
    by_cell = {(mean.condition.entropic_index, alpha_of(sweep, mean)): mean for mean in means}
    qs, alphas = (sorted({cell[i] for cell in by_cell}, key=float) for i in (0, 1))
    yield row("α", *(f"q = {q}" for q in qs))
    yield rule(1 + len(qs))
    for alpha in alphas:
        yield row(alpha, *(cell_text(sweep, by_cell.get((q, alpha))) for q in qs))


def alpha_of(sweep: Sweep, mean: Mean) -> str:
    """α of a condition."""
    return sweep.runs[mean.condition.runs[0]].tags[names.TAG_ALPHA]


def cell_text(sweep: Sweep, mean: Mean | None) -> str:
    """`0.21 ± 0.03, 1.4 nats (5)`; the spread is the standard deviation over seeds."""
    if mean is None or not mean.scores.by_seed:
        return ""
    scores = list(mean.scores.by_seed.values())
    runs = [run for run in mean.condition.runs if sweep.runs[run].status == "FINISHED"]
    entropy = np.mean([last_value(sweep, run, names.SHANNON_ENTROPY) for run in runs])
    apart = f" ± {np.std(scores, ddof=1):.2f}" if len(scores) > 1 else ""
    return f"{np.mean(scores):.2f}{apart}, {entropy:.1f} nats ({len(scores)})"


def named_figure(sweep: Sweep, name: str, figures: dict[str, Drawing]) -> Iterator[str]:
    """A figure of the compared stage.

    Raises:
        ValueError: There is no such figure.
    """
    study = study_of(sweep)
    stages = [
        found for found in analyse(sweep) if study.stage and found.stage.name == study.stage.name
    ]
    drawings = [d for found in stages for d in stage_drawings(sweep, found)]
    named = {slug(d.title): d for d in (*drawings, *study_drawings(study))}
    if name not in named:
        raise ValueError(f"{sweep.name} has no figure {name}, but {', '.join(named)}")
    yield from figure(sweep, named[name], figures)
