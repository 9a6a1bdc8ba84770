"""Hostile files are refused quickly, with little memory, and with a message."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.hostile_files import CORPUS, MEGABYTES, SECONDS
from tests.processes import fresh

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """The result of the programs for each file of the corpus."""
    folder = tmp_path_factory.mktemp("corpus")
    done = fresh("-m", "tests.hostile_files", folder, cwd=ROOT)
    results = [json.loads(line) for line in done.stdout.splitlines()]
    return {result["name"]: result for result in results}


@pytest.mark.parametrize("name", CORPUS)
def test_a_hostile_file_is_refused(found: dict[str, dict[str, Any]], name: str) -> None:
    """Exit code 2 and a message, within 5 s of processor time and 300 MB."""
    result = found[name]
    assert CORPUS[name].said in result["said"]
    assert "Traceback" not in result["said"]
    assert result["code"] == 2
    assert result["seconds"] < SECONDS
    assert result["megabytes"] < MEGABYTES
    assert not result["written"]
