"""Reports on a sweep that was logged to a real MLflow store, and their page in a real browser."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from music_rllib import names
from music_rllib.config.load import load_sweep
from music_rllib.experiment.plan import Node, make_plan
from music_rllib.experiment.run_info import run_info
from music_rllib.report.build import PAGE
from music_rllib.report.cli import app
from music_rllib.report.location import find_sweep
from music_rllib.results import from_mlflow
from music_rllib.results.archive.folder import Format, read_archive, write_archive
from music_rllib.results.data import ReportError, Sweep
from music_rllib.results.from_mlflow import read_mlflow
from music_rllib.results.mlflow_tables import read_tables
from music_rllib.store.run_record import Report
from music_rllib.tracking.projection import StoredRun
from music_rllib.tracking.store import resolve_store
from music_rllib.tracking.tracker import Tracker
from tests.integration.mlflow_server import MlflowServer

STEPS = range(20_000, 100_001, 20_000)
CONFIG = """
name: tiny
tasks: [FetchPush]
seeds: [0, 1]
storage: unused
defaults:
  env_steps: 100000
  evaluation: {interval: 20000, episodes: 10}
stages:
  - name: pretrain
    variant: music-u
  - name: finetune
    variant: music-r
    init_from: pretrain
    grid: {tac.entropic_index: [1.0, 1.5]}
"""
Q = "tac.entropic_index"
WORTH = {"name": "iqm of evaluation/success_rate", "direction": "maximize"}
SEARCHES = [
    {
        "stage": "finetune",
        "mode": "search",
        "sampler": "tpe",
        "objectives": [WORTH],
        "storage": "sqlite:////home/someone/studies/all.db",
        "arms": [
            {
                "values": {},
                "importance": {Q: 0.9},
                "trials": [
                    {
                        "number": 0,
                        "state": "judged",
                        "values": {Q: 1.25},
                        "objective": [0.8125],
                        "interval": [[0.75, None]],
                        "reason": None,
                    },
                    {
                        "number": 1,
                        "state": "pruned",
                        "values": {Q: 2.0},
                        "objective": None,
                        "reason": "0.1 is not among the best <2>",
                    },
                    {
                        "number": 2,
                        "state": "waiting",
                        "values": {},
                        "objective": None,
                        "reason": None,
                    },
                ],
            }
        ],
        "ranking": [
            {
                "trial": 0,
                "values": {Q: 1.25},
                "searched": [0.8125],
                "fresh": [0.6875],
                "interval": [[0.5, 0.75]],
                "scores": [[[0.5], [0.75]]],
            },
            {"trial": None, "values": {Q: 1.0}, "failure": "no memory"},
        ],
    }
]
"""As `search.json` has it."""
FAILED = 3
"""Position of the run that failed."""
FAILURE = "ValueError: the <simulation> broke"


def values(node: Node, step: int) -> dict[str, float]:
    final = {"finetune": 0.9, "pretrain": 0.1}[node.stage] - 0.05 * node.run.seed
    return {
        names.EVAL_SUCCESS: final * step / STEPS[-1],
        names.EVAL_SUCCESS_ANY: min(1.0, final * step / STEPS[-1] + 0.05),
        names.MI_BOUND: 0.5 * step / STEPS[-1],
        names.MI_REWARD: -0.5,
        names.ENTROPY: 1.0 - step / 2e5,
        names.SHANNON_ENTROPY: 2.0 - step / 2e5,
        names.ENV_STEPS: float(step),
        names.Q_MEAN: [np.nan, np.inf, -np.inf, 1e-300, -0.1][STEPS.index(step)],
    }


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> list[Node]:
    file = tmp_path_factory.mktemp("config") / "tiny.yaml"
    file.write_text(CONFIG)
    return list(make_plan(load_sweep(file)).nodes)


@pytest.fixture(scope="module")
def sweep_folder(nodes: list[Node], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two stages; of its six runs one failed and the last has not begun."""
    storage = tmp_path_factory.mktemp("results")
    file = storage / "tiny.yaml"
    file.write_text(CONFIG)
    with Tracker(
        sweep_name="tiny", storage=str(storage), config=load_sweep(file).document
    ) as tracker:
        for number, node in enumerate(nodes[:-1]):
            failed = node is nodes[FAILED]
            reports = [
                Report(
                    env_steps=step,
                    seconds=step,
                    timestamp_ms=1_700_000_000_000 + 1000 * step + number,
                    metrics=values(node, step),
                )
                for step in (STEPS[:2] if failed else STEPS)
            ]
            stored = StoredRun(reports)
            if failed:
                stored = StoredRun(reports, None, "FAILED", {names.TAG_FAILURE: FAILURE})
            tracker.mirror(run_info(node), partial(StoredRun, *stored))
        tracker.put_sweep_artefact(names.ARTEFACT_SEARCH, json.dumps(SEARCHES))
    return storage / "tiny"


@pytest.fixture(scope="module")
def page(sweep_folder: Path) -> Path:
    """As a user makes it."""
    done = subprocess.run(
        [sys.executable, "-m", "music_rllib.report", str(sweep_folder)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    path = sweep_folder / "report" / PAGE
    picture = path.parent / "figures" / "overview.png"
    assert done.stdout.splitlines()[-2:] == [f"Report: {path}", f"Picture: {picture}"]
    assert picture.is_file()
    assert "missing: 1 run not begun: finetune/" in done.stdout
    assert "finetune: No winner on FetchPush" in done.stdout
    return path


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def check_content(sweep: Sweep, nodes: list[Node]) -> None:
    """Everything that was logged, and nothing else."""
    assert [record.node_key for record in sweep.runs] == [node.key for node in nodes[:-1]]
    assert [record.status for record in sweep.runs[FAILED:]] == ["FAILED", "FINISHED"]
    assert sweep.runs[FAILED].failure == FAILURE
    assert sweep.runs[0].budget == 100_000
    assert "init_from: pretrain" in str(sweep.config)
    for position, node in enumerate(nodes[:-1]):
        logged = STEPS[:2] if position == FAILED else STEPS
        for metric in values(node, STEPS[0]):
            steps, found = sweep.series(position, metric)
            assert steps.tolist() == list(logged)
            np.testing.assert_array_equal(found, [values(node, step)[metric] for step in logged])
        assert sweep.last_step(position) == logged[-1]
    assert sweep.history[names.EVAL_SUCCESS].time[0] == round((1.7e9 + STEPS[0]) * 1000)


# Reading ----------------------------------------------------------------------------------------


def test_what_was_logged_is_what_is_read(
    sweep_folder: Path, nodes: list[Node], tmp_path: Path
) -> None:
    check_content(find_sweep(str(sweep_folder)).sweep, nodes)
    by_name = find_sweep("tiny", storage=str(sweep_folder.parent), metrics=[names.MI_BOUND])
    assert set(by_name.sweep.history) == {names.MI_BOUND}
    assert by_name.undelivered == 0
    (tmp_path / "latest").symlink_to(sweep_folder)
    assert find_sweep(str(tmp_path / "latest")).folder == sweep_folder


@pytest.mark.parametrize("table_format", get_args(Format))
def test_an_exported_sweep_is_the_same_sweep(
    table_format: str, sweep_folder: Path, nodes: list[Node], tmp_path: Path
) -> None:
    exported = tmp_path / "published"
    assert run(sweep_folder, "--export", exported, "--format", table_format).exit_code == 0
    check_content(read_archive(exported), nodes)
    original, again = find_sweep(str(sweep_folder)).sweep, read_archive(exported)
    assert [vars(record) for record in again.runs] == [vars(record) for record in original.runs]
    assert {f"metrics.{table_format}", f"runs.{table_format}", "sweep.json", "search.json"} == {
        path.name for path in exported.iterdir()
    }
    assert str(sweep_folder.parent) not in (exported / "sweep.json").read_text()
    assert list(original.searches) == SEARCHES
    assert again.searches == [SEARCHES[0] | {"storage": "sqlite:///studies/all.db"}]
    (exported / f"metrics.{table_format}").unlink()
    broken = run(exported)
    assert broken.exit_code == 2
    assert f"{exported} must hold an exported sweep" in broken.stderr


def test_an_export_of_another_sweep_is_not_replaced(sweep_folder: Path, tmp_path: Path) -> None:
    exported = tmp_path / "published"
    assert run(sweep_folder, "--export", exported).exit_code == 0
    write_archive(dataclasses.replace(read_archive(exported), name="other"), exported)
    for options in ((), ("--add",)):
        refused = run(sweep_folder, "--export", exported, *options)
        assert (refused.exit_code, "it has 'other', not 'tiny'" in refused.stderr) == (2, True)
    (exported / "runs.parquet").unlink()  # as an interrupted export leaves it
    assert run(sweep_folder, "--export", exported, "--add").exit_code == 2
    assert run(sweep_folder, "--export", exported).exit_code == 0
    assert read_archive(exported).name == "tiny"


def test_the_page_shows_what_a_search_found(page: Path) -> None:
    text = re.sub(r"<[^>]+>", "|", page.read_text().partition("Search of stage")[2])
    cells = [cell for cell in text.split("|") if cell.strip()]
    assert "trials: 1 judged, 1 pruned." in text
    ranked = cells[cells.index("Best is better with") + 1 :]
    assert ranked[:8] == ["1", "0", "1.25", "0.69", "0.50 to 0.75", "2", "0.81", "–"]
    assert "failed: no memory" in ranked
    assert ranked[ranked.index(Q) + 1] == "90 %"
    assert "0.1 is not among the best &lt;2&gt;" in ranked


def test_a_report_needs_neither_ray_nor_mlflow_for_an_exported_sweep(
    sweep_folder: Path, page: Path, tmp_path: Path
) -> None:
    exported = tmp_path / "published"
    run(sweep_folder, "--export", exported)
    code = (
        "import sys; sys.modules['ray'] = sys.modules['mlflow'] = None\n"
        "from music_rllib.report.cli import app; app(sys.argv[1:], standalone_mode=False)"
    )
    command = [sys.executable, "-c", code, str(exported)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    for name in ("final", "runs", "curves"):
        tables = (page.parent, exported / "report")
        one, other = ((folder / "tables" / f"{name}.csv").read_text() for folder in tables)
        assert one == other


def test_the_report_is_attached_to_the_sweep_s_run(sweep_folder: Path, page: Path) -> None:
    """`page` is made first: both write the same files."""
    done = run(sweep_folder, "--attach")
    sweep = find_sweep(str(sweep_folder)).sweep
    assert f"Attached to the sweep's run in MLflow: run {sweep.run_id}" in done.stdout
    kept = sweep_folder.parent / "mlartifacts" / "tiny" / sweep.run_id / "artifacts" / "report"
    assert (kept / PAGE).read_bytes() == page.read_bytes()
    assert (kept / "figures" / "finetune-success-rate.svg").is_file()


def test_a_report_on_a_database_that_is_being_made_waits_for_its_tables(tmp_path: Path) -> None:
    """Two that make MLflow's tables at a time crash each other, the sweep too."""
    store = resolve_store(None, str(tmp_path))
    make = "import sys; from music_rllib.tracking.tracker import Tracker; "
    make += "Tracker(sweep_name='s', storage=sys.argv[1], config={}).__enter__().close('FINISHED')"
    command = [sys.executable, "-c", make, str(tmp_path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as sweep:
        while not (tmp_path / "mlflow.db").exists():
            assert sweep.poll() is None
        with pytest.raises(ReportError, match="must be a sweep in MLflow"):
            read_mlflow(store, "none")
        _, errors = sweep.communicate(timeout=120)
        assert (sweep.returncode, "Traceback" in errors) == (0, False)


def test_there_is_no_such_sweep(sweep_folder: Path, tmp_path: Path) -> None:
    other = run("other", "--storage", sweep_folder.parent)
    assert other.exit_code == 2
    assert "'other' must be a sweep in MLflow at sqlite:///" in other.stderr
    assert "It has: tiny." in other.stderr
    nothing = run("tiny", "--storage", tmp_path)
    assert nothing.exit_code == 2
    assert f"{tmp_path}/mlflow.db must be the sqlite file" in nothing.stderr
    # A folder is not taken for the name of a sweep in the storage.
    for place in (f"{tmp_path}/tiny", "..", "~nobody-at-all/tiny"):
        nowhere = run(place, "--storage", sweep_folder.parent)
        assert nowhere.exit_code == 2
        assert nowhere.stderr.startswith("error: ")
        assert "sqlite" not in nowhere.stderr
    assert run("x" * 300, "--serve").exit_code == 2
    assert not list(tmp_path.iterdir())


@pytest.fixture
def server(sweep_folder: Path) -> Iterator[str]:
    with MlflowServer(sweep_folder.parent) as server:
        yield server.uri


def test_a_server_gives_the_same_as_its_database(server: str, nodes: list[Node]) -> None:
    sweep = read_mlflow(resolve_store(server, "unused"), "tiny")
    check_content(sweep, nodes)
    assert sweep.url(sweep.run_id) == f"{server}/#/experiments/{sweep.experiment_id}/runs/" + (
        sweep.run_id
    )


def test_its_tables_alone_give_the_same_as_mlflow(
    sweep_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = resolve_store(None, str(sweep_folder.parent))

    def found() -> tuple[object, ...]:
        sweep = read_mlflow(store, "tiny")
        orders = [(list(run.params), list(run.tags)) for run in sweep.runs]
        history = {
            name: [getattr(column, part).tolist() for part in ("run", "step", "value", "time")]
            for name, column in sweep.history.items()
        }
        return dataclasses.replace(sweep, history={}), orders, history

    file = sweep_folder.parent / "mlflow.db"
    assert read_tables(file, "tiny", None) is not None
    assert read_tables(file, "other", None) is None
    without = found()
    monkeypatch.setattr(from_mlflow, "read_tables", lambda *_: None)
    assert repr(without) == repr(found())  # NaN is not equal to itself
    (sweep_folder.parent / "not.db").write_bytes(b"no database" * 99)
    assert read_tables(sweep_folder.parent / "not.db", "tiny", None) is None


# In a browser -----------------------------------------------------------------------------------

_OWN = "not an origin"


class Browser:
    """Headless Chromium, each time with a profile of its own."""

    def __init__(self, program: Path, folder: Path) -> None:
        self._program = program
        self._folder = folder

    def open(self, page: Path, *, dark: bool = False) -> str:
        """The page's elements once it is loaded; `console` and `requests` say what happened."""
        shutil.rmtree(self._folder / "profile", ignore_errors=True)
        log = self._folder / "net.json"
        done = subprocess.run(
            [
                self._program,
                *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"),
                *("--disable-background-networking", "--disable-component-update"),
                *("--disable-sync", "--hide-scrollbars", "--enable-logging=stderr"),
                f"--user-data-dir={self._folder / 'profile'}",
                f"--log-net-log={log}",
                # Whatever asks for the network gets no answer.
                "--host-resolver-rules=MAP * ~NOTFOUND",
                "--window-size=1300,2400",
                f"--blink-settings=preferredColorScheme={0 if dark else 1}",
                "--dump-dom",
                page.as_uri(),
            ],
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
        self.console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
        self.requests = {
            found["url"]
            for event in json.loads(log.read_text())["events"]
            if not (found := event.get("params", {})).get("url", "file:").startswith("file:")
            # Chromium asks for its own updates, whatever its options say.
            and found.get("initiator", _OWN) != _OWN
        }
        return done.stdout


@pytest.fixture
def browser(require_service: Callable[[str], Path], tmp_path: Path) -> Browser:
    return Browser(require_service("chromium"), tmp_path)


def test_the_page_opens_without_an_error_and_without_the_network(
    browser: Browser, page: Path
) -> None:
    dom = browser.open(page)
    assert not browser.console
    assert not browser.requests
    for title in ("success-rate", "mutual-information-bound", "tsallis-entropy-of-the-policy"):
        assert f'<div class="static" id="finetune-{title}"' in dom
    assert "the &lt;simulation&gt; broke" in dom


def test_the_console_and_the_network_are_watched(browser: Browser, tmp_path: Path) -> None:
    """The test above could not fail otherwise."""
    bad = tmp_path / "bad.html"
    bad.write_text('<img src="http://127.0.0.1:9/x.png"><script>nothing.there()</script>')
    browser.open(bad)
    assert any("nothing is not defined" in line for line in browser.console)
    assert browser.requests == {"http://127.0.0.1:9/x.png"}


SCRIPT = """"'><script>document.body.dataset.ran = 1</script>
<img src=x onerror="document.body.dataset.ran = 1"><svg onload="document.body.dataset.ran = 1">"""


@pytest.fixture(scope="module")
def hostile_store(sweep_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Somebody's MLflow, with a script in each tag, param and name that a report shows."""
    copy = tmp_path_factory.mktemp("hostile") / "mlflow.db"
    shutil.copy(sweep_folder.parent / "mlflow.db", copy)
    shown = (names.TAG_STAGE, names.TAG_TASK, names.TAG_ENTROPIC_INDEX, names.TAG_FAILURE)
    with contextlib.closing(sqlite3.connect(copy)) as database, database:
        database.execute("update params set value = value || ?", [SCRIPT])
        database.execute("update runs set name = name || ?", [SCRIPT])
        for tag in (*shown, names.TAG_VARIANT, names.TAG_GIT_COMMIT):
            database.execute("update tags set value = value || ? where key = ?", [SCRIPT, tag])
    return f"sqlite:///{copy}"


@pytest.mark.parametrize("kind", ["store", "export"])
def test_a_script_in_somebody_s_sweep_does_not_run(
    browser: Browser, hostile_store: str, sweep_folder: Path, tmp_path: Path, kind: str
) -> None:
    place: list[str | Path] = ["tiny", "--tracking-uri", hostile_store]
    if kind == "export":
        assert run(*place, "--export", tmp_path / "published").exit_code == 0
        place = [tmp_path / "published"]
    made = run(*place, "--output", tmp_path / "report")
    assert made.exit_code == 0, made.output
    page = tmp_path / "report" / PAGE
    # Without the page's policy, which would stop a script that got into it.
    bare = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text())
    (tmp_path / "bare.html").write_text(bare)
    for one in (page, tmp_path / "bare.html"):
        dom = browser.open(one)
        assert "data-ran" not in dom.partition("<body")[2].partition(">")[0]
        assert dom.count("&lt;script&gt;") > 20
        assert not browser.console
        assert not browser.requests


def test_the_page_s_policy_stops_a_script_that_got_into_it(
    browser: Browser, page: Path, tmp_path: Path
) -> None:
    """And the test above could not fail otherwise."""
    injected = page.read_text().replace("</body>", f"{SCRIPT}</body>")
    (tmp_path / "injected.html").write_text(injected)
    assert "<body>" in browser.open(tmp_path / "injected.html")
    assert any("Content Security Policy" in line for line in browser.console)
    bare = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", injected)
    (tmp_path / "bare.html").write_text(bare)
    assert '<body data-ran="1">' in browser.open(tmp_path / "bare.html")
