"""A newcomer's first hour, in a folder that is not the repository's.

README's sweep with a budget of seconds, and what follows. tests/unit/test_snippets.py looks at all
commands and snippets that are not run here.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml

from music_rllib import load_sweep
from music_rllib.program import main as sweep
from tests.integration.conftest import call

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).parents[3]
SECONDS = {
    "env_steps": 300,
    "num_envs": 2,
    "evaluation": {"interval": 150, "episodes": 2},
    "tac": {"random_steps": 200, "replay_ratio": 0.1},
}


def snippet(page: str, language: str, position: int = 0) -> str:
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return str(blocks[position])


def said(main: Callable[[Sequence[str]], int], folder: Path, *arguments: str) -> str:
    """What a command prints there; it must end well."""
    code, output, errors = call(main, folder, *arguments)
    assert code == 0, output + errors
    return output


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The newcomer's folder, and what the sweep printed."""
    folder = tmp_path_factory.mktemp("newcomer")
    document: dict[str, Any] = yaml.safe_load(snippet("README.md", "yaml"))
    document |= {"seeds": [0], "defaults": SECONDS}
    (folder / "my_sweep.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    done = subprocess.run(
        [sys.executable, "-m", "music_rllib.sweep", "my_sweep.yaml"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MUSIC_RLLIB_REPORT": "on"},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder, done.stdout


def test_the_sweep_ends_with_its_picture(output: tuple[Path, str]) -> None:
    folder, text = output
    label, _, path = text.splitlines()[-1].partition(": ")
    assert label == "Picture"
    assert Path(path) == folder / "results" / "my_sweep" / "report" / "figures" / "overview.png"
    assert Path(path).read_bytes().startswith(b"\x89PNG")
    assert (folder / "results" / "my_sweep" / "report" / "report.html").is_file()


def test_results_in_hand(output: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """docs/reports.md as it stands, and the same out of the export."""
    folder, _ = output
    monkeypatch.chdir(folder)
    known: dict[str, Any] = {}
    exec(snippet("docs/reports.md", "python"), known)
    success = known["success"]
    assert sorted(set(success["q"])) == [1.0, 1.5, 2.0]
    assert success["env_steps"].max() == 300
    export = ["report", "results/my_sweep", "--export", "published/my_sweep", "--format", "csv"]
    said(sweep, folder, *export)
    first, second = load_sweep("results/my_sweep"), load_sweep("published/my_sweep")
    pd.testing.assert_frame_equal(
        first.conditions.sort_values("q"), second.conditions.sort_values("q")
    )


@pytest.mark.parametrize(
    "arguments",
    ["status results/my_sweep", "compare results/my_sweep", "plan my_sweep.yaml", "plan"],
)
def test_commands_beside_it(output: tuple[Path, str], arguments: str) -> None:
    assert said(sweep, output[0], *arguments.split())


def test_the_best_policy_is_played(output: tuple[Path, str]) -> None:
    folder, _ = output
    said(sweep, folder, "best", "results/my_sweep")
    played = ["evaluate", "results/my_sweep/best", "--episodes", "2"]
    assert "2 episodes" in said(sweep, folder, *played)
    example = [sys.executable, str(ROOT / "examples" / "load_policy.py"), "results/my_sweep/best"]
    done = subprocess.run(example, cwd=folder, capture_output=True, text=True, check=True)
    assert re.fullmatch(r"return -\d+, success [01]\n", done.stdout)
