"""A search with a real Ray, stopped and resumed, and two drivers on PostgreSQL."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import requests
from sqlalchemy import create_engine, inspect, text

from music_rllib import names
from music_rllib.experiment.run_info import RunInfo
from music_rllib.store.storage import database_url
from music_rllib.tracking.store import resolve_store
from music_rllib.tracking.tracker import Tracker
from tests.faults import comparison
from tests.integration.mlflow_server import USER, server_script
from tests.ports import free_port
from tests.processes import fresh

pytestmark = pytest.mark.integration

Document = dict[str, Any]
ROOT = Path(__file__).parents[3]


WORTH = names.ALPHA
"""Value of a trial: a metric that depends on its alpha, so that the stopped trial is known."""
STOPPED = 3


def searched(sweep_document: Document) -> Document:
    """A search with very short runs; trial 3 is by far the worst of the first four."""
    sweep_document["seeds"] = [0, 1, 2]
    sweep_document["defaults"] |= {
        "env_steps": 400,
        "evaluation": {"interval": 200, "episodes": 2},
    }
    sweep_document["defaults"]["tac"]["random_steps"] = 100
    sweep_document["stages"] = [
        {
            "name": "train",
            "variant": "tac",
            "search": {
                "space": {
                    "tac.entropic_index": {"float": [1.0, 2.0], "step": 0.5},
                    "tac.alpha": {"float": [0.01, 0.5], "log": True},
                },
                "points_to_evaluate": [
                    {"tac.entropic_index": q, "tac.alpha": alpha}
                    for q, alpha in ((1.0, 0.4), (1.5, 0.5), (2.0, 0.3), (1.0, 0.01))
                ],
                "trials": 6,
                "startup_trials": 3,
                "objective": {"metric": WORTH, "aggregate": "mean"},
                "pruning": {"rungs": [{"seeds": 2}], "warm_up": 3},
                "final": {"trials": 1, "seeds": 2},
            },
        }
    ]
    return sweep_document


PATIENCE = 1500
"""Timeout of a command on a busy machine, in seconds."""


def command(program: Any, *arguments: str) -> tuple[int, str, str]:
    place = {"cwd": program.folder, "env": program.environment}
    done = fresh("-m", "music_rllib.sweep", *arguments, code=None, timeout=PATIENCE, **place)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.thorough
@pytest.mark.timeout(2 * PATIENCE)
def test_a_stopped_search_resumes_and_its_commands_show_it(
    sweep_program: Any, sweep_document: Document, mlflow_runs: Callable[[], Any], tmp_path: Path
) -> None:
    sweep_program.write(searched(sweep_document))
    process = sweep_program.start_until("trial0/", timeout=PATIENCE)
    code, output, errors = command(sweep_program, "stop", "results/points", "--json")
    assert (code, json.loads(output)["state"]) == (0, "stopped"), errors
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + signal.SIGINT
    code, output, _ = command(sweep_program, "status", "results/points")
    assert (code, "Sweep points: stopped" in output) == (0, True), output

    code, output, errors = command(sweep_program, "resume", "points", "--json")
    assert code == 0, errors
    state = json.loads(output)
    assert state["driver"]["outcome"] == "finished"
    check_search(sweep_program.folder / "results")
    # An uninterrupted search without runs to reuse has the same study and the same numbers.
    code, _, errors = command(sweep_program, "sweep.yaml", "--storage", "unbroken")
    assert code == 0, errors
    resumed, whole = (
        json.loads((sweep_program.folder / f"{storage}/points/search.json").read_text())[0]
        for storage in ("results", "unbroken")
    )
    assert resumed["arms"][0]["trials"] == whole["arms"][0]["trials"]
    assert resumed["ranking"] == whole["ranking"]
    assert comparison.nodes(tmp_path / "results") == comparison.nodes(tmp_path / "unbroken")
    check_commands(sweep_program)
    runs = mlflow_runs()
    parts = {run.data.tags[names.TAG_PART] for run in runs.values() if "part" in run.data.tags}
    assert {f"trial{number}" for number in range(6)} <= parts
    assert any(part.startswith("final") for part in parts)


def check_search(storage: Path) -> None:
    """Every objective is the mean over its runs in the store."""
    (found,) = json.loads((storage / "points/search.json").read_text())
    plan = json.loads((storage / "points/plan.json").read_text())
    labels = {node["label"]: node["key"] for node in plan["nodes"]}
    assert found["complete"]
    trials = found["arms"][0]["trials"]
    assert trials[STOPPED]["state"] == "pruned"
    for trial in trials:
        assert trial["state"] in {"judged", "pruned"}
        values = []
        for label, key in labels.items():
            if f"/trial{trial['number']}/" in label:
                manifest = json.loads((storage / "nodes" / key / "manifest.json").read_text())
                values.append(manifest["meta"]["result"]["metrics"][WORTH])
        if trial["state"] == "pruned":
            assert "is not among the best" in trial["reason"]
            assert len(values) == 2
            continue
        assert len(values) == 3
        assert trial["objective"] == [pytest.approx(sum(values) / 3)]
    (first,) = found["ranking"]
    assert len(first["scores"][0]) == 2


def check_commands(program: Any) -> None:
    code, output, _ = command(program, "compare", "results/points", "--json")
    assert (code, len(json.loads(output)["conditions"])) == (0, 1)
    code, output, errors = command(program, "best", "results/points", "--output", "out", "--json")
    assert code == 0, errors
    chosen = json.loads(output)
    assert chosen["on_fresh_seeds"]
    play = ("evaluate", "out", "--episodes", "2", "--json")
    code, _, errors = command(program, *play)
    assert (code, "a file doesn't choose what is imported" in errors) == (2, True)
    code, output, errors = command(program, *play, "--env", "sweep.yaml")
    assert code == 0, errors
    played = json.loads(output)
    assert (played["task"], played["node_key"]) == ("Point", chosen["policies"][0]["node"])
    assert (program.folder / "out/run.yaml").is_file()
    code, output, _ = command(program, "clean", "results/points", "--all", "--yes", "--json")
    assert (code, json.loads(output)["deleted"]) == (0, True)
    assert not (program.folder / "results/points").exists()
    assert not list((program.folder / "results/nodes").iterdir())


# --- PostgreSQL --------------------------------------------------------------------------------


@pytest.fixture
def postgresql(require_service: Callable[[str], Path], tmp_path: Path) -> Iterator[str]:
    """URL of a new server on a free port of loopback."""
    programs = require_service("postgresql").resolve().parent
    programs = programs if (programs / "initdb").exists() else postgresql_programs()
    folder = tmp_path / "postgresql"
    folder.mkdir()
    # The server refuses to run as root.
    user: list[str] = []
    if os.getuid() == 0:
        shutil.chown(folder, "nobody")
        for above in (folder, *folder.parents):
            if above.stat().st_uid == 0 and above != Path("/tmp") and above != Path("/"):
                above.chmod(above.stat().st_mode | 0o011)
        user = ["setpriv", "--reuid=nobody", "--clear-groups"]
    run = {"check": True, "capture_output": True, "timeout": 120, "cwd": folder}
    data = folder / "data"
    initdb = [*user, str(programs / "initdb"), "-D", str(data), "-U", "driver", "--no-sync"]
    subprocess.run(initdb, **run)  # type: ignore[call-overload]
    port = free_port()
    options = f"-p {port} -k {folder} -c listen_addresses=127.0.0.1 -c fsync=off"
    control = [*user, str(programs / "pg_ctl"), "-D", str(data), "-w", "-l", str(folder / "log")]
    subprocess.run([*control, "-o", options, "start"], **run)  # type: ignore[call-overload]
    try:
        yield f"postgresql://driver@127.0.0.1:{port}/postgres"
    finally:
        with contextlib.suppress(subprocess.CalledProcessError):
            stop = [*control, "-m", "immediate", "stop"]
            subprocess.run(stop, **run)  # type: ignore[call-overload]


def postgresql_programs() -> Path:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    assert found, "initdb must be beside postgres"
    return found[-1].parent


DRIVER = """
    import sys, time
    from pathlib import Path
    from tests.played_search import Driver, document

    folder = Path(sys.argv[1])
    search = {"storage": sys.argv[2], "study": "together", "trials": 24, "concurrent": 6}
    # Together: one that is ready sooner could do all before the other has begun.
    (folder / "ready").touch()
    patience = time.monotonic() + 120
    while len(list(folder.parent.glob("*/ready"))) < 2:
        assert time.monotonic() < patience, "the other driver never came"
        time.sleep(0.01)
    driver = Driver(folder, document(search), seed=int(sys.argv[3]))
    while not driver.controller.over:
        try:
            driver.play(slots=2)
        except AssertionError as error:
            assert "wait for ever" in str(error), error
            time.sleep(0.02)  # for what the other one judges
    import json
    # Not all that is in its plan: there are also the trials that had ended before it began.
    keys = {computed.split("/")[0] for computed in driver.computed}
    mine = sorted({run.part for run in driver.sweep.plan.runs if run.part and run.key in keys})
    print(json.dumps([mine, driver.trials()]))
"""


def test_a_plan_leaves_nothing_in_a_database(
    postgresql: str, sweep_program: Any, sweep_document: Document
) -> None:
    document = searched(sweep_document)
    document["stages"][0]["search"] |= {"storage": postgresql}
    sweep_program.write(document)
    code, _, complaint = command(sweep_program, "plan", "sweep.yaml")
    assert code == 0, complaint
    engine = create_engine(database_url(postgresql))
    assert inspect(engine).get_table_names() == []
    engine.dispose()


def test_two_drivers_on_postgresql_lose_and_double_no_trial(
    postgresql: str, tmp_path: Path
) -> None:
    drivers = []
    for seed, name in enumerate(("one", "other")):
        (tmp_path / name).mkdir()
        code = textwrap.dedent(DRIVER)
        arguments = [str(tmp_path / name), postgresql, str(seed)]
        drivers.append(
            subprocess.Popen(
                [sys.executable, "-c", code, *arguments],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env=os.environ | {"PYTHONPATH": str(ROOT)},
            )
        )
    ended = [driver.communicate(timeout=240) for driver in drivers]
    assert [driver.returncode for driver in drivers] == [0, 0], ended
    _check_mlflow(postgresql, tmp_path)
    found = [json.loads(output.splitlines()[-1]) for output, _ in ended]
    (mine, trials), (theirs, the_same) = found
    assert trials == the_same
    assert [trial["state"] for trial in trials] == ["judged"] * 24
    assert sorted([*mine, *theirs]) == sorted(f"trial{number}" for number in range(24)), "once each"
    assert mine
    assert theirs


def _check_mlflow(postgresql: str, folder: Path) -> None:
    """The server of `cluster/` and a direct `mlflow.tracking_uri` reach the same database."""
    from mlflow import MlflowClient

    server, _, _ = postgresql.rpartition("/")
    engine = create_engine(database_url(postgresql), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        for name in ("mlflow", "mlflow_auth"):
            connection.execute(text(f"CREATE DATABASE {name}"))
    engine.dispose()
    databases = (f"{server}/mlflow", f"{server}/mlflow_auth")
    with server_script(folder / "server", "correct-horse-battery", *databases) as uri:
        url = f"{uri}/api/2.0/mlflow/experiments/create"
        assert requests.post(url, json={"name": "shared"}, timeout=60).status_code == 401
        user = (USER, "correct-horse-battery")
        requests.post(url, json={"name": "shared"}, auth=user, timeout=60).raise_for_status()
    store = resolve_store(databases[0], str(folder))
    assert MlflowClient(store.uri).get_experiment_by_name("shared") is not None
    fields: dict[str, Any] = {"storage": str(folder), "config": {}, "tracking_uri": databases[0]}
    with Tracker(sweep_name="direct", **fields) as tracker:
        tracker.start(RunInfo(node_key="a", name="a", config={"seed": 0}))
    assert not tracker.pending()
