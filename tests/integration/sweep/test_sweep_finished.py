"""A real small sweep to its end: its screen, its report, its policies, and MLflow's pages.

And a finer one after it. Both are run once, and looked at from all sides.
"""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd
import pytest
import yaml
from mlflow import MlflowClient

from music_rllib import load_sweep, names
from music_rllib.program import main
from music_rllib.report.build import PAGE
from tests.integration.conftest import (
    ENVIRONMENTS,
    SWEEP,
    call,
    metric_steps,
    program_environment,
    rows,
)
from tests.integration.devtools import PATIENCE, Page
from tests.integration.mlflow_server import MlflowServer, comparing

# A server without accounts has nobody to name.
HARMLESS = ("mlflow/users/current",)


class Finished(NamedTuple):
    """A sweep that a user ran, and its MLflow."""

    folder: Path
    output: str
    client: MlflowClient
    experiment_id: str

    def runs(self) -> dict[str, Any]:
        """Those of the current plan, by name."""
        wanted = f"tags.{names.TAG_CURRENT} = '{names.CURRENT}'"
        found = self.client.search_runs([self.experiment_id], wanted)
        return {run.info.run_name: run for run in found}


EXPECTED = re.compile(
    r"\[ *\d+:\d\d\] (pretrain/|finetune/|starting a local Ray$|best so far: finetune )"
    r"|(stage|run|pretrain|finetune)[ :/]|  |Sweep |Results |Storage: |3 runs, |"
    r"Report: |Picture: |Compare in MLflow: |Open MLflow's pages with: "
)
"""Lines of a sweep in which nothing goes wrong."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Two values of q after a MUSIC-u stage, with the report at the end."""
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "home").mkdir()
    (folder / "sweep.yaml").write_text(yaml.safe_dump(SWEEP))
    output = _run(folder, report="on")
    client = MlflowClient(f"sqlite:///{folder}/results/mlflow.db")
    experiment = client.get_experiment_by_name("points")
    assert experiment is not None
    return Finished(folder, output, client, str(experiment.experiment_id))


def _run(folder: Path, report: str) -> str:
    """What a user's sweep says that ends well."""
    # A screen wide enough for the last columns of tables, and a user without settings of Ray.
    user = {names.VARIABLE_REPORT: report, "COLUMNS": "160", "HOME": str(folder / "home")}
    environment = program_environment() | user
    del environment["RAY_AUTH_MODE"]
    done = subprocess.run(
        [sys.executable, "-m", "music_rllib.sweep", "sweep.yaml"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_the_screen_shows_the_plan_the_runs_and_their_results(finished: Finished) -> None:
    output = finished.output
    assert "3 runs, 3,600 env steps in total." in output
    assert output.index("Sweep points") < output.index(": started") < output.index("Results of")
    unexpected = [line for line in output.splitlines() if not EXPECTED.match(line)]
    assert unexpected == [], "the newcomer's screen"
    found = rows(output)
    runs = ["pretrain/seed0", "finetune/q=1/seed0", "finetune/q=2/seed0"]
    assert [row[0] for row in found] == runs
    assert {row[-1] for row in found} == {"finished"}
    assert all("1,200" in row for row in found)
    assert "mlflow ui --backend-store-uri" in output
    # Ray by itself would have written a token file that changes later `ray start`s.
    assert not (finished.folder / "home" / ".ray").exists()


def test_mlflow_has_each_run_with_what_it_was_and_came_from(finished: Finished) -> None:
    runs = {name: run for name, run in finished.runs().items() if not name.startswith("q=1.5 ")}
    assert set(runs) == {
        "points",
        "seed 0 Point pretrain",
        "q=1 seed 0 Point finetune",
        "q=2 seed 0 Point finetune",
    }
    parent, pretrain = runs["points"], runs["seed 0 Point pretrain"]
    for run in runs.values():
        assert run.info.status == "FINISHED"
    for q in (1, 2):
        run = runs[f"q={q} seed 0 Point finetune"]
        tags = run.data.tags
        assert tags[names.TAG_LABEL] == f"finetune/Point/tac.entropic_index={q}/seed0"
        assert tags[names.TAG_PARENT_RUN] == parent.info.run_id
        assert tags[names.TAG_SOURCE_RUN] == pretrain.info.run_id
        assert (tags[names.TAG_VARIANT], tags[names.TAG_TASK]) == ("music-r", "Point")
        assert tags[names.TAG_ENTROPIC_INDEX] == str(q)
        assert run.data.metrics[names.SETTING_ENTROPIC_INDEX] == q
        assert run.data.params["tac.entropic_index"] == f"{q}.0"
        assert metric_steps(finished.folder, run) == [0, 400, 800, 1200]
        assert metric_steps(finished.folder, run, names.EVAL_SUCCESS) == [0, 400, 800, 1200]


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


def test_each_run_has_its_policy_and_evaluate_finds_it_by_label(
    finished: Finished, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ENVIRONMENTS)
    runs = {name: run for name, run in finished.runs().items() if name != "points"}
    models = finished.client.search_logged_models([finished.experiment_id])
    assert {model.source_run_id for model in models} == {run.info.run_id for run in runs.values()}
    name = next(name for name in runs if name.startswith("q=1 "))
    label = runs[name].data.tags[names.TAG_LABEL]
    # The policy's file names a module, which only the user may have imported.
    options = ["--episodes", "2", "--json", "--env", "point_env:Point-v0"]
    code, output, errors = call(main, finished.folder, "evaluate", label, *options)
    assert (code, errors) == (0, "")
    document = json.loads(output)
    assert (document["task"], document["env_steps"]) == ("Point", 1200)
    assert document["node_key"] == runs[name].data.tags[names.TAG_NODE_KEY]


@pytest.fixture(scope="module")
def server(finished: Finished) -> Iterator[str]:
    with MlflowServer(finished.folder / "results") as server:
        yield server.uri


def test_mlflow_s_pages_filter_and_compare(
    finished: Finished, server: str, require_service: Callable[[str], Path], tmp_path: Path
) -> None:
    program = require_service("chromium")
    runs = finished.runs()
    pair = [runs[f"q={q} seed 0 Point finetune"].info.run_id for q in (1, 2)]
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
        await page.wait_for("Description", "Condition", "q = 1", "q = 2")
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
        await page.wait_for("points", f"{len(finished.runs())} matching runs")
        # The sweep's own run is shown above those that fit.
        for wanted, matching in (
            ("tags.entropic_index = '2'", 2),
            ("tags.task = 'Point' and tags.variant = 'music-r'", len(finished.runs()) - 1),
            ('metrics."setting/entropic_index" > 1.5', 2),
        ):
            await page.go(f"{pages}/runs?searchFilter={quote(wanted)}")
            await page.wait_for(f"{matching} matching runs")
        await page.go(comparing(server, finished.experiment_id, pair))
        text = await page.wait_for("Comparing 2 Runs", "q=2 seed 0 Point", "tac.entropic_index")
        axes = re.search(r"Parameters:\s+(.*?)\s+Metrics:\s+(.*?)\s+Clear All", text, re.DOTALL)
        assert axes
        assert axes.groups() == ("tac.entropic_index", names.EVAL_SUCCESS), "not q against q"
        await page.go(f"{pages}/models")
        await page.wait_for("policy", "Ready", "q=2 seed 0 Point")
        errors = [e for e in page.errors if not any(words in e for words in HARMLESS)]
    assert not errors


def test_a_finer_sweep_reuses_what_is_finished(
    finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = yaml.safe_load((finished.folder / "sweep.yaml").read_text())
    document["stages"][1]["grid"]["tac.entropic_index"] = [1.0, 1.5, 2.0]
    (finished.folder / "sweep.yaml").write_text(yaml.safe_dump(document))
    output = _run(finished.folder, report="off")
    assert "3 finished earlier and reused, 1,200 env steps left" in output
    again = rows(output)
    assert [row[-1] for row in again] == ["reused", "reused", "finished", "reused"]
    before = [row[:-1] for row in rows(finished.output)]
    assert [row[:-1] for row in again if row[-1] == "reused"] == before
    runs = finished.client.search_runs([finished.experiment_id])
    assert len(finished.runs()) == 1 + 4, "each is there once"
    assert len(runs) == 1 + 1 + 4, "and the sweep's own run of the coarser plan"
    check_frames(finished.folder, tmp_path / "export")

    # Under another name there is nothing to train, and MLflow gets all of it once more.
    monkeypatch.syspath_prepend(ENVIRONMENTS)
    monkeypatch.setenv("COLUMNS", "160")
    code, output, errors = call(main, finished.folder, "run", "sweep.yaml", "--name", "other")
    assert (code, errors) == (0, "")
    assert [row[-1] for row in rows(output)] == ["reused"] * 4
    other = finished.client.get_experiment_by_name("other")
    assert other is not None
    assert len(finished.client.search_runs([other.experiment_id])) == 1 + 4


def check_frames(folder: Path, export: Path) -> None:
    """The same from the storage and from an export."""
    place = folder / "results" / "points"
    assert main(["report", str(place), "--export", str(export)]) == 0
    first, other = load_sweep(place), load_sweep(export)
    for name, order in (("curves", ["key", "metric", "env_steps"]), ("conditions", ["stage", "q"])):
        one, two = (getattr(read, name).sort_values(order) for read in (first, other))
        assert len(one)
        pd.testing.assert_frame_equal(one.reset_index(drop=True), two.reset_index(drop=True))
    pd.testing.assert_frame_equal(first.runs, other.runs)
