"""The `report` command on a sweep in its storage and on its exports."""

from __future__ import annotations

import dataclasses
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import psutil
import pytest
from typer.testing import CliRunner, Result

from music_rllib import names
from music_rllib.experiment.open_sweep import open_sweep
from music_rllib.experiment.plan import Node, make_plan
from music_rllib.experiment.record import keep_record
from music_rllib.experiment.scheduler import Failure
from music_rllib.program import app
from music_rllib.report.build import PAGE
from music_rllib.results.archive import Format, read_archive, write_archive
from music_rllib.results.data import Sweep
from music_rllib.results.read import read_sweep
from music_rllib.results.search_tables import search_tables
from music_rllib.store.history import HISTORY, Report, RunResult, last_values, to_json_lines
from music_rllib.sweep.listeners.state_file import StateFile
from tests.processes import fresh, wait_until
from tests.sweep_files import loaded

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
JUDGED = {"state": "judged", "values": {Q: 1.5}, "objective": [0.5], "reason": None}
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
                    *(JUDGED | {"number": number} for number in range(3, 12)),
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
"""The search, as in `search.json`."""
FAILED = 3
"""Position of the run that failed."""
FAILURE = "ValueError: the <simulation> broke"
CODE = {names.TAG_GIT_COMMIT: "c0ffee"}


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
    return list(make_plan(loaded(tmp_path_factory.mktemp("config"), CONFIG)).nodes)


@pytest.fixture(scope="module")
def sweep_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two stages; one of its six runs failed, and the last one has not started."""
    storage = tmp_path_factory.mktemp("results")
    config = loaded(storage, CONFIG, storage=str(storage))
    sweep = open_sweep(config, make_plan(config), str(storage))
    keep_record(sweep)
    with StateFile(sweep) as state_file:
        for number, node in enumerate(sweep.plan.nodes[:-1]):
            made = tmp_path_factory.mktemp("made")
            reports = [
                Report(
                    env_steps=step,
                    seconds=step,
                    timestamp_ms=1_700_000_000_000 + 1000 * step + number,
                    metrics=values(node, step),
                )
                for step in (STEPS[:2] if number == FAILED else STEPS)
            ]
            (made / HISTORY).write_bytes(to_json_lines(reports))
            if number == FAILED:
                with sweep.store.work_folder(node.key).new_checkpoint(STEPS[1]) as draft:
                    shutil.copy(made / HISTORY, draft.folder)
                state_file.failed(node, Failure(FAILURE, storage / "log"))
                continue
            last = last_values(reports)
            result = RunResult(label=node.label, env_steps=STEPS[-1], seconds=1.0, metrics=last)
            sweep.store.publish(node.key, made, result, provenance=CODE)
        state_file.end("failed")
    return storage / "tiny"


@pytest.fixture(scope="module")
def searched(sweep_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export of the same sweep that also has the results of a search."""
    folder = tmp_path_factory.mktemp("searched")
    sweep = read_sweep(str(sweep_folder)).sweep
    write_archive(dataclasses.replace(sweep, searches=SEARCHES), folder)
    return folder


@pytest.fixture(scope="module")
def page(sweep_folder: Path) -> Path:
    """The report of the command in an environment without Ray and MLflow."""
    code = (
        "import sys; sys.modules['ray'] = sys.modules['mlflow'] = None\n"
        "from music_rllib.program import main; sys.exit(main(['report', *sys.argv[1:]]))"
    )
    done = fresh("-c", code, sweep_folder)
    assert not done.stderr
    path = sweep_folder / "report" / PAGE
    picture = path.parent / "figures" / "overview.png"
    assert done.stdout.splitlines()[-2:] == [f"Report: {path}", f"Picture: {picture}"]
    assert picture.is_file()
    assert "missing: 1 run not begun: finetune/" in done.stdout
    assert "No comparison was planned in advance" in done.stdout
    return path


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


def check_content(sweep: Sweep, nodes: list[Node]) -> None:
    """Check that the sweep has exactly the reported results."""
    begun = [run for run in sweep.runs if run.status != "SCHEDULED"]
    assert [record.node_key for record in begun] == [node.key for node in nodes[:-1]]
    assert [record.status for record in begun[FAILED:]] == ["FAILED", "FINISHED"]
    assert begun[FAILED].failure == FAILURE
    assert begun[0].budget == 100_000
    assert begun[0].tags[names.TAG_GIT_COMMIT] == "c0ffee"
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


def test_a_stored_sweep_is_read_as_it_was_reported(
    sweep_folder: Path, nodes: list[Node], tmp_path: Path
) -> None:
    check_content(read_sweep(str(sweep_folder)).sweep, nodes)
    by_name = read_sweep("tiny", str(sweep_folder.parent), metrics=[names.MI_BOUND])
    assert set(by_name.sweep.history) == {names.MI_BOUND}
    (tmp_path / "latest").symlink_to(sweep_folder)
    assert read_sweep(str(tmp_path / "latest")).folder == sweep_folder


@pytest.mark.parametrize("table_format", get_args(Format))
def test_an_export_has_the_same_runs_and_values(
    table_format: str, sweep_folder: Path, nodes: list[Node], tmp_path: Path
) -> None:
    exported = tmp_path / "published"
    assert run(sweep_folder, "--export", exported, "--format", table_format).exit_code == 0
    check_content(read_archive(exported), nodes)
    original, again = read_sweep(str(sweep_folder)).sweep, read_archive(exported)
    assert [vars(record) for record in again.runs] == [vars(record) for record in original.runs]
    assert {f"metrics.{table_format}", f"runs.{table_format}", "sweep.json"} == {
        path.name for path in exported.iterdir()
    }
    assert str(sweep_folder.parent) not in (exported / "sweep.json").read_text()
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
    (exported / "runs.parquet").unlink()  # like an interrupted export
    assert run(sweep_folder, "--export", exported, "--add").exit_code == 2
    assert run(sweep_folder, "--export", exported).exit_code == 0
    assert read_archive(exported).name == "tiny"


def test_the_page_shows_the_results_of_a_search(searched: Path, tmp_path: Path) -> None:
    assert read_archive(searched).searches == [
        SEARCHES[0] | {"storage": "sqlite:///studies/all.db"}
    ]
    assert run(searched, "--output", tmp_path).exit_code == 0
    page = tmp_path / PAGE
    text = re.sub(r"<[^>]+>", "|", page.read_text().partition("Search of stage")[2])
    cells = [cell for cell in text.split("|") if cell.strip()]
    assert "trials: 10 scored, 1 stopped early." in text
    ranked = cells[cells.index("Probability that the best is better") + 1 :]
    assert ranked[:8] == ["1", "0", "1.25", "0.69", "0.50 to 0.75", "2", "0.81", "–"]
    assert "failed: no memory" in ranked
    assert ranked[ranked.index(Q) + 1] == "90%"
    assert "0.1 is not among the best &lt;2&gt;" in ranked
    (search,) = read_archive(searched).searches
    (arm,) = search["arms"]
    fewer = {**search, "arms": [{**arm, "trials": arm["trials"][1:]}]}
    titles = [
        [table.title for table in search_tables(one) if table.rows] for one in (search, fewer)
    ]
    assert titles == [
        ["Ranking on fresh seeds", "Importance of the settings", "Trials"],
        ["Ranking on fresh seeds", "Trials"],
    ]


def test_the_report_of_an_export_has_the_same_tables(
    sweep_folder: Path, page: Path, tmp_path: Path
) -> None:
    exported = tmp_path / "published"
    run(sweep_folder, "--export", exported)
    assert run(exported).exit_code == 0
    for name in ("final", "runs", "curves"):
        tables = (page.parent, exported / "report")
        one, other = ((folder / "tables" / f"{name}.csv").read_text() for folder in tables)
        assert one == other


def test_a_sweep_that_does_not_exist_or_fit_is_refused(sweep_folder: Path, tmp_path: Path) -> None:
    other = run("other", "--storage", sweep_folder.parent)
    assert other.exit_code == 2
    assert "SWEEP must be a sweep that was started, got other" in other.stderr
    assert "(sweeps there: tiny)" in other.stderr
    # A folder does not name a sweep in the storage.
    for place in (f"{tmp_path}/tiny", "..", "~nobody-at-all/tiny"):
        nowhere = run(place, "--storage", sweep_folder.parent)
        assert (nowhere.exit_code, nowhere.stderr.startswith("error: ")) == (2, True)
    assert run("x" * 300, "--serve").exit_code == 2
    exported = run(sweep_folder, "--export", tmp_path / "published")
    assert exported.exit_code == 0
    refused = run(tmp_path / "published", "--attach", "--no-videos")
    assert (refused.exit_code, "--attach must be given with a sweep in its" in refused.stderr) == (
        2,
        True,
    )
    never = run(sweep_folder, "--attach", "--no-videos")
    assert (never.exit_code, "a sweep that was tracked" in never.stderr) == (2, True)


def test_drawing_processes_end_with_the_command(tmp_path: Path) -> None:
    export = Path(__file__).parents[3] / "docs/results/data/joint-pick"
    command = [sys.executable, "-m", "music_rllib", "report", str(export), "--no-videos"]
    with subprocess.Popen([*command, "--output", str(tmp_path / "report")]) as process:
        drawing = wait_until(psutil.Process(process.pid).children, 60)
        process.terminate()
    wait_until(lambda: not any(one.is_running() and one.status() != "zombie" for one in drawing), 9)
