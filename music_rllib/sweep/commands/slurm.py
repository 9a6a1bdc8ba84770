"""`slurm`: run a sweep as a Slurm job array, whose tasks share its runs through the storage."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from music_rllib.errors import FAILED, BadInputError
from music_rllib.sweep.commands.run import Name, Overrides, Seeds, SweepStorage

EXAMPLES = """\
Examples:
  music-rllib slurm my.yaml --array 8 --cpus 16 --storage /shared/results
      write NAME.slurm.sh, and print how to submit it
  music-rllib slurm my.yaml --array 8 --time 1-00 --partition cpu \\
    --sbatch=--account=lab --storage /shared/results --submit
      write and submit it
  music-rllib status /shared/results/NAME
      finished runs of all tasks, and the running runs of one task
"""
FIXED = ("--signal=B:TERM@120", "--requeue", "--open-mode=append", "--output=%x-%j.log")
"""Options of every script; later ones replace them."""
BODY = Path(__file__).parents[1] / "slurm.sh"
_MADE_BY = "# Written by 'music-rllib slurm'."
_TIME = re.compile(r"\d+(:\d\d){0,2}|\d+-\d\d?(:\d\d){0,2}")


def slurm(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Sweep file (YAML).")],
    overrides: Overrides = None,
    array: Annotated[
        int, typer.Option(metavar="TASKS", min=1, help="Number of tasks, each on one node.")
    ] = 4,
    time: Annotated[
        str,
        typer.Option(
            metavar="LIMIT",
            help="Time limit of a task, such as 12:00:00 or 1-00. Tasks that reach it save their "
            "runs and return to the queue.",
        ),
    ] = "12:00:00",
    cpus: Annotated[int, typer.Option(metavar="N", min=1, help="CPUs of a task.")] = 8,
    partition: Annotated[str | None, typer.Option(metavar="NAME", help="Slurm partition.")] = None,
    sbatch: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OPTION",
            help="Another option of sbatch, such as --sbatch=--account=lab. May be repeated.",
        ),
    ] = None,
    storage: SweepStorage = None,
    name: Name = None,
    seeds: Seeds = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="SCRIPT", help="Script to write. Default: NAME.slurm.sh"),
    ] = None,
    submit: Annotated[bool, typer.Option("--submit", help="Also submit the script.")] = False,
) -> int:
    """Write a batch script that runs a sweep as a Slurm job array; --submit submits it.

    The tasks are drivers that share the runs of the sweep through the storage, a folder that all
    nodes mount or a bucket. A second job after the array logs all runs to MLflow and writes the
    report.
    """
    from music_rllib.sweep import driver
    from music_rllib.tracking.store import resolve_store

    if any(one.startswith("resources.num_cpus=") for one in overrides or ()):
        raise BadInputError("resources.num_cpus must not be given: --cpus sets it for each task")
    of_a_task = [*(overrides or ()), f"resources.num_cpus={cpus}"]
    config = driver.load(file, of_a_task, storage=storage, name=name, seeds=seeds)
    # The tasks log to files of their own, the job after them to this store.
    is_given = "tracking_uri" in (config.document.get("mlflow") or {})
    uri = config.mlflow.tracking_uri if is_given else os.environ.get(driver.VARIABLE)
    resolve_store(uri, config.storage)
    if not _TIME.fullmatch(time):
        raise BadInputError(f"--time must be a time of Slurm such as 12:00:00 or 1-00, got {time}")
    options = {"job-name": config.name, "time": time, "cpus-per-task": cpus, "partition": partition}
    lines = [f"--{key}={value}" for key, value in options.items() if value is not None]
    lines += [*FIXED, *(sbatch or ())]
    for line in lines:
        if not line.startswith("-") or not line.isprintable():
            raise BadInputError(
                f"--sbatch and --partition must give one option of sbatch on one line, such as "
                f"--sbatch=--account=lab, got {line!r}"
            )
    given = {"--storage": storage, "--name": name, "--seeds": seeds}
    command = [sys.executable, "-m", "music_rllib", "run", str(file), *(overrides or ())]
    command += [part for key, value in given.items() if value for part in (key, value)]
    script = output or Path(f"{config.name}.slurm.sh")
    _write(script, [*(f"#SBATCH {line}" for line in lines), f"set -- {shlex.join(command)}"])
    typer.echo(f"{script} is written.")
    jobs = [f"--array=1-{array}"], ["--dependency=afterany:JOB"]
    if not submit:
        typer.echo("Submit it, then the job that logs all runs to MLflow and writes the report:")
        for job in jobs:
            typer.echo(f"  sbatch {shlex.join([*job, str(script)])}")
        return 0
    array_job = _submit([*jobs[0], str(script)])
    after = [f"--dependency=afterany:{array_job}", str(script)]
    try:
        last = _submit(after)
    except BadInputError as error:
        error.exit_code = FAILED  # something was started
        error.args = (
            f"{error}. Job {array_job} ({array} tasks) is submitted; submit the job that logs all "
            f"runs to MLflow and writes the report later: sbatch {shlex.join(after)}",
        )
        raise
    typer.echo(f"Submitted: job {array_job} ({array} tasks), then job {last} (MLflow and report).")
    return 0


def _write(script: Path, header: list[str]) -> None:
    """Write the script; a file of another origin, or an unwritable one, is a BadInputError."""
    parts = ["#!/bin/sh", _MADE_BY, *header, BODY.read_text(encoding="utf-8")]
    try:
        if script.exists() and _MADE_BY not in script.read_text(encoding="utf-8"):
            raise BadInputError(f"--output must not be a file of another origin, got {script}")
        script.write_text("\n".join(parts), encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(f"--output must be writable, got {script}: {error}") from error


def _submit(arguments: list[str]) -> str:
    """Number of the submitted job; a BadInputError if there is no sbatch, or it refuses the job."""
    command = ["sbatch", "--parsable", *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    except FileNotFoundError:
        raise BadInputError(
            "--submit needs sbatch on the PATH: use a login node of Slurm"
        ) from None
    if done.returncode != 0:
        raise BadInputError(f"{shlex.join(command)} failed: {done.stderr.strip()}")
    return done.stdout.strip().partition(";")[0]
