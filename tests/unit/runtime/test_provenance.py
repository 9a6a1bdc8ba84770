"""The recorded commit is the commit of this package."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from music_rllib import names
from music_rllib.runtime.machine import git_commit, provenance_tags


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    git(tmp_path, "init", "-q")
    (tmp_path / "module.py").write_text("a = 1\n")
    git(tmp_path, "add", "module.py")
    git(tmp_path, "commit", "-q", "-m", "first")
    return tmp_path


def test_the_commit_of_a_checkout_is_marked_if_files_changed(checkout: Path) -> None:
    commit = git(checkout, "rev-parse", "HEAD")
    assert git_commit(checkout / "module.py") == commit
    (checkout / "module.py").write_text("a = 2\n")
    assert git_commit(checkout / "module.py") == commit + "-dirty"


def test_a_package_installed_inside_another_checkout_has_no_commit(checkout: Path) -> None:
    installed = checkout / ".venv" / "module.py"
    installed.parent.mkdir()
    installed.write_text("a = 1\n")
    assert git_commit(installed) is None


def test_without_git_there_is_no_commit(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert git_commit(checkout / "module.py") is None


def test_the_versions_of_packages_are_recorded() -> None:
    tags = provenance_tags()
    for package in ("python", "ray", "torch", "mujoco", "mlflow"):
        assert tags[names.TAG_VERSION_PREFIX + package]
