"""Success rates of stages and conditions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from docs.result_pages.figures import figure
from docs.result_pages.words import THRESHOLD, rate_cells, row, rule, wait_text
from music_rllib.report.figures.choice import (
    PRIMARY,
    Drawing,
    drawings_of_stages,
    stage_drawings,
)
from music_rllib.results.analysis import StageAnalysis, analyse, time_to_threshold
from music_rllib.results.conditions import Condition, find_stages
from music_rllib.results.data import Sweep


def success(sweep: Sweep, figures: dict[str, Drawing], stages: Sequence[str] = ()) -> Iterator[str]:
    """For each stage: final success, steps to the threshold, and curves."""
    for analysis in analyse(sweep):
        if stages and analysis.stage.name not in stages:
            continue
        yield from success_table(sweep, analysis)
        yield ""
        yield from curves(sweep, analysis, figures)


def success_table(sweep: Sweep, analysis: StageAnalysis) -> Iterator[str]:
    """One row per task and condition."""
    yield row("task", f"{analysis.stage.variant}", *_OUTCOME)
    yield rule(2 + len(_OUTCOME))
    for task in analysis.stage.tasks:
        for condition, cells in outcomes(sweep, analysis, task):
            yield row(task, condition.label, *cells)


def stages_table(sweep: Sweep, *stages: str) -> Iterator[str]:
    """One row per task, stage and condition: stages side by side."""
    yield row("task", "stage", "condition", *_OUTCOME)
    yield rule(3 + len(_OUTCOME))
    for analysis in analyse(sweep):
        if not stages or analysis.stage.name in stages:
            for task in analysis.stage.tasks:
                for condition, cells in outcomes(sweep, analysis, task):
                    yield row(task, analysis.stage.name, condition.label, *cells)


_OUTCOME = (
    "finished",
    "success, last evaluation: mean [95% CI]",
    "each seed (%)",
    f"steps to {100 * THRESHOLD:.0f}%: median [95% CI]",
    "each run",
)


def outcomes(
    sweep: Sweep, analysis: StageAnalysis, task: str
) -> Iterator[tuple[Condition, tuple[str, ...]]]:
    """Each condition with a run of the task, and its cells for `_OUTCOME`."""
    (scope,) = [scope for scope in analysis.scopes if scope.name == task]
    finals = {final.condition: final for final in scope.finals}
    for condition in analysis.stage.conditions:
        runs = [i for i in condition.runs if sweep.runs[i].task == task]
        if runs:
            done = sum(sweep.runs[i].status == "FINISHED" for i in runs)
            yield (
                condition,
                (
                    f"{done} of {len(runs)}",
                    *rate_cells(finals.get(condition)),
                    *_times(sweep, condition, task),
                ),
            )


def _times(sweep: Sweep, condition: Condition, task: str) -> tuple[str, str]:
    """Median number of steps to the threshold, with censored runs, and the steps of each run."""
    found = time_to_threshold(sweep, condition, task, THRESHOLD)
    if found is None:
        return "", ""
    each = ", ".join(
        f"{'' if there else '> '}{steps:,.0f}"
        for steps, there in sorted(zip(found.steps, found.reached, strict=True))
    )
    return wait_text(found.median) if found.reached.any() else "not reached", each


def curves(sweep: Sweep, analysis: StageAnalysis, figures: dict[str, Drawing]) -> Iterator[str]:
    """The figure of success rates."""
    for drawing in stage_drawings(sweep, analysis):
        if drawing.title == "Success rate":
            yield from figure(sweep, drawing, figures)
            yield ""


def stage_curves(sweep: Sweep, figures: dict[str, Drawing], stages: Sequence[str]) -> Iterator[str]:
    """The figure of success rates of several stages, side by side."""
    for drawing in drawings_of_stages(
        sweep, [stage for stage in find_stages(sweep) if stage.name in stages]
    ):
        if drawing.title in PRIMARY:
            yield from figure(sweep, drawing, figures)
