"""Arguments that several commands of a sweep take, and what they name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from music_rllib.errors import BadInputError

if TYPE_CHECKING:
    from music_rllib.config.schema import Stage, SweepConfig
    from music_rllib.experiment.location import SweepLocation

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
    str | None, typer.Option(metavar="STAGE", help="Stage; the last one by default.")
]


def find_stage(config: SweepConfig, name: str | None) -> Stage:
    """The stage with this name; without a name, the sweep's last one.

    Raises:
        BadInputError: The sweep has no such stage.
    """
    stages = {stage.name: stage for stage in config.stages}
    name = name or list(stages)[-1]
    if name not in stages:
        raise BadInputError(f"--stage must be one of {', '.join(stages)}, got {name!r}")
    return stages[name]


def plan_nodes(location: SweepLocation) -> list[dict[str, Any]]:
    """The nodes in a sweep's `plan.json`, as far as they are known."""
    from music_rllib.experiment import sweep_files

    nodes: list[dict[str, Any]] = (location.read(sweep_files.PLAN) or {"nodes": []})["nodes"]
    return nodes
