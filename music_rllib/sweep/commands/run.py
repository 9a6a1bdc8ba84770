"""`run`, `plan` and `resume`: train a sweep, show what it would train, continue it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from music_rllib.command_line import Json
from music_rllib.sweep.cli_helpers import Place, Storage

RUN_EXAMPLES = """\
Examples:
  music-rllib run my.yaml
  music-rllib run my.yaml tac.alpha=0.1 seeds=5 env_steps=1e6
      other settings than the file's, in every stage; recorded like the file's
  music-rllib run my.yaml --storage /data/results --name first-try
  music-rllib run my.yaml --seeds 10
      the same with seeds 0 to 9: only the new ones are trained
  music-rllib run my.yaml stages.train.env_steps=2e5
      longer: finished runs of the stage go on from where they ended

Running a command again continues: finished runs are reused, others go on from
their last checkpoint. With RAY_ADDRESS=HOST:PORT, on a node
of that Ray cluster, it runs there.
"""
PLAN_EXAMPLES = """\
Examples:
  music-rllib plan my.yaml
  music-rllib plan my.yaml --seeds 12
      what it would take with 12 seeds; finished runs count as done
  music-rllib plan my.yaml env_steps=1e6 --measure
      how long it would take here: some seconds of training for each kind of run
  music-rllib plan my.yaml --json
      every run known beforehand with its key, the same on every machine
"""
RESUME_EXAMPLES = """\
Examples:
  music-rllib resume results/smoke
      no file needed: the configuration is in the storage
  music-rllib resume results/smoke --seeds 10
      extended by seeds: only the new ones are trained
  ray job submit --working-dir . -- \\
    python -m music_rllib.sweep resume s3://bucket/sweeps/smoke
      in a new job, after the head of a cluster has died
"""

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
AcceptChanges = Annotated[
    bool,
    typer.Option(
        "--accept-changes",
        help="If settings changed since the last run of this name, or an environment since its "
        "runs used it, retrain the affected runs. Without it the command names them and starts "
        "nothing.",
    ),
]
Retrain = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TASK|RUN",
        help="Delete the results of a run, by its label or a part of it, or of all runs on a task, "
        "and train it again. May be repeated.",
    ),
]
KeepRuns = Annotated[
    bool,
    typer.Option(
        "--keep-runs",
        help="If an environment has changed since runs used it, use these runs as they are. The "
        "answer is kept in the storage. Without an answer the command starts nothing.",
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
    retrain: Retrain = None,
    keep_runs: KeepRuns = False,
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

    config, overrides = _file_and_overrides(config, overrides)
    return run_sweep(
        config,
        dry_run=dry_run,
        storage=storage,
        name=name,
        seeds=seeds,
        overrides=overrides,
        accept_changes=accept_changes,
        retrain=retrain or (),
        keep_runs=keep_runs,
        retrain_damaged=retrain_damaged,
        must_exist=resume,
        as_json=json,
    )


def plan(
    config: Config = None,
    overrides: Overrides = None,
    storage: SweepStorage = None,
    name: Name = None,
    seeds: Seeds = None,
    measure: Annotated[
        bool,
        typer.Option(
            "--measure",
            help="Train each kind of run for some seconds on this machine, and say how long all "
            "of what is left would take on it.",
        ),
    ] = False,
    json: Json = False,
) -> int:
    """Check a sweep's file and show what it would run.

    No run is started. What its `analysis` states is kept as an analysis plan in the sweep's folder.
    """
    from music_rllib.sweep.driver import run_sweep

    config, overrides = _file_and_overrides(config, overrides)
    return run_sweep(
        config,
        dry_run=True,
        measure=measure,
        storage=storage,
        name=name,
        seeds=seeds,
        overrides=overrides,
        as_json=json,
    )


def resume(
    sweep: Place,
    storage: Storage = None,
    seeds: Seeds = None,
    accept_changes: AcceptChanges = False,
    retrain: Retrain = None,
    keep_runs: KeepRuns = False,
    retrain_damaged: RetrainDamaged = False,
    json: Json = False,
) -> int:
    """Go on with a sweep that was stopped or killed.

    By the configuration that it has left in its storage.
    """
    from music_rllib.experiment.location import find_sweep
    from music_rllib.sweep.driver import run_sweep

    return run_sweep(
        find_sweep(sweep, storage),
        seeds=seeds,
        accept_changes=accept_changes,
        retrain=retrain or (),
        keep_runs=keep_runs,
        retrain_damaged=retrain_damaged,
        as_json=json,
    )


def _file_and_overrides(
    config: Path | None, overrides: list[str] | None
) -> tuple[Path | None, list[str]]:
    """The file and its overrides; a first argument with a `=` that is no file is an override."""
    given = list(overrides or ())
    if config is not None and "=" in str(config) and not config.exists():
        return None, [str(config), *given]
    return config, given
