"""The report's numbers as CSV files, unrounded."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from music_rllib import names
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.data import Sweep

__all__ = [
    "Table",
    "finals_table",
    "improvement_table",
    "note",
    "races_table",
    "runs_table",
    "waits_table",
]


@dataclass(frozen=True, kw_only=True)
class Table:
    """One CSV file."""

    name: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]

    def to_csv(self) -> str:
        """With a header; NaN is `nan`, infinity `inf`."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(self.rows)
        return buffer.getvalue()


def finals_table(analyses: Iterable[StageAnalysis]) -> Table:
    """How each condition ended, and each of its seeds: means over the tasks."""
    return Table(
        name="final",
        columns=(
            *("stage", "tasks", "metric", "condition", "runs", "seeds", "mean", "lower", "upper"),
            "each_seed",
            *("shannon_entropy", "shannon_entropy_lower", "shannon_entropy_upper"),
            *("tsallis_entropy", "tsallis_entropy_lower", "tsallis_entropy_upper"),
        ),
        rows=[
            (
                analysis.stage.name,
                scope.name,
                scope.metric,
                final.condition.label,
                final.runs,
                final.seeds,
                final.value,
                float(final.estimate.lower),
                float(final.estimate.upper),
                " ".join(f"{score:g}" for score in final.scores.mean(axis=1)),
                *analysis.entropies[scope.name, final.condition].numbers,
            )
            for analysis in analyses
            for scope in analysis.scopes
            for final in scope.finals
        ],
    )


def note(analyses: Iterable[StageAnalysis], run_id: str, figure: str | None) -> str:
    """The last stage's conditions and the report's first figure, in Markdown for MLflow's page.

    Args:
        analyses: Of the sweep's stages.
        run_id: Of the sweep's own run.
        figure: An artefact of it; None where nothing is drawn.
    """
    columns = ("tasks", "condition", "seeds", "metric", "mean", "lower", "upper")
    final = finals_table(list(analyses)[-1:])
    cells = [[str(row[final.columns.index(name)]) for name in columns] for row in _rounded(final)]
    lines = [f"| {' | '.join(map(_escaped, row))} |" for row in (columns, *cells)]
    lines.insert(1, "|---" * len(columns) + "|")
    if figure is not None:
        # MLflow's pages and artefacts have one origin.
        lines += ["", f"![{figure}](get-artifact?path={figure}&run_uuid={run_id})"]
    return "\n".join(lines)


def _rounded(table: Table) -> Iterable[list[object]]:
    for row in table.rows:
        yield [f"{value:.3g}" if isinstance(value, float) else value for value in row]


def _escaped(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|#!~])", r"\\\1", text)


def improvement_table(analyses: Iterable[StageAnalysis]) -> Table:
    """Probability of improvement of each pair of conditions."""
    return Table(
        name="probability_of_improvement",
        columns=(
            *("stage", "tasks", "first", "second", "probability_first_higher", "lower", "upper"),
            *("gap", "gap_lower", "gap_upper", "p_value_holm", "decided"),
        ),
        rows=[
            (
                analysis.stage.name,
                scope.name,
                pair.first.condition.label,
                pair.second.condition.label,
                float(pair.estimate.value),
                float(pair.estimate.lower),
                float(pair.estimate.upper),
                *(float(end) for end in (pair.gap.value, pair.gap.lower, pair.gap.upper)),
                pair.p_value,
                pair.decided,
            )
            for analysis in analyses
            for scope in analysis.scopes
            for pair in scope.comparisons
        ],
    )


def waits_table(analyses: Iterable[StageAnalysis]) -> Table:
    """Environment steps to each success rate."""
    return Table(
        name="steps_to_threshold",
        columns=(
            *("stage", "task", "condition", "threshold", "runs", "reached"),
            *("median_env_steps", "lower", "upper", "each_run"),
        ),
        rows=[
            (
                analysis.stage.name,
                wait.task,
                wait.condition.label,
                wait.threshold,
                wait.runs,
                wait.reached,
                wait.median,
                wait.lower,
                wait.upper,
                " ".join(
                    f"{steps:.0f}" if there else f">{steps:.0f}"
                    for steps, there in zip(wait.waits.steps, wait.waits.reached, strict=True)
                ),
            )
            for analysis in analyses
            for wait in analysis.waits
        ],
    )


def races_table(analyses: Iterable[StageAnalysis]) -> Table:
    """Who gets to each success rate sooner, by pairs of conditions."""
    return Table(
        name="probability_sooner",
        columns=(
            *("stage", "task", "threshold", "first", "second", "probability_first_sooner"),
            *("lower", "upper", "p_value_holm", "decided", "reached"),
        ),
        rows=[
            (
                analysis.stage.name,
                race.task,
                race.threshold,
                race.first,
                race.second,
                float(race.estimate.value),
                float(race.estimate.lower),
                float(race.estimate.upper),
                race.p_value,
                race.decided,
                race.reached,
            )
            for analysis in analyses
            for race in analysis.races
        ],
    )


def runs_table(sweep: Sweep) -> Table:
    """Every run."""
    return Table(
        name="runs",
        columns=(
            *("run_id", "name", "stage", "task", "entropic_index", "seed", "status", "env_steps"),
            *("budget", "seconds", "success_rate", "episode_return", "failure"),
            *("shannon_entropy", "tsallis_entropy"),
        ),
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
