"""A node of a cluster dies with the runs on it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.faults import comparison, sweeps
from tests.integration.conftest import ENVIRONMENTS, REPOSITORY, Program

pytestmark = pytest.mark.thorough

CLUSTER = """
import sys
from ray.cluster_utils import Cluster
cluster = Cluster(
    initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
)
second = cluster.add_node(num_cpus=1)
cluster.wait_for_nodes()
print(cluster.address, second.all_processes["raylet"][0].process.pid, flush=True)
sys.stdin.read()
cluster.shutdown()
"""


@pytest.fixture
def two_nodes() -> Iterator[tuple[str, int]]:
    """Address of a Ray cluster with one CPU on each of two nodes, and the second one's raylet."""
    paths = os.pathsep.join(map(str, (REPOSITORY, ENVIRONMENTS)))
    process = subprocess.Popen(
        [sys.executable, "-c", CLUSTER],
        env=os.environ | {"PYTHONPATH": paths},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    try:
        line: Any = next(line for line in process.stdout if ":" in line).split()
        yield line[0], int(line[1])
    finally:
        process.communicate("", timeout=sweeps.PATIENCE)


def test_the_raylet_of_a_second_node_is_killed(
    two_nodes: tuple[str, int], program: Program, unbroken: Path
) -> None:
    address, raylet = two_nodes
    program.environment["RAY_ADDRESS"] = address
    process = sweeps.start_until(program, "finetune/q=2/seed0: started")
    os.kill(raylet, signal.SIGKILL)
    sweeps.ended(process)
    comparison.same(unbroken, program.folder / "results")
