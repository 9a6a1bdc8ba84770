"""The page of a report: the answer first, then figures and tables in groups."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain, groupby
from typing import Any

from music_rllib import names
from music_rllib.report.figures.choice import (
    COST,
    GROUPS,
    PERFORMANCE,
    PRIMARY,
    SENSITIVITY,
    SETTINGS,
    Drawing,
    slug,
)
from music_rllib.report.figures.draw import Figures
from music_rllib.report.figures.sensitivity import varied
from music_rllib.report.pieces import DASH, TextTable, document
from music_rllib.report.study import study_tables
from music_rllib.report.videos import Films
from music_rllib.report.web.charts import chart_data
from music_rllib.report.web.sections import (
    all_runs,
    budget,
    failures,
    origin,
    performance_tables,
    search_section,
    state_in_words,
)
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.answer import answer, planned_in_words
from music_rllib.results.conditions import SIDE_BY_SIDE
from music_rllib.results.data import Sweep
from music_rllib.results.study import Study


@dataclass(frozen=True, kw_only=True)
class Report:
    """Everything that the page shows."""

    sweep: Sweep
    analyses: Sequence[StageAnalysis]
    together: StageAnalysis | None
    """Stages against each other; None if there is nothing to compare."""
    study: Study
    """The comparisons that were planned and all others."""
    figures: Figures
    limitations: Sequence[str]
    """Sentences about what the report cannot show, and what is to be taken with care."""
    command: str
    """The command that made this report."""
    films: Films | None = None
    """None if no videos were asked for."""
    differences: Sequence[TextTable] = ()
    """Tables of how settings and results of two sweeps side by side differ."""

    @property
    def drawings(self) -> Sequence[Drawing]:
        return self.figures.drawings


def render(report: Report, *, live: bool = False) -> str:
    """The page as self-contained HTML.

    Args:
        report: the content of the page.
        live: whether the page is served and follows a running sweep.
    """
    sweep = report.sweep
    data = chart_data(sweep, report.drawings)
    numbers = {stage["name"]: number for number, stage in enumerate(data["stages"])}
    answer_lines = _answer(report)
    # The claims stand in large letters, and how runs were counted below them in small ones.
    counted = (i for i, line in enumerate(answer_lines) if line.startswith("Counted:"))
    claims = next(counted, len(answer_lines))
    return document(
        data,
        live=live,
        name=sweep.name,
        facts=_facts(report),
        limitations=report.limitations,
        question=_question(report),
        answer=answer_lines[:claims],
        counting=answer_lines[claims:],
        numbers=numbers,
        pictures=report.figures.pictures,
        large=_large_figure(report, list(numbers)),
        groups=list(_groups(report)),
        differences=[table for table in report.differences if table.rows],
        searches=[search_section(search) for search in sweep.searches],
        films=report.films,
        outcomes=_OUTCOMES,
        runs=all_runs(sweep),
        origin=origin(sweep, report.command),
        config=sweep.config,
        method=_METHOD,
    )


def _facts(report: Report) -> Sequence[tuple[str, object]]:
    sweep = report.sweep
    states = Counter(run.status for run in sweep.runs)
    stages = [analysis.stage for analysis in report.analyses]
    seeds = sorted(
        len({sweep.runs[run].seed for run in condition.runs})
        for stage in stages
        for condition in stage.compared
    )
    ends = dict.fromkeys((seeds[0], seeds[-1]) if seeds else ())
    began = DASH
    if sweep.started is not None:
        began = f"{datetime.fromtimestamp(sweep.started / 1000, UTC):%Y-%m-%d %H:%M UTC}"
    return (
        ("Sweep", state_in_words(sweep.status)),
        ("Runs finished", f"{states['FINISHED']} of {len(sweep.runs) - states['SCHEDULED']} begun"),
        ("Seeds per condition", " to ".join(map(str, ends)) or DASH),
        ("Tasks", ", ".join(dict.fromkeys(t for s in stages for t in s.tasks)) or DASH),
        ("Began", began),
    )


# The answer -------------------------------------------------------------------------------------


def _question(report: Report) -> str:
    """The question of the plan, or the one that the sweep's conditions ask."""
    if report.study.question is not None:
        return report.study.question
    if not report.analyses:
        return "Nothing has run yet."
    stage = report.study.stage or report.analyses[-1].stage
    metrics = dict.fromkeys(names.word_of(report.sweep.primary_metric(t)) for t in stage.tasks)
    aim = " or ".join("success rate" if word == "success" else word for word in metrics)
    budgets = [b for run in stage.runs if (b := report.sweep.runs[run].budget)]
    steps = f", {statistics.median(budgets):,.0f} environment steps per run" if budgets else ""
    seeds = "1 seed" if len(stage.seeds) == 1 else f"{len(stage.seeds)} seeds"
    where = f"on {_enumerated(stage.tasks)} ({seeds}{steps})"
    conditions = stage.compared or stage.conditions
    labels = [condition.short_label for condition in conditions]
    if len(labels) == 1:
        return f"What {aim} does {labels[0]} reach {where}?"
    which = _enumerated(labels, "or")
    if len(labels) > 4:
        settings = _enumerated(varied(conditions) or ["the stage"])
        which = f"{len(labels)} settings of {settings}"
    return f"Which has the higher {aim}, averaged over training, {where}: {which}?"


def _answer(report: Report) -> list[str]:
    """The study's answer without its question, and whether it was planned."""
    if not report.analyses:
        return []
    planned = planned_in_words(report.study)
    return [*answer(report.sweep, report.study)[1:], f"{planned[0].upper()}{planned[1:]}."]


# Figures ----------------------------------------------------------------------------------------


def _large_figure(report: Report, stages: Sequence[str]) -> Mapping[str, Any] | None:
    """Learning curves of the primary metrics: of all stages together, or of the last stage."""
    shown = [stage for stage in stages if stage == SIDE_BY_SIDE] or stages[-1:]
    drawings = [d for d in report.drawings if d.stage in shown and d.title in PRIMARY]
    # The reader selects its metric.
    return {**_figure("Learning curves", drawings), "metric": ""} if drawings else None


def _groups(report: Report) -> Iterable[Mapping[str, Any]]:
    """Figures, tables and remarks under each heading that has any."""
    stages = {drawing.stage for drawing in report.drawings if drawing.stage != SIDE_BY_SIDE}
    analyses = [*filter(None, [report.together]), *report.analyses]
    performance = performance_tables(analyses) if analyses else []
    tables = {
        PERFORMANCE: [*study_tables(report.study), *performance],
        COST: [budget(report.sweep, report.analyses), failures(report.sweep)],
    }
    remarks = {PERFORMANCE: list(_remarks(report)), SETTINGS: list(_not_drawn(report))}
    for group in GROUPS:
        by_title: dict[str, list[Drawing]] = {}
        for drawing in report.drawings:
            # The large figure has the primary metrics of its stages.
            is_large = drawing.stage == SIDE_BY_SIDE or len(stages) < 2
            if drawing.group == group and not (is_large and drawing.title in PRIMARY):
                by_title.setdefault(drawing.title, []).append(drawing)
        content = {
            "figures": [_figure(*item) for item in by_title.items()],
            "tables": [table for table in tables.get(group, ()) if table.rows],
            "remarks": remarks.get(group, []),
        }
        if any(content.values()):
            yield {"title": group, **content}


def _figure(title: str, drawings: Sequence[Drawing]) -> Mapping[str, Any]:
    """A figure of one or more stages; the page's script draws the curves of its metric."""
    metric = drawings[0].metric
    panels = sum(len(drawing.panels) for drawing in drawings)
    return {
        "name": slug(title),
        "title": title,
        "caption": drawings[-1].caption,
        "metric": None if metric is None else metric.name,
        "drawings": drawings,
        # A CSS class for the number of columns that it spans.
        "span": ("one", "two", "three")[min(panels, 3) - 1],
    }


def _remarks(report: Report) -> Iterable[Sequence[str]]:
    """A heading for each stage, and its peculiarities."""
    for analysis in [*filter(None, [report.together]), *reversed(report.analyses)]:
        stage = analysis.stage
        remarks = []
        if stage.compared not in ((), stage.conditions):
            remarks.append(
                "Curves and comparisons are of the runs on fresh seeds; tables have all."
            )
        if not stage.has_task_reward:
            remarks.append("It trains without the task's reward: success is not its aim.")
        if len(stage.conditions) == 1:
            only = stage.conditions[0].label
            remarks.append(f"It has a single condition ({only}): no comparison.")
        if len(stage.seeds) == 1:
            remarks.append(
                f"It has a single seed ({stage.seeds[0]}): one run shows what can happen and not "
                "what usually does; there are no intervals."
            )
        if analysis.cut_at:
            steps = sorted({f"{steps:,.0f}" for steps in analysis.cut_at.values()})
            remarks.append(
                f"Budgets differ: their final values are those after {_enumerated(steps, 'or')} "
                "steps, when the first stage ends."
            )
        heading = f"Stage {stage.name} ({stage.variant}), seeds {_in_ranges(stage.seeds)}"
        if analysis is report.together:
            heading = "Stages side by side, each by the runs of the conditions that all have"
        if remarks or len(report.analyses) > 1:
            yield [heading, *remarks]


def _in_ranges(seeds: Sequence[str]) -> str:
    """`0, 1, 1000 to 1019`."""
    if not all(seed.isdecimal() for seed in seeds):
        return ", ".join(seeds)  # of a run that came without one
    ordered = sorted(map(int, seeds))
    runs = [
        [seed for _, seed in run]
        for _, run in groupby(enumerate(ordered), key=lambda pair: pair[1] - pair[0])
    ]
    ranges = [[f"{run[0]} to {run[-1]}"] if len(run) > 2 else map(str, run) for run in runs]
    return ", ".join(chain.from_iterable(ranges))


def _not_drawn(report: Report) -> Iterable[Sequence[str]]:
    """For each stage without a figure of its settings, what that would need."""
    drawn = {drawing.stage for drawing in report.drawings if drawing.title == SENSITIVITY}
    for stage in (analysis.stage for analysis in report.analyses):
        if stage.name not in drawn and len(stage.conditions) > 1:
            yield (
                f"Stage {stage.name}",
                f"Not drawn: sensitivity, which needs α or the MI weight to vary. This stage "
                f"varies {', '.join(varied(stage.conditions)) or 'nothing'}.",
            )


_OUTCOMES = {True: "goal reached", False: "goal not reached", None: "the task names no success"}

_METHOD = (
    "A task is judged by its success rate, that of deterministic evaluation episodes at their last "
    "step, or by their return where it has no success. Only finished runs have a final one.",
    "Intervals: 95 %. Of a rate Korn and Graubard's, the exact one over all episodes where seeds "
    "tie; of a return Student's; of a difference from both of its ends. Simulated, they cover 93 % "
    "or more from three seeds on, but 85 to 92 % of skewed returns, and where few seeds fail, but "
    "wholly: what no seed has shown is not in them. From one seed there is none.",
    "The area under a learning curve is the mean over the budget, by the trapezoid rule. It is "
    "compared seed by seed (Student's t; Welch's without common seeds), for a difference and for "
    "equivalence within the margin (two one-sided tests, Schuirmann 1987), with Holm's correction "
    "over what was planned and over the rest.",
    "Probability of improvement and performance profiles: Agarwal et al. 2021, Deep Reinforcement "
    "Learning at the Edge of the Statistical Precipice (arXiv:2108.13264).",
    "Against gradient updates or wall time a curve is at the mean over its runs of the updates, or "
    "of the time since their start with pauses included, by which they were at these steps.",
)


def _enumerated(words: Sequence[str], last: str = "and") -> str:
    """`a, b and c`."""
    return f" {last} ".join(filter(None, (", ".join(words[:-1]), words[-1])))
