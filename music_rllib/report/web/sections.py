"""The tables of a report's page."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from music_rllib import names
from music_rllib.report.pieces import Cell, TextTable, number
from music_rllib.report.search_tables import search_in_words, search_tables
from music_rllib.results.analysis import StageAnalysis, Wait
from music_rllib.results.comparison import SHOW_SEEDS_BELOW, each_seed, interval_text, p_text
from music_rllib.results.comparison import number as in_short
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import SIGNIFICANCE, Estimate
from music_rllib.results.time_to_threshold import FEWEST_FOR_INTERVAL

__all__ = [
    "all_runs",
    "budget",
    "failures",
    "origin",
    "performance_tables",
    "search_section",
    "state_in_words",
]

DASH = "–"
MOST_ROWS = 30
"""Of a search's table; a longer one is folded."""
LONG = 40
"""Characters from which on a cell has several lines."""


def performance_tables(analyses: Sequence[StageAnalysis]) -> list[TextTable]:
    """What runs ended at, when they got somewhere, and the comparisons: of every stage."""
    kinds = (_final_table, _entropy_table, _waits_table, _races_table, _improvement_table)
    return [_of_stages([(one.stage.name, kind(one)) for one in analyses]) for kind in kinds]


def _of_stages(tables: Sequence[tuple[str, TextTable]]) -> TextTable:
    """The same table of several stages as one that names them."""
    if len(tables) == 1:
        return tables[0][1]
    rows = [(stage, *row) for stage, table in tables for row in table.rows]
    first = tables[0][1]
    return replace(first, header=("Stage", *first.header), rows=rows)


def _final_table(analysis: StageAnalysis) -> TextTable:
    rows = [
        (
            scope.name,
            final.condition.label,
            names.word_of(scope.metric),
            number(in_short(final.value)),
            interval_text(final.estimate),
            " ".join(map(in_short, each_seed(final))) or DASH,
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
        (
            scope.name,
            final.condition.label,
            *(
                cell
                for one in analysis.entropies[scope.name, final.condition]
                for cell in _with_interval(one)
            ),
        )
        for scope in analysis.scopes
        for final in scope.finals
        if any(analysis.entropies[scope.name, final.condition])
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


def _with_interval(estimate: Estimate | None) -> tuple[Cell, str]:
    if estimate is None:
        return number(DASH), DASH
    return number(in_short(estimate.value)), interval_text(estimate)


def _waits_table(analysis: StageAnalysis) -> TextTable:
    rows = [
        (
            wait.task,
            wait.condition.label,
            f"{wait.threshold * 100:.0f} %",
            f"{wait.reached} of {wait.runs}",
            number(_steps(wait.median)),
            _between(wait),
            _each_wait(wait),
        )
        for wait in sorted(analysis.waits, key=lambda wait: (wait.threshold, wait.task))
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


def _races_table(analysis: StageAnalysis) -> TextTable:
    rows = [
        (
            race.task,
            f"{race.first} before {race.second}",
            f"{race.threshold * 100:.0f} %",
            *(
                (
                    number(in_short(race.estimate.value)),
                    interval_text(race.estimate),
                    p_text(race.p_value),
                    "yes" if race.decided else "no",
                )
                if race.reached
                else (number(DASH), "not reached by either", DASH, "no")
            ),
        )
        for race in sorted(analysis.races, key=lambda race: (race.threshold, race.task))
    ]
    return TextTable(
        title="Who gets there sooner",
        header=(
            *("Task", "Pair", "Success", "Probability"),
            *("95 % interval", "Permutation", "Decided"),
        ),
        rows=rows,
        note="Probability that a run of the first reaches the success rate in fewer environment "
        "steps than a run of the second (ties half; whoever ends below it is last). Decided: "
        f"p < {SIGNIFICANCE:g} after Holm's correction.",
    )


def _improvement_table(analysis: StageAnalysis) -> TextTable:
    rows = [
        (
            scope.name,
            f"{pair.first.condition.label} over {pair.second.condition.label}",
            number(in_short(pair.gap.value)),
            interval_text(pair.gap),
            number(in_short(pair.estimate.value)),
            interval_text(pair.estimate),
            p_text(pair.p_value),
            "yes" if pair.decided else "no",
        )
        for scope in analysis.scopes
        for pair in scope.comparisons
    ]
    return TextTable(
        title="Who ends higher",
        header=(
            *("Task", "Pair", "Gap", "95 % interval", "Probability", "95 % interval"),
            *("Permutation", "Decided"),
        ),
        rows=rows,
        note="Gap: of the means. Probability of improvement: that a run of the first ends higher "
        f"than a run of the second (ties half). Decided: p < {SIGNIFICANCE:g} after Holm's "
        "correction.",
    )


def search_section(search: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a search found: in words, and its tables."""
    tables = [
        replace(
            found,
            rows=[[_search_cell(shown) for shown in row] for row in found.rows],
            long=len(found.rows) > MOST_ROWS,
        )
        for found in search_tables(search)
    ]
    return {"stage": search["stage"], "words": search_in_words(search), "tables": tables}


def _search_cell(shown: object) -> Cell:
    text = str(shown)
    is_number = text.rstrip(" %").replace(".", "").replace("-", "").isdigit()
    return number(text) if is_number else Cell(text=text, kind="long" * (len(text) > LONG))


def budget(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> TextTable:
    """Steps and wall time of each stage."""
    rows = []
    for analysis in analyses:
        runs = analysis.stage.runs
        done = sum(sweep.last_step(run) for run in runs)
        budget = sum(sweep.runs[run].budget or 0 for run in runs)
        seconds = [s for run in runs if (s := sweep.runs[run].seconds) is not None]
        rows.append(
            (
                analysis.stage.name,
                len(runs),
                number(f"{done:,}"),
                number(f"{budget:,}" if budget else DASH),
                number(_clock(sum(seconds)) if seconds else DASH),
                number(_clock(statistics.median(seconds)) if seconds else DASH),
            )
        )
    return TextTable(
        title="Budget and wall time",
        header=("Stage", "Runs", "Env steps done", "Planned", "Wall time, all runs", "Median run"),
        rows=rows,
        note="h:min:s from each run's start to its end in MLflow, pauses included. Runs that are "
        "not over count for no time.",
    )


def failures(sweep: Sweep) -> TextTable:
    """The runs that failed."""
    return TextTable(
        title="What failed and why",
        header=("Run", "Env steps", "Cause"),
        rows=[
            (
                _run_cell(sweep, position),
                f"{sweep.last_step(position):,}",
                Cell(text=run.failure or "no cause was recorded", kind="long", code=True),
            )
            for position, run in enumerate(sweep.runs)
            if run.status == "FAILED"
        ],
    )


def all_runs(sweep: Sweep) -> TextTable:
    """Every run."""
    return TextTable(
        title=f"All {len(sweep.runs)} runs",
        header=("Run", "State", "Env steps", "Last evaluation", "Wall time", "MLflow run"),
        rows=[
            (
                _run_cell(sweep, position),
                state_in_words(run.status),
                number(f"{sweep.last_step(position):,}"),
                number(_last(sweep, position)),
                number(DASH if run.seconds is None else _clock(run.seconds)),
                Cell(text=run.run_id, code=True),
            )
            for position, run in enumerate(sweep.runs)
        ],
    )


def origin(sweep: Sweep, command: str) -> TextTable:
    """Code, versions and place behind the numbers."""
    versions = sorted(
        (name.removeprefix(names.TAG_VERSION_PREFIX), value)
        for name, value in sweep.tags.items()
        if name.startswith(names.TAG_VERSION_PREFIX)
    )
    said = ", ".join(f"{name} {value}" for name, value in versions)
    commit = sweep.tags.get(names.TAG_GIT_COMMIT, "unknown")
    return TextTable(
        title="Where it comes from",
        header=("What", "Value"),
        rows=[
            ("MLflow", Cell(text=sweep.source, kind="long", code=True)),
            ("Experiment", f"{sweep.name}, id {sweep.experiment_id}"),
            ("Sweep's run", Cell(text=sweep.run_id, url=sweep.url(sweep.run_id))),
            ("Code", Cell(text=commit, code=True)),
            ("Versions", Cell(text=said or "unknown", kind="long")),
            ("This report", Cell(text=command, kind="long", code=True)),
        ],
    )


def _run_cell(sweep: Sweep, run: int) -> Cell:
    record = sweep.runs[run]
    return Cell(text=record.name, url=sweep.url(record.run_id))


def _last(sweep: Sweep, run: int) -> str:
    value = sweep.final(run, sweep.primary_metric(sweep.runs[run].task))
    return DASH if value is None else in_short(value)


def _steps(value: float) -> str:
    return "not reached" if math.isinf(value) else f"{value:,.0f}"


def _each_wait(wait: Wait) -> str:
    if wait.runs >= SHOW_SEEDS_BELOW:
        return DASH
    found = zip(wait.waits.steps, wait.waits.reached, strict=True)
    return " ".join(
        f"{steps:,.0f}" if there else f">{steps:,.0f}" for steps, there in sorted(found)
    )


def _between(wait: Wait) -> str:
    if math.isnan(wait.lower) or not wait.reached:
        return "no interval"
    upper = "beyond the budget" if math.isinf(wait.upper) else f"{wait.upper:,.0f}"
    return upper if math.isinf(wait.lower) else f"{wait.lower:,.0f} to {upper}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def state_in_words(status: str) -> str:
    """MLflow's status of a run or a sweep."""
    return {"KILLED": "stopped", "SCHEDULED": "waiting"}.get(status, status.lower())
