"""Compiled code is kept where it can be, and works where it can't."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.caching import FunctionCache

from music_rllib.compiling import compiled, kept_on_disk

PROGRAM = """
import numpy as np
from music_rllib.intrinsic.compiled import bounds
numbers = np.ones((1, 2, 1), np.float32)
weight = np.ones((4, 1), np.float32)
pairs = np.array([[1, 0]])
given = (numbers, numbers, pairs, np.array([2]), weight, weight[:, 0].copy(), weight)
found = bounds(*given, np.ones((1, 4), np.float32), np.zeros(1, np.float32))
print(float(found[0]), sum(bounds.stats.cache_hits.values()))
"""


def test_the_next_process_finds_what_was_compiled(tmp_path: Path) -> None:
    def bound_and_hits() -> str:
        return subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    assert [bound_and_hits() for _ in range(2)] == ["0.0 0\n", "0.0 1\n"]


def test_where_nothing_can_be_written_each_process_compiles(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def nowhere(*_: Any) -> None:
        raise RuntimeError("no locator available")

    monkeypatch.setattr(FunctionCache, "__init__", nowhere)
    assert kept_on_disk(lambda x: x + 1)(2) == 3
    assert "no locator available" in caplog.text


def test_a_full_disk_stops_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(FunctionCache, "_save_overload", full)
    assert kept_on_disk(lambda x: x + 1)(2) == 3
    assert "No space left on device" in caplog.text


@pytest.mark.parametrize("any_order", [False, True])
def test_nan_stays_nan(any_order: bool) -> None:
    def rectified_sum(values: Any) -> float:
        total = 0.0
        for i in range(len(values)):
            total += max(values[i], np.float32(0))
        return total

    function = compiled(rectified_sum, any_order=any_order)
    values = np.ones(100, np.float32)
    assert function(values) == 100
    values[17] = np.nan
    assert np.isnan(function(values))
