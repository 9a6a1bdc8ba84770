"""Arguments that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

Place = Annotated[
    str,
    typer.Argument(
        metavar="SWEEP",
        help="Folder of a sweep (results/smoke, s3://bucket/results/smoke), its name in "
        "--storage, or its YAML file.",
    ),
]
Storage = Annotated[
    str | None,
    typer.Option(metavar="PLACE", help="Folder or URI of results, if SWEEP is a name."),
]
StageName = Annotated[
    str | None,
    typer.Option(
        metavar="STAGE", help="Stage. Default: the stage of the analysis, or the last one."
    ),
]
