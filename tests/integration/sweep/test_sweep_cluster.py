"""The same program on a cluster: with `RAY_ADDRESS`, and as a submitted job."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest
import ray
import requests
import yaml

from music_rllib.runtime.quiet import LOCAL_RAY_BEYOND_LOOPBACK
from tests.integration.conftest import ENVIRONMENTS, REPOSITORY, rows
from tests.ports import free_port

pytestmark = pytest.mark.integration

BIN = Path(sys.executable).parent


TOKEN = "planted-" + "0123456789abcdef" * 3
STOP = {"RAY_JOB_STOP_SIGNAL": "SIGINT", "RAY_JOB_STOP_WAIT_TIME_S": "60"}
"""The guide's settings for the runtime environment of jobs."""


class Head(NamedTuple):
    """A running head node, alone or with a second node."""

    address: str
    dashboard: str
    folder: Path
    environment: dict[str, str]
    process: subprocess.Popen[Any]

    @property
    def home(self) -> Path:
        """Home folder of the cluster's user."""
        return Path(self.environment["HOME"])


def ray_start(
    folder: Path, environment: dict[str, str], cpus: int, *options: str
) -> subprocess.Popen[Any]:
    """A node; it ends with its process, which uses `--block`."""
    command = [str(BIN / "ray"), "start", "--block", f"--num-cpus={cpus}"]
    common = [
        "--disable-usage-stats",
        "--node-ip-address=127.0.0.1",
        # Accepts jobs; its default port may belong to another Ray on this machine.
        f"--dashboard-agent-listen-port={free_port()}",
    ]
    with (folder / "log").open("a") as log:
        return subprocess.Popen(
            [*command, *common, *options],
            env=environment,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )


def without_loopback_only() -> dict[str, str]:
    """The environment without the variables that a sweep in this process set for its local Ray."""
    return {k: v for k, v in os.environ.items() if k != LOCAL_RAY_BEYOND_LOOPBACK}


@contextlib.contextmanager
def head_node(home: Path, cpus: int, workers: Sequence[int] = ()) -> Iterator[Head]:
    """A head that requires a token, and further nodes, all with this home folder."""
    port, dashboard = free_port(), free_port()
    # Not pytest's folder: Ray's sockets need a short path.
    folder = Path(tempfile.mkdtemp(prefix="ray"))
    environment = without_loopback_only() | {
        "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}",
        "HOME": str(home),
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": TOKEN,
        "MLFLOW_TRACKING_PASSWORD": "planted-mlflow-password",
    }
    address, temporary = f"127.0.0.1:{port}", f"--temp-dir={folder / 'ray'}"
    options = ["--head", f"--port={port}", f"--dashboard-port={dashboard}", temporary]
    nodes = [ray_start(folder, environment, cpus, *options)]
    url = f"http://127.0.0.1:{dashboard}"
    head = Head(address, url, folder, environment, nodes[0])
    try:
        wait_for_jobs(head)
        for number, more in enumerate(workers):
            # With one folder for both, a node would delete a job's files while another one uses
            # them.
            options = [f"--address={address}", f"--temp-dir={folder / f'ray{number}'}"]
            nodes.append(ray_start(folder, environment, more, *options))
        wait_for_nodes(head, len(nodes))
        yield head
    finally:
        for process in nodes:
            process.terminate()  # `--block` ends its node's processes
        for process in nodes:
            process.wait(timeout=60)
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Head]:
    """Two nodes with one CPU each, so that two runs at a time need both."""
    with head_node(tmp_path_factory.mktemp("home"), 1, workers=[1]) as head:
        yield head


def request(head: Head, path: str, body: Any = None) -> Any:
    """The dashboard's answer."""
    headers = {"Authorization": f"Bearer {TOKEN}"}
    method = "GET" if body is None else "POST"
    answer = requests.request(
        method, f"{head.dashboard}{path}", json=body, headers=headers, timeout=30
    )
    answer.raise_for_status()
    return answer.json()


def wait_for_jobs(head: Head) -> None:
    """Wait until the dashboard and its agent accept jobs."""
    for _ in range(240):
        try:
            request(head, "/api/jobs/", {"entrypoint": "true"})
        except requests.RequestException:
            assert head.process.poll() is None, (head.folder / "log").read_text()
            time.sleep(0.5)
        else:
            return
    pytest.fail((head.folder / "log").read_text())


def wait_for_nodes(head: Head, count: int) -> None:
    """Wait until `count` nodes are alive."""
    for _ in range(240):
        alive = request(head, "/nodes?view=summary")["data"]["summary"]
        if sum(node["raylet"].get("state") == "ALIVE" for node in alive) == count:
            return
        time.sleep(0.5)
    pytest.fail((head.folder / "log").read_text())


def small(document: dict[str, Any]) -> dict[str, Any]:
    document["stages"] = document["stages"][:1]
    document["defaults"]["env_steps"] = 600
    del document["resources"]
    return document


def start_sweep(
    head: Head, document: dict[str, Any], folder: Path, command: str = "run"
) -> subprocess.Popen[str]:
    """With `RAY_ADDRESS`, from the user's folder, which contains the environment's module."""
    (folder / "sweep.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    shutil.copy(ENVIRONMENTS / "point_env.py", folder)
    return subprocess.Popen(
        [sys.executable, "-m", "music_rllib.sweep", command, "sweep.yaml"],
        cwd=folder,
        env=head.environment | {"RAY_ADDRESS": head.address, "PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run_sweep(
    head: Head, document: dict[str, Any], folder: Path, command: str = "run"
) -> subprocess.CompletedProcess[str]:
    """Run `start_sweep` to its end."""
    with start_sweep(head, document, folder, command) as process:
        output, errors = process.communicate(timeout=280)
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)


FAKE_HEAD = "f" * 51 + "00000"
"""Node id of the head for Ray's provider of simulated nodes."""


COMMANDS = (
    *("initialization_commands", "setup_commands", "head_setup_commands", "worker_setup_commands"),
    *("head_start_ray_commands", "worker_start_ray_commands", "cluster_synced_files"),
    *("rsync_exclude", "rsync_filter"),
)
"""Required keys of the launcher's configuration, empty because nothing is launched."""


@contextlib.contextmanager
def growing_head(folder: Path, home: Path) -> Iterator[Head]:
    """A head with one CPU, whose autoscaler adds nodes with three, as processes of this machine.

    `ray.cluster_utils.AutoscalingCluster` is not used: it stops every Ray of the machine, and needs
    a file that is not in Ray's wheel.
    """
    port = free_port()
    # Added nodes use this address, so the head must use it too.
    here = ray.util.get_node_ip_address()
    address = f"{here}:{port}"
    module = "ray.autoscaler._private.fake_multi_node.node_provider.FakeMultiNodeProvider"
    provider: dict[str, Any] = {"type": "external", "module": module, "gcs_address": address}
    provider |= {"launch_multiple": True, "head_node_id": FAKE_HEAD}
    worker = {"resources": {"CPU": 3, "object_store_memory": 10**8}, "max_workers": 2}
    types = {
        "ray.head.default": {"resources": {"CPU": 1}, "node_config": {}, "max_workers": 0},
        "cpu": worker | {"node_config": {}, "min_workers": 0},
    }
    config = {"cluster_name": "growing", "max_workers": 2, "provider": provider}
    config |= {"available_node_types": types, "head_node_type": "ray.head.default"}
    config |= {"upscaling_speed": 10, "idle_timeout_minutes": 5}
    empty = ("auth", "docker", "file_mounts")
    config |= {key: {} for key in empty} | {key: [] for key in COMMANDS}
    (folder / "autoscaling.json").write_text(json.dumps(config))
    environment = without_loopback_only() | {
        "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}",
        "HOME": str(home),
        "PYTHONPATH": str(ENVIRONMENTS),
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": TOKEN,
        "RAY_FAKE_CLUSTER": "1",
        "RAY_enable_autoscaler_v2": "1",
        "RAY_CLOUD_INSTANCE_ID": FAKE_HEAD,
        "RAY_OVERRIDE_NODE_ID_FOR_TESTING": FAKE_HEAD,
        "RAY_NODE_TYPE_NAME": "ray.head.default",
    }
    options = ["--head", f"--port={port}", f"--temp-dir={folder / 'ray'}"]
    options += [f"--node-ip-address={here}", "--include-dashboard=false"]
    options += [f"--autoscaling-config={folder / 'autoscaling.json'}"]
    process = ray_start(folder, environment, 1, *options)
    for name in ("RAY_CLOUD_INSTANCE_ID", "RAY_OVERRIDE_NODE_ID_FOR_TESTING"):
        del environment[name]  # of the head only
    try:
        while "block forever" not in (folder / "log").read_text():
            assert process.poll() is None, (folder / "log").read_text()
            time.sleep(0.2)
        yield Head(address, "", folder, environment, process)
    finally:
        # When the autoscaler itself has ended, nothing else ends the processes of added nodes.
        started = psutil.Process(process.pid).children(recursive=True)
        process.terminate()
        process.wait(timeout=60)
        _, left = psutil.wait_procs(started, timeout=10)
        for other in left:
            with contextlib.suppress(psutil.NoSuchProcess):
                other.kill()


@pytest.mark.thorough
def test_a_cluster_grows_for_runs_that_no_node_of_it_could_hold(
    sweep_document: dict[str, Any], tmp_path: Path
) -> None:
    # Not pytest's folder: Ray's sockets need a short path.
    place = tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True)
    with place as folder, growing_head(Path(folder), tmp_path) as head:
        document = small(sweep_document) | {"resources": {"cpus_per_run": 2}}
        done = run_sweep(head, document, tmp_path)
        assert (done.returncode, done.stderr) == (0, ""), done.stdout
        assert "waits until its autoscaler adds one" in done.stdout


class Jobs:
    """Run `ray job` as a user does, from a folder with the package and without an installation."""

    def __init__(self, folder: Path, sweep: dict[str, Any]) -> None:
        self.folder = folder
        shutil.copytree(
            REPOSITORY / "music_rllib",
            folder / "music_rllib",
            ignore=shutil.ignore_patterns("__pycache__"),
        )
        lab = folder / "lab"  # the module is next to the sweep's file, not in the job's folder
        lab.mkdir()
        shutil.copy(ENVIRONMENTS / "point_env.py", lab)
        (lab / "sweep.yaml").write_text(yaml.safe_dump(sweep, sort_keys=False))

    def call(
        self, head: Head, *arguments: str, token: str = TOKEN
    ) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(BIN / "ray"), "job", *arguments],
            env=head.environment | {"RAY_ADDRESS": head.dashboard, "RAY_AUTH_TOKEN": token},
            capture_output=True,
            text=True,
            timeout=280,
            check=False,
        )

    def submit(
        self, head: Head, job: str, *options: str, wait: bool = True, token: str = TOKEN
    ) -> subprocess.CompletedProcess[str]:
        arguments = ["--working-dir", str(self.folder), "--submission-id", job]
        arguments += ["--runtime-env-json", json.dumps({"env_vars": STOP})]
        arguments += [] if wait else ["--no-wait"]
        program = ["python", "-m", "music_rllib.sweep", "lab/sweep.yaml", *options]
        return self.call(head, "submit", *arguments, "--", *program, token=token)

    def wait_for_log(self, head: Head, job: str, wanted: str) -> str:
        """The job's log as soon as it contains `wanted`."""
        text = ""
        for _ in range(400):
            text = str(request(head, f"/api/jobs/{job}/logs")["logs"])
            if wanted in text:
                return text
            state = request(head, f"/api/jobs/{job}")
            assert state["status"] in ("PENDING", "RUNNING"), (state, text)
            time.sleep(0.3)
        pytest.fail(text)


@dataclass(frozen=True)
class Site:
    """Folder of jobs: their checkout, the file that makes their environment fast, and a home."""

    jobs: Jobs
    fast: Path
    home: Path

    @property
    def storage(self) -> Path:
        return self.home / "results"

    def stop_one(self, head: Any) -> str:
        """Stop a job after its first checkpoint; returns its log."""
        assert self.jobs.submit(head, "one", wait=False).returncode == 0
        wait_for_newer(self.storage / "work", "")
        assert self.jobs.call(head, "stop", "one").returncode == 0
        assert request(head, "/api/jobs/one")["status"] == "STOPPED"
        log = str(request(head, "/api/jobs/one/logs")["logs"])
        assert "stopping, this takes a few seconds" in log
        assert "Stopped. Finished runs and the last checkpoints are kept" in log
        return log

    def finish(self, head: Any, runs: int = 1) -> str:
        """Resume a job to its end; returns its output."""
        self.fast.touch()
        done = self.jobs.submit(head, "last")
        assert done.returncode == 0, done.stdout + done.stderr
        for seed in range(runs):
            assert f"] seed{seed}: continues at" in done.stdout
            assert f"] seed{seed}: finished" in done.stdout
        assert f"using {self.storage}. Give an absolute path" in done.stdout
        assert request(head, "/api/jobs/last")["driver_exit_code"] == 0
        assert len(list((self.storage / "nodes").iterdir())) == runs
        return str(done.stdout)


def paced(document: dict[str, Any], fast: Path) -> dict[str, Any]:
    """A sweep whose runs are slow until the file `fast` exists."""
    small(document)["defaults"] |= {
        "env_steps": 10_000,
        "evaluation": {"interval": 400, "episodes": 1},
    }
    document["environments"]["Point"] |= {
        "env_id": "point_env:Paced-v0",
        "env_kwargs": {"fast": str(fast)},
    }
    return document


@pytest.mark.timeout(900)
def test_two_runs_on_two_nodes_are_stopped_and_a_job_finishes_them(
    head: Head, sweep_document: dict[str, Any], tmp_path: Path
) -> None:
    """Each run waits for the other one, and neither node has room for more than one."""
    met, fast = tmp_path / "met", tmp_path / "fast"
    met.mkdir()
    document = paced(sweep_document, fast)
    document["environments"]["Point"] |= {
        "env_id": "point_env:Meeting-v0",
        "env_kwargs": {"folder": str(met), "fast": str(fast)},
    }
    document["seeds"] = [0, 1]
    document["resources"] = {"memory_per_run": 0.05}  # so that Ray is also asked before it starts
    document["defaults"] |= {"env_steps": 2_000, "evaluation": {"interval": 200, "episodes": 1}}
    # Otherwise updates would be compiled again in the job's copy of the package.
    document["defaults"]["tac"]["random_steps"] = 1_999
    site = Site(Jobs(tmp_path / "checkout", document), fast, head.home)
    document["storage"] = str(site.storage)
    with start_sweep(head, document, tmp_path) as process:
        wait_for_newer(site.storage / "work", "")
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=120)
    assert (process.returncode, errors) == (130, "")
    assert "continue with: python -m music_rllib.sweep run sweep.yaml" in output
    assert [row[-1] for row in rows(output)] == ["interrupted", "interrupted"]
    assert len(list(met.iterdir())) == 2
    site.finish(head, runs=2)
    document["seeds"] = [0, 1, 2, 3]
    planned = run_sweep(head, document, tmp_path, "plan")
    assert f"Cluster {head.address}: 2 nodes hold 2 runs at a time. The 2 runs left take " in (
        planned.stdout
    )


@pytest.mark.thorough
@pytest.mark.timeout(900)  # four programs and two clusters start, one after the other
def test_job_is_stopped_then_outlives_its_cluster(
    sweep_document: dict[str, Any], tmp_path: Path
) -> None:
    """Stopped in order; resumed, and its head killed; resumed on a new cluster to its end."""
    home = tmp_path / "home"
    home.mkdir()
    fast = tmp_path / "fast"
    jobs = Jobs(tmp_path / "checkout", paced(sweep_document, fast))
    site = Site(jobs, fast, home)
    work = site.storage / "work"
    with head_node(site.home, 1) as head:
        stranger = jobs.submit(head, "stranger", token="another-token-of-some-length-0123456789")
        assert stranger.returncode == 1
        assert "authentication is enabled" in stranger.stderr
        log = site.stop_one(head)
        assert jobs.submit(head, "two", wait=False).returncode == 0
        log += jobs.wait_for_log(head, "two", "continues at")
        wait_for_newer(work, newest_checkpoint(work))
        kill_tree(head.process)
    assert not list((site.storage / "nodes").glob("*")), "it was to be interrupted before its end"

    with head_node(site.home, 1) as head:
        log += site.finish(head)
        wrong = jobs.submit(head, "four", "--storage", "ftp://nowhere")
        assert wrong.returncode == 1, "the client knows no other codes than 0 and 1"
        assert request(head, "/api/jobs/four")["driver_exit_code"] == 2
    for path in [path for path in site.storage.rglob("*") if path.is_file()]:
        assert b"planted-" not in path.read_bytes(), path
    assert "planted-" not in log


def kill_tree(process: subprocess.Popen[Any]) -> None:
    """Kill all processes that the node started, incl. drivers and workers, as a power cut does."""
    tree = psutil.Process(process.pid)
    for inner in [tree, *tree.children(recursive=True)]:
        with contextlib.suppress(psutil.NoSuchProcess):
            inner.kill()
    process.wait(timeout=60)


def newest_checkpoint(work: Path) -> str:
    """Name of the newest one, which grows with the environment steps; empty without one."""
    found = [path.parent.name for path in work.glob("*/*/manifest.json")]
    return max(found, default="")


def wait_for_newer(work: Path, than: str) -> None:
    for _ in range(1200):
        if newest_checkpoint(work) > than:
            return
        time.sleep(0.1)
    pytest.fail("no new checkpoint")
