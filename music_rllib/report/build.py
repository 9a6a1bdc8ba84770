"""Computes the report of a sweep, and writes the page, its figures, videos and tables."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import signal
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import chain
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from music_rllib import names
from music_rllib.config.tac_settings import Range, have_diverged
from music_rllib.envs.tasks import Task
from music_rllib.names import ShortLabels, in_runs
from music_rllib.report.charts import curves_csv
from music_rllib.report.figures.choice import (
    AGAINST_ENTROPY,
    FINALS,
    Drawing,
    drawings_of_stages,
    overview,
    stage_drawings,
    study_drawings,
)
from music_rllib.report.figures.draw import files
from music_rllib.report.page import SweepReport, render, runs_table
from music_rllib.report.two_sweeps import difference_tables, titles_of
from music_rllib.report.videos import Videos, make_videos
from music_rllib.results.analysis import METRICS, StageAnalysis, analyse, mixed
from music_rllib.results.answer import claim_rows, mean_rows
from music_rllib.results.conditions import StageRuns
from music_rllib.results.data import ReportError, Sweep
from music_rllib.results.statistics import Array
from music_rllib.results.study import Study, study_of
from music_rllib.results.tables import performance_tables, to_csv

PAGE = "report.html"
PICTURE = "overview"
"""File name of the figure that shows the whole sweep."""
WANTED = (
    *(metric.name for metric in METRICS),
    names.EVAL_EPISODES,
    names.ENV_STEPS,
    names.GRAD_UPDATES,
    names.SYSTEM_SECONDS,
    names.Q_MEAN,
    names.TRAIN_DISPLACEMENT,
    names.ALPHA,
    names.MI_REWARD_WEIGHT,
    names.INTRINSIC_WEIGHT,
)
"""Metrics that a report reads."""
MOST_PROCESSES = 8
"""Largest number of processes that draw; each needs some memory."""
SHOWN = 5
"""Largest number of labels in a sentence."""
_STATES = {
    "RUNNING": "still running, or killed without notice",
    "KILLED": "stopped before the end; the same command continues",
    "FAILED": "failed; see below",
}


def build_report(
    sweep: Sweep,
    *,
    damaged: str = "",
    command: str = "",
    storage: str | None = None,
    videos: bool = False,
    environments: Sequence[Task] = (),
    both: tuple[Sweep, Sweep] | None = None,
    live: bool = False,
) -> SweepReport:
    """Compute the report of a sweep: numbers, figures, videos and limitations.

    Args:
        sweep: The sweep, with the metrics of `WANTED`.
        damaged: A sentence about finished runs that are damaged in the storage; empty if none is.
        command: The command that makes this report.
        storage: The storage that has the policies for videos; None for an exported sweep.
        environments: Tasks of the user that videos may show, in addition to the built-in ones.
        both: The two sweeps that `sweep` consists of, in a report on two sweeps.
        live: Whether the sweep is running, so that waiting runs are not reported as missing.
    """
    analyses = analyse(sweep)
    stages = [analysis.stage for analysis in analyses]
    studies = {"": study_of(sweep)}
    if both is not None:  # each has a plan of its own
        titles = titles_of(*both)
        studies = {f"{t}: ": study_of(one) for t, one in zip(titles, both, strict=True)}
    drawings = chain(
        *(stage_drawings(sweep, analysis) for analysis in analyses),
        drawings_of_stages(sweep, stages),
        *(study_drawings(study, title) for title, study in studies.items()),
    )
    sentences = limitations(sweep, analyses, live=live or both is not None)
    for one in both or ():
        sentences += [f"{one.name}: {line}" for line in _missing(one)]
    return SweepReport(
        sweep=sweep,
        analyses=analyses,
        studies=studies,
        both=both,
        drawings=list(_with_own_names(_without_chance(drawings, stages))),
        differences=() if both is None else difference_tables(*both, analyses),
        limitations=[*sentences, *filter(None, [damaged])],
        command=command,
        videos=make_videos(sweep, of_the_answer(analyses, studies[""]), storage, environments)
        if videos
        else Videos(),
    )


def of_the_answer(analyses: Sequence[StageAnalysis], study: Study) -> Sequence[StageAnalysis]:
    """The stage of the answer, or the last one if the answer has none."""
    asked = [one for one in analyses if study.stage and one.stage.name == study.stage.name]
    return asked or analyses[-1:]


def _without_chance(drawings: Iterator[Drawing], stages: Sequence[StageRuns]) -> Iterator[Drawing]:
    """The drawings, without the success of stages whose success is chance, if others train for it.

    It looks like failure.
    """
    rewarded = [stage.name for stage in stages if stage.has_task_reward]
    unrewarded = {stage.name for stage in stages if rewarded and stage.name not in rewarded}
    for drawing in drawings:
        is_success = drawing.title in (FINALS[names.EVAL_SUCCESS], AGAINST_ENTROPY) or (
            drawing.metric is not None and drawing.metric.name in names.EVAL_RATES
        )
        if not (is_success and drawing.stage in unrewarded):
            yield drawing


def _with_own_names(drawings: Iterator[Drawing]) -> Iterator[Drawing]:
    seen: Counter[str] = Counter()
    for drawing in drawings:
        seen[drawing.name] += 1
        yield replace(drawing, number=seen[drawing.name])


# Limitations ------------------------------------------------------------------------------------


def limitations(
    sweep: Sweep, analyses: Sequence[StageAnalysis], *, live: bool = False
) -> list[str]:
    """Sentences about runs that are missing, mixed or diverged.

    In a `live` sweep no run is missing yet.
    """
    sentences = [] if live else [*_missing(sweep)]
    return [*sentences, *mixed(sweep.runs), *_missing_results(sweep, analyses), *_diverged(sweep)]


def _missing(sweep: Sweep) -> Iterator[str]:
    yield from _missing_runs(sweep)
    if sweep.earlier:
        yield sweep.earlier


def _missing_runs(sweep: Sweep) -> Iterator[str]:
    # Runs that a search has stopped are in its table.
    runs = [run for run in sweep.runs if names.TAG_PRUNED not in run.tags]
    waiting = [run.name for run in runs if run.status == "SCHEDULED"]
    if len(waiting) == len(sweep.runs):
        yield "No run has begun, so there is nothing to draw or compare."
    if waiting:
        short = ShortLabels.of(run.name for run in sweep.runs)
        yield f"{in_runs(len(waiting))} not begun: {_listed([*map(short, waiting)])}."
    # Damaged runs have a cause as well, and a sentence of their own.
    states = Counter(r.status for r in runs if not (r.status == "KILLED" and r.failure))
    for state, text in _STATES.items():
        if states[state]:
            yield f"{in_runs(states[state])} {text}."


def _missing_results(sweep: Sweep, analyses: Sequence[StageAnalysis]) -> Iterator[str]:
    unevaluated = [
        f"{task} ({names.word_of(metric)})"
        for task in dict.fromkeys(run.task for run in sweep.runs)
        if (metric := sweep.primary_metric(task))
        and not any(len(sweep.series(i, metric)[0]) for i in sweep.on(task))
    ]
    if unevaluated:
        yield f"No evaluation yet on {_listed(unevaluated)}."
    for stage in (analysis.stage for analysis in analyses):
        unfinished = [
            condition.label
            for condition in stage.conditions
            if not any(
                sweep.runs[run].is_finished or names.TAG_PRUNED in sweep.runs[run].tags
                for run in condition.runs
            )
        ]
        if unfinished and len(unfinished) < len(stage.conditions):
            yield f"Stage {stage.name}: no run of {_listed(unfinished)} has finished."


def _diverged(sweep: Sweep) -> Iterator[str]:
    """A sentence with the runs whose critics have diverged, if there are any."""
    labels = [run.name for i, run in enumerate(sweep.runs) if _has_diverged(sweep, i)]
    if labels:
        labels = [*map(ShortLabels.of(run.name for run in sweep.runs), labels)]
        yield (
            f"The critics of {in_runs(len(labels))} diverged, to values that no reward explains "
            f"({names.Q_MEAN}): {_listed(labels)}. These runs count like any other run."
        )


def _has_diverged(sweep: Sweep, run: int) -> bool:
    def at_steps(metric: str) -> Array:
        values = dict(zip(*sweep.series(run, metric), strict=True))
        return np.array([values.get(step, 0.0) for step in steps])

    params = sweep.runs[run].params
    steps, means = sweep.series(run, names.Q_MEAN)
    try:
        gamma = float(params["tac.gamma"])
        low = high = 0.0
        if params.get("music.task_reward") != "False":
            low, high = map(float, params["task.reward_range"].strip("[]").split(","))
    except (KeyError, ValueError):
        return False  # the reachable return is unknown
    if not gamma < 1:
        return False
    weights = (names.MI_REWARD_WEIGHT, names.INTRINSIC_WEIGHT)
    weight = sum(at_steps(name).max(initial=0.0) for name in weights)
    bonuses = at_steps(names.ALPHA) * at_steps(names.ENTROPY)
    return bool(have_diverged(means, bonuses, Range(low - weight, high), gamma).any())


def _listed(labels: Sequence[str]) -> str:
    more = len(labels) - SHOWN
    return "; ".join(labels[:SHOWN]) + (f"; and {more} more" if more > 0 else "")


# Files ------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _drawn(figures: Sequence[Drawing]) -> Iterator[Iterator[Mapping[str, bytes]]]:
    """The files of each figure, drawn by a process for each core if it is safe to fork."""
    cores = len(os.sched_getaffinity(0))
    if cores == 1 or len(figures) < 2 or threading.active_count() > 1:
        yield map(_draw, figures)
        return
    # Functions that draw cannot be pickled, so the processes inherit the figures.
    with ProcessPoolExecutor(
        min(cores, len(figures), MOST_PROCESSES),
        get_context("fork"),
        _inherit,
        (figures, os.getpid()),
    ) as pool:
        with warnings.catch_warnings():  # of Python 3.12, about the idle threads of BLAS
            warnings.simplefilter("ignore", DeprecationWarning)
            drawn = pool.map(_draw_inherited, range(len(figures)))
        yield drawn


_INHERITED: list[Drawing] = []
_SET_DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of Linux."""


def _inherit(figures: Sequence[Drawing], parent: int) -> None:
    """Keep the figures in a drawing process, which ends with its parent."""
    ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGTERM)
    if os.getppid() != parent:  # it has ended already
        sys.exit()
    _INHERITED.extend(figures)


def _draw_inherited(number: int) -> Mapping[str, bytes]:
    return _draw(_INHERITED[number])


def _draw(figure: Drawing) -> Mapping[str, bytes]:
    return files(figure.subplots, figure.legend)


def write_report(report: SweepReport, folder: Path) -> Path:
    """Write the page, `figures/*` (PNG, SVG), `videos/*` and `tables/*.csv` into `folder`.

    Files of an earlier report that this one does not have are removed, and no others.

    Returns:
        The path of the page.

    Raises:
        ReportError: The folder is not writable.
    """
    earlier, made = made_files(folder), []
    try:
        for name, content in _files_of(report):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            made.append(name)
        for stale in set(earlier) - set(made):
            (folder / stale).unlink(missing_ok=True)
        (folder / _MADE).parent.mkdir(exist_ok=True)
        (folder / _MADE).write_text(json.dumps(made), encoding="utf-8")
    except OSError as error:
        raise ReportError(f"{folder} must be writable: {error}") from error
    return folder / PAGE


_MADE = "figures/.made.json"
"""The list of a report's files; its folder may have others."""
_FILE = re.compile(rf"{re.escape(PAGE)}|(?:figures|tables|videos)/[^/.][^/]*")


def made_files(folder: Path) -> list[str]:
    """Paths of the files of the report in `folder`, below it; empty if there is no report."""
    try:
        found = json.loads((folder / _MADE).read_text("utf-8"))
    except (OSError, ValueError):
        return []
    found = found if isinstance(found, list) else []
    return [name for name in found if isinstance(name, str) and _FILE.fullmatch(name)]


def _files_of(report: SweepReport) -> Iterator[tuple[str, bytes]]:
    """Paths, below the report's folder, and contents of its files."""
    shown, legend = overview(report.sweep, [analysis.stage for analysis in report.analyses])
    first = Drawing(stage="", title=PICTURE, caption="", subplots=shown, legend=legend)
    figures = [*[first] * bool(shown), *report.drawings]
    with _drawn(figures) as contents:
        yield PAGE, render(report).encode()  # while other processes draw
        for figure, content in zip(figures, contents, strict=True):
            for suffix, data in content.items():
                yield f"figures/{figure.name}{suffix}", data
    for video in report.videos.videos:
        yield f"videos/{video.file}", video.data
    tables = [*performance_tables(report.analyses), runs_table(report.sweep)]
    numbers = [(table.name, table.to_csv()) for table in tables]
    numbers.append(("curves", curves_csv(report.drawings)))
    for name, rows_of in (("area_under_curve", mean_rows), ("comparisons", claim_rows)):
        rows = [
            ({"sweep": title.removesuffix(": ")} if title else {}) | row
            for title, study in report.studies.items()
            for row in rows_of(study)
        ]
        numbers.append((name, to_csv(rows)))
    for name, text in numbers:
        if text.strip():  # a table without rows has no columns
            yield f"tables/{name}.csv", text.encode()
