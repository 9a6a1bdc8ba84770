"""The tables of a report's page."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from music_rllib import names
from music_rllib.report.pieces import DASH, Cell, TextTable, estimate_cells, number_cell
from music_rllib.report.search_tables import search_in_words, search_tables
from music_rllib.results.analysis import StageAnalysis, TimeToThreshold
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import FEWEST_FOR_INTERVAL, SHOW_SEEDS_BELOW, number

UNFOLDED_ROWS = 30
"""Largest number of rows of a search's table that is shown unfolded."""
UNWRAPPED_LETTERS = 40
"""Largest number of letters of a search's table cell that is shown in one line."""


def performance_tables(analyses: Sequence[StageAnalysis]) -> list[TextTable]:
    """Final values, entropies, steps to a threshold and comparisons of all stages."""
    tables = (_final_table, _entropy_table, _waits_table, _improvement_table)
    return [_of_stages([(one.stage.name, table(one)) for one in analyses]) for table in tables]


def _of_stages(tables: Sequence[tuple[str, TextTable]]) -> TextTable:
    """One table with the rows of all stages, and a column for the stage if there are several."""
    first = tables[0][1]
    if len(tables) == 1:
        return first
    rows = [(stage, *row) for stage, table in tables for row in table.rows]
    return replace(first, header=("Stage", *first.header), rows=rows)


def _final_table(analysis: StageAnalysis) -> TextTable:
    rows = [
        (
            scope.name,
            final.condition.label,
            names.word_of(scope.metric),
            *estimate_cells(final.estimate),
            " ".join(map(number, final.each_seed)) or DASH,
            final.seeds,
            final.runs,
        )
        for scope in analysis.scopes
        for final in scope.finals
    ]
    return TextTable(
        title="What runs ended at",
        header=(
            *("Task", "Condition", "Metric", "Mean", "95 % interval"),
            *("Each seed", "Seeds", "Runs"),
        ),
        rows=rows,
        note="Mean of the last evaluation of finished runs; over all tasks, of the seeds that have "
        f"finished on each of them. Fewer than {SHOW_SEEDS_BELOW} seeds are shown one by one.",
    )


def _entropy_table(analysis: StageAnalysis) -> TextTable:
    rows = [
        (scope, condition.label, *estimate_cells(found.shannon), *estimate_cells(found.tsallis))
        for (scope, condition), found in analysis.entropies.items()
        if any(found)
    ]
    return TextTable(
        title="How random policies are at the end",
        header=(
            *("Task", "Condition", "Shannon entropy (nats)", "95 % interval"),
            *("S_q", "95 % interval"),
        ),
        rows=rows,
        note="Entropies of the policy over all action dimensions, means over finished runs. Where "
        "the Shannon entropies of two q differ, what they end at may differ for that and not for "
        "q. S_q is measured with each run's own q: over different q it is not to be compared.",
    )


def _waits_table(analysis: StageAnalysis) -> TextTable:
    rows = [
        (
            wait.task,
            wait.condition.label,
            _percent(wait.threshold),
            f"{wait.reached.sum()} of {len(wait.reached)}",
            number_cell(
                "not reached" if math.isinf(wait.median.value) else f"{wait.median.value:,.0f}"
            ),
            _wait_interval(wait),
            _wait_of_each_run(wait),
        )
        for wait in sorted(analysis.times, key=lambda wait: (wait.threshold, wait.task))
    ]
    return TextTable(
        title="Environment steps to a success rate",
        header=(
            *("Task", "Condition", "Success", "Got there", "Median steps", "95 % interval"),
            "Each run",
        ),
        rows=rows,
        note="First evaluation at or above the success rate. Runs that never got there count as "
        "not there yet at their last evaluation (Kaplan-Meier median): none is left out. The "
        f"interval is that of the runs' order, which needs {FEWEST_FOR_INTERVAL} of them.",
    )


def _improvement_table(analysis: StageAnalysis) -> TextTable:
    rows = [
        (
            scope.name,
            f"{pair.first.condition.label} - {pair.second.condition.label}",
            *estimate_cells(pair.gap),
            number_cell(_percent(pair.improvement)),
        )
        for scope in analysis.scopes
        for pair in scope.differences
    ]
    return TextTable(
        title="Differences of the final values",
        header=("Task", "Pair", "Difference", "95 % interval", "Probability of improvement"),
        rows=rows,
        note="Difference of the means, without a test: comparisons are above. Probability of "
        "improvement: a run of the first ends higher than a run of the second (ties half).",
    )


def search_section(search: Mapping[str, Any]) -> Mapping[str, Any]:
    """A search's stage, its summary in a sentence, and its tables."""
    tables = [
        replace(
            table,
            rows=[[_search_cell(text) for text in row] for row in table.rows],
            long=len(table.rows) > UNFOLDED_ROWS,
        )
        for table in search_tables(search)
    ]
    return {"stage": search["stage"], "words": search_in_words(search), "tables": tables}


def _search_cell(value: object) -> Cell:
    text = str(value)
    if text.rstrip(" %").replace(".", "").replace("-", "").isdigit():
        return number_cell(text)
    return Cell(text=text, kind="long" if len(text) > UNWRAPPED_LETTERS else "")


def budget(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> TextTable:
    """Environment steps and wall time of each stage."""
    rows = []
    for analysis in analyses:
        runs = analysis.stage.runs
        done = sum(sweep.last_step(run) for run in runs)
        planned = sum(sweep.runs[run].budget or 0 for run in runs)
        seconds = [s for run in runs if (s := sweep.runs[run].seconds) is not None]
        rows.append(
            (
                analysis.stage.name,
                len(runs),
                number_cell(f"{done:,}"),
                number_cell(f"{planned:,}" if planned else DASH),
                _time_cell(sum(seconds) if seconds else None),
                _time_cell(statistics.median(seconds) if seconds else None),
            )
        )
    return TextTable(
        title="Budget and wall time",
        header=("Stage", "Runs", "Env steps done", "Planned", "Wall time, all runs", "Median run"),
        rows=rows,
        note="h:min:s from each run's start to its last report, pauses included. Runs that are "
        "not over count for no time.",
    )


def failures(sweep: Sweep) -> TextTable:
    """The failed and the damaged runs, with the causes."""
    return TextTable(
        title="What failed and why",
        header=("Run", "Env steps", "Cause"),
        rows=[
            (
                run.name,
                f"{sweep.last_step(position):,}",
                Cell(text=run.failure or "no cause was recorded", kind="long", code=True),
            )
            for position, run in enumerate(sweep.runs)
            if run.status == "FAILED" or (run.status == "KILLED" and run.failure)
        ],
    )


def all_runs(sweep: Sweep) -> TextTable:
    """Every run of the sweep."""
    finals = (sweep.final(i, sweep.primary_metric(run.task)) for i, run in enumerate(sweep.runs))
    return TextTable(
        title=f"All {len(sweep.runs)} runs",
        header=("Run", "State", "Env steps", "Last evaluation", "Wall time", "Key"),
        rows=[
            (
                run.name,
                state_in_words(run.status),
                number_cell(f"{sweep.last_step(position):,}"),
                number_cell(DASH if final is None else number(final)),
                _time_cell(run.seconds),
                Cell(text=run.run_id, code=True),
            )
            for position, (run, final) in enumerate(zip(sweep.runs, finals, strict=True))
        ],
    )


def origin(sweep: Sweep, command: str) -> TextTable:
    """The storage, the code and the versions that the numbers come from."""
    versions = sorted(
        f"{name.removeprefix(names.TAG_VERSION_PREFIX)} {value}"
        for name, value in sweep.tags.items()
        if name.startswith(names.TAG_VERSION_PREFIX)
    )
    commit = sweep.tags.get(names.TAG_GIT_COMMIT, "unknown")
    return TextTable(
        title="Where it comes from",
        header=("What", "Value"),
        rows=[
            ("Read from", Cell(text=sweep.source, kind="long", code=True)),
            ("Code", Cell(text=commit, code=True)),
            ("Versions", Cell(text=", ".join(versions) or "unknown", kind="long")),
            ("This report", Cell(text=command, kind="long", code=True)),
        ],
    )


def _wait_of_each_run(wait: TimeToThreshold) -> str:
    if len(wait.steps) >= SHOW_SEEDS_BELOW:
        return DASH
    runs = sorted(zip(wait.steps, wait.reached, strict=True))
    return " ".join(f"{'' if reached else '>'}{steps:,.0f}" for steps, reached in runs)


def _wait_interval(wait: TimeToThreshold) -> str:
    lower, upper = float(wait.median.lower), float(wait.median.upper)
    if math.isnan(lower) or not wait.reached.any():
        return "no interval"
    end = "beyond the budget" if math.isinf(upper) else f"{upper:,.0f}"
    return end if math.isinf(lower) else f"{lower:,.0f} to {end}"


def _time_cell(seconds: float | None) -> Cell:
    """A duration as h:min:s."""
    if seconds is None:
        return number_cell(DASH)
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return number_cell(f"{hours}:{minutes:02d}:{rest:02d}")


def _percent(share: float) -> str:
    return f"{share * 100:.0f} %"


def state_in_words(status: str) -> str:
    """A word for the status of a run or a sweep."""
    return {"KILLED": "stopped", "SCHEDULED": "waiting"}.get(status, status.lower())
