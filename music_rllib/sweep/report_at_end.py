"""The report at the end of a sweep, made by the `report` command in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from music_rllib import names
from music_rllib.redaction import redact
from music_rllib.store.storage import below, is_remote, sweep_folder

TIMEOUT_SECONDS = 900.0
"""After this time the sweep ends without a report."""


def report_at_end(storage: str, name: str, tracking_uri: str | None, config: Path) -> str | None:
    """Make the report of a sweep and attach it to the sweep's run in MLflow.

    It runs in a process of its own: whatever happens in it, the results of the sweep are kept.

    Args:
        storage: Folder or URI of a bucket.
        name: The sweep's name.
        tracking_uri: MLflow's, password included; None for the file in the storage.
        config: The sweep's YAML file, whose environments are recorded in videos.

    Returns:
        A message with the paths of the page and its picture, or with the reason why there is no
        report; None if `MUSIC_RLLIB_REPORT=off` is set.
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
    command = [sys.executable, "-m", "music_rllib", "report", place]
    if config.is_file():
        command += ["--env", str(config.absolute())]
    try:
        done = subprocess.run(  # noqa: S603
            [*command, "--attach"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        reason = redact(str(error))
    else:
        marks = ("Report: ", "Picture: ")
        made = [line for line in done.stdout.splitlines() if line.startswith(marks)]
        errors = done.stderr.strip().splitlines()
        if made:  # even if it could not be attached, or if runs are damaged
            return "\n".join(made if done.returncode == 0 else [*made, *errors[-1:]])
        reason = errors[-1] if errors else f"it ended with exit code {done.returncode}"
    place = below(redact(storage), name)
    return f"No report: {reason}. Make it with: music-rllib report {place}"
