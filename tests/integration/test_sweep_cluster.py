"""The same program on a cluster: by `RAY_ADDRESS`, and as a submitted job."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

pytestmark = pytest.mark.integration

REPOSITORY = Path(__file__).parents[2]
ENVIRONMENTS = Path(__file__).parents[1] / "environments"
BIN = Path(sys.executable).parent


class Head(NamedTuple):
    """A running head node."""

    address: str
    dashboard: str
    home: Path
    environment: dict[str, str]


def free_ports(count: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [sock.getsockname()[1] for sock in sockets]
    for sock in sockets:
        sock.close()
    return ports


@pytest.fixture(scope="module")
def head() -> Iterator[Head]:
    """`ray start --head --num-cpus=2`, with a home folder of its own; ended by its process id."""
    port, dashboard, agent = free_ports(3)
    # Not pytest's folder: Ray's sockets need a short path.
    folder = Path(tempfile.mkdtemp(prefix="ray"))
    home = folder / "home"
    home.mkdir()
    environment = os.environ | {
        "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}",
        "HOME": str(home),
        "PYTHONPATH": str(ENVIRONMENTS),
        "RAY_AUTH_MODE": "disabled",
    }
    command = [str(BIN / "ray"), "start", "--head", "--block", "--num-cpus=2"]
    options = [
        "--disable-usage-stats",
        "--node-ip-address=127.0.0.1",
        f"--port={port}",
        f"--dashboard-port={dashboard}",
        # Takes the jobs; its default port may belong to another Ray on this machine.
        f"--dashboard-agent-listen-port={agent}",
        f"--temp-dir={folder / 'ray'}",
    ]
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [*command, *options],
            env=environment,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        wait_for_jobs(dashboard, process, folder / "log")
        yield Head(f"127.0.0.1:{port}", f"http://127.0.0.1:{dashboard}", home, environment)
    finally:
        process.terminate()  # `--block` ends its node's processes
        process.wait(timeout=60)
        shutil.rmtree(folder, ignore_errors=True)


def wait_for_jobs(port: int, process: subprocess.Popen[Any], log: Path) -> None:
    """Until the dashboard and the agent behind it take jobs."""
    from ray.job_submission import JobSubmissionClient

    for _ in range(120):
        try:
            JobSubmissionClient(f"http://127.0.0.1:{port}").submit_job(entrypoint="true")
        except Exception:
            assert process.poll() is None, log.read_text()
            time.sleep(1)
        else:
            return
    pytest.fail(log.read_text())


def small(document: dict[str, Any]) -> str:
    document["stages"] = document["stages"][:1]
    document["defaults"]["env_steps"] = 600
    del document["resources"]
    return yaml.safe_dump(document, sort_keys=False)


def test_ray_address(head: Head, sweep_document: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_text(small(sweep_document))
    path = os.pathsep.join((str(REPOSITORY), str(ENVIRONMENTS)))
    done = subprocess.run(
        [sys.executable, "-m", "music_rllib.sweep", "sweep.yaml"],
        cwd=tmp_path,
        env=head.environment | {"RAY_ADDRESS": head.address, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert "pretrain/Point/seed0: finished" in done.stdout
    assert len(list((tmp_path / "results" / "nodes").iterdir())) == 1


def test_more_cpus_than_any_node_has(
    head: Head, sweep_document: dict[str, Any], tmp_path: Path
) -> None:
    sweep_document["resources"] = {"cpus_per_run": 64}
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(sweep_document))
    path = os.pathsep.join((str(REPOSITORY), str(ENVIRONMENTS)))
    done = subprocess.run(
        [sys.executable, "-m", "music_rllib.sweep", "sweep.yaml"],
        cwd=tmp_path,
        env=head.environment | {"RAY_ADDRESS": head.address, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "resources.cpus_per_run must fit into one node of the cluster, whose largest" in (
        done.stderr
    )


def test_submitted_as_a_job(head: Head, sweep_document: dict[str, Any], tmp_path: Path) -> None:
    """From a folder with the package in it, as on a machine where it isn't installed."""
    working_dir = tmp_path / "checkout"
    shutil.copytree(
        REPOSITORY / "music_rllib",
        working_dir / "music_rllib",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    shutil.copy(ENVIRONMENTS / "point_env.py", working_dir)
    (working_dir / "sweep.yaml").write_text(small(sweep_document))
    command = ["job", "submit", "--address", head.dashboard, "--working-dir", str(working_dir)]
    program = ["python", "-m", "music_rllib.sweep", "sweep.yaml"]

    def submit(*options: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [BIN / "ray", *command, "--", *program, *options],
            env=head.environment,
            capture_output=True,
            text=True,
            timeout=280,
            check=False,
        )

    done = submit()
    assert done.returncode == 0, done.stdout + done.stderr
    assert "pretrain/Point/seed0: finished" in done.stdout
    storage = head.home / "results"
    assert f"using {storage}. Give an absolute path" in done.stdout
    assert len(list((storage / "nodes").iterdir())) == 1
    assert (storage / "mlflow.db").exists()

    again = submit("--dry-run")
    assert again.returncode == 0
    assert "1 finished earlier and reused" in again.stdout
