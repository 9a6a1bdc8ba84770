"""The page: the answer first, then everything behind it in groups."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from music_rllib import names
from music_rllib.report.figures.choice import (
    COST,
    GROUPS,
    INFLUENCE,
    PERFORMANCE,
    PRIMARY,
    SETTINGS,
    Drawing,
    slug,
)
from music_rllib.report.figures.draw import Figures
from music_rllib.report.figures.importance import FEWEST_RUNS, varied
from music_rllib.report.pieces import Figure, Panels, TextTable, document
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
from music_rllib.results.claims.answer import answer, planned_in_words
from music_rllib.results.claims.study import Study
from music_rllib.results.comparison import verdict
from music_rllib.results.conditions import SIDE_BY_SIDE, Stage
from music_rllib.results.data import Sweep

__all__ = ["Report", "render"]

DASH = "–"


@dataclass(frozen=True, kw_only=True)
class Report:
    """Everything that the page shows."""

    sweep: Sweep
    analyses: Sequence[StageAnalysis]
    together: StageAnalysis | None
    """Stages against each other; None where there is nothing to compare."""
    study: Study
    """What is claimed, planned or not."""
    figures: Figures
    missing: Sequence[str]
    difference: float
    """In success rate, which the reader would want to be able to see."""
    command: str
    """That made this report."""
    films: Films | None = None
    """None where nobody asked for videos."""
    differences: Sequence[TextTable] = ()
    """Of two sweeps: what was set otherwise, and what came of it."""

    @property
    def drawings(self) -> Sequence[Drawing]:
        return self.figures.drawings


def render(report: Report, *, live: bool = False) -> str:
    """The page as HTML that needs nothing else.

    Args:
        report: what it shows.
        live: whether it is served, and follows a sweep that runs.
    """
    sweep = report.sweep
    data = chart_data(sweep, report.drawings)
    numbers = {stage["name"]: number for number, stage in enumerate(data["stages"])}
    said = _said(report)
    # What is claimed is to be seen at once; how it was counted stands below in small letters.
    claims = next((i for i, line in enumerate(said) if line.startswith("Counted:")), len(said))
    return document(
        data,
        live=live,
        name=sweep.name,
        facts=_facts(report),
        missing=report.missing,
        asked=_asked(report),
        said=said[:claims],
        about=said[claims:],
        large=_large(report, numbers),
        groups=list(_groups(report, numbers)),
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
    seeds = sorted({len(stage.seeds) for stage in stages})
    return (
        ("Sweep", state_in_words(sweep.status)),
        ("Runs finished", f"{states['FINISHED']} of {len(sweep.runs)} begun"),
        ("Seeds per condition", _range(seeds)),
        ("Tasks", ", ".join(dict.fromkeys(t for s in stages for t in s.tasks)) or DASH),
        ("Began", _date(sweep.started)),
    )


# The answer -------------------------------------------------------------------------------------


def _main(report: Report) -> StageAnalysis | None:
    """What came of the sweep: its stages against each other, or the last that has the task."""
    if report.together is not None:
        return report.together
    last = [one for one in report.analyses if one.stage.has_task_reward] or report.analyses
    return last[-1] if last else None


def _asked(report: Report) -> str:
    """What the plan asks, or what the sweep's conditions do."""
    if report.study.question is not None:
        return report.study.question
    main = _main(report)
    if main is None:
        return "Nothing has run yet."
    stage = main.stage
    metrics = dict.fromkeys(names.word_of(report.sweep.primary_metric(t)) for t in stage.tasks)
    aim = " or ".join("success rate" if word == "success" else word for word in metrics)
    budgets = [b for run in stage.runs if (b := report.sweep.runs[run].budget)]
    steps = f", {statistics.median(budgets):,.0f} environment steps per run" if budgets else ""
    seeds = f"{len(stage.seeds)} seed{'s' * (len(stage.seeds) != 1)}"
    where = f"on {_and(stage.tasks)} ({seeds}{steps})"
    if len(stage.conditions) == 1:
        return f"What {aim} does {stage.conditions[0].label} reach {where}?"
    settings = _and(varied(stage.conditions) or ["the stage"])
    choices = len(stage.conditions)
    which = f"{choices} settings of {settings}" if choices > 4 else _and(_labels(stage), "or")
    return f"Which ends at the higher {aim} {where}: {which}?"


def _labels(stage: Stage) -> list[str]:
    return [condition.label for condition in stage.conditions]


def _said(report: Report) -> list[str]:
    """The study's answer; of final values the main comparison, and other stages' first lines."""
    main = _main(report)
    if main is None or not main.scopes:
        return []
    planned = planned_in_words(report.study)
    said = [*answer(report.sweep, report.study)[1:], f"{planned[0].upper()}{planned[1:]}."]
    others = [one for one in report.analyses if one.stage.has_task_reward and one is not main]
    firsts = [] if report.together else [verdict(s.scopes[0])[0] for s in others if s.scopes]
    finals = [verdict(main.scopes[0], report.difference)[0], *firsts]
    return [*said, *(f"At the end of training: {line}" for line in finals)]


# Figures ----------------------------------------------------------------------------------------


def _large(report: Report, numbers: Mapping[str, int]) -> Figure | None:
    """All tasks of what came of the sweep, by what they are judged by."""
    stages = [stage for stage in numbers if stage == SIDE_BY_SIDE] or list(numbers)[-1:]
    drawn = [d for d in report.drawings if d.stage in stages and d.title in PRIMARY]
    return _figure(report, "Learning curves", drawn, numbers, metric="") if drawn else None


def _groups(report: Report, numbers: Mapping[str, int]) -> Iterable[Mapping[str, Any]]:
    own = {drawing.stage for drawing in report.drawings if drawing.stage != SIDE_BY_SIDE}
    pairs = [*([report.together] if report.together else []), *report.analyses]
    tables: dict[str, Sequence[TextTable]] = {
        PERFORMANCE: [*study_tables(report.study), *(performance_tables(pairs) if pairs else [])],
        COST: [budget(report.sweep, report.analyses), failures(report.sweep)],
    }
    for group in GROUPS:
        by_title: dict[str, list[Drawing]] = {}
        for drawing in report.drawings:
            on_top = drawing.stage == SIDE_BY_SIDE and drawing.title in PRIMARY
            if drawing.group == group and not on_top:
                by_title.setdefault(drawing.title, []).append(drawing)
        figures = [
            _figure(report, title, drawn, numbers)
            for title, drawn in by_title.items()
            # The large figure has them already.
            if len(own) > 1 or title not in PRIMARY
        ]
        said = {PERFORMANCE: list(_remarks(report)), SETTINGS: _not_drawn(report)}.get(group, [])
        shown = [table for table in tables.get(group, ()) if table.rows]
        if figures or shown or said:
            yield {"title": group, "figures": figures, "tables": shown, "said": said}


def _figure(
    report: Report,
    title: str,
    drawings: Sequence[Drawing],
    numbers: Mapping[str, int],
    metric: str | None = None,
) -> Figure:
    if metric is None and drawings[0].metric is not None:
        metric = drawings[0].metric.name
    pictures = report.figures.pictures
    return Figure(
        name=slug(title),
        title=title,
        caption=drawings[-1].caption,
        metric=metric,
        stages=[
            Panels(
                name=drawing.name,
                stage=drawing.stage if len(drawings) > 1 else "",
                number=numbers.get(drawing.stage, -1),
                legend=drawing.legend,
                panels=[
                    (f"{drawing.title}, {panel.title}", panel.title, svg)
                    for panel, svg in zip(drawing.panels, pictures[drawing.name], strict=True)
                ],
            )
            for drawing in drawings
        ],
    )


def _remarks(report: Report) -> Iterable[Sequence[str]]:
    """Of each stage what else is to be known, and what may be said on each task."""
    several = len(report.analyses) > 1
    for analysis in [*([report.together] if report.together else []), *reversed(report.analyses)]:
        stage, said = analysis.stage, []
        if stage.compared not in ((), stage.conditions):
            said.append("Curves and comparisons are of the runs on fresh seeds; tables have all.")
        if not stage.has_task_reward:
            said.append("It trains without the task's reward: success is not its aim.")
        if len(stage.conditions) == 1:
            said.append(f"It has a single condition ({_labels(stage)[0]}): no comparison.")
        if len(stage.seeds) == 1:
            said.append(
                f"It has a single seed ({stage.seeds[0]}): one run shows what can happen and not "
                "what usually does; there are no intervals."
            )
        said += [line for scope in analysis.scopes for line in verdict(scope, report.difference)]
        head = f"Stage {stage.name} ({stage.variant}), seeds {', '.join(stage.seeds)}"
        if analysis is report.together:
            head = "Stages side by side, each by the runs of the conditions that all have"
        if said or several:
            yield [head, *said]


def _not_drawn(report: Report) -> list[Sequence[str]]:
    """What would have to vary for the figures that are not there."""
    drawn = {(drawing.stage, drawing.title) for drawing in report.drawings}
    found: list[Sequence[str]] = []
    for analysis in report.analyses:
        stage = analysis.stage
        absent = [title for title in INFLUENCE if (stage.name, title) not in drawn]
        if not absent or len(stage.conditions) == 1:
            continue
        settings = ", ".join(varied(stage.conditions)) or "nothing"
        found.append(
            (
                f"Stage {stage.name}",
                f"Not drawn: {', '.join(title.lower() for title in absent)}. This stage varies "
                f"{settings}; sensitivity needs α or the MI weight, the other two need a second "
                f"setting beside q and finished runs (importance: {FEWEST_RUNS} on a task).",
            )
        )
    return found


_OUTCOMES = {True: "goal reached", False: "goal not reached", None: "the task names no success"}

_METHOD = (
    "A task is judged by its success rate, that of deterministic evaluation episodes at their last "
    "step, or by their return where it has no success. Only finished runs have a final one.",
    "Intervals: 95 %. Of a rate Korn and Graubard's, the exact one over all episodes where seeds "
    "tie; of a return Student's; of a gap from both of its ends; of a probability of "
    "improvement Newcombe's. Simulated, they cover 93 % or more from three seeds on; rare failures "
    "that no seed has shown are not in them. From one seed there is none.",
    "The area under a learning curve is the mean over the budget, by the trapezoid rule. It is "
    "compared seed by seed (Student's t; Welch's without common seeds), for a difference and for "
    "equivalence within the margin (two one-sided tests, Schuirmann 1987), with Holm's correction "
    "over what was planned and over the rest.",
    "Permutation: the exact test over all relabellings of the runs. Three runs against three never "
    "give less than 0.1.",
    "Probability of improvement and performance profiles: Agarwal et al. 2021, Deep Reinforcement "
    "Learning at the Edge of the Statistical Precipice (arXiv:2108.13264).",
    "Against gradient updates or wall time a curve is at the mean over its runs of the updates, or "
    "of the time since their start with pauses included, by which they were at these steps.",
)


def _and(words: Sequence[str], last: str = "and") -> str:
    return f" {last} ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _range(values: Sequence[int]) -> str:
    if not values:
        return DASH
    return str(values[0]) if len(values) == 1 else f"{values[0]} to {values[-1]}"


def _date(milliseconds: int | None) -> str:
    if milliseconds is None:
        return DASH
    return datetime.fromtimestamp(milliseconds / 1000, UTC).strftime("%Y-%m-%d %H:%M UTC")
