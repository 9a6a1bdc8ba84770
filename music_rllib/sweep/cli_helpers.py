"""Arguments that several commands of a sweep take."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["Name", "Place", "Seeds", "Storage", "SweepStorage"]

Place = Annotated[
    str,
    typer.Argument(
        metavar="SWEEP",
        help="A sweep's folder (results/smoke, s3://bucket/results/smoke), its name in --storage, "
        "or its YAML file.",
    ),
]
Storage = Annotated[
    str | None,
    typer.Option(metavar="PLACE", help="Folder or URI of results, where SWEEP is a name."),
]
SweepStorage = Annotated[
    str | None,
    typer.Option(
        metavar="PLACE",
        help="Folder, or s3:// or gs:// URI, for results; replaces the file's 'storage'. Sweeps "
        "with the same storage share finished runs.",
    ),
]
Name = Annotated[
    str | None, typer.Option(metavar="NAME", help="Name of the sweep; replaces the file's 'name'.")
]
Seeds = Annotated[
    str | None,
    typer.Option(
        metavar="N",
        help="So many seeds, the file's first, or a list like 0,1,7. Those that have run are "
        "reused; the report says how many would likely decide.",
    ),
]
