"""`run`, `plan` and `resume`: train a sweep, show its runs, resume it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from music_rllib.command_line import Json, time_option
from music_rllib.errors import BadInputError
from music_rllib.sweep.commands import Place, Storage

RUN_EXAMPLES = """\
Examples:
  music-rllib run my.yaml
  music-rllib run my.yaml tac.alpha=0.1 seeds=5 env_steps=1e6
      replace settings of the file in every stage; the sweep records them
  music-rllib run my.yaml --storage /data/results --name first-try
  music-rllib run my.yaml --seeds 10
      10 seeds, those of the file first; only new ones are trained
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
        help="Sweep file (YAML). Default: a small packaged sweep.",
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
        help="Number of seeds (those of the file first, then the smallest others) or a list such "
        "as 0,1,7. Finished seeds are reused.",
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
        "storage records this choice. Without it the command starts nothing.",
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
WaitForNodes = Annotated[
    float | None,
    typer.Option(
        metavar="MINUTES",
        parser=time_option,
        help="Time to wait for nodes of a cluster that can hold a run. Default: 5 minutes if no "
        "node has CPUs yet, as after a restart of the head; otherwise 0.",
        show_default=False,
    ),
]


def run(
    config: Config = None,
    overrides: Overrides = None,
    storage: SweepStorage = None,
    name: Name = None,
    seeds: Seeds = None,
    accept_changes: AcceptChanges = False,
    retrain: Retrain = None,
    keep_runs: KeepRuns = False,
    retrain_damaged: RetrainDamaged = False,
    wait_for_nodes: WaitForNodes = None,
    json: Json = False,
) -> int:
    """Train every run of a sweep and log them to MLflow."""
    from music_rllib.sweep import driver

    return driver.run(
        driver.load(config, overrides, storage=storage, name=name, seeds=seeds),
        accept_changes=accept_changes,
        retrain=retrain or (),
        keep_runs=keep_runs,
        retrain_damaged=retrain_damaged,
        wait_minutes=wait_for_nodes,
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
    from music_rllib.sweep import driver

    sweep = driver.load(config, overrides, storage=storage, name=name, seeds=seeds)
    return driver.plan(sweep, measure=measure, as_json=json)


def resume(
    sweep: Place,
    storage: Storage = None,
    seeds: Seeds = None,
    accept_changes: AcceptChanges = False,
    retrain: Retrain = None,
    keep_runs: KeepRuns = False,
    retrain_damaged: RetrainDamaged = False,
    wait_for_nodes: WaitForNodes = None,
    json: Json = False,
) -> int:
    """Resume a stopped or killed sweep, using the configuration kept in its storage."""
    from music_rllib.experiment.sweep_files import find_sweep
    from music_rllib.sweep import driver

    location = find_sweep(sweep, storage)
    config = location.config(seeds)
    if config.name != location.name:  # its folder was renamed or copied
        raise BadInputError(
            f"SWEEP must be in a folder with its name, {config.name}, got {location.place}: rename "
            f"the folder, or give 'run' the sweep's file and --name {location.name}, which reuses "
            "finished runs"
        )
    return driver.run(
        config,
        accept_changes=accept_changes,
        retrain=retrain or (),
        keep_runs=keep_runs,
        retrain_damaged=retrain_damaged,
        wait_minutes=wait_for_nodes,
        as_json=json,
    )
