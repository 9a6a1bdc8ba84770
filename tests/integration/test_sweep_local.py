"""A whole sweep with a local Ray and an embedded MLflow, as a user starts it."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from mlflow import MlflowClient

from music_rllib import load_sweep, names
from music_rllib.results.archive.folder import write_archive
from music_rllib.results.from_mlflow import read_mlflow
from music_rllib.tracking.store import resolve_store
from tests.integration.conftest import listening

pytestmark = pytest.mark.integration

Document = dict[str, Any]
Runs = Callable[[], dict[str, Any]]


EXPECTED = re.compile(
    r"\[ *\d+:\d\d\] (pretrain/|finetune/|starting a local Ray$|best so far: finetune )"
    r"|(stage|run|pretrain|finetune)[ :/]|  |Sweep |Results |Storage: |3 runs, |"
    r"Compare in MLflow: |Open MLflow's pages with: "
)
"""Lines of a sweep in which nothing goes wrong."""


def rows(output: str) -> list[list[str]]:
    """Cells of the table of results."""
    table = output[output.index("Results of") :]
    lines = [line for line in table.splitlines() if re.match(r"\S*seed\d+ ", line)]
    return [re.split(r"\s{2,}", line.strip()) for line in lines]


def metric_steps(folder: Path, run: Any, name: str = names.ENV_STEPS) -> list[int]:
    client = MlflowClient(f"sqlite:///{folder}/results/mlflow.db")
    return [metric.step for metric in client.get_metric_history(run.info.run_id, name)]


def test_a_sweep_from_the_plan_to_mlflow_and_then_a_finer_one(
    sweep_program: Any, sweep_document: Document, mlflow_runs: Runs, tmp_path: Path
) -> None:
    sweep_program.environment["COLUMNS"] = "160"  # for the table's last columns
    sweep_program.write(sweep_document)
    code, output, errors = sweep_program.run()
    assert (code, errors) == (0, "")
    assert "3 runs, 3,600 env steps in all." in output
    assert output.index("Sweep points") < output.index(": started") < output.index("Results of")
    unexpected = [line for line in output.splitlines() if not EXPECTED.match(line)]
    assert unexpected == [], "the newcomer's screen"
    found = rows(output)
    runs = ["pretrain/seed0", "finetune/q=1/seed0", "finetune/q=2/seed0"]
    assert [row[0] for row in found] == runs
    assert {row[-1] for row in found} == {"finished"}
    assert all("1,200" in row for row in found)
    assert "mlflow ui --backend-store-uri" in output
    check_mlflow(mlflow_runs(), tmp_path, found)

    sweep_document["stages"][1]["grid"]["tac.entropic_index"] = [1.0, 1.5, 2.0]
    sweep_program.write(sweep_document)
    code, output, errors = sweep_program.run()
    assert (code, errors) == (0, "")
    assert "3 finished earlier and reused, 1,200 env steps left" in output
    again = rows(output)
    assert [row[-1] for row in again] == ["reused", "reused", "finished", "reused"]
    assert [row[:-1] for row in again if row[-1] == "reused"] == [row[:-1] for row in found]
    assert len(mlflow_runs()) == 1 + 4
    check_frames(tmp_path)

    code, output, errors = sweep_program.run("--name", "other")
    assert (code, errors) == (0, "")
    assert [row[-1] for row in rows(output)] == ["reused"] * 4
    assert {row[-2] for row in rows(output)}.isdisjoint({row[-2] for row in again})
    assert "-" not in {row[-2] for row in rows(output)}


def check_mlflow(runs: dict[str, Any], folder: Path, found: list[list[str]]) -> None:
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
        assert metric_steps(folder, run) == [0, 400, 800, 1200]
        assert metric_steps(folder, run, names.EVAL_SUCCESS) == [0, 400, 800, 1200]
    ids = [run.info.run_id[:8] for name, run in sorted(runs.items()) if name != "points"]
    assert sorted(ids) == sorted(row[-2] for row in found)


def check_frames(folder: Path) -> None:
    """The same from the storage, from MLflow and from an export."""
    store = f"sqlite:///{folder}/results/mlflow.db"
    write_archive(read_mlflow(resolve_store(store, "results"), "points"), folder / "export")
    read = [
        load_sweep(folder / "results" / "points"),
        load_sweep("points", tracking_uri=store),
        load_sweep(folder / "export"),
    ]
    # MLflow has the moment when it was told.
    told = {"runs": ["started", "ended"], "curves": ["time"], "conditions": []}
    order = {
        "runs": ["name"],
        "curves": ["key", "metric", "env_steps"],
        "conditions": ["stage", "q"],
    }
    for name, columns in told.items():
        first, *others = (
            getattr(one, name).drop(columns=columns).sort_values(order[name]) for one in read
        )
        assert len(first)
        for other in others:
            pd.testing.assert_frame_equal(
                first.reset_index(drop=name != "runs"), other.reset_index(drop=name != "runs")
            )


def test_a_task_without_success_shows_its_return_from_the_first_line_to_the_report(
    sweep_program: Any, sweep_document: Document, mlflow_runs: Runs, tmp_path: Path
) -> None:
    sweep_document["environments"]["Point"]["success_key"] = None
    sweep_document["defaults"] |= {"env_steps": 800}
    stage = {"name": "train", "variant": "tac", "grid": {"tac.entropic_index": [1.0, 2.0]}}
    sweep_document["stages"] = [stage]
    sweep_program.environment[names.VARIABLE_REPORT] = "on"
    sweep_program.write(sweep_document)
    code, output, errors = sweep_program.run()
    assert (code, errors) == (0, "")
    assert re.search(r"400 of 800 env steps.*, return -\d", output)
    assert re.search(r"finished, return -\d", output)
    assert "success" not in output.replace(str(tmp_path), "")
    assert all(float(row[1]) < 0 for row in rows(output))
    for run in mlflow_runs().values():
        assert names.EVAL_SUCCESS not in run.data.metrics
    page = (tmp_path / "results/points/report/report.html").read_text()
    assert "Nothing was evaluated" not in page
    assert 'id="train-return"' in page
    assert (tmp_path / "results/points/report/figures/train-final-return.svg").is_file()
    table = (tmp_path / "results/points/report/tables/final.csv").read_text()
    assert table.count(f"train,Point,{names.EVAL_RETURN},q = ") == 2
    for command, words in (
        ("status", "Best so far: train q = "),
        ("compare", f"{names.EVAL_RETURN} of train on Point"),
    ):
        said = subprocess.run(
            [sys.executable, "-m", "music_rllib.sweep", command, "points", "--storage", "results"],
            cwd=tmp_path,
            env=sweep_program.environment,
            capture_output=True,
            text=True,
            check=True,
        )
        assert words in said.stdout


def test_a_failure_is_explained_and_the_others_finish(
    sweep_program: Any, sweep_document: Document, mlflow_runs: Runs, tmp_path: Path
) -> None:
    point = sweep_document["environments"]["Point"]
    sweep_document["environments"]["Broken"] = point | {"env_kwargs": {"fail_at": 300}}
    sweep_document["tasks"] = ["Broken", "Point"]
    sweep_document["stages"][1].pop("grid")
    sweep_program.write(sweep_document)
    sweep_program.environment["POINT_SAYS"] = (
        "look at postgresql://me:planted-1@db/screws "
        "(password=planted-2, 'token': 'planted-3') \x1b[2J"
    )
    code, output, errors = sweep_program.run()
    assert (code, errors) == (1, "")
    assert "pretrain/Broken/seed0: FAILED: RuntimeError: the gripper fell off" in output
    assert "look at postgresql://db/screws (password=***, 'token': '***') \\u001b[2J" in output
    assert "finetune/Broken/seed0: skipped, it starts from pretrain/Broken/seed0" in output
    assert [(row[0].split("/")[1], row[-1]) for row in rows(output)] == [
        ("Broken", "failed"),
        ("Point", "finished"),
        ("Broken", "skipped"),
        ("Point", "finished"),
    ]
    log = Path(re.findall(r"whole traceback: (.*)", output)[0])
    text = log.read_text()
    assert 'raise RuntimeError(f"the gripper fell off' in text
    assert "point_env.py" in text
    failed = mlflow_runs()["seed 0 Broken pretrain"]
    assert failed.info.status == "FAILED"
    assert failed.data.tags[names.TAG_FAILURE].startswith("RuntimeError: the gripper fell off")
    assert "seed 0 Broken finetune" not in mlflow_runs()
    # What the environment said holds passwords: they are in no byte of what is kept and shown.
    files = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert [file for file in files if b"planted-" in file.read_bytes()] == []
    assert "planted-" not in output


def test_stopped_killed_and_continued(
    sweep_program: Any, sweep_document: Document, mlflow_runs: Runs, tmp_path: Path
) -> None:
    sweep_document["defaults"]["env_steps"] = 4000
    sweep_document["stages"] = sweep_document["stages"][:1]
    sweep_program.write(sweep_document)

    process = sweep_program.start_until(" 1,200 of 4,000 env steps")
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "")
    assert "continue with: python -m music_rllib.sweep sweep.yaml" in output
    assert [row[-1] for row in rows(output)] == ["interrupted"]

    process = sweep_program.start_until(": continues at ")
    for line in process.stdout:
        if "2,400 of" in line:
            break
    process.kill()
    process.communicate()

    code, output, errors = sweep_program.run()
    assert (code, errors) == (0, "")
    (continued,) = re.findall(r"continues at ([\d,]+) env steps", output)
    assert int(continued.replace(",", "")) >= 2000
    assert [row[-1] for row in rows(output)] == ["finished"]
    assert metric_steps(tmp_path, mlflow_runs()["seed 0 Point pretrain"]) == list(
        range(0, 4001, 400)
    )
    assert list((tmp_path / "results" / "work").iterdir()) == []
    (node,) = (tmp_path / "results" / "nodes").iterdir()
    history = [json.loads(line) for line in (node / "history.jsonl").read_text().splitlines()]
    assert [report["env_steps"] for report in history] == list(range(0, 4001, 400))
    seconds = [report["seconds"] for report in history]
    assert seconds == sorted(seconds)


def test_a_second_driver_is_refused_and_sigterm_stops_the_first_in_good_order(
    sweep_program: Any, sweep_document: Document
) -> None:
    sweep_document["defaults"]["env_steps"] = 12_000
    sweep_program.write(sweep_document)
    first = sweep_program.start_until(": started")
    places = listening(first)
    assert "raylet" in set.union(*places.values())
    assert all(ip_address(place.removeprefix("::ffff:")).is_loopback for place in places), places
    code, _, errors = sweep_program.run()
    assert code == 2
    assert "must be used by one process at a time" in errors
    first.send_signal(signal.SIGTERM)
    output, _ = first.communicate(timeout=60)
    assert first.returncode == 128 + signal.SIGTERM
    assert "continue with: python -m music_rllib.sweep sweep.yaml" in output
