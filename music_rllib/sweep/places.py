"""Where a sweep keeps things."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

__all__ = ["in_ray_job", "resolve_storage", "sweep_folder"]


def in_ray_job() -> bool:
    """Whether this is the driver of a submitted Ray job, in a working directory that will go."""
    return "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ


def resolve_storage(storage: str) -> tuple[str, str | None]:
    """Make a folder absolute, so that it is the same for every worker; leave a URI as it is.

    Returns:
        The storage, and what to tell the user if it isn't where a shell would look for it.
    """
    if "://" in storage:
        return storage, None
    path = Path(storage).expanduser()
    if path.is_absolute() or not in_ray_job():
        return str(path.absolute()), None
    resolved = Path.home() / path
    return str(resolved), (
        f"storage {storage!r} is relative and a Ray job's working directory is temporary: "
        f"using {resolved}. Give an absolute path or a bucket to choose another place."
    )


def sweep_folder(storage: str, name: str) -> Path:
    """Local folder of a sweep's own files: in the storage, or in the home folder for a bucket."""
    if "://" not in storage:
        return Path(storage) / name
    if storage.startswith("file://"):
        return Path(storage.removeprefix("file://")) / name
    bucket = hashlib.sha256(storage.encode()).hexdigest()[:12]
    return Path.home() / ".music_rllib" / bucket / name
