"""`python -m benchmarks` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.measure import ratio_row
from tests.processes import fresh

ROOT = Path(__file__).parents[3]
BENCH = ("-m", "benchmarks")


def test_a_group_is_measured_printed_and_written(tmp_path: Path) -> None:
    finished = fresh(*BENCH, "--repeats", 1, "--output", tmp_path / "bench", "replay", cwd=ROOT)
    document = json.loads((tmp_path / "bench" / "bench.json").read_text())
    values = {row["what"]: row for row in document["rows"]}
    hindsight = values["HER, 20,000 trajectories: a minibatch"]
    assert hindsight["target"] == "<= 0.25"
    # Their times are compared by benchmarks on an idle machine, not here.
    assert hindsight["value"] > 0
    assert values["uniform, 20,000 trajectories"]["value"] > 0
    assert "load_average_before" in document["machine"]
    table = (tmp_path / "bench" / "bench.md").read_text()
    assert all(f"| {what} |" in table for what in values)
    assert f"written to {tmp_path / 'bench' / 'bench.md'}" in finished.stdout


def test_bad_input_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for arguments, told in (
        (["nothing"], "GROUP must be one of step, environment"),
        (["--repeats", "0", "replay"], "--repeats must be >= 1, got 0"),
        (["--output", str(tmp_path / "file"), "replay"], "--output can't be a folder"),
    ):
        finished = fresh(*BENCH, *arguments, code=2, cwd=ROOT)
        assert told in finished.stderr
        assert "measuring" not in finished.stderr


@pytest.mark.parametrize(
    ("limits", "target", "met"),
    [
        ({"at_most": 1.1}, "<= 1.1", True),
        ({"at_most": 1.0}, "<= 1", False),
        ({"at_least": 1.0}, ">= 1", True),
        ({"at_least": 1.1}, ">= 1.1", False),
        ({"at_most": 1.1, "cpu_ratios": [1.2]}, "<= 1.1", False),
        ({"at_least": 1.0, "cpu_ratios": [1.2]}, ">= 1", True),
        ({}, "", None),
    ],
)
def test_a_target_is_for_the_median(limits: dict[str, Any], target: str, met: bool) -> None:
    row = ratio_row("group", "what", 1.0, "s", against="that", ratios=[1.05, 9.0, 0.1], **limits)
    assert (row.ratio, row.low, row.high) == (1.05, 0.1, 9.0)
    assert (row.target, row.met) == (target, met)
