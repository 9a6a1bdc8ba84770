"""Compiled code is cached if possible, and works without a cache."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.caching import FunctionCache

from music_rllib.kernels.compiling import compiled, is_kept, kept_on_disk
from tests.processes import fresh

PROGRAM = """
from music_rllib.kernels.compiling import is_kept, kept_on_disk

@kept_on_disk
def twice(x):
    return 2 * x

before = is_kept(twice)
print(twice(21), sum(twice.stats.cache_hits.values()), before, is_kept(twice))
"""


def test_machine_code_is_cached_until_the_source_changes(tmp_path: Path) -> None:
    program = tmp_path / "program.py"

    def result_and_hits() -> str:
        return fresh(program).stdout

    program.write_text(PROGRAM)
    assert [result_and_hits() for _ in range(2)] == ["42 0 False True\n", "42 1 True True\n"]
    program.write_text(PROGRAM.replace("2 * x", "22 * x"))
    assert result_and_hits().startswith("462 0 ")


def test_processes_that_begin_together_compile_once(tmp_path: Path) -> None:
    program, go = tmp_path / "program.py", tmp_path / "go"
    wait = f"""
import pathlib, time
print("ready", flush=True)
while not pathlib.Path({str(go)!r}).exists():
    time.sleep(0.001)
"""
    program.write_text(PROGRAM.replace("\nbefore", f"{wait}\nbefore"))
    command = [sys.executable, str(program)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    go.touch()
    hits = [process.communicate()[0].split()[1] for process in processes]
    assert sorted(hits) == ["0", "1", "1"]


def test_without_a_writable_cache_each_process_compiles(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def nowhere(*_: Any) -> None:
        raise RuntimeError("no locator available")

    monkeypatch.setattr(FunctionCache, "__init__", nowhere)
    function = kept_on_disk(lambda x: x + 1)
    assert function(2) == 3
    assert not is_kept(function)
    assert "no locator available" in caplog.text


def test_a_full_disk_only_prints_a_warning(
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
