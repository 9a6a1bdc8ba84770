"""Ray dies: the driver prints a message, keeps everything and ends within a minute."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import psutil
import pytest

from tests.faults import comparison, sweeps
from tests.faults.test_dead_nodes import two_nodes
from tests.integration.conftest import Program

__all__ = ["two_nodes"]

pytestmark = pytest.mark.thorough


def daemon(of: int, name: str) -> int:
    (found,) = [child for child in psutil.Process(of).children() if child.name() == name]
    return int(found.pid)


def check_end(program: Program, output: str) -> None:
    assert "Finished runs and the last checkpoints are kept; continue with: python -m" in output
    state = json.loads((program.folder / "results" / "points" / "state.json").read_text())
    assert state["driver"]["outcome"] == "failed"


@pytest.mark.parametrize("name", ["raylet", "gcs_server"])
def test_the_driver_exits_when_a_local_ray_dies(
    name: str, program: Program, unbroken: Path
) -> None:
    process = sweeps.start_until(program, "pretrain/seed0: started")
    pid = daemon(process.pid, name)
    os.kill(pid, signal.SIGKILL)
    output = sweeps.ended(process, 1)
    assert f"the local Ray has died: its {name} (process {pid}) is gone" in output
    check_end(program, output)
    sweeps.finish(program)
    comparison.same(unbroken, program.folder / "results")


def test_the_driver_exits_when_the_head_of_a_cluster_dies(
    two_nodes: tuple[str, int], program: Program, unbroken: Path
) -> None:
    address, raylet = two_nodes
    # Instead of a minute; the driver waits two thirds of it for the head to return.
    program.environment |= {
        "RAY_ADDRESS": address,
        "RAY_gcs_rpc_server_reconnect_timeout_s": "20",
    }
    process = sweeps.start_until(program, "pretrain/seed0: started")
    head = psutil.Process(raylet).parent()
    assert head is not None
    os.kill(daemon(head.pid, "gcs_server"), signal.SIGKILL)
    output = sweeps.ended(process, 1)
    assert f"the Ray cluster at {address} has died or can't be reached: {address} has" in output
    check_end(program, output)
    del program.environment["RAY_ADDRESS"]
    sweeps.finish(program)
    comparison.same(unbroken, program.folder / "results")
