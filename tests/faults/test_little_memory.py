"""Workers that are ended for lack of memory."""

from __future__ import annotations

from pathlib import Path

import pytest

from music_rllib.sweep.tune_events import RESTARTS
from tests.faults import comparison, sweeps
from tests.integration.conftest import Program


@pytest.mark.thorough
def test_ray_ends_workers_where_memory_is_low(program: Program, unbroken: Path) -> None:
    """A machine whose memory is all but used up: the limit is named, and nothing is lost."""
    plenty = dict(program.environment)
    program.environment |= {
        "RAY_memory_usage_threshold": "0.001",
        "RAY_memory_monitor_refresh_ms": "100",
    }
    code, output, errors = program.run(timeout=600)
    assert code == 1, output + errors
    assert f"({RESTARTS} of {RESTARTS} times)" in output
    assert "memory" in output
    assert "threshold" in output
    program.environment = plenty
    sweeps.finish(program)
    comparison.same(unbroken, program.folder / "results")
