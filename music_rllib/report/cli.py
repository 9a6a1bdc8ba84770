"""`report`: one page about a sweep, or its tables."""

from __future__ import annotations

import contextlib
import re
import shlex
import sys
from collections.abc import Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from music_rllib import names
from music_rllib.command_line import called_as, folder_option
from music_rllib.errors import FAILED, BadInputError

if TYPE_CHECKING:
    from music_rllib.experiment.open_sweep import OpenSweep
    from music_rllib.report.page import SweepReport
    from music_rllib.results.data import RunRecord, Sweep

EXAMPLES = """\
Examples:
  music-rllib report results/smoke
      report on the sweep in that folder, during the sweep or afterwards
  music-rllib report s3://bucket/sweeps/smoke --output reports
      report on a sweep in a bucket, from any machine
  music-rllib report results/smoke --serve
      the same page while the sweep runs, with its progress
  music-rllib report results/smoke results/other
      differences in the settings and in the results of two sweeps
  music-rllib report results/smoke --export published/smoke --format csv
      its runs and metrics as plain tables; 'report published/smoke' reads them
  music-rllib report results/smoke --export published/smoke --add
      the same; keeps the runs that another machine exported there

Exit codes: 0 the report is written, whatever the state of the sweep; 1 the
report is written without finished runs whose files are damaged; 2 there is no
such sweep.
"""


class TableFormat(StrEnum):
    """The format of exported tables."""

    csv = "csv"
    parquet = "parquet"


def report(
    sweeps: Annotated[
        list[str],
        typer.Argument(
            help="A sweep's folder or URI, an exported folder, or a sweep's name or YAML file; two "
            "for a comparison of sweeps.",
            metavar="SWEEP",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the report; `report` in the sweep's folder by default.",
            parser=folder_option,
            metavar="FOLDER",
        ),
    ] = None,
    storage: Annotated[
        str | None,
        typer.Option(
            help="Folder or URI of results, if SWEEP is a name; `results` by default.",
            # A key in a URI on a command line could be read by everyone on the machine.
            envvar=names.VARIABLE_STORAGE,
            show_envvar=False,
        ),
    ] = None,
    videos: Annotated[
        bool, typer.Option(help="Record an episode for each q, if this machine can render.")
    ] = True,
    env: Annotated[
        Path | None,
        typer.Option(
            help="A sweep's YAML file whose declared environments are created for videos, in "
            "addition to built-in tasks and Gymnasium's environments.",
        ),
    ] = None,
    serve: Annotated[
        bool,
        typer.Option(
            "--serve",
            help="Serve the page on this machine while the sweep runs, with its progress.",
        ),
    ] = False,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port for --serve. Default: a free port.")
    ] = None,
    attach: Annotated[
        bool, typer.Option("--attach", help="Also store the report with the sweep's run in MLflow.")
    ] = False,
    export: Annotated[
        Path | None,
        typer.Option(
            help="Write the sweep as tables into this folder instead of a report.",
            parser=folder_option,
            metavar="FOLDER",
        ),
    ] = None,
    format_: Annotated[
        TableFormat | None,
        typer.Option(
            "--format", help="With --export: format of the tables.", show_default="parquet"
        ),
    ] = None,
    add: Annotated[
        bool,
        typer.Option("--add", help="With --export: keep the runs of an earlier export there."),
    ] = False,
) -> int:
    """Write one page about a sweep, or about two.

    The page is self-contained; its figures (PNG, SVG) and numbers (CSV) are also files.
    """
    for option, needs, is_lone in (
        ("--add", "--export", add and export is None),
        ("--format", "--export", format_ is not None and export is None),
        ("--port", "--serve", port is not None and not serve),
    ):
        if is_lone:
            raise BadInputError(f"{option} must be given with {needs}")
    if serve and (export or output or attach):
        raise BadInputError("--serve must be given without --export, --output and --attach")
    if len(sweeps) > 1 and (len(sweeps) > 2 or serve or attach or export is not None):
        raise BadInputError(
            "SWEEP must be given once, or twice for a comparison without --serve, --attach and "
            "--export"
        )
    if export is not None:
        _export(sweeps[0], storage, export, format_ or TableFormat.parquet, add=add)
    elif serve:
        _serve(sweeps[0], storage, port or 0)
    else:
        return _report(sweeps, storage, output, env, videos=videos, attach=attach)
    return 0


def _export(
    place: str, storage: str | None, folder: Path, table_format: TableFormat, *, add: bool
) -> None:
    from music_rllib.names import in_runs
    from music_rllib.results.archive import is_archive, merged, read_archive, write_archive
    from music_rllib.results.data import ReportError
    from music_rllib.results.read import read_sweep

    sweep, earlier = read_sweep(place, storage).sweep, None
    if is_archive(folder):
        # What an interrupted export has left may be replaced.
        with contextlib.nullcontext() if add else contextlib.suppress(ReportError):
            earlier = read_archive(folder)
    if earlier is not None and earlier.name != sweep.name:
        raise ReportError(
            f"--export must be the folder of an export of the same sweep, or another folder, got "
            f"{folder}: it has {earlier.name!r}, not {sweep.name!r}"
        )
    if add and earlier is not None:
        kept = earlier.having(partial(_is_kept, sweep))
        names_kept = {run.name for run in kept.runs}
        # A run of an earlier version of the algorithm stays instead of its waiting successor.
        own = sweep.having(lambda run: run.status != "SCHEDULED" or run.name not in names_kept)
        sweep = merged(kept, own)
    write_archive(sweep, folder, table_format.value)
    if sweep.earlier:
        typer.echo(sweep.earlier)
    values = sum(len(column.run) for column in sweep.history.values())
    typer.echo(f"{in_runs(len(sweep.runs))}, {values} values: {folder}")


def _is_kept(sweep: Sweep, run: RunRecord) -> bool:
    """Whether a run of an earlier export stays: unless the sweep has it with other settings.

    The sweep has its own waiting runs. A run of an earlier version of the algorithm stays until the
    sweep has finished its own.
    """
    own = next((one for one in sweep.runs if one.name == run.name), run)
    replaced = own.is_finished or own.tags.get(names.TAG_ALGORITHM) == run.tags.get(
        names.TAG_ALGORITHM
    )
    return run.status != "SCHEDULED" and (own.node_key == run.node_key or not replaced)


def _report(
    places: Sequence[str],
    storage: str | None,
    output: Path | None,
    env: Path | None,
    *,
    videos: bool,
    attach: bool,
) -> int:
    from music_rllib.config.load import declared_tasks
    from music_rllib.redaction import for_people, redact
    from music_rllib.report.build import PICTURE, WANTED, build_report, write_report
    from music_rllib.report.figures.choice import slug
    from music_rllib.report.two_sweeps import joined_sweeps
    from music_rllib.results.data import ReportError
    from music_rllib.results.read import read_sweep

    first, *others = (read_sweep(place, storage, metrics=WANTED, lenient=True) for place in places)
    if attach and first.opened is None:
        raise ReportError("--attach must be given with a sweep in its storage, got an exported one")
    sweep, both, name = first.sweep, None, "report"
    for other in others:
        both = (first.sweep, other.sweep)
        sweep, name = joined_sweeps(*both), f"report-and-{slug(other.sweep.name)}"
    damaged = " ".join(source.damaged for source in (first, *others) if source.damaged)
    made = build_report(
        sweep,
        damaged=damaged,
        storage=None if first.opened is None else first.opened.storage,
        videos=videos and both is None,
        environments=() if env is None else declared_tasks(env),
        both=both,
        command=_command(),
    )
    page = write_report(made, output or first.folder / name)
    for sentence in made.limitations:
        typer.echo(f"missing: {for_people(sentence)}")
    for sentence in made.answer:
        typer.echo(for_people(sentence))
    typer.echo(f"Report: {page.absolute()}")
    picture = page.parent / "figures" / f"{PICTURE}.png"
    if picture.exists():
        typer.echo(f"Picture: {picture.absolute()}")
    if attach and first.opened is not None:
        _attach(first.opened, page.parent, made)
    if damaged:
        typer.echo(f"error: {redact(damaged)}", err=True)
        return FAILED
    return 0


def _command() -> str:
    from music_rllib.redaction import redact

    return redact(shlex.join([*called_as(), *sys.argv[1:]]))


def _serve(place: str, storage: str | None, port: int) -> None:
    from music_rllib.experiment.sweep_files import find_sweep
    from music_rllib.report.build import WANTED, build_report
    from music_rllib.report.live import LivePage, Progress, make_server, serve
    from music_rllib.report.page import render
    from music_rllib.results.read import read_stored

    sweep = find_sweep(place, None if "/" in place else storage)
    progress = Progress(sweep)

    def make_page() -> str:
        source = read_stored(sweep, metrics=WANTED, lenient=True)
        made = build_report(
            source.sweep,
            damaged=source.damaged or "",
            command=_command(),
            live=progress.is_running(),
        )
        return render(made, live=True)

    page = LivePage(make_page, progress)
    serve(make_server(page, port), page, typer.echo)


def _attach(opened: OpenSweep, folder: Path, made: SweepReport) -> None:
    """Store the report, in `folder`, with the sweep's run in MLflow."""
    from music_rllib.report.build import made_files
    from music_rllib.tracking.tracker import SweepRun

    run = SweepRun.of(opened)
    note = _note(made.answer[1], made, run.run_id)
    run.attach(folder, made_files(folder), "report", note)
    typer.echo(f"Attached to the sweep's run in MLflow: {run.page}")


MOST_NOTE = 7500
"""Longest text and table of a description in MLflow, whose tags have at most 8,000 characters."""


def _note(answer: str, made: SweepReport, run_id: str) -> str:
    """The answer, its stage's final values and a figure, in Markdown for MLflow's page."""
    from music_rllib.report.build import of_the_answer
    from music_rllib.results.tables import performance_tables

    lines = [f"**{_escaped(answer)}**", ""]
    stage = ""
    if made.analyses:
        own = of_the_answer(made.analyses, made.study)
        stage = own[0].stage.name
        table = performance_tables(own)[0]
        titles = [title for title, _ in table.heads]
        rows = [titles, *([cell.text for cell in row] for row in table.cells)]
        # MLflow's tables have no space between their columns.
        lines += ["".join(f"| {_escaped(text)}&emsp;" for text in row) + "|" for row in rows]
        lines.insert(3, "|---" * len(titles) + "|")
    drawn = sorted(made.drawings, key=lambda drawing: drawing.stage != stage)
    count = len(lines)
    # MLflow would cut off the end, which is the figure.
    while sum(map(len, lines)) + len(lines) > MOST_NOTE and len(lines) > 4:
        lines.pop()
    if count > len(lines):
        lines += ["", f"The report has {count - len(lines)} more rows."]
    if drawn:
        figure = f"report/figures/{drawn[0].name}.png"
        # MLflow serves its pages and its artifacts from the same origin.
        lines += ["", f"![{figure}](get-artifact?path={figure}&run_uuid={run_id})"]
    return "\n".join(lines)


def _escaped(text: str) -> str:
    return re.sub(r"([\\`*_\[\]<>|#!~])", r"\\\1", text)
