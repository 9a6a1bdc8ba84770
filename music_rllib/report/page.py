"""The page: every section of a sweep's report."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

from music_rllib import names
from music_rllib.report.figures.choice import (
    CURVES,
    FINALS,
    INFLUENCE,
    PRIMARY,
    PROFILES,
    Drawing,
    slug,
)
from music_rllib.report.figures.draw import Pictures
from music_rllib.report.figures.importance import FEWEST_RUNS, varied
from music_rllib.report.pieces import Cell, Figure, TextTable, document, number
from music_rllib.report.search_tables import search_in_words, search_tables
from music_rllib.report.videos import Films
from music_rllib.results.analysis import StageAnalysis, Wait
from music_rllib.results.comparison import (
    SHOW_SEEDS_BELOW,
    each_seed,
    interval_text,
    p_text,
    verdict,
)
from music_rllib.results.comparison import number as in_short
from music_rllib.results.conditions import SIDE_BY_SIDE
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import SIGNIFICANCE
from music_rllib.results.time_to_threshold import FEWEST_FOR_INTERVAL

__all__ = ["Report", "render"]

DASH = "–"
MOST_ROWS = 30
"""Of a search's table; a longer one is folded."""
LONG = 40
"""Characters from which on a cell has several lines."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Everything that the page shows."""

    sweep: Sweep
    analyses: Sequence[StageAnalysis]
    together: StageAnalysis | None
    """Stages against each other; None where there is nothing to compare."""
    drawings: Sequence[Drawing]
    pictures: Mapping[str, Pictures]
    """By the drawings' names."""
    missing: Sequence[str]
    difference: float
    """In success rate, which the reader would want to be able to see."""
    command: str
    """That made this report."""
    films: Films | None = None
    """None where nobody asked for videos."""


def render(report: Report) -> str:
    """The page as HTML that needs nothing else."""
    sweep = report.sweep
    return document(
        name=sweep.name,
        facts=_facts(report),
        missing=report.missing,
        searches=[_search(search) for search in sweep.searches],
        side_by_side=_side_by_side(report),
        # What comes of a sweep is in its last stage.
        stages=[_stage(report, analysis) for analysis in reversed(report.analyses)],
        films=report.films,
        outcomes=_OUTCOMES,
        budget=_budget(sweep, report.analyses),
        failures=_failures(sweep),
        runs=_all_runs(sweep),
        origin=_origin(report),
        config=sweep.config,
        method=_METHOD,
    )


def _facts(report: Report) -> Sequence[tuple[str, object]]:
    sweep = report.sweep
    states = Counter(run.status for run in sweep.runs)
    stages = [analysis.stage for analysis in report.analyses]
    seeds = sorted({len(stage.seeds) for stage in stages})
    return (
        ("Sweep", _state(sweep.status)),
        ("Runs finished", f"{states['FINISHED']} of {len(sweep.runs)} begun"),
        ("Seeds per condition", _range(seeds)),
        ("Tasks", ", ".join(dict.fromkeys(t for s in stages for t in s.tasks)) or DASH),
        ("Began", _date(sweep.started)),
    )


def _search(search: Mapping[str, Any]) -> Mapping[str, Any]:
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


def _side_by_side(report: Report) -> Mapping[str, Any] | None:
    figures = _figures(report, SIDE_BY_SIDE)
    if not figures:
        return None
    shown: dict[str, Any] = {"figures": list(figures.values()), "tables": [], "said": []}
    if report.together is not None:
        shown["tables"] = [_races_table(report.together), _improvement_table(report.together)]
        shown["said"] = ["Of each stage the runs of the conditions that all have."]
    return shown


def _stage(report: Report, analysis: StageAnalysis) -> Mapping[str, Any]:
    stage = analysis.stage
    count, seeds = len(stage.conditions), ", ".join(stage.seeds)
    said = []
    if stage.compared not in ((), stage.conditions):
        said.append("Curves and comparisons are of the runs on fresh seeds; tables have all.")
    if not stage.has_task_reward:
        said.append("It trains without the task's reward: success is not its aim.")
    drawn = _figures(report, stage.name)
    return {
        "name": stage.name,
        "slug": slug(stage.name),
        "variant": stage.variant,
        "runs": f"{count} condition{'s' * (count != 1)} on {', '.join(stage.tasks)}; "
        f"seeds {seeds}.",
        "said": said,
        "verdicts": [verdict(scope, report.difference) for scope in analysis.scopes],
        "first_figures": [drawn.get(title) for title in (*PRIMARY, *FINALS.values())],
        "tables": [
            _final_table(analysis),
            _waits_table(analysis),
            _races_table(analysis),
            _improvement_table(analysis),
        ],
        "figures": [drawn.get(title) for title in (PROFILES, *INFLUENCE, *CURVES[2:])],
        "not_drawn": _why_no_influence(analysis, drawn),
    }


def _figures(report: Report, stage: str) -> dict[str, Figure]:
    """A stage's figures by their titles."""
    return {
        drawing.title: Figure(
            name=drawing.name,
            title=drawing.title,
            caption=drawing.caption,
            legend=drawing.legend,
            panels=[
                (f"{drawing.title}, {panel.title}", svg)
                for panel, svg in zip(
                    drawing.panels, report.pictures[drawing.name].inline, strict=True
                )
            ],
        )
        for drawing in report.drawings
        if drawing.stage == stage
    }


def _why_no_influence(analysis: StageAnalysis, drawn: Mapping[str, Figure]) -> list[str]:
    """What would have to vary for the figures that are not there."""
    absent = [title for title in INFLUENCE if title not in drawn]
    if not absent or len(analysis.stage.conditions) == 1:
        return []
    settings = ", ".join(varied(analysis.stage.conditions)) or "nothing"
    return [
        f"Not drawn: {', '.join(title.lower() for title in absent)}. This stage varies {settings}; "
        "sensitivity needs α or the MI weight, the other two need a second setting beside q and "
        f"finished runs (importance: {FEWEST_RUNS} on a task)."
    ]


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


_OUTCOMES = {True: "goal reached", False: "goal not reached", None: "the task names no success"}


def _budget(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> TextTable:
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


def _failures(sweep: Sweep) -> TextTable:
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


def _all_runs(sweep: Sweep) -> TextTable:
    return TextTable(
        title=f"All {len(sweep.runs)} runs",
        header=("Run", "State", "Env steps", "Last evaluation", "Wall time", "MLflow run"),
        rows=[
            (
                _run_cell(sweep, position),
                _state(run.status),
                number(f"{sweep.last_step(position):,}"),
                number(_last(sweep, position)),
                number(DASH if run.seconds is None else _clock(run.seconds)),
                Cell(text=run.run_id, code=True),
            )
            for position, run in enumerate(sweep.runs)
        ],
    )


def _origin(report: Report) -> TextTable:
    sweep = report.sweep
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
            ("This report", Cell(text=report.command, kind="long", code=True)),
        ],
    )


_METHOD = (
    "A task is judged by its success rate, that of deterministic evaluation episodes at their last "
    "step, or by their return where it has no success. Only finished runs have a final one.",
    "Intervals: 95 %. Of a rate Korn and Graubard's, the exact one over all episodes where seeds "
    "tie; of a return Student's; of a gap from both of its ends; of a probability of "
    "improvement Newcombe's. Simulated, they cover 93 % or more from three seeds on; rare failures "
    "that no seed has shown are not in them. From one seed there is none.",
    "Permutation: the exact test over all relabellings of the runs. Three runs against three never "
    "give less than 0.1.",
    "Probability of improvement and performance profiles: Agarwal et al. 2021, Deep Reinforcement "
    "Learning at the Edge of the Statistical Precipice (arXiv:2108.13264).",
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


def _range(values: Sequence[int]) -> str:
    if not values:
        return DASH
    return str(values[0]) if len(values) == 1 else f"{values[0]} to {values[-1]}"


def _date(milliseconds: int | None) -> str:
    if milliseconds is None:
        return DASH
    return datetime.fromtimestamp(milliseconds / 1000, UTC).strftime("%Y-%m-%d %H:%M UTC")


def _state(status: str) -> str:
    return {"KILLED": "stopped", "SCHEDULED": "waiting"}.get(status, status.lower())
