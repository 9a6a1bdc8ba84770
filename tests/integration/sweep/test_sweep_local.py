"""Sweeps with a local Ray that fail, are stopped or killed; tasks without success rates.

One in which nothing goes wrong is in test_sweep_finished.py.
"""

import json
import re
import shutil
import signal
from collections.abc import Callable
from ipaddress import ip_address
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from music_rllib import names
from music_rllib.program import main
from tests.integration.conftest import (
    ENVIRONMENTS,
    POINT,
    REPOSITORY,
    SWEEP,
    Program,
    call,
    listening,
    metric_steps,
    mlflow_runs_of,
    program_environment,
    rows,
)

pytestmark = pytest.mark.integration

Document = dict[str, Any]
Runs = Callable[[], dict[str, Any]]


class Ended(NamedTuple):
    """A sweep that has ended, and what it said."""

    folder: Path
    code: int
    output: str
    errors: str


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """A sweep on two tasks without success, one of which fails in its 300th step.

    Their module lies beside the file, in another folder than the current one, as do some with the
    names of Python's own.
    """
    point = POINT | {"success_key": None}
    document = SWEEP | {
        "tasks": ["Broken", "Point"],
        "environments": {"Broken": point | {"env_kwargs": {"fail_at": 300}}, "Point": point},
        "defaults": SWEEP["defaults"] | {"env_steps": 800},
    }
    folder = tmp_path_factory.mktemp("ended")
    program = Program(folder, program_environment(), "lab/sweep.yaml")
    (folder / "lab").mkdir()
    program.write(document)
    shutil.copy(ENVIRONMENTS / "point_env.py", folder / "lab")
    for name in ("random", "types", "queue", "secrets"):
        (folder / "lab" / f"{name}.py").write_text("raise RuntimeError('not this one')")
    # `python -m` finds modules in the current folder first, where `music-rllib` does not.
    program.environment |= {"PYTHONPATH": str(REPOSITORY), "PYTHONSAFEPATH": "1"}
    program.environment[names.VARIABLE_REPORT] = "on"
    program.environment["POINT_SAYS"] = (
        "look at postgresql://me:planted-1@db/screws "
        "(password=planted-2, 'token': 'planted-3') \x1b[2J"
    )
    return Ended(program.folder, *program.run())


def test_a_failure_is_explained_and_the_others_finish(ended: Ended) -> None:
    assert (ended.code, ended.errors) == (1, "")
    output = ended.output
    assert "pretrain/Broken/seed0: FAILED: RuntimeError: the gripper fell off" in output
    assert "look at postgresql://db/screws (password=***, 'token': '***') \\u001b[2J" in output
    assert "finetune/Broken/q=1/seed0: skipped, it starts from pretrain/Broken/seed0" in output
    assert [(row[0].split("/")[1], row[-1]) for row in rows(output)] == [
        ("Broken", "failed"),
        ("Point", "finished"),
        *[("Broken", "skipped"), ("Point", "finished")] * 2,
    ]
    log = Path(re.findall(r"whole traceback: (.*)", output)[0])
    text = log.read_text()
    assert 'raise RuntimeError(f"the gripper fell off' in text
    assert "point_env.py" in text
    runs = mlflow_runs_of(ended.folder)
    failed = runs["seed 0 Broken pretrain"]
    assert failed.info.status == "FAILED"
    assert failed.data.tags[names.TAG_FAILURE].startswith("RuntimeError: the gripper fell off")
    assert not [name for name in runs if "Broken finetune" in name]
    # What the environment said holds passwords: they are in no byte of what is kept and shown.
    files = [file for file in ended.folder.rglob("*") if file.is_file()]
    assert [file for file in files if b"planted-" in file.read_bytes()] == []
    assert "planted-" not in output


def test_tasks_without_success_show_their_return_from_the_first_line_to_the_report(
    ended: Ended,
) -> None:
    folder, output = ended.folder, ended.output
    assert re.search(r"400 of 800 env steps.*, return -\d", output)
    assert re.search(r"finished, return -\d", output)
    assert "success" not in output.replace(str(folder), "")
    assert all(float(row[1]) < 0 for row in rows(output) if row[-1] == "finished")
    for run in mlflow_runs_of(folder).values():
        assert names.EVAL_SUCCESS not in run.data.metrics
    report = folder / "results" / "points" / "report"
    page = (report / "report.html").read_text()
    assert "Nothing was evaluated" not in page
    assert 'id="finetune-return"' in page
    assert (report / "figures" / "finetune-final-return.svg").is_file()
    table = (report / "tables" / "final.csv").read_text()
    assert len(re.findall(r"finetune,Point,q = \d,return,-\d", table)) == 2
    for command, words in (
        ("status", "Best so far: finetune q = "),
        ("compare", "Metric: mean return over 800 steps"),
    ):
        code, said, errors = call(main, folder, command, "points", "--storage", "results")
        assert (code, errors) == (0, "")
        assert words in said


def test_two_drivers_of_one_sweep_stopped_killed_and_continued(
    sweep_program: Any,
    sweep_document: Document,
    mlflow_runs: Runs,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(ENVIRONMENTS)
    fast = tmp_path / "fast"
    sweep_document["environments"]["Point"] |= {
        "env_id": "point_env:Paced-v0",
        # It does not end before the other driver has begun.
        "env_kwargs": {"fast": str(fast), "after": 140, "seconds": 0.2},
    }
    sweep_document["defaults"] |= {
        "env_steps": 2000,
        "evaluation": {"interval": 200, "episodes": 2},
    }
    sweep_document["stages"] = sweep_document["stages"][:1]
    sweep_document |= {"seeds": [0, 1], "resources": {"num_cpus": 1}}
    sweep_program.write(sweep_document)

    one = sweep_program.start_until(" 200 of 2,000 env steps")
    places = listening(one)
    assert "raylet" in set.union(*places.values())
    assert all(ip_address(place.removeprefix("::ffff:")).is_loopback for place in places), places
    other = sweep_program.start_until("seed1: 200 of 2,000 env steps")
    code, _, errors = call(main, tmp_path, "run", "sweep.yaml", "--retrain", "seed0")
    assert code == 2
    assert "given while no other process runs points, got sweep 'points' (process" in errors
    one.send_signal(signal.SIGINT)
    output, errors = one.communicate(timeout=60)
    assert (one.returncode, errors) == (130, "")
    assert "continue with: python -m music_rllib.sweep run sweep.yaml" in output
    assert [row[-1] for row in rows(output)] == ["interrupted", "not started"]
    other.kill()
    other.communicate()

    one = sweep_program.start_until("seed0: continues at ")
    other = sweep_program.start_until("seed1: continues at ")
    fast.touch()
    for process in (one, other):
        output, errors = process.communicate(timeout=240)
        assert (process.returncode, errors) == (0, "")
        assert [row[-1] for row in rows(output)] == ["finished", "finished"]
    evaluated = list(range(0, 2001, 200))
    for seed in (0, 1):
        assert metric_steps(tmp_path, mlflow_runs()[f"seed {seed} Point pretrain"]) == evaluated
    assert list((tmp_path / "results" / "work").iterdir()) == []
    for node in (tmp_path / "results" / "nodes").iterdir():
        history = [json.loads(line) for line in (node / "history.jsonl").read_text().splitlines()]
        assert [report["env_steps"] for report in history] == evaluated
        seconds = [report["seconds"] for report in history]
        assert seconds == sorted(seconds)
