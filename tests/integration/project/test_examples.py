"""The programs of examples/, as their README says; load_policy.py is in test_first_hour.py."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).parents[3]


def printed(folder: Path, program: str, *arguments: str) -> str:
    """What an example prints; it must end well."""
    done = subprocess.run(
        [sys.executable, "-W", "error", str(ROOT / "examples" / program), *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "HOME": str(folder)},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_an_own_environment_is_learned(tmp_path: Path) -> None:
    rates = re.findall(r"success (\d+)%", printed(tmp_path, "own_environment.py"))
    assert int(rates[-1]) >= 80 > int(rates[0])


def test_own_networks_learn(tmp_path: Path) -> None:
    first, *_, last = json.loads(printed(tmp_path, "own_networks.py"))
    assert first < -900 < -600 < last


def test_a_restored_algorithm_continues(tmp_path: Path) -> None:
    *_, last, restored = printed(tmp_path, "rllib_program.py", "1000").splitlines()
    assert last.startswith(" 1,600 steps: return -")
    assert restored == "restored: 3,200 steps"


def test_tune_has_a_grid_over_q(tmp_path: Path) -> None:
    """With two trials instead of six, each of which starts a process."""
    text = (ROOT / "examples" / "tune_grid.py").read_text(encoding="utf-8")
    assert "[1.0, 1.5, 2.0]" in text
    fewer = text.replace("[1.0, 1.5, 2.0]", "[1.0, 2.0]").replace("[0, 1]", "[0]")
    (tmp_path / "tune_grid.py").write_text(fewer, encoding="utf-8")
    table = printed(tmp_path, str(tmp_path / "tune_grid.py"), "200").splitlines()[-2:]
    assert [float(row.split()[0]) for row in table] == [1.0, 2.0]


def test_frames_become_a_plot(tmp_path: Path) -> None:
    export = ROOT / "docs" / "results" / "data" / "v3-fetch-reach"
    assert printed(tmp_path, "frames_to_plot.py", str(export), "curves.svg") == "wrote curves.svg\n"
    assert "q = 1.5 (mean of" in (tmp_path / "curves.svg").read_text(encoding="utf-8")


def test_no_example_is_longer_than_a_screen() -> None:
    for program in (ROOT / "examples").glob("*.py"):
        assert len(program.read_text(encoding="utf-8").splitlines()) <= 40, program.name
