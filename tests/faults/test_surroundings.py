"""A user without rights and home folder, with another umask and language."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.faults import comparison, sweeps
from tests.integration.conftest import ENVIRONMENTS, REPOSITORY

pytestmark = pytest.mark.thorough

NOBODY = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups")
READS_ALL = ("--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search")
"""Right to read everything and write nothing, for code in a home folder."""


@pytest.fixture
def public() -> Iterator[Path]:
    """A folder that every user can access, unlike pytest's."""
    folder = Path(tempfile.mkdtemp(prefix="music-nobody-", dir="/tmp"))
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def turkish(public: Path) -> dict[str, str]:
    """Turkish, in which the lowercase letter of I is not i."""
    made = subprocess.run(
        ["localedef", "-i", "tr_TR", "-f", "UTF-8", str(public / "tr_TR.UTF-8")],
        capture_output=True,
        check=False,
    )
    if not (public / "tr_TR.UTF-8").is_dir():
        pytest.skip(f"no Turkish locale can be made (Debian: locales): {made.stderr!r}")
    subprocess.run(["chmod", "-R", "a+rX", str(public)], check=True)
    return {"LOCPATH": str(public), "LC_ALL": "tr_TR.UTF-8"}


def as_nobody(folder: Path, environment: dict[str, str], *command: str) -> tuple[int, str, str]:
    done = subprocess.run(
        [*NOBODY, *READS_ALL, "sh", "-c", 'umask 077; exec "$@"', "sh", *command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=sweeps.PATIENCE,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def test_another_user_without_home_in_another_language(
    public: Path, turkish: dict[str, str], unbroken: Path
) -> None:
    environment = os.environ | turkish
    environment |= {"PYTHONPATH": os.pathsep.join(map(str, (REPOSITORY, ENVIRONMENTS)))}
    for name in ("HOME", "USER", "LOGNAME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        environment.pop(name, None)
    if os.geteuid() != 0 or shutil.which(NOBODY[0]) is None:
        pytest.skip("only root can be another user, with util-linux' setpriv")
    look = "import locale, music_rllib, point_env; locale.setlocale(locale.LC_ALL, '')"
    code, _, errors = as_nobody(public, environment, sys.executable, "-c", look)
    if code:
        pytest.skip(f"another user can't read this tree: {errors}")
    home = public / "home"
    home.mkdir(mode=0o777)
    home.chmod(0o777)
    (home / "sweep.yaml").write_text(yaml.safe_dump(sweeps.document(), sort_keys=False))
    command = (sys.executable, "-m", "music_rllib.sweep")
    for arguments in (("sweep.yaml",), ("status", "results/points"), ("best", "results/points")):
        code, output, errors = as_nobody(home, environment, *command, *arguments)
        assert code == 0, output + errors
        # It prints the folder that replaces the home folder.
        assert all("atplotlib" in line for line in errors.splitlines()), errors
    comparison.same(unbroken, home / "results")
    assert sorted(path.name for path in home.iterdir()) == ["results", "sweep.yaml"]
    readable = [
        path for path in (home / "results").rglob("*") if path.stat().st_mode & stat.S_IRWXO
    ]
    assert not readable, "with umask 077 only the owner can read"
