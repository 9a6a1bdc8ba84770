"""A real small sweep to its end: its report, its policies, and MLflow's pages in a browser."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote
from urllib.request import urlopen

import pytest
import yaml
from mlflow import MlflowClient

from music_rllib import names
from music_rllib.report.build import PAGE
from tests.integration.conftest import ENVIRONMENTS, REPOSITORY, SWEEP
from tests.integration.devtools import PATIENCE, Page

# A server without accounts has nobody to name.
HARMLESS = ("mlflow/users/current",)


class Finished(NamedTuple):
    """A sweep that a user ran, and its MLflow."""

    folder: Path
    output: str
    client: MlflowClient
    experiment_id: str

    def runs(self) -> dict[str, Any]:
        """By name."""
        found = self.client.search_runs([self.experiment_id])
        return {run.info.run_name: run for run in found}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Two values of q after a MUSIC-u stage, with the report at the end."""
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "sweep.yaml").write_text(yaml.safe_dump(SWEEP))
    done = subprocess.run(
        [sys.executable, "-m", "music_rllib.sweep", "sweep.yaml"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": _python_path(), names.VARIABLE_REPORT: "on"},
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
    )
    assert (done.returncode, done.stderr) == (0, "")
    client = MlflowClient(f"sqlite:///{folder}/results/mlflow.db")
    experiment = client.get_experiment_by_name("points")
    assert experiment is not None
    return Finished(folder, done.stdout, client, str(experiment.experiment_id))


def test_the_sweep_s_run_carries_its_report(finished: Finished) -> None:
    page = finished.folder / "results" / "points" / "report" / PAGE
    assert f"Report: {page}\n" in finished.output
    parent = finished.runs()["points"]
    kept = {item.path for item in finished.client.list_artifacts(parent.info.run_id, "report")}
    assert {"report/figures", f"report/{PAGE}", "report/tables"} <= kept
    text = page.read_text()
    # The point has no picture: the page says so, instead of failing.
    assert "No videos: " in text
    assert "it has no rgb_array rendering" in text


def test_each_run_has_its_policy_and_evaluate_finds_it_by_label(finished: Finished) -> None:
    runs = {name: run for name, run in finished.runs().items() if name != "points"}
    models = finished.client.search_logged_models([finished.experiment_id])
    assert {model.source_run_id for model in models} == {run.info.run_id for run in runs.values()}
    name = next(name for name in runs if name.startswith("q=1 "))
    label = runs[name].data.tags[names.TAG_LABEL]
    # The policy's file names a module, which only the user may have imported.
    options = ["--episodes", "2", "--json", "--env", "point_env:Point-v0"]
    done = subprocess.run(
        [sys.executable, "-m", "music_rllib.sweep", "evaluate", label, *options],
        cwd=finished.folder,
        env=os.environ | {"PYTHONPATH": _python_path()},
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    assert (done.returncode, done.stderr) == (0, "")
    document = json.loads(done.stdout)
    assert (document["task"], document["env_steps"]) == ("Point", 1200)
    assert document["node_key"] == runs[name].data.tags[names.TAG_NODE_KEY]


def _python_path() -> str:
    return os.pathsep.join(map(str, (REPOSITORY, ENVIRONMENTS)))


@pytest.fixture(scope="module")
def server(finished: Finished) -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "mlflow", "server", "--workers", "1", "--port", str(port)]
    process = subprocess.Popen(
        [*command, "--backend-store-uri", f"sqlite:///{finished.folder}/results/mlflow.db"],
        env={**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    url = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 180
        while time.monotonic() < deadline:
            try:
                urlopen(f"{url}/health", timeout=5).close()
                break
            except OSError:
                assert process.poll() is None
                time.sleep(0.2)
        yield url
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(60)


def test_mlflow_s_pages_filter_and_compare(
    finished: Finished, server: str, require_service: Callable[[str], Path], tmp_path: Path
) -> None:
    program = require_service("chromium")
    runs = finished.runs()
    pair = [run.info.run_id for name, run in runs.items() if name.startswith("q=")]
    assert len(pair) == 2
    asyncio.run(_look(finished, server, program, tmp_path, pair))


def test_the_link_at_the_end_opens_the_comparison(
    finished: Finished, server: str, require_service: Callable[[str], Path], tmp_path: Path
) -> None:
    """Grouped by q, the task's metric first; and the sweep's page shows its result."""
    program = require_service("chromium")
    _, said, rest = finished.output.partition("\nCompare in MLflow: http://127.0.0.1:5000/")
    assert said
    link = rest.splitlines()[0]
    asyncio.run(_compare(finished, f"{server}/{link}", server, program, tmp_path))


async def _compare(finished: Finished, link: str, server: str, program: Path, folder: Path) -> None:
    async with Page(program, folder) as page:
        await page.go(link)
        text = await page.wait_for(
            "Group by: entropic_index",
            *("Group: 1", "Group: 2", "q=2 seed 0 Point"),
            *("Comparison", names.EVAL_SUCCESS, "setting/entropic_index vs."),
        )
        assert "seed 0 Point pretrain" not in text
        assert names.CRITIC_LOSS not in text, "it is folded away"
        run_id = finished.runs()["points"].info.run_id
        await page.go(f"{server}/#/experiments/{finished.experiment_id}/runs/{run_id}")
        await page.wait_for("Description", "condition", "q = 1", "q = 2")
        loaded = "[...document.images].some(i => i.src.includes('get-artifact') && i.naturalWidth)"
        deadline = time.monotonic() + PATIENCE
        while not await page.evaluate(loaded):
            assert time.monotonic() < deadline, "the report's figure is on the page"
            await asyncio.sleep(0.3)
        errors = [e for e in page.errors if not any(words in e for words in HARMLESS)]
    assert not errors


async def _look(
    finished: Finished, server: str, program: Path, folder: Path, pair: list[str]
) -> None:
    pages = f"{server}/#/experiments/{finished.experiment_id}"
    async with Page(program, folder) as page:
        await page.go(f"{pages}/runs")
        await page.wait_for("points", "4 matching runs")
        # The sweep's own run is shown above those that fit.
        for wanted, matching in (
            ("tags.entropic_index = '2'", 2),
            ("tags.task = 'Point' and tags.variant = 'music-r'", 3),
            ('metrics."setting/entropic_index" > 1.5', 2),
        ):
            await page.go(f"{pages}/runs?searchFilter={quote(wanted)}")
            await page.wait_for(f"{matching} matching runs")
        compared = quote(json.dumps(pair, separators=(",", ":")))
        experiments = quote(json.dumps([finished.experiment_id]))
        await page.go(f"{server}/#/compare-runs?runs={compared}&experiments={experiments}")
        text = await page.wait_for("Comparing 2 Runs", "q=2 seed 0 Point", "tac.entropic_index")
        axes = re.search(r"Parameters:\s+(.*?)\s+Metrics:\s+(.*?)\s+Clear All", text, re.DOTALL)
        assert axes
        assert axes.groups() == ("tac.entropic_index", names.EVAL_SUCCESS), "not q against q"
        await page.go(f"{pages}/models")
        await page.wait_for("policy", "Ready", "q=2 seed 0 Point")
        errors = [e for e in page.errors if not any(words in e for words in HARMLESS)]
    assert not errors
