"""A newcomer's first hour, in a folder outside the repository: a sweep without problems.

README's sweep with a budget of seconds, the commands after it, and a finer sweep.
tests/unit/test_snippets.py checks all commands and snippets that are not run here; sweeps with
failures are in test_sweep_local.py.
"""

from __future__ import annotations

import asyncio
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd
import pytest
import yaml
from mlflow import MlflowClient

from music_rllib import load_sweep, names
from music_rllib.program import main as sweep
from music_rllib.report.build import PAGE
from tests.integration.conftest import call, metric_steps, program_environment, rows
from tests.integration.devtools import PATIENCE, Page
from tests.integration.mlflow_server import MlflowServer, comparing
from tests.processes import fresh

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).parents[3]
SECONDS = {
    "env_steps": 300,
    "num_envs": 2,
    "evaluation": {"interval": 150, "episodes": 2},
    "tac": {"random_steps": 200, "replay_ratio": 0.1},
}
# A server without accounts has no user names.
HARMLESS = ("mlflow/users/current",)
EXPECTED = re.compile(
    r"\[ *\d+:\d\d\] (q=|starting a local Ray$|best so far: (train )?q = )"
    r"|(stage|run|train|q=\S+)[ :/]|  |Sweep |Results |Storage: |3 runs, |"
    r"Report: |Picture: |Compare in MLflow: |Open MLflow's pages with: "
    r"|No comparison was planned|q = |Metric: |Seeds: |Control: |All conditions |The standard "
)
"""Lines that a sweep without problems prints."""


def snippet(page: str, language: str, position: int = 0) -> str:
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return str(blocks[position])


def said(main: Callable[[Sequence[str]], int], folder: Path, *arguments: str) -> str:
    """Output of a command in the newcomer's folder; it must succeed."""
    code, output, errors = call(main, folder, *arguments)
    assert code == 0, output + errors
    return output


class Newcomer(NamedTuple):
    """The newcomer's folder, the sweep's output, and its MLflow."""

    folder: Path
    output: str
    client: MlflowClient
    experiment_id: str

    def runs(self) -> dict[str, Any]:
        """Runs of the current plan, by name."""
        wanted = f"tags.{names.TAG_CURRENT} = '{names.CURRENT}'"
        found = self.client.search_runs([self.experiment_id], wanted)
        return {run.info.run_name: run for run in found}


@pytest.fixture(scope="module")
def newcomer(tmp_path_factory: pytest.TempPathFactory) -> Newcomer:
    """Three values of q, with the report at the end."""
    folder = tmp_path_factory.mktemp("newcomer")
    (folder / "home").mkdir()
    document: dict[str, Any] = yaml.safe_load(snippet("README.md", "yaml"))
    document |= {"seeds": [0], "defaults": SECONDS}
    (folder / "my_sweep.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    output = _run(folder, report="on")
    client = MlflowClient(f"sqlite:///{folder}/results/mlflow.db")
    experiment = client.get_experiment_by_name("my_sweep")
    assert experiment is not None
    return Newcomer(folder, output, client, str(experiment.experiment_id))


def _run(folder: Path, report: str) -> str:
    """Output of the user's sweep, which succeeds."""
    # A terminal wide enough for the last columns of tables, and a user without settings of Ray.
    user = {names.VARIABLE_REPORT: report, "COLUMNS": "160", "HOME": str(folder / "home")}
    environment = program_environment() | user
    del environment["RAY_AUTH_MODE"]
    done = fresh("-m", "music_rllib.sweep", "my_sweep.yaml", cwd=folder, env=environment)
    assert done.stderr == ""
    return done.stdout


def test_the_sweep_ends_with_its_picture(newcomer: Newcomer) -> None:
    label, _, path = newcomer.output.splitlines()[-1].partition(": ")
    report = newcomer.folder / "results" / "my_sweep" / "report"
    assert label == "Picture"
    assert Path(path) == report / "figures" / "overview.png"
    assert Path(path).read_bytes().startswith(b"\x89PNG")
    assert f"Report: {report / PAGE}\n" in newcomer.output
    parent = newcomer.runs()["my_sweep"]
    kept = {item.path for item in newcomer.client.list_artifacts(parent.info.run_id, "report")}
    assert {"report/figures", f"report/{PAGE}", "report/tables"} <= kept


def test_the_screen_shows_the_plan_the_runs_and_their_results(newcomer: Newcomer) -> None:
    output = newcomer.output
    assert "3 runs, 900 env steps in total." in output
    assert output.index("Sweep my_sweep") < output.index(": started") < output.index("Results of")
    unexpected = [line for line in output.splitlines() if not EXPECTED.match(line)]
    assert unexpected == [], "the newcomer's screen"
    found = rows(output)
    assert [row[0] for row in found] == ["q=1/seed0", "q=1.5/seed0", "q=2/seed0"]
    assert {row[-1] for row in found} == {"finished"}
    assert all("300" in row for row in found)
    assert "mlflow ui --backend-store-uri" in output
    # Ray itself would have written a token file that changes later `ray start`s.
    assert not (newcomer.folder / "home" / ".ray").exists()


def test_mlflow_has_each_run_with_its_settings_curves_and_policy(newcomer: Newcomer) -> None:
    runs = newcomer.runs()
    parent = runs.pop("my_sweep")
    wanted = {f"q={q} seed 0 FetchReach train": q for q in ("1", "1.5", "2")}
    assert set(runs) >= set(wanted)
    for name, q in wanted.items():
        run, tags = runs[name], runs[name].data.tags
        assert run.info.status == "FINISHED"
        assert tags[names.TAG_PARENT_RUN] == parent.info.run_id
        assert (tags[names.TAG_VARIANT], tags[names.TAG_TASK]) == ("tac", "FetchReach")
        assert tags[names.TAG_ENTROPIC_INDEX] == q
        assert run.data.metrics[names.SETTING_ENTROPIC_INDEX] == float(q)
        assert run.data.params["tac.entropic_index"] == str(float(q))
        assert metric_steps(newcomer.folder, run) == [0, 200, 300]
        assert metric_steps(newcomer.folder, run, names.EVAL_SUCCESS) == [0, 200, 300]
    models = newcomer.client.search_logged_models([newcomer.experiment_id])
    assert {model.source_run_id for model in models} == {run.info.run_id for run in runs.values()}


def test_results_in_hand(newcomer: Newcomer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The snippets of docs/reports.md on a storage, and with the same output on its export."""
    folder = newcomer.folder
    monkeypatch.chdir(folder)
    known: dict[str, Any] = {}
    exec(snippet("docs/reports.md", "python"), known)
    success = known["success"]
    assert sorted(set(success["q"])) == [1.0, 1.5, 2.0]
    assert success["env_steps"].max() == 300
    export = ["report", "results/my_sweep", "--export", "published/my_sweep", "--format", "csv"]
    said(sweep, folder, *export)
    first, second = load_sweep("results/my_sweep"), load_sweep("published/my_sweep")
    pd.testing.assert_frame_equal(
        first.conditions.sort_values("q"), second.conditions.sort_values("q")
    )


@pytest.mark.parametrize(
    "arguments",
    ["status results/my_sweep", "compare results/my_sweep", "plan my_sweep.yaml", "plan"],
)
def test_commands_beside_it(newcomer: Newcomer, arguments: str) -> None:
    assert said(sweep, newcomer.folder, *arguments.split())


def test_the_best_policy_is_played(newcomer: Newcomer) -> None:
    folder = newcomer.folder
    said(sweep, folder, "best", "results/my_sweep")
    played = ["evaluate", "results/my_sweep/best", "--episodes", "2"]
    assert "2 episodes" in said(sweep, folder, *played)
    example = [sys.executable, str(ROOT / "examples" / "load_policy.py"), "results/my_sweep/best"]
    done = subprocess.run(example, cwd=folder, capture_output=True, text=True, check=True)
    assert re.fullmatch(r"return -\d+, success [01]\n", done.stdout)


# --- MLflow's pages ----------------------------------------------------------------------------


def test_mlflow_s_pages_filter_and_compare(
    newcomer: Newcomer, require_service: Callable[[str], Path], tmp_path: Path
) -> None:
    """The link at the sweep's end groups by q; the sweep's page shows its result."""
    program = require_service("chromium")
    _, found, rest = newcomer.output.partition("\nCompare in MLflow: http://127.0.0.1:5000/")
    assert found
    with MlflowServer(newcomer.folder / "results") as server:
        asyncio.run(_look(newcomer, server.uri, rest.splitlines()[0], program, tmp_path))


async def _look(newcomer: Newcomer, server: str, link: str, program: Path, folder: Path) -> None:
    pages = f"{server}/#/experiments/{newcomer.experiment_id}"
    runs = {name: run.info.run_id for name, run in newcomer.runs().items()}
    async with Page(program, folder) as page:
        await page.go(f"{server}/{link}")
        text = await page.wait_for(
            "Group by: entropic_index",
            *("Group: 1", "Group: 2", "q=2 seed 0 FetchReach"),
            *("Comparison", names.EVAL_SUCCESS, "setting/entropic_index vs."),
        )
        assert names.CRITIC_LOSS not in text, "it is folded away"
        await page.go(f"{pages}/runs/{runs['my_sweep']}")
        await page.wait_for("Description", "Condition", "q = 1", "q = 2")
        loaded = "[...document.images].some(i => i.src.includes('get-artifact') && i.naturalWidth)"
        deadline = time.monotonic() + PATIENCE
        while not await page.evaluate(loaded):
            assert time.monotonic() < deadline, "the report's figure is on the page"
            await asyncio.sleep(0.3)
        await page.go(f"{pages}/runs")
        await page.wait_for("my_sweep", f"{len(runs)} matching runs")
        # The sweep's own run is shown above those that fit.
        for wanted, matching in (
            ("tags.entropic_index = '2' and tags.task = 'FetchReach'", 2),
            ("tags.variant = 'tac'", len(runs)),
            ('metrics."setting/entropic_index" > 1.7', 2),
        ):
            await page.go(f"{pages}/runs?searchFilter={quote(wanted)}")
            await page.wait_for(f"{matching} matching runs")
        pair = [runs[f"q={q} seed 0 FetchReach train"] for q in (1, 2)]
        await page.go(comparing(server, newcomer.experiment_id, pair))
        text = await page.wait_for(
            "Comparing 2 Runs", "q=2 seed 0 FetchReach", "tac.entropic_index"
        )
        axes = re.search(r"Parameters:\s+(.*?)\s+Metrics:\s+(.*?)\s+Clear All", text, re.DOTALL)
        assert axes
        assert axes.groups() == ("tac.entropic_index", names.EVAL_SUCCESS), "not q against q"
        await page.go(f"{pages}/models")
        await page.wait_for("policy", "Ready", "q=2 seed 0 FetchReach")
        errors = [e for e in page.errors if not any(words in e for words in HARMLESS)]
    assert not errors


# --- a finer sweep -----------------------------------------------------------------------------


def test_a_finer_sweep_reuses_finished_runs(
    newcomer: Newcomer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, file = newcomer.folder, newcomer.folder / "my_sweep.yaml"
    document = yaml.safe_load(file.read_text())
    document["stages"][0]["grid"]["tac.entropic_index"] = [1.0, 1.25, 1.5, 2.0]
    file.write_text(yaml.safe_dump(document))
    output = _run(folder, report="off")
    assert "3 finished earlier and reused, 300 env steps left" in output
    again = rows(output)
    assert [row[-1] for row in again] == ["reused", "finished", "reused", "reused"]
    before = [row[:-1] for row in rows(newcomer.output)]
    assert [row[:-1] for row in again if row[-1] == "reused"] == before
    runs = newcomer.client.search_runs([newcomer.experiment_id])
    assert len(newcomer.runs()) == 1 + 4, "each is there once"
    assert len(runs) == 1 + 1 + 4, "and the sweep's own run of the coarser plan"
    check_frames(folder, tmp_path / "export")

    # Under another name all results are reused, and MLflow gets all of them again.
    monkeypatch.setenv("COLUMNS", "160")
    again = rows(said(sweep, folder, "run", "my_sweep.yaml", "--name", "other"))
    assert [row[-1] for row in again] == ["reused"] * 4
    other = newcomer.client.get_experiment_by_name("other")
    assert other is not None
    assert len(newcomer.client.search_runs([other.experiment_id])) == 1 + 4


def check_frames(folder: Path, export: Path) -> None:
    """The same tables from the storage and from an export."""
    place = folder / "results" / "my_sweep"
    assert sweep(["report", str(place), "--export", str(export)]) == 0
    first, other = load_sweep(place), load_sweep(export)
    for name, order in (("curves", ["key", "metric", "env_steps"]), ("conditions", ["stage", "q"])):
        one, two = (getattr(read, name).sort_values(order) for read in (first, other))
        assert len(one)
        pd.testing.assert_frame_equal(one.reset_index(drop=True), two.reset_index(drop=True))
    pd.testing.assert_frame_equal(first.runs, other.runs)
