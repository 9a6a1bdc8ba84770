"""Sweeps with a local Ray that fail, are stopped or killed, and one without success rates.

One in which nothing goes wrong is in test_sweep_finished.py.
"""

import json
import re
import signal
from collections.abc import Callable
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import pytest

from music_rllib import names
from music_rllib.sweep.cli import main
from tests.integration.conftest import call, listening, metric_steps, rows

pytestmark = pytest.mark.integration

Document = dict[str, Any]
Runs = Callable[[], dict[str, Any]]


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
        code, said, errors = call(main, tmp_path, command, "points", "--storage", "results")
        assert (code, errors) == (0, "")
        assert words in said


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
