"""A cluster whose machines share only the installed package: five faults change no number.

A head without CPUs, two workers, a laptop that submits the jobs, and a machine with S3. They are
namespaces of this machine, so the test needs root.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from music_rllib import names
from tests.faults import comparison, sweeps
from tests.faults.hosts import Host, Network
from tests.integration.conftest import ENVIRONMENTS, POINT

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(1800)]

TOKEN = "0123456789abcdef" * 3
S3 = "http://10.77.0.5:5000"
ENVIRONMENT = {
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": TOKEN,
    "AWS_ACCESS_KEY_ID": "testing",
    "AWS_SECRET_ACCESS_KEY": "testing",
    "OMP_NUM_THREADS": "1",
    "NO_COLOR": "1",
    "PYTHONUNBUFFERED": "1",
    "RAY_worker_niceness": "0",  # by default 15: it would starve beside other programs
    names.VARIABLE_REPORT: "off",
    "MUSIC_RLLIB_PROGRESS": "all",
}
CUT_SECONDS, FAILING_SECONDS = 75.0, 60.0
SERVE_S3 = """
from pathlib import Path
from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import run_simple

moto = DomainDispatcherApplication(create_backend_app)

def serve(environ, start_response):
    if Path("/tmp/fails").exists():
        start_response("500 Internal Server Error", [])
        return [b""]
    return moto(environ, start_response)

run_simple("0.0.0.0", 5000, serve, threaded=True)
"""
CREATE = """
import boto3, sys
boto3.client("s3", endpoint_url=sys.argv[1], region_name="us-east-1").create_bucket(Bucket="lab")
"""
COPY = """
import sys
from pyarrow import fs
fs.copy_files(*sys.argv[1:])
"""
NODES = """
import json, sys, urllib.request
headers = {"Authorization": f"Bearer {sys.argv[2]}"}
request = urllib.request.Request(f"{sys.argv[1]}/nodes?view=summary", headers=headers)
nodes = json.load(urllib.request.urlopen(request, timeout=10))["data"]["summary"]
print(sum(node["raylet"].get("state") == "ALIVE" for node in nodes))
"""
RAY = "ray start --block --disable-usage-stats --object-store-memory=100000000 --temp-dir=/tmp/r"
ALWAYS = "while :; do {}; sleep 1; done"
"""Restart a node as `cluster/ray-node.service` does."""


class Cluster:
    """The machines, and what a user does on them."""

    def __init__(self, network: Network) -> None:
        self.network = network
        machines = ("head", "worker-1", "worker-2", "laptop", "storage")
        self.head, *self.workers, self.laptop, self.storage = (
            Host(network, name, ENVIRONMENT) for name in machines
        )
        self.dashboard = f"http://{self.head.address}:8265"

    def start(self) -> None:
        """Start S3 and Ray, and make the user's folder."""
        self.network.start()
        self.storage.start(f"exec python -c '{SERVE_S3}'")
        self.start_head()
        for worker in self.workers:
            address = f"--num-cpus=1 --node-ip-address={worker.address}"
            worker.start(ALWAYS.format(f"{RAY} --address={self.head.address}:6379 {address}"))
        lab = self.laptop.path("/tmp/lab")
        lab.mkdir()
        shutil.copy(ENVIRONMENTS / "point_env.py", lab)
        document = sweeps.document(seeds=[0, 1])
        document["defaults"]["env_steps"] = 1200
        document["stages"] = document["stages"][:1]
        slow = {"fast": "/tmp/fast", "seconds": 0.04}
        document["environments"]["Point"] = POINT | {
            "env_id": "point_env:Paced-v0",
            "env_kwargs": slow,
        }
        (lab / "sweep.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
        eventually(lambda: self.storage.call(f"python -c '{CREATE}' {S3}"))

    def start_head(self) -> None:
        own = f"--head --port=6379 --num-cpus=0 --node-ip-address={self.head.address}"
        self.head.start(ALWAYS.format(f"{RAY} {own} --dashboard-host=0.0.0.0"))

    def hurry(self, on: bool) -> None:
        """Let environments step as fast as they can, or slowly."""
        for worker in self.workers:
            _switch(worker, "fast", on)

    def fail_s3(self, on: bool) -> None:
        """Let S3 answer 500 to every request."""
        _switch(self.storage, "fails", on)

    def submit(self, case: str, attempt: str = "") -> subprocess.Popen[str]:
        """Submit the sweep from the laptop, with its own storage and MLflow."""
        eventually(self._check_nodes)
        return self.laptop.start(
            f"exec ray job submit --address {self.dashboard} --working-dir /tmp/lab "
            f"--submission-id {case}{attempt} -- python -m music_rllib.sweep sweep.yaml "
            f"--storage {self.uri(case)!r} mlflow.tracking_uri=sqlite:////tmp/{case}.db",
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def uri(self, case: str) -> str:
        """Storage of a case."""
        return f"s3://lab/{case}?endpoint_override={S3}&scheme=http&region=us-east-1"

    def _check_nodes(self) -> None:
        nodes = self.laptop.call(f"python -c '{NODES}' {self.dashboard} {TOKEN}").strip()
        if nodes != str(1 + len(self.workers)):
            raise OSError(f"{nodes} nodes")

    def results(self, case: str, folder: Path) -> Path:
        """A copy of a case's storage, and of its MLflow."""
        self.storage.call(f"python -c '{COPY}' {self.uri(case)!r} /tmp/{case}")
        results = folder / case
        shutil.copytree(self.storage.path(f"/tmp/{case}"), results)
        shutil.copy(self.head.path(f"/tmp/{case}.db"), results / "mlflow.db")
        (results / "work").mkdir(exist_ok=True)  # a bucket has no empty folders
        return results


def _switch(host: Host, name: str, on: bool) -> None:
    file = host.path(f"/tmp/{name}")
    file.touch() if on else file.unlink(missing_ok=True)


def eventually(act: Callable[[], object], seconds: float = 600.0) -> None:
    """Call `act` until it raises no OSError."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            act()
            return
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(1.0)


@dataclass
class Case:
    """A sweep into which a test injects a fault, while both workers train."""

    cluster: Cluster
    name: str
    folder: Path
    job: subprocess.Popen[str]

    def read_until(self, *signs: str) -> None:
        """Read the job's output until each of `signs` has appeared."""
        assert self.job.stdout is not None
        missing, seen = set(signs), []
        for line in self.job.stdout:
            seen.append(line)
            missing -= {sign for sign in missing if sign in line}
            if not missing:
                return
        pytest.fail("".join(seen))

    def end(self) -> str:
        """Wait for the end of the job; returns the rest of its output."""
        return self.job.communicate(timeout=sweeps.PATIENCE)[0]

    def finish(self, expected: Path | None = None) -> str:
        """Wait for the successful end, with bit-identical results; returns the output."""
        self.cluster.hurry(True)
        output = self.end()
        assert self.job.returncode == 0, output
        results = self.cluster.results(self.name, self.folder)
        comparison.same(expected or results, results)
        return output


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    if os.geteuid() != 0:
        pytest.skip("machines made of namespaces need root")
    network = Network()
    try:
        try:
            own = Cluster(network)
        except (OSError, subprocess.SubprocessError) as error:
            pytest.skip(f"no machines can be made of namespaces here: {error}")
        own.start()
        yield own
    finally:
        network.close()


@pytest.fixture(scope="module")
def expected(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results without a fault."""
    folder = tmp_path_factory.mktemp("cluster")
    Case(cluster, "unbroken", folder, cluster.submit("unbroken")).finish()
    return folder / "unbroken"


@pytest.fixture
def case(
    cluster: Cluster, expected: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[Case]:
    """A sweep whose results must equal `expected`; the test's faults are repaired at its end."""
    cluster.hurry(False)
    name = request.node.name.replace("_", "-")
    own = Case(cluster, name, tmp_path, cluster.submit(name))
    own.read_until("seed0: 400", "seed1: 400")
    yield own
    cluster.network.cut.clear()
    cluster.network.slow.clear()
    cluster.fail_s3(False)


def test_a_raylet_is_killed(case: Case, expected: Path) -> None:
    case.cluster.workers[0].kill("raylet")
    assert "Another worker resumes from the last checkpoint" in case.finish(expected)


def test_a_worker_loses_its_network(case: Case, expected: Path) -> None:
    case.cluster.network.cut.add(case.cluster.workers[0])
    time.sleep(CUT_SECONDS)
    case.cluster.network.cut.clear()
    case.finish(expected)


def test_a_worker_has_a_slow_network(case: Case, expected: Path) -> None:
    case.cluster.network.slow.add(case.cluster.workers[0])
    case.finish(expected)


def test_s3_answers_500(case: Case, expected: Path) -> None:
    case.cluster.fail_s3(True)
    time.sleep(FAILING_SECONDS)
    case.cluster.fail_s3(False)
    output = case.finish(expected)
    assert "the storage does not answer, trying again for 15 min" in output
    assert "the storage answers again" in output


def test_the_head_is_restarted(case: Case, expected: Path) -> None:
    """The job ends with the head, and is submitted again."""
    case.cluster.head.kill()
    case.end()
    assert case.job.returncode != 0
    case.cluster.start_head()
    case.job = case.cluster.submit(case.name, "-again")
    case.finish(expected)
