"""Computes the report of a sweep and writes the page, its figures and its numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from itertools import chain
from pathlib import Path

from music_rllib import names
from music_rllib.envs.tasks import Task
from music_rllib.report.figures.choice import drawings_of_stages, stage_drawings
from music_rllib.report.figures.draw import Figures, files
from music_rllib.report.figures.overview import overview
from music_rllib.report.figures.plots import METRICS
from music_rllib.report.limitations import diverged, missing
from music_rllib.report.page import Report, render
from music_rllib.report.side_by_side import difference_tables
from music_rllib.report.study import study_csv, study_drawings
from music_rllib.report.tables import (
    Table,
    curves_table,
    finals_table,
    improvement_table,
    runs_table,
    waits_table,
)
from music_rllib.report.videos import make_films
from music_rllib.results.analysis import analyse, analyse_stages
from music_rllib.results.data import ReportError, Sweep
from music_rllib.results.study import study_of

PAGE = "report.html"
PICTURE = "overview"
"""File name of the figure that shows the whole sweep."""
WANTED = (
    *(metric.name for metric in METRICS),
    names.EVAL_EPISODES,
    names.ENV_STEPS,
    names.GRAD_UPDATES,
    names.Q_MEAN,
    names.ALPHA,
    names.MI_REWARD_WEIGHT,
)
"""Metrics that a report reads."""


def build_report(
    sweep: Sweep,
    *,
    damaged: str | None = None,
    command: str = "",
    storage: str | None = None,
    video_seed: int | None = None,
    environments: Sequence[Task] = (),
    beside: tuple[Sweep, Sweep] | None = None,
    live: bool = False,
    processes: Executor | None = None,
) -> Report:
    """Compute the report of a sweep: numbers, figures, videos and notes.

    Args:
        sweep: the sweep, with the metrics of `WANTED`.
        damaged: a sentence about finished runs that are damaged in the storage, if there are any.
        command: the command that makes this report.
        storage: the storage that has the policies to film; None for an exported sweep.
        video_seed: the seed of filmed episodes; None: no videos.
        environments: tasks of the user that may be filmed, beside the built-in ones.
        beside: the two sweeps that `sweep` puts side by side.
        live: whether the sweep is running, so that runs to come are not reported as missing.
        processes: worker processes that draw the figures, from `drawing_processes`.
    """
    figures = Figures(processes)
    analyses = analyse(sweep)
    stages = [analysis.stage for analysis in analyses]
    study = study_of(sweep)
    # One by one: a process draws each while the next is computed.
    for drawing in chain(
        *(stage_drawings(sweep, analysis) for analysis in analyses),
        drawings_of_stages(sweep, stages),
        study_drawings(study),
    ):
        figures.add(drawing)
    gaps = missing(sweep, analyses, live=live or beside is not None)
    for one in beside or ():  # each has a configuration of its own
        gaps += [f"{one.name}: {line}" for line in missing(one, ())]
    return Report(
        sweep=sweep,
        analyses=analyses,
        together=analyse_stages(sweep, stages),
        study=study,
        figures=figures,
        differences=() if beside is None else difference_tables(*beside, analyses),
        limitations=[*gaps, *diverged(sweep), *filter(None, [damaged])],
        command=command,
        films=None
        if video_seed is None
        else make_films(sweep, analyses, storage, video_seed, environments),
    )


def write_report(report: Report, folder: Path) -> Path:
    """Write the page, `figures/*` (PNG, SVG, PDF), `videos/*` and `tables/*.csv` into `folder`.

    Files of an earlier report that this one does not have are removed, and no others.

    Returns:
        The path of the page.

    Raises:
        ReportError: if the folder is not writable.
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
"""The list of a report's files, since its folder may have others."""
_FILE = re.compile(rf"{re.escape(PAGE)}|(?:figures|tables|videos)/[^/.][^/]*")


def made_files(folder: Path) -> list[str]:
    """Names of the files of the report in `folder`, below it; empty where there is none."""
    try:
        names = json.loads((folder / _MADE).read_text("utf-8"))
    except (OSError, ValueError):
        return []
    names = names if isinstance(names, list) else []
    return [name for name in names if isinstance(name, str) and _FILE.fullmatch(name)]


def _files_of(report: Report) -> Iterator[tuple[str, bytes]]:
    """Names, below the report's folder, and contents of its files."""
    yield PAGE, render(report).encode()
    panels = overview(report.sweep, [analysis.stage for analysis in report.analyses])
    picture = [(PICTURE, files(panels, []))] if panels else []
    for name, contents in chain(picture, report.figures.files()):
        for suffix, content in contents.items():
            yield f"figures/{name}{suffix}", content
    for film in report.films.films if report.films is not None else ():
        yield f"videos/{film.name}", film.data
    for table in _tables(report):
        yield f"tables/{table.name}.csv", table.to_csv().encode()


def _tables(report: Report) -> Iterable[Table]:
    with_stages = [*report.analyses, *filter(None, [report.together])]
    yield from study_csv(report.study)
    yield finals_table(report.analyses)
    yield waits_table(report.analyses)
    yield improvement_table(with_stages)
    yield runs_table(report.sweep)
    yield curves_table(report.drawings)
