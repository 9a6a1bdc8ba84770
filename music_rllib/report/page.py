"""The page of a report: the answer first, then figures and tables in groups."""

from __future__ import annotations

import base64
import hashlib
import statistics
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from jinja2.utils import htmlsafe_json_dumps

from music_rllib import names
from music_rllib.report.charts import chart_data
from music_rllib.report.figures.choice import COST, GROUPS, PERFORMANCE, PRIMARY, Drawing, slug
from music_rllib.report.figures.draw import inline
from music_rllib.report.videos import Videos
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.answer import answer, planned_in_words
from music_rllib.results.conditions import SIDE_BY_SIDE
from music_rllib.results.data import Sweep
from music_rllib.results.search_tables import search_in_words, search_tables
from music_rllib.results.study import Study
from music_rllib.results.tables import DASH, Code, Seconds, Table, performance_tables, study_tables

# The page may fetch nothing and run only its own script, whatever text a sweep puts into it.
# Styles cannot be restricted by a hash: Matplotlib's SVGs have style attributes.
_POLICY = (
    "default-src 'none'; script-src 'sha256-{script}'; connect-src {connect}; "
    "style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; form-action 'none'"
)
_MARKS = {"o": "●", "s": "■", "D": "◆", "^": "▲", "v": "▼", "P": "✚", "X": "✖", "*": "★"}
_METHOD = (
    "Tasks are compared by their success rate (success at the last step of deterministic "
    "evaluation episodes), or by their return if they declare no success. Only finished runs have "
    "a final value.",
    "95% CI of a rate: Korn and Graubard's interval, which is exact over all episodes if all seeds "
    "tie. Of a return: Student's interval. Of a difference: computed from the intervals of both "
    "sides. In simulations the intervals cover 93% or more from three seeds on, but 85 to 92% for "
    "skewed returns and where a few seeds fail completely. A single seed has no interval.",
    "The area under the learning curve is the mean over the budget (trapezoidal rule). Seeds are "
    "compared in pairs (Student's t-test) if both conditions have the same seeds, otherwise with "
    "Welch's t-test. A difference and equivalence within the margin (two one-sided tests, "
    "Schuirmann 1987) are tested, with Holm's correction over the planned comparisons, or over all "
    "comparisons if there is no plan.",
    "Probability of improvement and performance profiles: Agarwal et al. 2021, Deep Reinforcement "
    "Learning at the Edge of the Statistical Precipice (arXiv:2108.13264).",
    "The x axes gradient updates and training time are means over the runs of a curve. Training "
    "time has no pauses; exports of earlier versions have only the time since a run's start.",
)


@dataclass(frozen=True, kw_only=True)
class SweepReport:
    """Everything that the page shows."""

    sweep: Sweep
    analyses: Sequence[StageAnalysis]
    studies: Mapping[str, Study]
    """The planned comparisons and all others; of two sweeps by the start of their titles."""
    both: tuple[Sweep, Sweep] | None = None
    """The two sweeps that `sweep` consists of, in a report on two sweeps."""
    drawings: Sequence[Drawing]
    limitations: Sequence[str]
    """Sentences about missing runs and about runs to treat with care."""
    command: str
    """The command that made this report."""
    videos: Videos
    differences: Sequence[Table] = ()
    """Tables of the differences of two sweeps."""

    @property
    def study(self) -> Study:
        """The study of a single sweep."""
        return self.studies[""]

    @cached_property
    def answer(self) -> Sequence[str]:
        """The study in sentences, the question first; of two sweeps, questions and verdicts."""
        if self.both is None:
            return answer(self.sweep, self.study)
        found: list[str] = []
        for sweep, (title, study) in zip(self.both, self.studies.items(), strict=True):
            verdicts = takewhile(lambda line: not line.startswith("Metric: "), answer(sweep, study))
            found += [f"{title}{line}" for line in verdicts]
        return found


_PAGES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(report: SweepReport, *, live: bool = False) -> str:
    """The page as self-contained HTML; a `live` one is served and follows a running sweep."""
    sweep, folder = report.sweep, Path(__file__).parent
    scripts = ("chart.js", "page.js", "live.js") if live else ("chart.js", "page.js")
    script = "\n".join((folder / name).read_text(encoding="utf-8") for name in scripts)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    data = chart_data(sweep, report.drawings)
    numbers = {stage["name"]: number for number, stage in enumerate(data["stages"])}
    sentences = [*report.answer] if report.analyses else []
    if not report.differences:
        sentences = sentences[1:]
    # The verdicts are in large letters; the metric, seeds and control follow in small ones.
    details = (i for i, line in enumerate(sentences) if line.startswith("Metric:"))
    claims = next(details, len(sentences))
    planned = [] if report.differences else [_as_sentence(planned_in_words(report.study))]
    page = _PAGES.get_template("page.html").render(
        style=(folder / "page.css").read_text(encoding="utf-8"),
        script=script,
        # JSON in which no text can close the script element.
        data=htmlsafe_json_dumps(data, separators=(",", ":"), allow_nan=False),
        policy=_POLICY.format(script=digest, connect="'self'" if live else "'none'"),
        live=live,
        name=sweep.name,
        facts=_facts(report),
        limitations=report.limitations,
        question=_question(report),
        answer=sentences[:claims],
        details=[*sentences[claims:], *planned] if sentences else [],
        numbers=numbers,
        pictures={drawing.name: inline(drawing) for drawing in report.drawings},
        large=_large_figure(report, list(numbers), data["main"]),
        groups=list(_groups(report)),
        differences=report.differences,
        searches=[
            (search["stage"], search_in_words(search), list(search_tables(search)))
            for search in sweep.searches
        ],
        videos=report.videos,
        runs=runs_table(sweep),
        origin=origin_table(sweep, report.command),
        config=sweep.config,
        method=_METHOD,
        marks=_MARKS,
    )
    return page.strip() + "\n"


def _as_sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _facts(report: SweepReport) -> Sequence[tuple[str, object]]:
    sweep = report.sweep
    states = Counter(run.status for run in sweep.runs)
    stages = [analysis.stage for analysis in report.analyses]
    seeds = sorted(
        len({sweep.runs[run].seed for run in condition.runs})
        for stage in stages
        for condition in stage.compared
    )
    ends = dict.fromkeys((seeds[0], seeds[-1]) if seeds else ())
    start = DASH
    if sweep.started is not None:
        start = f"{datetime.fromtimestamp(sweep.started / 1000, UTC):%Y-%m-%d %H:%M UTC}"
    return (
        ("Sweep", state_in_words(sweep.status)),
        ("Runs finished", f"{states['FINISHED']} of {len(sweep.runs)}"),
        ("Seeds per condition", " to ".join(map(str, ends)) or DASH),
        ("Tasks", ", ".join(dict.fromkeys(t for s in stages for t in s.tasks)) or DASH),
        ("Started", start),
    )


def _question(report: SweepReport) -> str:
    """The question of the plan, or the one that the sweep's conditions ask."""
    if report.differences:
        return f"How do {report.sweep.name} differ?"
    if report.study.question is not None:
        return report.study.question
    if not report.analyses:
        return "No run has started yet."
    stage = report.study.stage or report.analyses[-1].stage
    metrics = dict.fromkeys(names.word_of(report.sweep.primary_metric(t)) for t in stage.tasks)
    aim = " or ".join("success rate" if word == "success" else word for word in metrics)
    compared = stage.compared or stage.conditions
    runs = [report.sweep.runs[run] for condition in compared for run in condition.runs]
    budgets = [budget for run in runs if (budget := run.budget)]
    ends = dict.fromkeys(f"{end(budgets):,}" for end in (min, max) if budgets)
    steps = f", {' to '.join(ends)} environment steps per run" if budgets else ""
    # A stage of all stages has a name of its own in its conditions' labels.
    several = sum(one.stage.has_task_reward for one in report.analyses) > 1
    of_stage = f"in stage {stage.name} " if several and stage.name != SIDE_BY_SIDE else ""
    where = f"{of_stage}on {_enumerated(stage.tasks)} ({_seeds({run.seed for run in runs})}{steps})"
    labels = [condition.short_label for condition in compared]
    if len(labels) == 1:
        return f"What {aim} does {labels[0]} reach {where}?"
    which = _enumerated(labels, "or") if len(labels) <= 4 else f"{len(labels)} conditions"
    return f"Which has the higher {aim}, averaged over training, {where}: {which}?"


# Figures and tables -----------------------------------------------------------------------------


def _large_figure(
    report: SweepReport, stages: Sequence[str], main: int
) -> Mapping[str, Any] | None:
    """Learning curves of the primary metrics: of all stages together, or of the last stage."""
    shown = stages[main : main + 1]
    drawings = [d for d in report.drawings if d.stage in shown and d.title in PRIMARY]
    # The reader selects its metric.
    return {**_figure("Learning curves", drawings), "metric": ""} if drawings else None


def _groups(report: SweepReport) -> Iterable[Mapping[str, Any]]:
    """Figures, tables and remarks under each heading that has any."""
    stages = {drawing.stage for drawing in report.drawings if drawing.stage != SIDE_BY_SIDE}
    compared = [
        replace(table, title=f"{title}{table.title}", name=table.name if not title else "")
        for title, study in report.studies.items()
        for table in study_tables(study)
    ]
    performance = [*compared, *performance_tables(report.analyses)]
    tables = {
        PERFORMANCE: performance if report.analyses else [],
        COST: [budget_table(report.sweep, report.analyses), failures_table(report.sweep)],
    }
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
            "remarks": list(_remarks(report)) if group == PERFORMANCE else [],
        }
        if any(content.values()):
            yield {"title": group, **content}


def _figure(title: str, drawings: Sequence[Drawing]) -> Mapping[str, Any]:
    """A figure of one or more stages; the page's script draws the curves of its metric."""
    metric = drawings[0].metric
    subplots = sum(len(drawing.subplots) for drawing in drawings)
    return {
        "name": slug(title),
        "title": title,
        "caption": _caption(drawings),
        "metric": None if metric is None else metric.name,
        "drawings": drawings,
        # A CSS class for the number of columns that it spans.
        "span": ("one", "two", "three")[min(subplots, 3) - 1],
    }


def _caption(drawings: Sequence[Drawing]) -> str:
    """The caption of all drawings, or each one with the stages that have it."""
    of_stages: dict[str, list[str]] = {}
    for drawing in drawings:
        of_stages.setdefault(drawing.caption, []).append(drawing.stage)
    if len(of_stages) == 1 or len({drawing.stage for drawing in drawings}) == 1:
        return max(of_stages, key=len)  # of two primary metrics, only success has a target
    return " ".join(f"{', '.join(stages)}: {text}" for text, stages in of_stages.items())


def _remarks(report: SweepReport) -> Iterable[Sequence[str]]:
    """A heading for each stage, and its peculiarities."""
    claims = report.study.claims if report.both is None else ()  # positions in another sweep
    compared = {one.runs for claim in claims for pair in claim.pairs for one in pair}
    for analysis in reversed(report.analyses):
        stage = analysis.stage
        remarks = []
        if stage.compared not in ((), stage.conditions):
            remarks.append("Figures and comparisons show the runs on fresh seeds.")
        if not stage.has_task_reward:
            remarks.append("It trains without the task's reward, so its success is chance.")
        if len(stage.conditions) == 1 and stage.conditions[0].runs not in compared:
            remarks.append(f"It has one condition ({stage.conditions[0].label}): no comparison.")
        if len(stage.seeds) == 1:
            remarks.append(f"It has one seed ({stage.seeds[0]}): no intervals and no tests.")
        seeds = " to ".join(dict.fromkeys((stage.seeds[0], stage.seeds[-1])))
        heading = f"Stage {stage.name} ({stage.variant}), {_seeds(stage.seeds)} ({seeds})"
        if remarks or len(report.analyses) > 1:
            yield [heading, *remarks]


def _seeds(seeds: Collection[str]) -> str:
    return "1 seed" if len(seeds) == 1 else f"{len(seeds)} seeds"


def _enumerated(words: Sequence[str], last: str = "and") -> str:
    """`a, b and c`."""
    return f" {last} ".join(filter(None, (", ".join(words[:-1]), words[-1])))


# Runs -------------------------------------------------------------------------------------------


def budget_table(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> Table:
    """Environment steps and training time of each stage."""
    rows = []
    for stage in (analysis.stage for analysis in analyses):
        seconds = [s for run in stage.runs if (s := sweep.runs[run].seconds) is not None]
        rows.append(
            (
                stage.name,
                len(stage.runs),
                sum(sweep.last_step(run) for run in stage.runs),
                sum(sweep.runs[run].budget or 0 for run in stage.runs) or None,
                Seconds(sum(seconds)) if seconds else None,
                Seconds(statistics.median(seconds)) if seconds else None,
            )
        )
    return Table(
        title="Budget and training time",
        header=(
            "Stage",
            "Runs",
            "Steps done",
            "Steps planned",
            "Training time, all runs",
            "Median",
        ),
        rows=rows,
        note="Environment steps. Training time (h:min:s) excludes interruptions; running runs are "
        "not counted.",
    )


def runs_table(sweep: Sweep) -> Table:
    """Every run of the sweep, with its last evaluation and its entropies."""
    return Table(
        name="runs",
        title=f"All {len(sweep.runs)} runs",
        folded=True,
        header=(
            *("Run", "Stage", "Task", "q", "Seed", "State", "Steps", "Budget", "Training time"),
            *("Success rate", "Return", "Shannon entropy", "S_q", "Cause of failure", "Key"),
        ),
        rows=[
            (
                run.name,
                run.stage,
                run.task,
                run.entropic_index,
                run.seed,
                state_in_words(run.status),
                sweep.last_step(position),
                run.budget,
                None if run.seconds is None else Seconds(run.seconds),
                sweep.final(position, names.EVAL_SUCCESS),
                sweep.final(position, names.EVAL_RETURN),
                *(sweep.final(position, metric) for metric in names.ENTROPIES),
                run.failure,
                Code(run.run_id),
            )
            for position, run in enumerate(sweep.runs)
        ],
    )


def failures_table(sweep: Sweep) -> Table:
    """The failed and the damaged runs, with the causes."""
    return Table(
        title="Failed runs",
        header=("Run", "Steps", "Cause"),
        rows=[
            (run.name, sweep.last_step(position), Code(run.failure or "no cause was recorded"))
            for position, run in enumerate(sweep.runs)
            if run.status == "FAILED" or (run.status == "KILLED" and run.failure)
        ],
    )


def origin_table(sweep: Sweep, command: str) -> Table:
    """The storage, the code and the versions that the numbers come from."""
    prefix = names.TAG_VERSION_PREFIX
    versions = sorted(
        f"{tag.removeprefix(prefix)} {value}"
        for tag, value in sweep.tags.items()
        if tag.startswith(prefix)
    )
    return Table(
        title="Origin",
        header=("Item", "Value"),
        rows=[
            ("Read from", Code(sweep.source)),
            ("Git commit", Code(sweep.tags.get(names.TAG_GIT_COMMIT, "unknown"))),
            ("Versions", ", ".join(versions) or "unknown"),
            ("Command of this report", Code(command)),
        ],
    )


def state_in_words(status: str) -> str:
    """A word for the status of a run or a sweep."""
    return {"KILLED": "stopped", "SCHEDULED": "waiting"}.get(status, status.lower())
