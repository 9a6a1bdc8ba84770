"""Sweeps with a local Ray that fail or are killed; tasks without success rates.

A sweep without problems is in test_first_hour.py.
"""

import json
import re
import shutil
import stat
import subprocess
import time
from collections.abc import Callable, Iterator
from ipaddress import ip_address
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import requests

from music_rllib import names
from music_rllib.program import main
from music_rllib.sweep.listeners.prometheus import TARGETS
from tests.faults import sweeps
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
from tests.integration.mlflow_server import USER, server_script
from tests.integration.report.test_dashboards import (
    DASHBOARD_SECONDS,
    Prometheus,
    prometheus,
    queries,
    variables,
)

__all__ = ["prometheus"]

pytestmark = pytest.mark.integration


PASSWORD = "planted-mlflow-password"
PLANTED = {
    "MLFLOW_TRACKING_USERNAME": USER,
    "MLFLOW_TRACKING_PASSWORD": PASSWORD,
    "AWS_SECRET_ACCESS_KEY": "planted-aws-key",
    "MUSIC_RLLIB_SERVE_TOKEN": "planted-serve-token",
    "RAY_AUTH_TOKEN": "planted-ray-token-" + "0" * 32,
    "RAY_AUTH_MODE": "token",
}


class Ended(NamedTuple):
    """A sweep that has ended, and its output."""

    folder: Path
    server: str
    code: int
    output: str
    errors: str

    def runs(self) -> dict[str, Any]:
        """All runs in MLflow by name."""
        return mlflow_runs_of(self.folder, "server/runs.db")


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ended]:
    """A sweep on two tasks without success; one of them fails in its 300th step.

    Their module is next to the file, outside the current folder, as are modules with the names of
    Python's own. MLflow is a server with a password.
    """
    folder = tmp_path_factory.mktemp("ended")
    program = Program(folder, program_environment(), "lab/sweep.yaml")
    (folder / "lab").mkdir()
    shutil.copy(ENVIRONMENTS / "point_env.py", folder / "lab")
    for name in ("random", "types", "queue", "secrets"):
        (folder / "lab" / f"{name}.py").write_text("raise RuntimeError('not this one')")
    # `python -m` searches the current folder first, `music-rllib` does not.
    program.environment |= {"PYTHONPATH": str(REPOSITORY), "PYTHONSAFEPATH": "1"}
    program.environment[names.VARIABLE_REPORT] = "on"
    program.environment["POINT_SAYS"] = (
        "look at postgresql://me:planted-1@db/screws "
        "(password=planted-2, 'token': 'planted-3') \x1b[2J"
    )
    point = POINT | {"success_key": None}
    with server_script(folder / "server", PASSWORD) as server:
        document = SWEEP | {
            "tasks": ["Broken", "Point"],
            "environments": {"Broken": point | {"env_kwargs": {"fail_at": 300}}, "Point": point},
            "defaults": SWEEP["defaults"] | {"env_steps": 800},
            "resources": {"num_cpus": 1},
            "mlflow": {"tracking_uri": server},
        }
        program.write(document)
        program.environment |= PLANTED
        yield Ended(folder, server, *program.run())


def test_a_failure_is_explained_and_the_others_finish(ended: Ended) -> None:
    assert (ended.code, ended.errors) == (1, "")
    output = ended.output
    assert "pretrain/Broken/seed0: FAILED: GripperError: the gripper fell off" in output
    assert "look at postgresql://db/screws (password=***, 'token': '***') \\u001b[2J" in output
    assert "finetune/Broken/q=1/seed0: skipped, it starts from pretrain/Broken/seed0" in output
    assert [(row[0].split("/")[1], row[-1]) for row in rows(output)] == [
        ("Broken", "failed"),
        ("Point", "finished"),
        *[("Broken", "skipped"), ("Point", "finished")] * 2,
    ]
    log = Path(re.findall(r"whole traceback: (.*)", output)[0])
    text = log.read_text()
    assert 'raise GripperError("the gripper fell off' in text
    assert "point_env.py" in text
    runs = ended.runs()
    failed = runs["seed 0 Broken pretrain"]
    assert failed.info.status == "FAILED"
    assert failed.data.tags[names.TAG_FAILURE].startswith("GripperError: the gripper fell off")
    assert not [name for name in runs if "Broken finetune" in name]


def test_secrets_are_used_and_written_nowhere(ended: Ended) -> None:
    """Passwords in variables and in an environment's message."""
    url = f"{ended.server}/api/2.0/mlflow/runs/search"
    wanted: Any = {"experiment_ids": ["1"], "max_results": 50}
    assert requests.post(url, json=wanted, timeout=60).status_code == 401
    found = requests.post(url, json=wanted, auth=(USER, PASSWORD), timeout=60)
    assert len(found.json()["runs"]) == 5, "the sweep's run and those that started"
    for shown in (ended.output, found.text):
        assert "planted-" not in shown
    # The storage, the server's database, artifacts and log.
    (settings,) = ended.folder.rglob("basic_auth.ini")  # the only place where MLflow reads it
    assert stat.S_IMODE(settings.stat().st_mode) == 0o600
    files = [path for path in ended.folder.rglob("*") if path.is_file()]
    assert [path for path in files if b"planted-" in path.read_bytes()] == [settings]
    assert settings.read_text().count("planted-") == 1


def test_tasks_without_success_show_their_return_from_the_first_line_to_the_report(
    ended: Ended,
) -> None:
    folder, output = ended.folder, ended.output
    assert re.search(r"400 of 800 env steps.*, return -\d", output)
    assert re.search(r"finished, return -\d", output)
    assert "success" not in output.replace(str(folder), "")
    assert all(float(row[1]) < 0 for row in rows(output) if row[-1] == "finished")
    for run in ended.runs().values():
        assert names.EVAL_SUCCESS not in run.data.metrics
    report = folder / "results" / "points" / "report"
    page = (report / "report.html").read_text()
    # The point cannot be rendered: the page explains it.
    assert "No videos: " in page
    assert "it has no rgb_array rendering" in page
    assert "Nothing was evaluated" not in page
    assert 'id="subplots-finetune-return"' in page
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


def test_a_run_names_its_source_and_evaluate_finds_its_policy_by_label(
    ended: Ended, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ENVIRONMENTS)
    runs = ended.runs()
    tags = runs["q=1 seed 0 Point finetune"].data.tags
    assert tags[names.TAG_LABEL] == "finetune/Point/tac.entropic_index=1/seed0"
    assert tags[names.TAG_SOURCE_RUN] == runs["seed 0 Point pretrain"].info.run_id
    # The policy's file names a module, which only the user may import.
    options = ["--episodes", "2", "--json", "--env", "point_env:Point-v0"]
    code, output, errors = call(main, ended.folder, "evaluate", tags[names.TAG_LABEL], *options)
    assert (code, errors) == (0, "")
    document = json.loads(output)
    assert (document["task"], document["env_steps"]) == ("Point", 800)
    assert document["node_key"] == tags[names.TAG_NODE_KEY]


class Paced(NamedTuple):
    """A driver whose runs are slow until the file `fast` exists."""

    program: Program
    fast: Path
    driver: subprocess.Popen[str]


@pytest.fixture(scope="module")
def paced(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Paced]:
    """A sweep of two runs, one at a time, at step 200 of 2,000."""
    folder = tmp_path_factory.mktemp("paced")
    fast = folder / "fast"
    # It must not end before the other driver has started.
    kwargs = {"fast": str(fast), "after": 140, "seconds": 0.2}
    slow = POINT | {"env_id": "point_env:Paced-v0", "env_kwargs": kwargs}
    defaults = SWEEP["defaults"] | {
        "env_steps": 2000,
        "evaluation": {"interval": 200, "episodes": 2},
        "tac": SWEEP["defaults"]["tac"] | {"random_steps": 100},
    }
    program = sweeps.program(folder)
    program.write(
        SWEEP
        | {"stages": SWEEP["stages"][:1], "seeds": [0, 1], "resources": {"num_cpus": 1}}
        | {"environments": {"Point": slow}, "defaults": defaults}
    )
    try:
        yield Paced(program, fast, program.start_until(" 200 of 2,000 env steps"))
    finally:
        program.end_all()


def test_every_query_of_the_dashboard_returns_data_of_a_running_sweep(
    paced: Paced, prometheus: Callable[[Path], Prometheus]
) -> None:
    server = prometheus(paced.program.folder)
    waiting = queries()
    seen: dict[str, list[dict[str, Any]]] = {}
    deadline = time.monotonic() + DASHBOARD_SECONDS
    while waiting and time.monotonic() < deadline and paced.driver.poll() is None:
        for name, query in list(waiting.items()):
            if found := server.ask(query):
                seen[name] = found
                del waiting[name]
        time.sleep(0.5)
    assert not waiting, f"no data for {list(waiting)}"
    assert {label for metric, label in variables() if server.ask(metric)} == {"sweep", "task", "q"}
    (success,) = seen["Success rate by q and task A"]
    assert success["metric"] == {"q": "1", "stage": "pretrain", "task": "Point"}
    assert 0 <= float(success["value"][1]) <= 1
    states = {one["metric"]["state"]: float(one["value"][1]) for one in seen["Runs by state A"]}
    assert states["started"] > 0
    assert sum(states.values()) == 2
    assert seen["Failed runs A"][0]["value"][1] == "0"


def test_two_drivers_of_one_sweep_killed_and_continued(
    paced: Paced, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ENVIRONMENTS)
    program, fast, one = paced
    folder = program.folder
    results = folder / "results"
    places = listening(one)
    assert "raylet" in set.union(*places.values())
    assert all(ip_address(place.removeprefix("::ffff:")).is_loopback for place in places), places
    other = program.start_until("seed1: 200 of 2,000 env steps")
    code, _, errors = call(main, folder, "run", "sweep.yaml", "--retrain", "seed0")
    assert code == 2
    assert "given while no other process runs points, got sweep 'points' (process" in errors
    one.kill()
    one.communicate()
    third = program.start_until("seed0: continues at ")
    fast.touch()
    for process in (other, third):
        output, errors = process.communicate(timeout=240)
        assert (process.returncode, errors) == (0, "")
        assert [row[-1] for row in rows(output)] == ["finished", "finished"]
    evaluated = list(range(0, 2001, 200))
    for seed in (0, 1):
        run = mlflow_runs_of(folder)[f"seed {seed} Point pretrain"]
        assert metric_steps(folder, run) == evaluated
    assert list((results / "work").iterdir()) == []
    assert not list((results / TARGETS).iterdir()), "a sweep that has ended is not scraped"
    for node in (results / "nodes").iterdir():
        history = [json.loads(line) for line in (node / "history.jsonl").read_text().splitlines()]
        assert [report["env_steps"] for report in history] == evaluated
        seconds = [report["seconds"] for report in history]
        assert seconds == sorted(seconds)
