"""An SQLite file that another program locks for longer than the timeouts."""

from __future__ import annotations

import contextlib
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from music_rllib.search import searches
from tests.faults import comparison, sweeps
from tests.integration.conftest import Program, read_until
from tests.played_search import Driver, document, searched


@contextlib.contextmanager
def locked(file: Path) -> Iterator[None]:
    """Hold the write lock for this `with`."""
    assert file.is_file()
    connection = sqlite3.connect(file, isolation_level=None, timeout=30)
    connection.execute("BEGIN IMMEDIATE")
    yield
    connection.execute("ROLLBACK")
    connection.close()


def test_a_locked_study_prints_a_warning_and_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = searches._engine_options

    def impatient(url: Any) -> dict[str, Any]:
        return options(url) | {"connect_args": {"timeout": 0.1}}

    monkeypatch.setattr(searches, "_engine_options", impatient)
    for folder in ("whole", "locked"):
        (tmp_path / folder).mkdir()
    whole = searched(tmp_path / "whole")
    driver = Driver(tmp_path / "locked", document({}))
    said: list[str] = []
    driver.controller._say = said.append
    driver.play(stop_after=3)
    (file,) = driver.sweep.folder.glob("*.db")
    with locked(file), pytest.raises(AssertionError, match="wait for ever"):
        driver.play()
    assert sum("does not answer, trying again: " in line for line in said) == 1
    assert any("database is locked" in line for line in said)
    driver.play()
    assert driver.trials() == whole.trials()


@pytest.mark.thorough
def test_a_locked_mlflow_delays_no_run_and_has_each_step_once(
    program: Program, unbroken: Path
) -> None:
    results = program.folder / "results"
    process = sweeps.start_until(program, "pretrain/seed0: started")
    with locked(results / "mlflow.db"):
        read_until(process, "pretrain/seed0: finished")
        time.sleep(10.0)
    output = sweeps.ended(process)
    assert "did not reach MLflow" not in output
    comparison.same(unbroken, results)
