"""From a sweep to its report on disk: the page, its figures and its numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from pathlib import Path

from music_rllib import names
from music_rllib.envs.tasks import Task
from music_rllib.report.figures.choice import Drawing, drawings_of_stages, stage_drawings
from music_rllib.report.figures.draw import Figures, files, stale_files
from music_rllib.report.figures.overview import overview
from music_rllib.report.figures.plots import METRICS
from music_rllib.report.limitations import missing
from music_rllib.report.page import Report, render
from music_rllib.report.side_by_side import difference_tables
from music_rllib.report.study import study_csv, study_drawings
from music_rllib.report.tables import (
    Table,
    finals_table,
    improvement_table,
    races_table,
    runs_table,
    waits_table,
)
from music_rllib.report.videos import make_films
from music_rllib.results.analysis import analyse, analyse_stages
from music_rllib.results.claims.study import study_of
from music_rllib.results.comparison import GAP
from music_rllib.results.data import ReportError, Sweep
from music_rllib.tracking.store import TrackingStore

__all__ = ["PAGE", "PICTURE", "WANTED", "build_report", "write_report"]

PAGE = "report.html"
PICTURE = "overview"
"""The figure that shows the whole sweep."""
WANTED = (
    *(metric.name for metric in METRICS),
    names.EVAL_EPISODES,
    names.ENV_STEPS,
    names.GRAD_UPDATES,
)
"""Metrics that a report reads."""
_CURVE_COLUMNS = (
    *("stage", "task", "condition", "metric", "env_steps", "runs", "mean", "lower", "upper"),
)


def build_report(
    sweep: Sweep,
    *,
    difference: float = GAP,
    undelivered: int = 0,
    damaged: str | None = None,
    command: str = "",
    store: TrackingStore | None = None,
    video_seed: int | None = None,
    environments: Sequence[Task] = (),
    beside: tuple[Sweep, Sweep] | None = None,
    live: bool = False,
    processes: Executor | None = None,
) -> Report:
    """Compute and arrange everything.

    Args:
        sweep: with the metrics of `WANTED`.
        difference: in success rate, which the reader would want to be able to see.
        undelivered: runs of which MLflow does not have everything yet.
        damaged: which finished runs are damaged in the storage, in words.
        command: that makes this report.
        store: where the sweep is logged, with its policies.
        video_seed: of the filmed episodes; None: no videos.
        environments: of tasks that may be made for videos, beside the known ones.
        beside: the two that `sweep` puts side by side.
        live: the sweep is running, and the page says how far it is.
        processes: that draw for the page and for files, from `drawing_processes`.
    """
    figures = Figures(processes)
    analyses = analyse(sweep)
    stages = [analysis.stage for analysis in analyses]
    for analysis in analyses:
        for drawing in stage_drawings(sweep, analysis):
            figures.add(drawing)
    study = study_of(sweep)
    for drawing in (*drawings_of_stages(sweep, stages), *study_drawings(study)):
        figures.add(drawing)
    return Report(
        sweep=sweep,
        analyses=analyses,
        together=analyse_stages(sweep, stages),
        study=study,
        figures=figures,
        differences=() if beside is None else difference_tables(*beside, analyses),
        missing=missing(sweep, analyses, undelivered, live=live) + ([damaged] if damaged else []),
        difference=difference,
        command=command,
        films=None
        if video_seed is None
        else make_films(sweep, analyses, store, video_seed, environments),
    )


def write_report(report: Report, folder: Path) -> Path:
    """Write the page, `figures/*` (PNG, SVG, PDF), `videos/*` and `tables/*.csv` into `folder`.

    Figures of an earlier report that this one does not have are removed.

    Returns:
        The page.

    Raises:
        ReportError: where the folder is not writable.
    """
    figures, tables = folder / "figures", folder / "tables"
    try:
        for part in (figures, tables):
            part.mkdir(parents=True, exist_ok=True)
        page = folder / PAGE
        page.write_text(render(report), encoding="utf-8")
        here = [file.name for file in figures.iterdir()]
        for stale in stale_files({drawing.name for drawing in report.drawings}, here):
            (figures / stale).unlink()
        if panels := overview(report.sweep, [one.stage for one in report.analyses]):
            for ending, content in files(panels, []).items():
                (figures / f"{PICTURE}{ending}").write_bytes(content)
        for name, drawn in report.figures.files():
            for ending, content in drawn.items():
                (figures / f"{name}{ending}").write_bytes(content)
        if report.films is not None and report.films.films:
            (folder / "videos").mkdir(exist_ok=True)
            for film in report.films.films:
                (folder / "videos" / film.name).write_bytes(film.data)
        for table in _tables(report):
            (tables / f"{table.name}.csv").write_text(table.to_csv(), encoding="utf-8")
    except OSError as error:
        raise ReportError(f"{folder} must be writable: {error}") from error
    return page


def _tables(report: Report) -> Iterable[Table]:
    pairs = [*report.analyses, *([report.together] if report.together else [])]
    yield from study_csv(report.study)
    yield finals_table(report.analyses)
    yield waits_table(report.analyses)
    yield races_table(pairs)
    yield improvement_table(pairs)
    yield runs_table(report.sweep)
    yield _curves_table(report.drawings)


def _curves_table(drawings: Iterable[Drawing]) -> Table:
    rows = [row for drawing in drawings for row in drawing.values]
    return Table(name="curves", columns=_CURVE_COLUMNS, rows=rows)
