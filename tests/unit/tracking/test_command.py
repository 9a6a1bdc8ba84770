"""The re-delivery command explains itself and refuses bad input (delivery: integration tests)."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from music_rllib.tracking.cli import app


def test_help_shows_an_example() -> None:
    command = [sys.executable, "-m", "music_rllib.tracking", "deliver", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "music-rllib tracking deliver results/smoke" in done.stdout


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (None, "must be the folder of a tracked sweep"),
        ("{", "sweep.json must hold a sweep's record"),
        (
            '{"sweep_name": "s", "sweep_id": "i", "storage": "..", '
            '"tracking_uri": "http://127.0.0.1:9"}',
            "must name an MLflow server that answers, got http://127.0.0.1:9",
        ),
    ],
)
def test_bad_input_is_refused(tmp_path: Path, record: str | None, reason: str) -> None:
    if record is not None:
        (tmp_path / "tracking").mkdir()
        (tmp_path / "tracking" / "sweep.json").write_text(record)
    done = CliRunner().invoke(app, ["deliver", str(tmp_path)])
    assert done.exit_code == 2
    assert reason in done.output
