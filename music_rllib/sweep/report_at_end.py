"""The report at a sweep's end: made by the report's own program, kept with the sweep's run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from music_rllib import names
from music_rllib.experiment.sweep_files import is_remote
from music_rllib.redaction import redact
from music_rllib.store.paths import sweep_folder

PATIENCE = 900.0
"""Seconds after which the sweep ends without a report."""


def report_at_end(storage: str, name: str, tracking_uri: str | None, config: Path) -> str | None:
    """Make the report of a sweep and attach it to the sweep's run in MLflow.

    In a process of its own: it draws on all CPUs, and whatever happens in it, the sweep is over and
    its results are kept.

    Args:
        storage: the sweep's, a folder or a bucket's URI.
        name: the sweep's.
        tracking_uri: of its MLflow, password included; None for the file in the storage.
        config: the sweep's YAML file, whose environments are filmed.

    Returns:
        Where the page and its picture are, for the user; None where `MUSIC_RLLIB_REPORT=off` says
        that nobody wants them.
    """
    if os.environ.get(names.VARIABLE_REPORT, "").lower() in {"off", "0", "no", "false"}:
        return None
    environment = dict(os.environ)
    if tracking_uri is not None:
        environment[names.VARIABLE_TRACKING_URI] = tracking_uri
    place = str(sweep_folder(storage, name))
    if is_remote(storage):
        # Its URI may hold a key, which everyone on the machine could read on a command line.
        environment[names.VARIABLE_STORAGE], place = storage, name
    command = [sys.executable, "-m", "music_rllib.report", place]
    if config.is_file():
        command += ["--env", str(config.absolute())]
    try:
        done = subprocess.run(  # noqa: S603
            [*command, "--attach"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return _no_report(redact(str(error)), storage, name)
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    if done.returncode or not lines:
        return _no_report(lines[-1] if lines else f"it ended with {done.returncode}", storage, name)
    kept = 2 if lines[-1].startswith("Picture: ") else 1
    return "\n".join(lines[-kept:])


def _no_report(reason: str, storage: str, name: str) -> str:
    place = f"{redact(storage)}/{name}"
    return f"No report: {reason}. Make it with: python -m music_rllib.report {place}"
