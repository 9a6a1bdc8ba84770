"""`run`, `plan` and `resume`: train a sweep, show its runs, resume it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from music_rllib.command_line import Json
from music_rllib.sweep.commands.arguments import Place, Storage

RUN_EXAMPLES = """\
Examples:
  music-rllib run my.yaml
  music-rllib run my.yaml tac.alpha=0.1 seeds=5 env_steps=1e6
      replace settings of the file in every stage; the sweep records them
  music-rllib run my.yaml --storage /data/results --name first-try
  music-rllib run my.yaml --seeds 10
      seeds 0 to 9; only new seeds are trained
  music-rllib run my.yaml stages.train.env_steps=2e5
      train longer; finished runs of the stage continue from their end

Run the command again to resume: finished runs are reused, others resume from
their last checkpoint. With RAY_ADDRESS=HOST:PORT the sweep runs on that Ray
cluster.
"""
PLAN_EXAMPLES = """\
Examples:
  music-rllib plan my.yaml
  music-rllib plan my.yaml --seeds 12
      the plan with 12 seeds; finished runs count as done
  music-rllib plan my.yaml env_steps=1e6 --measure
      train each kind of run for some seconds and estimate the total time
  music-rllib plan my.yaml --json
      every planned run with its key, which is the same on every machine
"""
RESUME_EXAMPLES = """\
Examples:
  music-rllib resume results/smoke
      no file needed; the configuration is in the storage
  music-rllib resume results/smoke --seeds 10
      add seeds; only the new ones are trained
  ray job submit --working-dir . -- \\
    python -m music_rllib.sweep resume s3://bucket/sweeps/smoke
      in a new job, after the head node of a cluster died
"""

Config = Annotated[
    Path | None,
    typer.Argument(
        metavar="CONFIG",
        help="Sweep file (YAML). Without one, a small packaged sweep runs.",
        show_default=False,
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="KEY=VALUE",
        help="Setting that replaces the file's: in every stage (tac.alpha=0.1), in one stage "
        "(stages.finetune.env_steps=1e5), or a top-level key (seeds=5).",
        show_default=False,
    ),
]
SweepStorage = Annotated[
    str | None,
    typer.Option(
        metavar="PLACE",
        help="Folder or s3:// or gs:// URI for results; replaces 'storage' of the file. Sweeps "
        "with the same storage share finished runs.",
    ),
]
Name = Annotated[
    str | None, typer.Option(metavar="NAME", help="Name of the sweep; replaces 'name' of the file.")
]
Seeds = Annotated[
    str | None,
    typer.Option(
        metavar="N",
        help="Number of seeds (the first N of the file) or a list such as 0,1,7. Finished seeds "
        "are reused.",
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
        help="Delete and retrain finished runs whose files are damaged. Without it the command "
        "names them and starts nothing.",
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
            help="Start only if this sweep has run before. A repeated command resumes the sweep "
            "with and without this option.",
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
            help="Train each kind of run for some seconds on this machine and estimate the "
            "remaining time.",
        ),
    ] = False,
    json: Json = False,
) -> int:
    """Check a sweep file and show the runs that it would train.

    No run is started. The `analysis` section is recorded as the analysis plan of the sweep.
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
    """Resume a stopped or killed sweep, using the configuration kept in its storage."""
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
