"""Arguments that several commands of a sweep take, and what they name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from music_rllib.errors import BadInputError

if TYPE_CHECKING:
    from music_rllib.config.schema import Stage, SweepConfig
    from music_rllib.experiment.location import SweepLocation

Config = Annotated[
    Path | None,
    typer.Argument(
        metavar="CONFIG",
        help="The sweep, a YAML file. Without one, a small packaged sweep is taken.",
        show_default=False,
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="KEY=VALUE",
        help="Replace what the file says: a setting in every stage (tac.alpha=0.1), in one "
        "(stages.finetune.env_steps=1e5), or a key of the file's top (seeds=5).",
        show_default=False,
    ),
]
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
StageName = Annotated[
    str | None, typer.Option(metavar="STAGE", help="Of which stage; the last by default.")
]
AcceptChanges = Annotated[
    bool,
    typer.Option(
        "--accept-changes",
        help="Where settings are others than the last time under this name: train anew what they "
        "touch. Without it the command says what would be lost, and starts nothing.",
    ),
]
RetrainDamaged = Annotated[
    bool,
    typer.Option(
        "--retrain-damaged",
        help="Where finished runs are not what they were when they ended: delete them and train "
        "them again. Without it the command names them, and starts nothing.",
    ),
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
