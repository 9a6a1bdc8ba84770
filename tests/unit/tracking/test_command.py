"""Help and bad input of `tracking deliver`; integration tests cover the delivery."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from music_rllib.tracking.cli import app
from tests.kept_sweep import kept_sweep


def test_help_shows_an_example() -> None:
    command = [sys.executable, "-m", "music_rllib.tracking", "deliver", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "music-rllib tracking deliver results/smoke" in done.stdout


def refused(folder: Path) -> str:
    done = CliRunner().invoke(app, ["deliver", str(folder)])
    assert done.exit_code == 2
    return done.output


def test_a_folder_that_is_no_sweep_is_refused(tmp_path: Path) -> None:
    assert "SWEEP must be a sweep that was started" in refused(tmp_path)


def test_a_sweep_that_was_never_tracked_is_refused(tmp_path: Path) -> None:
    folder = kept_sweep(tmp_path)
    (folder / "tracking" / "sweep.json").unlink()
    assert "SWEEP must be a sweep that was tracked" in refused(folder)


@pytest.mark.parametrize("record", ["{", "[]", "3", '{"sweep_name": "s"}'])
def test_a_damaged_record_is_named(tmp_path: Path, record: str) -> None:
    folder = kept_sweep(tmp_path)
    (folder / "tracking" / "sweep.json").write_text(record)
    assert "sweep.json must hold a sweep's record" in refused(folder)


def test_a_server_that_does_not_answer_is_named(tmp_path: Path) -> None:
    folder = kept_sweep(tmp_path, "http://127.0.0.1:9")
    assert "must name an MLflow server that answers, got http://127.0.0.1:9" in refused(folder)
