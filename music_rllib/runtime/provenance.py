"""Tags with the versions of packages and the git commit of a run."""

from __future__ import annotations

import platform
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path

import music_rllib
from music_rllib import names

PACKAGES = (
    "music-rllib",
    "ray",
    "torch",
    "numpy",
    "gymnasium",
    "gymnasium-robotics",
    "mujoco",
    "optuna",
    "mlflow",
)
GIT_SECONDS = 5.0


@cache
def provenance_tags() -> dict[str, str]:
    """Versions of the packages that determine a result, and the git commit of a checkout."""
    tags = {names.TAG_VERSION_PREFIX + "python": platform.python_version()}
    for package in PACKAGES:
        try:
            tags[names.TAG_VERSION_PREFIX + package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    commit = git_commit(Path(music_rllib.__file__))
    return tags if commit is None else {**tags, names.TAG_GIT_COMMIT: commit}


def git_commit(file: Path) -> str | None:
    """Commit of the repository that tracks `file`, with `-dirty` if it has uncommitted changes.

    None if no repository tracks it. The virtual environment of an installed package may be inside
    the checkout of another project.
    """
    folder = file.resolve().parent
    if _git(folder, "ls-files", "--error-unmatch", file.name) is None:
        return None
    commit = _git(folder, "rev-parse", "HEAD")
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}-dirty" if commit and changed else commit


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(  # noqa: S603 - fixed commands, no shell
            ["git", "-C", str(folder), *arguments],  # noqa: S607 - the user's own git
            capture_output=True,
            text=True,
            timeout=GIT_SECONDS,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
