"""The programs of examples/, run as in their README; load_policy.py is in test_first_hour.py."""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).parents[3]


@pytest.fixture
def printed(
    local_ray: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Callable[..., str]:
    """Output of an example that must succeed, run without its own process and Ray."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))

    def run(program: str | Path, *arguments: str) -> str:
        path = str(ROOT / "examples" / program)
        monkeypatch.setattr(sys, "argv", [path, *arguments])
        runpy.run_path(path, run_name="__main__")
        return capsys.readouterr().out

    return run


def test_an_own_environment_is_learned(printed: Callable[..., str]) -> None:
    rates = re.findall(r"success (\d+)%", printed("own_environment.py"))
    assert int(rates[-1]) >= 60 > int(rates[0])


def test_own_networks_learn(printed: Callable[..., str]) -> None:
    first, *_, last = json.loads(printed("own_networks.py"))
    assert first < -900 < -600 < last


def test_a_restored_algorithm_continues(printed: Callable[..., str]) -> None:
    *_, last, restored = printed("rllib_program.py", "1000").splitlines()
    assert last.startswith(" 1,600 steps: return -")
    assert restored == "restored: 3,200 steps"


def test_tune_has_a_grid_over_q(printed: Callable[..., str], tmp_path: Path) -> None:
    """Only one trial instead of six, because each starts a process."""
    text = (ROOT / "examples" / "tune_grid.py").read_text(encoding="utf-8")
    assert "[1.0, 1.5, 2.0]" in text
    fewer = text.replace("[1.0, 1.5, 2.0]", "[2.0]").replace("[0, 1]", "[0]")
    (tmp_path / "tune_grid.py").write_text(fewer, encoding="utf-8")
    table = printed(tmp_path / "tune_grid.py", "200")
    assert re.findall(r"^(\d\.\d) +-\d+", table, re.MULTILINE) == ["2.0"]


def test_frames_become_a_plot(tmp_path: Path) -> None:
    export = ROOT / "docs" / "results" / "data" / "v3-fetch-reach"
    program = str(ROOT / "examples" / "frames_to_plot.py")
    said = subprocess.check_output(
        [sys.executable, "-W", "error", program, str(export), "curves.svg"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "HOME": str(tmp_path)},
    )
    assert said == b"wrote curves.svg\n"
    assert "q = 1.5 (mean of" in (tmp_path / "curves.svg").read_text(encoding="utf-8")


def test_no_example_is_longer_than_a_screen() -> None:
    for program in (ROOT / "examples").glob("*.py"):
        assert len(program.read_text(encoding="utf-8").splitlines()) <= 40, program.name
