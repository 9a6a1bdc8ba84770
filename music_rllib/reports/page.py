"""The page: every section of a sweep's report."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from music_rllib.reports.films import Film, Films
from music_rllib.reports.gallery import CURVES, FINALS, INFLUENCE, PROFILES, Drawing, slug
from music_rllib.reports.html import (
    Cell,
    bullets,
    document,
    facts,
    legend,
    link,
    paragraph,
    table,
    text,
)
from music_rllib.reports.influence import FEWEST_RUNS, varied
from music_rllib.reports.pictures import Pictures
from music_rllib.reports.searches import search_in_words, search_tables
from music_rllib.reports.tables import last_success
from music_rllib.results.analysis import StageAnalysis, Wait
from music_rllib.results.conditions import SIDE_BY_SIDE
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import SIGNIFICANCE
from music_rllib.results.verdict import interval_text, p_text, verdict
from music_rllib.tracking import names

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
    sections = [
        _head(report),
        *map(_search, report.sweep.searches),
        _side_by_side(report),
        # What comes of a sweep is in its last stage.
        *(_stage(report, analysis) for analysis in reversed(report.analyses)),
        _films(report.films),
        _budget(report.sweep, report.analyses),
        _failures(report.sweep),
        _all_runs(report.sweep),
        _origin(report),
        _method(),
    ]
    return document(f"{report.sweep.name}: sweep report", "\n".join(filter(None, sections)))


def _head(report: Report) -> str:
    sweep = report.sweep
    states = Counter(run.status for run in sweep.runs)
    stages = [analysis.stage for analysis in report.analyses]
    seeds = sorted({len(stage.seeds) for stage in stages})
    parts = [
        f"<h1>{text(sweep.name)}</h1>",
        facts(
            (
                ("Sweep", _state(sweep.status)),
                ("Runs finished", f"{states['FINISHED']} of {len(sweep.runs)} begun"),
                ("Seeds per condition", _range(seeds)),
                ("Tasks", ", ".join(dict.fromkeys(t for s in stages for t in s.tasks)) or DASH),
                ("Began", _date(sweep.started)),
            )
        ),
    ]
    if report.missing:
        parts.append(f'<div class="note"><strong>Missing</strong>{bullets(report.missing)}</div>')
    if len(stages) > 1:
        links = " ".join(link(s.name, f"#stage-{slug(s.name)}") for s in reversed(stages))
        parts.append(f'<nav class="soft">Stages: {links}</nav>')
    return "".join(parts)


def _search(search: Mapping[str, Any]) -> str:
    parts = [f"<section><h2>Search of stage {text(search['stage'])}</h2>"]
    parts.append(paragraph(search_in_words(search)))
    for found in search_tables(search):
        rows = [[_search_cell(shown) for shown in row] for row in found.rows]
        shown = table(found.header, rows, found.note)
        parts.append(
            f"<details><summary><strong>{text(found.title)}</strong></summary>{shown}</details>"
            if len(rows) > MOST_ROWS
            else f"<h3>{text(found.title)}</h3>{shown}"
        )
    return "".join([*parts, "</section>"])


def _search_cell(shown: str) -> Cell:
    is_number = shown.rstrip(" %").replace(".", "").replace("-", "").isdigit()
    return _number(shown) if is_number else Cell(text(shown), "long" * (len(shown) > LONG))


def _side_by_side(report: Report) -> str:
    drawn = {drawing.title: drawing for drawing in report.drawings if drawing.stage == SIDE_BY_SIDE}
    if not drawn:
        return ""
    parts = [_figure(report, drawn, CURVES[0])]
    if report.together is not None:
        parts += [_races_table(report.together), _improvement_table(report.together)]
        parts.append(paragraph("Of each stage the runs of the conditions that all have.", "soft"))
    return f"<section><h2>Stages side by side</h2>{''.join(parts)}</section>"


def _stage(report: Report, analysis: StageAnalysis) -> str:
    stage = analysis.stage
    seeds = ", ".join(stage.seeds)
    parts = [
        f'<section id="stage-{slug(stage.name)}"><h2>Stage {text(stage.name)} '
        f"({text(stage.variant)})</h2>",
        paragraph(
            f"{len(stage.conditions)} condition{'s' * (len(stage.conditions) != 1)} on "
            f"{', '.join(stage.tasks)}; seeds {seeds}.",
            "soft",
        ),
    ]
    if stage.compared not in ((), stage.conditions):
        parts.append(
            paragraph("Curves and comparisons are of the runs on fresh seeds; tables have all.")
        )
    if not stage.has_task_reward:
        parts.append(paragraph("It trains without the task's reward: success is not its aim."))
    for scope in analysis.scopes:
        said = "".join(paragraph(line) for line in verdict(scope, report.difference))
        parts.append(f'<div class="verdict">{said}</div>')
    drawn = {drawing.title: drawing for drawing in report.drawings if drawing.stage == stage.name}
    parts += [_figure(report, drawn, title) for title in (CURVES[0], FINALS)]
    parts += [_final_table(analysis), _waits_table(analysis), _races_table(analysis)]
    parts.append(_improvement_table(analysis))
    parts += [_figure(report, drawn, title) for title in (PROFILES, *INFLUENCE, *CURVES[1:])]
    parts.append(_why_no_influence(report, analysis, drawn))
    return "".join([*parts, "</section>"])


def _figure(report: Report, drawn: dict[str, Drawing], title: str) -> str:
    drawing = drawn.get(title)
    if drawing is None:
        return ""
    panels = "".join(f"<div>{svg}</div>" for svg in report.pictures[drawing.name].inline)
    return (
        f'<figure id="{drawing.name}"><h3>{text(title)}</h3>{legend(drawing.legend)}'
        f'<div class="panels">{panels}</div>'
        f"<figcaption>{text(drawing.caption)}</figcaption></figure>"
    )


def _why_no_influence(report: Report, analysis: StageAnalysis, drawn: Mapping[str, Drawing]) -> str:
    """What would have to vary for the figures that are not there."""
    absent = [title for title in INFLUENCE if title not in drawn]
    if not absent or len(analysis.stage.conditions) == 1:
        return ""
    settings = ", ".join(varied(analysis.stage.conditions)) or "nothing"
    return paragraph(
        f"Not drawn: {', '.join(title.lower() for title in absent)}. This stage varies {settings}; "
        "sensitivity needs α or the MI weight, the other two need a second setting beside q and "
        f"finished runs (importance: {FEWEST_RUNS} on a task).",
        "soft",
    )


def _final_table(analysis: StageAnalysis) -> str:
    rows = [
        (
            scope.name,
            final.condition.label,
            _number(f"{float(final.estimate.value):.2f}"),
            interval_text(final.estimate),
            final.seeds,
            final.runs,
        )
        for scope in analysis.scopes
        for final in scope.finals
    ]
    if not rows:
        return ""
    return "<h3>Final success rate</h3>" + table(
        ("Task", "Condition", "IQM", "95 % interval", "Seeds", "Runs"),
        rows,
        "Interquartile mean of the last evaluation of finished runs; over all tasks, of the seeds "
        "that have finished on each of them.",
    )


def _waits_table(analysis: StageAnalysis) -> str:
    if not analysis.waits:
        return ""
    rows = [
        (
            wait.task,
            wait.condition.label,
            f"{wait.threshold * 100:.0f} %",
            f"{wait.reached} of {wait.runs}",
            _number(_steps(wait.median)),
            _between(wait),
        )
        for wait in sorted(analysis.waits, key=lambda wait: (wait.threshold, wait.task))
    ]
    return "<h3>Environment steps to a success rate</h3>" + table(
        ("Task", "Condition", "Success", "Got there", "Median steps", "95 % interval"),
        rows,
        "First evaluation at or above the success rate. Runs that never got there count as not "
        "there yet at their last evaluation (Kaplan-Meier median): none is left out.",
    )


def _races_table(analysis: StageAnalysis) -> str:
    if not analysis.races:
        return ""
    rows = [
        (
            race.task,
            f"{race.first} before {race.second}",
            f"{race.threshold * 100:.0f} %",
            _number(f"{float(race.estimate.value):.2f}"),
            interval_text(race.estimate),
            p_text(race.p_value),
            "yes" if race.decided else "no",
        )
        for race in sorted(analysis.races, key=lambda race: (race.threshold, race.task))
    ]
    return "<h3>Who gets there sooner</h3>" + table(
        ("Task", "Pair", "Success", "Probability", "95 % interval", "Permutation", "Decided"),
        rows,
        "Probability that a run of the first reaches the success rate in fewer environment steps "
        "than a run of the second (ties half; whoever ends below it is last). Decided: "
        f"p < {SIGNIFICANCE:g} after Holm's correction.",
    )


def _improvement_table(analysis: StageAnalysis) -> str:
    rows = [
        (
            scope.name,
            f"{pair.first.condition.label} over {pair.second.condition.label}",
            _number(f"{float(pair.estimate.value):.2f}"),
            interval_text(pair.estimate),
            "overlap" if pair.overlaps else "apart",
            p_text(pair.p_value),
            "yes" if pair.decided else "no",
        )
        for scope in analysis.scopes
        for pair in scope.comparisons
    ]
    if not rows:
        return ""
    return "<h3>Probability of improvement</h3>" + table(
        ("Task", "Pair", "Probability", "95 % interval", "Final rates", "Permutation", "Decided"),
        rows,
        "Probability that a run of the first ends higher than a run of the second (ties half). "
        f"Decided: the intervals of the final rates are apart and p < {SIGNIFICANCE:g} after "
        "Holm's correction.",
    )


def _films(films: Films | None) -> str:
    if films is None or not (films.films or films.why_not):
        return ""
    shown = "".join(
        f"<figure>{_player(film)}<figcaption>q = {text(film.entropic_index)} on {text(film.task)}: "
        f"{_OUTCOMES[film.success]}. {text(film.run)}</figcaption></figure>"
        for film in films.films
    )
    parts = ["<h2>Videos</h2>"]
    if shown:
        parts.append(
            paragraph(
                "One episode each, with the same start and goal for every q: an example, and no "
                "evidence. The policy is that of the middle run by final success.",
                "soft",
            )
            + f'<div class="panels videos">{shown}</div>'
        )
    if films.why_not:
        parts.append(
            paragraph(
                f"No video of {films.why_not}" if shown else f"No videos: {films.why_not}", "soft"
            )
        )
    return "".join(parts)


_OUTCOMES = {True: "goal reached", False: "goal not reached", None: "the task names no success"}


def _player(film: Film) -> str:
    label = f"An episode with q = {film.entropic_index} on {film.task}"
    if film.ending == "gif":
        return f'<img src="{film.uri}" alt="{text(label)}">'
    return (
        f'<video src="{film.uri}" aria-label="{text(label)}" controls loop muted playsinline>'
        "</video>"
    )


def _budget(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> str:
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
                _number(f"{done:,}"),
                _number(f"{budget:,}" if budget else DASH),
                _number(_clock(sum(seconds)) if seconds else DASH),
                _number(_clock(statistics.median(seconds)) if seconds else DASH),
            )
        )
    if not rows:
        return ""
    return "<h2>Budget and wall time</h2>" + table(
        ("Stage", "Runs", "Env steps done", "Planned", "Wall time, all runs", "Median run"),
        rows,
        "h:min:s from each run's start to its end in MLflow, pauses included. Runs that are not "
        "over count for no time.",
    )


def _failures(sweep: Sweep) -> str:
    rows = [
        (
            Cell(_run_link(sweep, position)),
            f"{sweep.last_step(position):,}",
            Cell(f"<code>{text(run.failure or 'no cause was recorded')}</code>", "long"),
        )
        for position, run in enumerate(sweep.runs)
        if run.status == "FAILED"
    ]
    if not rows:
        return ""
    return "<h2>What failed and why</h2>" + table(("Run", "Env steps", "Cause"), rows)


def _all_runs(sweep: Sweep) -> str:
    if not sweep.runs:
        return ""
    rows = [
        (
            Cell(_run_link(sweep, position)),
            _state(run.status),
            _number(f"{sweep.last_step(position):,}"),
            _number(_rate(last_success(sweep, position))),
            _number(DASH if run.seconds is None else _clock(run.seconds)),
            Cell(f"<code>{text(run.run_id)}</code>"),
        )
        for position, run in enumerate(sweep.runs)
    ]
    return (
        f"<details><summary><strong>All {len(rows)} runs</strong>, with their ids in MLflow"
        "</summary>"
        + table(("Run", "State", "Env steps", "Last success", "Wall time", "MLflow run"), rows)
        + "</details>"
    )


def _origin(report: Report) -> str:
    sweep = report.sweep
    versions = sorted(
        (name.removeprefix(names.TAG_VERSION_PREFIX), value)
        for name, value in sweep.tags.items()
        if name.startswith(names.TAG_VERSION_PREFIX)
    )
    rows = [
        ("MLflow", Cell(f"<code>{text(sweep.source)}</code>", "long")),
        ("Experiment", Cell(f"{text(sweep.name)}, id <code>{text(sweep.experiment_id)}</code>")),
        ("Sweep's run", Cell(link(sweep.run_id, sweep.url(sweep.run_id)))),
        ("Code", Cell(f"<code>{text(sweep.tags.get(names.TAG_GIT_COMMIT, 'unknown'))}</code>")),
        ("Versions", Cell(text(", ".join(f"{n} {v}" for n, v in versions) or "unknown"), "long")),
        ("This report", Cell(f"<code>{text(report.command)}</code>", "long")),
    ]
    parts = ["<h2>Where it comes from</h2>", table(("What", "Value"), rows)]
    if sweep.config is not None:
        parts += [
            "<p>To repeat the sweep, save this as <code>sweep.yaml</code>, then "
            "<code>python -m music_rllib.sweep sweep.yaml</code>:</p>",
            f"<pre>{text(sweep.config)}</pre>",
        ]
    return "".join(parts)


def _method() -> str:
    return "<h2>How to read this</h2>" + bullets(
        (
            "IQM: the mean of the middle half of the runs; less moved by one odd seed than the "
            "mean, less wasteful than the median.",
            "Intervals: 95 %, percentile bootstrap, runs resampled within each task (stratified). "
            "From fewer than five seeds they are too narrow; from one there is none.",
            "Success rate is that of deterministic evaluation episodes at their last step. Only "
            "finished runs have a final one.",
            "Definitions: Agarwal et al. 2021, Deep Reinforcement Learning at the Edge of the "
            "Statistical Precipice (arXiv:2108.13264).",
        )
    )


def _run_link(sweep: Sweep, run: int) -> str:
    record = sweep.runs[run]
    return link(record.name, sweep.url(record.run_id))


def _number(shown: str) -> Cell:
    return Cell(text(shown), "number")


def _rate(value: float | None) -> str:
    return DASH if value is None or math.isnan(value) else f"{value:.2f}"


def _steps(value: float) -> str:
    return "not reached" if math.isinf(value) else f"{value:,.0f}"


def _between(wait: Wait) -> str:
    if math.isnan(wait.lower):
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
