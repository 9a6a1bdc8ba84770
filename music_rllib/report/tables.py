"""The report's numbers as CSV files, unrounded."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from music_rllib import names
from music_rllib.report.figures.choice import Drawing
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.conditions import SIDE_BY_SIDE
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Estimate, interval_text, number


@dataclass(frozen=True, kw_only=True)
class Table:
    """The content of one CSV file."""

    name: str
    columns: str
    """Names of the columns, separated by spaces."""
    rows: Sequence[Sequence[object]]

    def to_csv(self) -> str:
        """The rows below a header; NaN is `nan`, infinity `inf`."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(self.columns.split())
        writer.writerows(self.rows)
        return buffer.getvalue()


def _numbers(estimate: Estimate) -> tuple[float, float, float]:
    return float(estimate.value), float(estimate.lower), float(estimate.upper)


def finals_table(analyses: Iterable[StageAnalysis]) -> Table:
    """Final values of each condition and of each of its seeds, means over the tasks."""
    return Table(
        name="final",
        columns="stage tasks metric condition runs seeds mean lower upper each_seed "
        "shannon_entropy shannon_entropy_lower shannon_entropy_upper tsallis_entropy "
        "tsallis_entropy_lower tsallis_entropy_upper",
        rows=[
            (
                analysis.stage.name,
                scope.name,
                scope.metric,
                final.condition.label,
                final.runs,
                final.seeds,
                *_numbers(final.estimate),
                " ".join(f"{score:g}" for score in final.scores.mean(axis=1)),
                *analysis.entropies[scope.name, final.condition].numbers,
            )
            for analysis in analyses
            for scope in analysis.scopes
            for final in scope.finals
        ],
    )


def note(answer: str, analyses: Iterable[StageAnalysis], run_id: str, figure: str | None) -> str:
    """The answer, the last stage's final values and a figure, in Markdown for MLflow's page.

    Args:
        answer: The first sentence of the report's answer.
        analyses: The analyses of the sweep's stages.
        run_id: The MLflow id of the sweep's own run.
        figure: The path of an artefact of that run; None if nothing is drawn.
    """
    rows: list[tuple[str, ...]] = [("task", "condition", "seeds", "final value", "95 %")]
    for analysis in list(analyses)[-1:]:
        for scope in analysis.scopes:
            for final in scope.finals:
                value = f"{names.word_of(scope.metric)} {number(final.value)}"
                interval = interval_text(final.estimate)
                label = final.condition.label
                rows.append((scope.name, label, str(final.seeds), value, interval))
    # MLflow's tables have no space between their columns.
    lines = ["".join(f"| {_escaped(text)}&emsp;" for text in row) + "|" for row in rows]
    lines.insert(1, "|---" * len(rows[0]) + "|")
    lines = [f"**{_escaped(answer)}**", "", *lines]
    if figure is not None:
        # MLflow serves its pages and its artefacts from the same origin.
        lines += ["", f"![{figure}](get-artifact?path={figure}&run_uuid={run_id})"]
    return "\n".join(lines)


def _escaped(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|#!~])", r"\\\1", text)


def improvement_table(analyses: Iterable[StageAnalysis]) -> Table:
    """Difference of the final values and probability of improvement of each pair."""
    return Table(
        name="probability_of_improvement",
        columns="stage tasks first second probability_first_higher gap gap_lower gap_upper",
        rows=[
            (
                analysis.stage.name,
                scope.name,
                pair.first.condition.label,
                pair.second.condition.label,
                pair.improvement,
                *_numbers(pair.gap),
            )
            for analysis in analyses
            for scope in analysis.scopes
            for pair in scope.differences
        ],
    )


def waits_table(analyses: Iterable[StageAnalysis]) -> Table:
    """Environment steps that each condition needs to each success rate."""
    return Table(
        name="steps_to_threshold",
        columns="stage task condition threshold runs reached median_env_steps lower upper each_run",
        rows=[
            (
                analysis.stage.name,
                wait.task,
                wait.condition.label,
                wait.threshold,
                len(wait.steps),
                int(wait.reached.sum()),
                *_numbers(wait.median),
                " ".join(
                    f"{'' if reached else '>'}{steps:.0f}"
                    for steps, reached in zip(wait.steps, wait.reached, strict=True)
                ),
            )
            for analysis in analyses
            for wait in analysis.times
        ],
    )


def runs_table(sweep: Sweep) -> Table:
    """Every run of the sweep, with its last evaluation and entropies."""
    return Table(
        name="runs",
        columns="run_id name stage task entropic_index seed status env_steps budget seconds "
        "success_rate episode_return failure shannon_entropy tsallis_entropy",
        rows=[
            (
                run.run_id,
                run.name,
                run.stage,
                run.task,
                run.entropic_index,
                run.seed,
                run.status,
                sweep.last_step(position),
                run.budget,
                run.seconds,
                sweep.final(position, names.EVAL_SUCCESS),
                sweep.final(position, names.EVAL_RETURN),
                run.failure,
                *(sweep.final(position, metric) for metric in names.ENTROPIES),
            )
            for position, run in enumerate(sweep.runs)
        ],
    )


def curves_table(drawings: Iterable[Drawing]) -> Table:
    """The points of all learning curves; stages side by side have none but those of each stage."""
    return Table(
        name="curves",
        columns="stage task condition metric env_steps runs mean lower upper",
        rows=[
            (drawing.stage, curve.task, curve.condition.label, drawing.metric.name, *point)
            for drawing in drawings
            if drawing.metric is not None and drawing.stage != SIDE_BY_SIDE
            for curves in drawing.curves.values()
            for curve in curves
            for point in zip(
                curve.steps.astype(int).tolist(),
                curve.runs.tolist(),
                curve.estimate.value.tolist(),
                curve.estimate.lower.tolist(),
                curve.estimate.upper.tolist(),
                strict=True,
            )
        ],
    )
