"""A sweep is suspended, like a sleeping laptop, while another one takes over."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.faults import comparison, sweeps
from tests.integration.conftest import Program, read_until
from tests.processes import wait_until

pytestmark = pytest.mark.thorough


@pytest.fixture
def other(tmp_path: Path) -> Iterator[sweeps.OwnProgram]:
    """Another sweep in the storage of `program`, with its own MLflow."""
    folder = tmp_path / "other"
    folder.mkdir()
    own = sweeps.program(folder)
    own.write(
        sweeps.document(
            storage=str(tmp_path / "results"),
            mlflow={"tracking_uri": f"sqlite:///{folder}/mlflow.db"},
        )
    )
    yield own
    own.end_all()


def signal_all(process: subprocess.Popen[str], number: signal.Signals) -> None:
    """The driver and its child processes."""
    for each in (driver := psutil.Process(process.pid), *driver.children(recursive=True)):
        os.kill(each.pid, number)


def let_expire(*leases: Path) -> None:
    """Let the lease expire."""
    for lease in leases:
        content = json.loads(lease.read_text())
        lease.write_text(json.dumps(content | {"expires": time.time() - 1}))


def test_a_suspended_sweep_leaves_its_run_to_the_new_owner(
    program: Program, other: sweeps.OwnProgram, unbroken: Path, tmp_path: Path
) -> None:
    process = sweeps.start_until(program, "pretrain/seed0: started")
    (lease,) = wait_for_lease(tmp_path / "results")
    signal_all(process, signal.SIGSTOP)
    let_expire(lease)
    second = other.start("--name", "second")
    read_until(second, "pretrain/seed0: ")
    signal_all(process, signal.SIGCONT)
    output = sweeps.ended(process)
    assert "pretrain/seed0: another process took over while this one was suspended" in output
    sweeps.ended(second)
    comparison.same(unbroken, tmp_path / "results")
    theirs = comparison.logged(f"sqlite:///{other.folder}/mlflow.db", "second")
    assert theirs == comparison.logged(f"sqlite:///{unbroken}/mlflow.db")


def wait_for_lease(storage: Path) -> list[Path]:
    """The lease of the run, which its worker acquires in the first step."""
    return wait_until(lambda: [*(storage / "work").glob("*/lease.json")], sweeps.FIRST_SIGN)
