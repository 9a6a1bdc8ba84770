"""`report`: one page about a sweep, or its tables."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from music_rllib import names
from music_rllib.command_line import add_command, called_as, new_app, run_app
from music_rllib.errors import FAILED, BadInputError

if TYPE_CHECKING:
    from music_rllib.report.page import Report
    from music_rllib.results.data import RunRecord, Sweep
    from music_rllib.results.read import SweepRead

EXAMPLES = """\
Examples:
  music-rllib report results/smoke
      on the sweep in that folder, while it runs or afterwards
  music-rllib report s3://bucket/sweeps/smoke --output reports
      on a sweep in a bucket, from any machine
  music-rllib report results/smoke --serve
      the same page while it runs, with its progress
  music-rllib report results/smoke results/other
      what differs in the settings and in the results of two sweeps
  music-rllib report results/smoke --export published/smoke --format csv
      its runs and metrics as plain tables; 'report published/smoke' reads them
  music-rllib report results/smoke --export published/smoke --add
      the same, and what another machine has exported there stays

Exit codes: 0 the report is written, whatever state the sweep is in; 1 it is
written without finished runs whose files are damaged; 2 there is no such sweep.
"""


class TableFormat(StrEnum):
    """The format of exported tables."""

    csv = "csv"
    parquet = "parquet"


def report(
    sweeps: Annotated[
        list[str],
        typer.Argument(
            help="A sweep's folder or URI, an exported folder, or a sweep's name; two are put "
            "side by side.",
            metavar="SWEEP",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(help="Folder for the report; `report` in the sweep's folder by default."),
    ] = None,
    storage: Annotated[
        str | None,
        typer.Option(
            help="Folder or URI of results, where SWEEP is a name; `results` by default.",
            # A key in a URI on a command line could be read by everyone on the machine.
            envvar=names.VARIABLE_STORAGE,
            show_envvar=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the filmed episodes.")] = 0,
    videos: Annotated[
        bool, typer.Option(help="Film an episode for each q, where this machine can draw.")
    ] = True,
    env: Annotated[
        Path | None,
        typer.Option(
            help="A sweep's YAML file: the environments that it declares are made for videos, "
            "beside the built-in tasks' and Gymnasium's own.",
        ),
    ] = None,
    serve: Annotated[
        bool,
        typer.Option(
            "--serve",
            help="Serve the page on loopback while the sweep runs, with its progress.",
        ),
    ] = False,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="With --serve; 0 takes a free one.")
    ] = 0,
    attach: Annotated[
        bool, typer.Option("--attach", help="Also keep the report with the sweep's run in MLflow.")
    ] = False,
    export: Annotated[
        Path | None,
        typer.Option(help="Write the sweep as tables into this folder instead of a report."),
    ] = None,
    format_: Annotated[
        TableFormat, typer.Option("--format", help="Of the exported tables.")
    ] = TableFormat.parquet,
    add: Annotated[
        bool,
        typer.Option("--add", help="With --export: keep the runs of an earlier export there."),
    ] = False,
) -> int:
    """Write one page about a sweep, or about two.

    Self-contained, with its figures (PNG, SVG, PDF) and numbers (CSV).
    """
    if add and export is None:
        raise BadInputError("--add must be given with --export")
    if serve and (export or output or attach):
        raise BadInputError("--serve must be given without --export, --output and --attach")
    place = sweeps[0]
    if len(sweeps) > 1:
        _beside(sweeps, storage, output, alone=serve or attach or export is not None)
    elif export is not None:
        _export(place, storage, export, format_, add=add)
    elif serve:
        _serve(place, storage, port)
    else:
        video_seed = seed if videos else None
        return _report(place, storage, output, video_seed, env, attach=attach)
    return 0


def _export(
    place: str, storage: str | None, folder: Path, table_format: TableFormat, *, add: bool
) -> None:
    from music_rllib.labels import in_runs
    from music_rllib.results.archive import is_archive, merged, read_archive, write_archive
    from music_rllib.results.data import ReportError
    from music_rllib.results.read import read_sweep

    whole = read_sweep(place, storage).sweep
    sweep, earlier = whole.having(lambda run: run.status != "SCHEDULED"), None
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
        sweep = merged(earlier.having(partial(_is_kept, whole)), sweep)
    write_archive(sweep, folder, table_format.value)
    if sweep.earlier:
        typer.echo(sweep.earlier)
    values = sum(len(column.run) for column in sweep.history.values())
    typer.echo(f"{in_runs(len(sweep.runs))}, {values} values: {folder}")


def _is_kept(sweep: Sweep, run: RunRecord) -> bool:
    """Whether a run of an earlier export stays: unless the sweep has it with other settings.

    A run of an earlier version of the algorithm stays until the sweep has finished its own.
    """
    own = next((one for one in sweep.runs if one.name == run.name), run)
    replaced = own.is_finished or own.tags.get(names.TAG_ALGORITHM) == run.tags.get(
        names.TAG_ALGORITHM
    )
    return own.node_key == run.node_key or not replaced


def _report(
    place: str,
    storage: str | None,
    output: Path | None,
    video_seed: int | None,
    env: Path | None,
    *,
    attach: bool,
) -> int:
    from music_rllib.report.figures.processes import drawing_processes

    # The processes load their modules while this one loads its own.
    with drawing_processes() as processes:
        from music_rllib.config.load import declared_tasks
        from music_rllib.redaction import for_people, redact
        from music_rllib.report.build import PICTURE, WANTED, build_report, write_report
        from music_rllib.results.answer import answer
        from music_rllib.results.read import read_sweep

        source = read_sweep(place, storage, metrics=WANTED, lenient=True)
        report = build_report(
            source.sweep,
            damaged=source.damaged,
            storage=None if source.opened is None else source.opened.storage,
            video_seed=video_seed,
            environments=() if env is None else declared_tasks(env),
            command=_command(),
            processes=processes,
        )
        page = write_report(report, output or source.folder / "report")
    for note in report.limitations:
        typer.echo(f"missing: {for_people(note)}")
    for line in answer(source.sweep, report.study):
        typer.echo(for_people(line))
    typer.echo(f"Report: {page.absolute()}")
    picture = page.parent / "figures" / f"{PICTURE}.png"
    if picture.exists():
        typer.echo(f"Picture: {picture.absolute()}")
    if attach:
        _attach(source, page.parent, report)
    if source.damaged is not None:
        typer.echo(f"error: {redact(source.damaged)}", err=True)
        return FAILED
    return 0


def _command() -> str:
    """This command without secrets."""
    from music_rllib.redaction import redact

    return redact(shlex.join([*called_as(), *sys.argv[1:]]))


def _beside(
    places: Sequence[str],
    storage: str | None,
    output: Path | None,
    *,
    alone: bool,
) -> None:
    """Write a report of two sweeps; `alone`: an option was given that takes a single sweep."""
    from music_rllib.report.figures.processes import drawing_processes
    from music_rllib.results.data import ReportError

    if len(places) > 2 or alone:
        raise ReportError(
            "SWEEP must be one, or two to put side by side; --serve, --attach and --export take one"
        )
    with drawing_processes() as processes:
        from music_rllib.report.build import WANTED, build_report, write_report
        from music_rllib.report.figures.choice import slug
        from music_rllib.report.side_by_side import side_by_side
        from music_rllib.results.read import read_sweep

        sources = [read_sweep(place, storage, metrics=WANTED) for place in places]
        first, second = (source.sweep for source in sources)
        report = build_report(
            side_by_side(first, second),
            beside=(first, second),
            command=_command(),
            processes=processes,
        )
        folder = output or sources[0].folder / f"report-beside-{slug(second.name)}"
        page = write_report(report, folder)
    typer.echo(f"Report: {page.absolute()}")


def _serve(place: str, storage: str | None, port: int) -> None:
    from music_rllib.experiment.sweep_files import find_sweep
    from music_rllib.report.build import WANTED, build_report
    from music_rllib.report.live.server import LivePage, make_server, serve
    from music_rllib.report.live.state import Progress
    from music_rllib.report.page import render
    from music_rllib.results.read import read_stored

    sweep = find_sweep(place, None if "/" in place else storage)
    progress = Progress(sweep)

    def make_page() -> str:
        source = read_stored(sweep, metrics=WANTED, lenient=True)
        report = build_report(
            source.sweep,
            damaged=source.damaged,
            command=_command(),
            live=progress.is_running(),
        )
        return render(report, live=True)

    page = LivePage(make_page, progress)
    serve(make_server(page, port), page, typer.echo)


def _attach(source: SweepRead, folder: Path, report: Report) -> None:
    """Keep the report, in `folder`, with the sweep's run in MLflow."""
    from music_rllib.report.build import made_files
    from music_rllib.report.tables import note
    from music_rllib.results.answer import answer
    from music_rllib.results.data import ReportError
    from music_rllib.tracking.store import SweepRun

    if source.opened is None:
        raise ReportError("--attach must be given with a sweep in its storage, got an exported one")
    run = SweepRun.of(source.opened)
    last = report.analyses[-1].stage.name if report.analyses else ""
    drawn = sorted(report.drawings, key=lambda drawing: drawing.stage != last)
    figure = f"report/figures/{drawn[0].name}.png" if drawn else None
    said = answer(source.sweep, report.study)[1]
    text = note(said, report.analyses, run.run_id, figure)
    run.attach(folder, made_files(folder), "report", text)
    typer.echo(f"Attached to the sweep's run in MLflow: {run.page}")


app = new_app()
add_command(app, "report", report, EXAMPLES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `python -m music_rllib.report` and return its exit code."""
    return run_app(app, "python -m music_rllib.report", arguments)
