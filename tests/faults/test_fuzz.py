"""Randomly changed files: some seconds, a minute with `make test-faults`, or `make fuzz`."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tests.processes import fresh

ROOT = Path(__file__).parents[2]
SEED = os.environ.get("FUZZ_SEED", "0")


def test_randomly_changed_files_are_handled_safely(pytestconfig: pytest.Config) -> None:
    """See `tests/fuzz.py`, which prints the case, the seed and the place of the files."""
    seconds = 60 if "thorough" in pytestconfig.option.markexpr else 6
    done = fresh("-m", "tests.fuzz", "--seconds", seconds, "--seed", SEED, cwd=ROOT)
    found = json.loads(done.stdout.splitlines()[-1])
    # Some changed files of each kind are still valid, and some are not.
    for kind in ("sealed_policy", "packed_policy", "export", "sweep_file", "state"):
        outcomes = {name for name in found if name.startswith(f"{kind}:")}
        assert f"{kind}: read" in outcomes
        assert len(outcomes) > 1
