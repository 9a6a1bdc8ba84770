"""The commands of a sweep: each module has a function and the examples of its help.

A module is imported for every call of the program, so it loads nothing heavy before it is called.
"""

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
        metavar="STAGE",
        help="Stage. Default: that of the analysis, or the last that trains for the task.",
    ),
]
