"""Fault injection: `make test-faults` runs all tests, a plain `pytest` the fast ones."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults import sweeps
from tests.integration.conftest import Program, mlflow_runs, sweep_document, sweep_program

__all__ = ["mlflow_runs", "sweep_document", "sweep_program"]


@pytest.fixture(scope="session")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The storage of `sweeps.document()`, run without interruption."""
    program = sweeps.program(tmp_path_factory.mktemp("unbroken"))
    program.write(sweeps.document())
    sweeps.finish(program)
    return program.folder / "results"


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Program]:
    """The program in its own folder, with `sweeps.document()` to run."""
    own = sweeps.program(tmp_path)
    own.write(sweeps.document())
    yield own
    own.end_all()
