"""MLflow's pages of a published sweep, used to compare q."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from urllib.parse import quote

import pytest
from mlflow import MlflowClient
from typer.testing import CliRunner

from music_rllib import names
from music_rllib.experiment.open_sweep import open_sweep
from music_rllib.experiment.plan import make_plan
from music_rllib.experiment.record import keep_record
from music_rllib.experiment.run_info import run_info
from music_rllib.program import app
from music_rllib.results.archive import read_archive
from music_rllib.results.data import Sweep
from music_rllib.store.history import Report
from music_rllib.sweep.listeners.mlflow_view import VERSIONS, comparison_view
from music_rllib.tracking.listener import finished_run
from music_rllib.tracking.tracker import Tracker
from tests.integration.conftest import REPOSITORY
from tests.integration.devtools import Page
from tests.integration.mlflow_server import MlflowServer, comparing
from tests.played_search import publish
from tests.sweep_files import loaded

NAME = "proof-fetch-push-her"


def log_published_sweep(folder: Path) -> str:
    """Log a published sweep and its report into a storage's MLflow; the path of its comparison."""
    sweep = read_archive(REPOSITORY / "docs" / "results" / "data" / NAME)
    config = loaded(folder, str(sweep.config))
    plan = make_plan(config)
    of_seed = {(run.entropic_index, run.seed): number for number, run in enumerate(sweep.runs)}
    opened = open_sweep(config, plan, str(folder))
    keep_record(opened)
    with Tracker(sweep_name=NAME, storage=str(folder), config=config.document) as tracker:
        for node in plan.nodes:
            key = (f"{node.values['tac.entropic_index']:g}", str(node.run.seed))
            publish(opened, node, _reports(sweep, of_seed[key]))
            tracker.mirror(run_info(node), partial(finished_run, opened.store, node))
        tracker.keep_view(
            comparison_view(plan, config.stage(), tracker.sweep_id, time.time()), VERSIONS
        )
        assert tracker.flush(60.0)
    arguments = ["report", str(folder / NAME), "--attach", "--no-videos"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    return tracker.comparison_url().partition("/#/")[2]


def _reports(sweep: Sweep, run: int) -> list[Report]:
    """Reports of the run's evaluations."""
    evaluated, begun = sweep.column(run, names.EVAL_SUCCESS), sweep.runs[run].started or 0
    return [
        Report(
            env_steps=int(step),
            seconds=(time_ms - begun) / 1000,
            timestamp_ms=int(time_ms),
            metrics={
                metric: float(values[at == step][0])
                # MLflow compares by the metric that was logged first.
                for metric in sorted(sweep.history, key=lambda one: one != names.EVAL_SUCCESS)
                for at, values in [sweep.series(run, metric)]
                if step in at
            },
        )
        for step, time_ms in zip(evaluated.step, evaluated.time, strict=True)
    ]


@pytest.mark.thorough
def test_pictures_of_a_comparison(require_service: Callable[[str], Path], tmp_path: Path) -> None:
    """The pages as the documentation shows them."""
    chromium, comparison = require_service("chromium"), log_published_sweep(tmp_path)
    client = MlflowClient(f"sqlite:///{tmp_path}/mlflow.db")
    found = client.get_experiment_by_name(NAME)
    assert found is not None
    runs = {run.info.run_name: run.info.run_id for run in client.search_runs([found.experiment_id])}
    three = [runs[f"q={q} seed 0 FetchPush train"] for q in ("1", "1.5", "2")]
    with MlflowServer(tmp_path) as server:
        pages = f"{server.uri}/#/experiments/{found.experiment_id}"
        wanted = {
            "comparison": f"{server.uri}/#/{comparison}",
            "sweep": f"{pages}/runs/{runs[NAME]}",
            "runs": f"{pages}/runs?searchFilter=" + quote('metrics."setting/entropic_index" > 1.2'),
            "compare": comparing(server.uri, found.experiment_id, three),
        }
        asyncio.run(_photograph(wanted, chromium, tmp_path))


async def _photograph(wanted: dict[str, str], program: Path, folder: Path) -> None:
    async with Page(program, folder) as page:
        await page.view(1500, 800)
        await page.go(wanted["comparison"])
        await page.wait_for("Group: 1.5")
        # MLflow's assistant takes up a third of the window until it is closed.
        await page.evaluate("localStorage.setItem('mlflow.assistant.panelOpen_v1', 'false')")
        lines = [f"{q} ({names.EVAL_SUCCESS})" for q in ("1", "1.5")]
        for name, words, pressed, then in (
            ("comparison", ["Comparison", *lines], None, lines),
            ("grouping", lines, "Group by: entropic_index", ["Tags\n"]),
            ("sweep", ["q = 1.5 against q = 1 on FetchPush"], "Show more", ["Show less"]),
            ("runs", ["7 matching runs"], "", ["q=1.5 seed 0 FetchPush", "q=2 seed 2 FetchPush"]),
            ("compare", ["Comparing 3 Runs", "tac.entropic_index"], None, ["Metrics:"]),
        ):
            await page.go(wanted.get(name, wanted["comparison"]))
            await page.wait_for(*words)
            await asyncio.sleep(1.0)
            if pressed is not None:
                await page.click(pressed, "button" if pressed else ".ag-row button")
            await page.wait_for(*then)
            await page.picture(f"mlflow-{name}.png")
