"""`run`: train every run of a sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from music_rllib.command_line import Json
from music_rllib.sweep.cli_helpers import (
    AcceptChanges,
    Config,
    Name,
    Overrides,
    RetrainDamaged,
    Seeds,
    SweepStorage,
)

EXAMPLES = """\
Examples:
  music-rllib run my.yaml
  music-rllib run my.yaml tac.alpha=0.1 seeds=5 env_steps=1e6
      other settings than the file's, in every stage; recorded like the file's
  music-rllib run my.yaml --storage /data/results --name first-try
  music-rllib run my.yaml --seeds 10
      the same with seeds 0 to 9: only the new ones are trained
  music-rllib run my.yaml env_steps=2e5
      longer: finished runs go on from where they ended

Running a command again continues: finished runs are reused, others go on from
their last checkpoint. With RAY_ADDRESS=HOST:PORT it runs on that Ray cluster.
"""


def run(
    config: Config = None,
    overrides: Overrides = None,
    storage: SweepStorage = None,
    name: Name = None,
    seeds: Seeds = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check everything, show the plan, run nothing.")
    ] = False,
    accept_changes: AcceptChanges = False,
    retrain_damaged: RetrainDamaged = False,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Start only where there is an earlier run of this sweep to go on with. Without "
            "it a repeated command goes on just the same.",
        ),
    ] = False,
    json: Json = False,
) -> int:
    """Train every run of a sweep and log them to MLflow."""
    from music_rllib.sweep.driver import run_sweep

    config, overrides = file_and_overrides(config, overrides)
    return run_sweep(
        config,
        dry_run=dry_run,
        storage=storage,
        name=name,
        seeds=seeds,
        overrides=overrides,
        accept_changes=accept_changes,
        retrain_damaged=retrain_damaged,
        must_exist=resume,
        as_json=json,
    )


def file_and_overrides(
    config: Path | None, overrides: list[str] | None
) -> tuple[Path | None, list[str]]:
    """The file and its overrides; a first argument with a `=` that is no file is an override."""
    given = list(overrides or ())
    if config is not None and "=" in str(config) and not config.exists():
        return None, [str(config), *given]
    return config, given
