"""Sub-commands on a sweep's storage: a folder or a bucket."""

from __future__ import annotations

import contextlib
import functools
import io
import itertools
import json
import operator
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow.fs as pafs
import pytest
import yaml
from fsspec.implementations.memory import MemoryFileSystem  # type: ignore[import-untyped]
from rich.console import Console

from music_rllib import names
from music_rllib.config.load import load_config
from music_rllib.errors import BadInputError
from music_rllib.experiment import open_sweep as open_sweep_module
from music_rllib.experiment import sweep_files
from music_rllib.experiment.open_sweep import (
    OpenSweep,
    changed_text,
    continued_runs_text,
    found_runs,
    open_started,
    open_sweep,
    remove_damaged,
)
from music_rllib.experiment.plan import Node, make_plan
from music_rllib.experiment.record import changes_since, keep_record
from music_rllib.experiment.scheduler import Status
from music_rllib.experiment.sweep_files import as_json
from music_rllib.names import ShortLabels
from music_rllib.program import main
from music_rllib.results.analysis import analyse
from music_rllib.results.analysis_plan import record_plan
from music_rllib.results.answer import answer, claim_rows, mean_rows
from music_rllib.results.read import read_sweep
from music_rllib.results.study import study_of
from music_rllib.results.tables import performance_tables
from music_rllib.store import lease as lease_module
from music_rllib.store import node_store
from music_rllib.store import storage as storage_module
from music_rllib.store.history import HISTORY, Report, RunResult, to_json_lines
from music_rllib.store.lease import Lease, LeaseFile
from music_rllib.store.storage import DamagedError, StorageError, StorageFolder
from music_rllib.store.work_folder import WorkFolder
from music_rllib.sweep import clean, driver, driver_lock, execution
from music_rllib.sweep.commands.run import resume
from music_rllib.sweep.export import sweep_of_run
from music_rllib.sweep.listeners.state_file import StateFile
from music_rllib.sweep.preflight import import_checkpoints
from music_rllib.sweep.views.results import console_table
from tests.handoffs import music_u, write_estimator
from tests.kept_sweep import kept_sweep
from tests.sweep_files import loaded

REPOSITORY = Path(__file__).parents[3]
SWEEP: dict[str, Any] = {
    "name": "mine",
    "tasks": ["FetchPush"],
    "seeds": [0, 1, 2],
    "defaults": {"env_steps": 4000},
    "stages": [
        {"name": "train", "variant": "tac", "grid": {"tac.entropic_index": [1.0, 1.5, 2.0]}}
    ],
}


class Said:
    """Exit code and output of the program."""

    def __init__(self, code: int, output: str, errors: str) -> None:
        self.code, self.output, self.errors = code, output, errors

    @property
    def document(self) -> Any:
        """The only JSON document of its output."""
        assert self.code == 0, self.errors
        return json.loads(self.output)


Program = Callable[..., Said]


ROOT = Path(__file__).parents[3]

IN_A_BUCKET = pytest.mark.parametrize("storage", ["folder", "bucket"], indirect=True)
"""For tests of commands that read, write or delete in the storage themselves."""


@pytest.fixture
def storage(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Storage of the sweep; the bucket is a file system without renames and folders."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    if getattr(request, "param", "folder") == "folder":
        return str(tmp_path / "results")
    # No other process writes leases here.
    monkeypatch.setattr(lease_module, "SETTLE_SECONDS", 0.0)
    memory = MemoryFileSystem()
    memory.store.clear()
    memory.pseudo_dirs[:] = [""]
    bucket = StorageFolder(pafs.PyFileSystem(pafs.FSSpecHandler(memory)), "bucket/path")
    # Import all of them first: a module imported later would keep the replacement.
    local = storage_module.open_storage
    for module in (storage_module, node_store, sweep_files, open_sweep_module, clean):
        monkeypatch.setattr(
            module, "open_storage", lambda uri: bucket if "://" in uri else local(uri)
        )
    for module in (sweep_files, storage_module):
        monkeypatch.setattr(module, "check_answers", lambda _: None)
    return "s3://bucket/path"


@pytest.fixture
def program(capsys: pytest.CaptureFixture[str]) -> Program:
    def run(*arguments: str) -> Said:
        capsys.readouterr()
        code = main(arguments)
        return Said(code, *capsys.readouterr())

    return run


def opened(storage: str, tmp_path: Path, **changes: Any) -> OpenSweep:
    config = loaded(tmp_path, SWEEP | changes, storage=storage)
    sweep = open_sweep(config, make_plan(config), storage)
    keep_record(sweep)
    return sweep


def finish(
    sweep: OpenSweep,
    state_file: StateFile,
    node: Node,
    value: float,
    folder: Path,
    metric: str = names.EVAL_SUCCESS,
) -> None:
    """As if the run had been trained."""
    metrics = {metric: value, names.EVAL_EPISODES: 20.0}
    metrics |= {names.SHANNON_ENTROPY: 0.5 - value, names.ENTROPY: 0.25 - value}
    report = Report(env_steps=4000, seconds=1.0, timestamp_ms=1, metrics=metrics)
    folder.mkdir(exist_ok=True)
    (folder / HISTORY).write_bytes(to_json_lines([report]))
    (folder / "handoff").mkdir(exist_ok=True)
    (folder / "handoff/handoff.json").write_text("{}")
    result = RunResult(label=node.label, env_steps=4000, seconds=1.0, metrics=metrics)
    sweep.store.publish(node.key, folder, result)
    sweep.scheduler.start(node.key)
    state_file.reported(node, [report])
    sweep.scheduler.finish(node.key)
    state_file.finished(node, result)


HEIGHTS = {1.0: 0.2, 1.5: 0.8, 2.0: 0.3}


def played(storage: str, tmp_path: Path, runs: int = 9, seeds: int = 3) -> OpenSweep:
    sweep = opened(storage, tmp_path, seeds=list(range(seeds)))
    with StateFile(sweep) as state_file:
        for node in list(sweep.plan.nodes)[:runs]:
            height = HEIGHTS[float(node.run.tac.entropic_index)]  # type: ignore[arg-type]
            finish(sweep, state_file, node, height + 0.02 * node.run.seed, tmp_path / "made")
        state_file.end("finished" if runs == 9 else "stopped")
    return sweep


@IN_A_BUCKET
def test_status_and_compare(storage: str, tmp_path: Path, program: Program) -> None:
    played(storage, tmp_path)
    place = f"{storage}/mine"
    state = program("status", place, "--json").document
    assert state["state"] == "finished"
    assert state["stages"][0]["runs"] == {"finished": 9}
    assert state["env_steps"] == {"done": 36_000, "left": 0, "to_come": 0}
    assert state["best"]["values"] == {"tac.entropic_index": 1.5}
    shown = program("status", "mine", "--storage", storage).output
    assert "Sweep mine: finished" in shown
    assert "Best so far: train q = 1.5: success 0.82 [" in shown
    best = program("compare", place, "--json").document["conditions"][1]
    assert (best["condition"], best["value"]) == ("q = 1.5", pytest.approx(0.82))
    text = program("compare", place).output
    assert "0.80 0.82 0.84" in text
    assert "Final entropies of the policies" in text
    assert "-0.32" in text
    assert "3 runs, entropy -0.32 nats" in in_one_line(program("status", place).output)
    bad = program("compare", place, "--metric", "nonsense")
    assert (bad.code, "--metric must be one of" in bad.errors) == (2, True)
    bad = program("compare", place, "--minimize")
    assert (bad.code, "--minimize must be given with the --metric" in bad.errors) == (2, True)


def in_one_line(text: str) -> str:
    """Without the screen's line breaks."""
    return " ".join(text.split())


def test_compare_and_the_report_say_the_same_of_the_same_sweep(
    storage: str, tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Intervals, comparisons, unfinished seeds, words: there is one definition."""
    monkeypatch.setenv("COLUMNS", "160")  # cells of narrower tables have several lines
    tasks, seeds = ["FetchPush", "FetchSlide"], list(range(6))
    sweep = opened(storage, tmp_path, tasks=tasks, seeds=seeds)
    unfinished = {(1.5, "FetchSlide", 5), (1.5, "FetchPush", 2), (2.0, "FetchPush", 0)}
    with StateFile(sweep) as state_file:
        for node in sweep.plan.nodes:
            q, task = float(node.run.tac.entropic_index), node.run.task.name  # type: ignore[arg-type]
            if (q, task, node.run.seed) not in unfinished:
                height = HEIGHTS[q] + 0.15 * (task == "FetchPush") + 0.01 * node.run.seed
                finish(sweep, state_file, node, height, tmp_path / "made")
        state_file.end("stopped")
    logged = read_sweep(f"{storage}/mine").sweep
    text = program("compare", f"{storage}/mine").output
    finals, *_ = performance_tables(analyse(logged))
    # A seed that has finished on one of two tasks counts for that task only.
    assert [row[-1] for row in finals.rows] == [12, 8, 10, 6, 5, 5, 6, 5, 6]
    console = Console(width=160, file=io.StringIO(), record=True)
    console.print(console_table(finals))
    assert in_one_line(console.export_text()) in in_one_line(text)
    document = program("compare", f"{storage}/mine", "--json").document
    study = study_of(logged)
    assert document["comparisons"] == json.loads(as_json(claim_rows(study)))
    assert document["conditions"][0]["by_seed"] == mean_rows(study)[0]["by_seed"]
    assert document["answer"] == answer(logged, study)


def test_compare_has_one_family_of_tests(storage: str, tmp_path: Path, program: Program) -> None:
    played(storage, tmp_path, runs=15, seeds=5)
    document = program("compare", f"{storage}/mine", "--json").document
    assert {row["second"]: row["verdict"] for row in document["comparisons"]}["q = 1.5"] == "worse"
    _, title, finals = program("compare", f"{storage}/mine").output.partition("Final values")
    assert title
    assert " p " not in finals, "final values have no column of p-values"


def test_compare_and_best_name_no_first_without_evidence(
    storage: str, tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{__name__}.HEIGHTS", dict.fromkeys(HEIGHTS, 0.5))
    played(storage, tmp_path)
    document = program("compare", f"{storage}/mine", "--json").document
    assert {row["why"] for row in document["comparisons"]} == {"3 seeds: no verdict below 5"}
    chosen = program("best", f"{storage}/mine", "--output", "out", "--json").document
    assert "tied with 2 more" in chosen["why"]


def test_compare_counts_unfinished_runs(storage: str, tmp_path: Path, program: Program) -> None:
    played(storage, tmp_path, runs=4)
    rows = program("compare", f"{storage}/mine", "--json").document["conditions"]
    assert [(row["seeds"], row["runs"]) for row in rows] == [(3, 3), (1, 3)]


@IN_A_BUCKET
def test_best_takes_the_middle_run_of_the_best_condition(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = played(storage, tmp_path)
    chosen = program("best", f"{storage}/mine", "--output", "out", "--json").document
    assert chosen["values"] == {"tac.entropic_index": 1.5}
    (policy,) = chosen["policies"]
    assert policy["seed"] == 1
    folder = Path(policy["folder"])
    assert (folder / "handoff/handoff.json").is_file()
    (stage,) = yaml.safe_load((folder / "run.yaml").read_text())["stages"]
    assert stage["tac"]["entropic_index"] == 1.5
    server = "mlflow.tracking_uri=http://mlflow:5000"
    plan = program("plan", str(folder / "run.yaml"), server, "--storage", storage)
    assert (plan.code, "1 finished earlier and reused, 0 env" in plan.output) == (0, True)
    assert json.loads((folder / "chosen.json").read_text())["node"] == policy["node"]
    assert policy["node"] in sweep.finished
    # An export with several tasks, and a file of the user.
    shutil.copytree(folder, folder / policy["task"])
    shutil.copytree(folder / policy["task"], folder / "mine")
    (folder / "notes.txt").touch()
    again = program("best", f"{storage}/mine", "--output", "out")
    assert not (folder / policy["task"]).exists(), "readers would find two policies"
    assert (folder / "notes.txt").exists()
    assert (folder / "mine" / "handoff").exists()
    assert (again.code, "train q = 1.5: success " in again.output) == (0, True)
    assert "entropy -0.32 nats" in again.output
    own = Path("own/handoff/thesis.txt")
    own.parent.mkdir(parents=True)
    own.touch()
    refused = program("best", f"{storage}/mine", "--output", "own")
    assert (refused.code, "handoff/ is not a policy's" in in_one_line(refused.errors)) == (2, True)
    assert own.exists()
    for options in (("best", "--output"), ("report", "--output"), ("report", "--export")):
        refused = program(options[0], f"{storage}/mine", options[1], "")
        assert (refused.code, "must name a folder" in in_one_line(refused.errors)) == (2, True)


@pytest.mark.parametrize(
    "name", ["smoke", "paper_figures", "q_entropy_factorial", "proofs/fetch_push_family", "default"]
)
def test_what_best_writes_is_the_run_to_the_last_setting(name: str, tmp_path: Path) -> None:
    file = driver.DEFAULT_CONFIG if name == "default" else Path("tune_configs", f"{name}.yaml")
    config = load_config(REPOSITORY / file, storage=str(tmp_path))
    sweep = open_sweep(config, make_plan(config), str(tmp_path))
    for key in {(node.stage, node.run.task.name): node.key for node in sweep.plan.nodes}.values():
        of_run = loaded(tmp_path, sweep_of_run(sweep, key, tmp_path))
        assert make_plan(of_run).nodes[-1].key == key


def test_a_condition_with_all_its_runs_is_better_than_a_lucky_one(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = opened(storage, tmp_path)
    heights = {1.0: 0.2, 1.5: 0.3, 2.0: 0.99}

    def play(state_file: StateFile, *cells: tuple[float, int]) -> None:
        for node in sweep.plan.nodes:
            q = float(node.run.tac.entropic_index)  # type: ignore[arg-type]
            if (q, node.run.seed) in cells:
                finish(sweep, state_file, node, heights[q], tmp_path / "made")

    with StateFile(sweep) as state_file:
        play(state_file, (2.0, 0))
        state_file.end("stopped")
    said = in_one_line(program("status", f"{storage}/mine").output)
    assert "1 of 3 runs (no condition has all of its runs yet)" in said
    lucky = program("best", f"{storage}/mine", "--output", "lucky", "--json").document
    assert lucky["values"] == {"tac.entropic_index": 2.0}
    assert "1 of 3 runs (no condition has all of its runs yet)" in lucky["why"]
    with StateFile(sweep) as state_file:
        state_file.reused(next(n for n in sweep.plan.nodes if n.key in sweep.finished))
        play(state_file, (1.0, 0), (1.5, 0), (1.5, 1), (1.5, 2))
        state_file.end("stopped")
    whole = program("best", f"{storage}/mine", "--output", "whole", "--json").document
    assert whole["values"] == {"tac.entropic_index": 1.5}
    state = program("status", f"{storage}/mine", "--json").document
    assert (state["best"]["values"], state["best"]["runs"]) == (whole["values"], 3)


def test_a_single_setting_is_the_best_of_nothing(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = opened(storage, tmp_path, stages=[{"name": "train", "variant": "tac"}])
    with StateFile(sweep) as state_file:
        finish(sweep, state_file, sweep.plan.nodes[0], 0.5, tmp_path / "made")
        assert state_file.headline()[1] is None
        state_file.end("finished")
    assert "Best" not in program("status", f"{storage}/mine").output
    assert program("best", f"{storage}/mine", "--output", "out", "--json").document["value"] == 0.5


def test_the_first_of_equals_is_not_named_alone(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = opened(storage, tmp_path, seeds=[0])
    with StateFile(sweep) as state_file:
        for node in sweep.plan.nodes:
            value = 0.25 if node.run.tac.entropic_index == 1.0 else 1.0
            finish(sweep, state_file, node, value, tmp_path / "made")
        state_file.end("finished")
    said = program("status", f"{storage}/mine").output
    assert "Best so far: train q = 1.5, tied with 1 more: success 1, 1 run\n" in said


def test_tasks_without_success_are_judged_by_their_return(
    storage: str, tmp_path: Path, program: Program
) -> None:
    task = {"env_id": "Reacher-v5", "horizon": 50, "success_key": None}
    sweep = opened(storage, tmp_path, environments={"Reacher": task}, tasks=["Reacher"])
    with StateFile(sweep) as state_file:
        for node in list(sweep.plan.nodes):
            height = -HEIGHTS[float(node.run.tac.entropic_index)]  # type: ignore[arg-type]
            finish(sweep, state_file, node, height, tmp_path / "made", names.EVAL_RETURN)
        state_file.end("finished")
    place = f"{storage}/mine"
    document = program("compare", place, "--json").document
    assert document["metric"] == names.EVAL_RETURN
    chosen = program("best", place, "--output", "out", "--json").document
    assert chosen["values"] == {"tac.entropic_index": 1.0}
    assert (chosen["metric"], chosen["value"]) == (names.EVAL_RETURN, pytest.approx(-0.2))
    assert chosen["success_rate"] is None
    assert "return -0.2, " in chosen["why"]
    shown = program("status", place).output
    assert "Best so far: train q = 1: return -0.2" in shown


def test_returns_of_different_tasks_are_never_averaged(
    storage: str, tmp_path: Path, program: Program
) -> None:
    """q = 1 is best on a task with returns of hundreds, q = 2 on one with returns of tenths."""
    task = {"env_id": "Reacher-v5", "horizon": 50, "success_key": None}
    tasks = {"Large": task, "Small": {**task, "horizon": 51}}
    sweep = opened(storage, tmp_path, environments=tasks, tasks=list(tasks))
    with StateFile(sweep) as state_file:
        for node in list(sweep.plan.nodes):
            q = float(node.run.tac.entropic_index)  # type: ignore[arg-type]
            value = 500 - 100 * q if node.run.task.name == "Large" else q / 10
            finish(sweep, state_file, node, value, tmp_path / "made", names.EVAL_RETURN)
        state_file.end("finished")
    place = f"{storage}/mine"
    shown = in_one_line(program("status", place).output)
    assert "Large: train q = 1: return 400" in shown
    assert "Small: train q = 2: return 0.2" in shown
    chosen = program("best", place, "--output", "out", "--json").document
    assert [policy["task"] for policy in chosen["policies"]] == ["Large", "Small"]
    assert "Small: train q = 2: return 0.2" in chosen["why"]


@IN_A_BUCKET
def test_clean_lists_and_deletes_files_that_no_other_sweep_has(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = played(storage, tmp_path)
    other = opened(storage, tmp_path, name="other", seeds=[0])
    going = program("clean", f"{storage}/mine", "--all", "--json").document
    assert not going["deleted"]
    paths = 1 + (sweep.folder != Path(storage) / "mine")  # a bucket's sweep has files here too
    assert len(going["items"]) == 9 - 3 + paths
    assert len(going["kept"]) == 3
    assert all(item["what"].endswith("other has it too") for item in going["kept"])
    done = program("clean", f"{storage}/mine", "--all", "--yes")
    assert (done.code, f"{6 + paths} deleted." in done.output) == (0, True)
    assert not sweep.folder.exists()
    kept = {node.key for node in sweep.plan.nodes if sweep.store.is_finished(node.key)}
    assert kept == {node.key for node in other.plan.nodes}
    gone = program("status", f"{storage}/mine")
    assert (gone.code, ": other)" in gone.errors) == (2, True)


def test_clean_deletes_runs_of_earlier_versions_of_the_plan(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = played(storage, tmp_path)
    opened(storage, tmp_path, seeds=[0])
    assert program("clean", f"{storage}/mine", "--all", "--yes").code == 0
    assert not any(sweep.store.is_finished(node.key) for node in sweep.plan.nodes)


@IN_A_BUCKET
def test_clean_is_refused_while_a_sweep_is_being_started(
    storage: str, tmp_path: Path, program: Program
) -> None:
    """Its state is still the one that its last driver wrote."""
    sweep = played(storage, tmp_path)
    with driver_lock.driving(sweep.location):
        said = program("clean", f"{storage}/mine", "--all", "--yes")
        assert (said.code, "mine is: stop it first" in said.errors) == (2, True)
        assert program("stop", f"{storage}/mine", "--wait", "0").code == 0
    assert len(sweep.finished) == 9
    assert program("clean", f"{storage}/mine", "--all", "--yes").code == 0


@IN_A_BUCKET
def test_clean_deletes_nothing_if_another_process_computes_a_run(
    storage: str, tmp_path: Path, program: Program
) -> None:
    """Such as a worker that outlives its driver, or one of another sweep."""
    sweep = played(storage, tmp_path, runs=7)
    first, second = (sweep.store.work_folder(node.key) for node in sweep.plan.nodes[7:9])
    for work in (first, second):
        with work.new_checkpoint(400) as new:
            (new.folder / "x").touch()
    theirs = Lease.of_this_process("sweep 'other'")
    assert second.lease.acquire(theirs) is None
    said = program("clean", f"{storage}/mine", "--all", "--yes")
    assert (said.code, "got sweep 'other' (process" in said.errors) == (2, True)
    assert len(sweep.store.finished(node.key for node in sweep.plan.nodes)) == 7
    assert [len(work.names()) for work in (first, second)] == [1, 1]
    assert first.lease.read() is None
    second.lease.release(theirs.owner)
    assert program("clean", f"{storage}/mine", "--all", "--yes").code == 0
    assert not sweep.store.begun()


@pytest.mark.parametrize("storage", ["bucket"], indirect=True)
@pytest.mark.parametrize("taken", [[], [4]])
def test_clean_holds_the_lease_of_each_run_that_it_deletes(
    taken: list[int],
    storage: str,
    tmp_path: Path,
    program: Program,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also if a lease expires before the last is acquired, and if a worker starts meanwhile."""
    sweep = played(storage, tmp_path, runs=0)
    works = [sweep.store.work_folder(node.key) for node in sweep.plan.nodes]
    for work in works:
        with work.new_checkpoint(400) as new:
            (new.folder / "x").touch()
    theirs = Lease.of_this_process("sweep 'other'").model_dump_json().encode()
    deleted = []

    def delete(folder: StorageFolder, name: str = "") -> None:
        lease = LeaseFile(folder, "lease.json").read()
        if folder.path in {work.folder.path for work in works} and not name:
            assert lease is not None
            assert (lease.what, lease.holds()) == ("clean", True)
            deleted.append(folder.path)
        really_delete(folder, name)

    def settle(seconds: float) -> None:
        for work in (works[number] for number in taken):
            if work.lease.read() is not None:
                work.folder.write("lease.json", theirs)
        really_sleep(seconds)

    really_delete, really_sleep = StorageFolder.delete, time.sleep
    monkeypatch.setattr(StorageFolder, "delete", delete)
    monkeypatch.setattr(lease_module, "time", SimpleNamespace(**vars(time) | {"sleep": settle}))
    monkeypatch.setattr(lease_module, "SETTLE_SECONDS", 0.1)
    monkeypatch.setattr(lease_module, "EXPIRES_SECONDS", 0.8)
    monkeypatch.setattr(storage_module, "REQUESTS", 1)
    said = program("clean", f"{storage}/mine", "--all", "--yes")
    assert len(deleted) == len(works) - len(taken)
    assert {*sweep.store.begun()} == {sweep.plan.nodes[number].key for number in taken}
    if taken:
        assert (said.code, "got sweep 'other' (process" in said.errors) == (2, True)
        assert program("status", f"{storage}/mine").code == 0
    else:
        assert said.code == 0


@pytest.mark.parametrize("storage", ["bucket"], indirect=True)
def test_a_plan_of_ten_thousand_runs_asks_a_bucket_for_less_than_a_minute(
    storage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each request takes 25 ms, of which `REQUESTS` run at once in threads of the pool."""
    seconds = 0.0
    # pyarrow reads the size of an object before its content, and a missing object may be a folder.
    costs = {"get_file_info": 2, "get_file_info_selector": 1, "open_input_stream": 2}

    def counted(name: str) -> Callable[..., Any]:
        method = getattr(pafs.FSSpecHandler, name)

        def call(*arguments: Any) -> Any:
            nonlocal seconds
            alone = threading.current_thread() is threading.main_thread()
            seconds += 0.025 * costs[name] / (1 if alone else storage_module.REQUESTS)
            return method(*arguments)

        return call

    def start(seeds: int) -> float:
        """The time for requests of a sweep with half of its runs finished."""
        nonlocal seconds
        MemoryFileSystem.store.clear()
        sweep = played(storage, tmp_path, runs=3 * seeds // 2, seeds=seeds)
        node = sweep.plan.nodes[0]
        last = sweep.store.continuation(node.continuation)
        with last.new_checkpoint(4000) as new:
            (new.folder / "x").touch()
        seconds = 0.0
        sweep = opened(storage, tmp_path, seeds=list(range(seeds)))
        assert changes_since(sweep) is None
        assert not changed_text(sweep, found_runs(sweep))
        assert continued_runs_text(sweep) == []
        with StateFile(sweep) as state_file:
            assert len(sweep.results()) == 3 * seeds // 2
            state_file.end("finished")
        return seconds

    for name in costs:
        monkeypatch.setattr(pafs.FSSpecHandler, name, counted(name))
    monkeypatch.setattr(node_store, "FEW", 8)  # both have more finished runs
    few, many = start(10), start(15)
    assert few + (many - few) * (10_000 - 30) / 15 < 60


def last_checkpoint(sweep: OpenSweep, env_steps: int) -> WorkFolder:
    """The folder of the first run's last checkpoint, with a checkpoint after `env_steps`."""
    node = sweep.plan.nodes[0]
    last = sweep.store.continuation(node.continuation)
    with last.new_checkpoint(env_steps) as new:
        (new.folder / "x").touch()
    return last


@IN_A_BUCKET
def test_clean_keeps_a_last_checkpoint_that_another_sweep_shares(
    storage: str, tmp_path: Path, program: Program
) -> None:
    """Runs that differ only in their budget share one folder for it."""
    longer = opened(storage, tmp_path, name="long", defaults={"env_steps": 8000})
    sweep = played(storage, tmp_path)
    last = last_checkpoint(sweep, 8000)
    going = program("clean", f"{storage}/mine", "--yes", "--json").document
    assert not going["items"]
    (kept,) = going["kept"]
    assert kept["what"] == f"last checkpoint of {sweep.plan.nodes[0].label}: long has it too"
    assert len(last.names()) == 1
    longer.location.files.remove("plan.json")
    opened(storage, tmp_path, defaults={"env_steps": 8000})  # now two runs of `mine` share it
    assert len(program("clean", f"{storage}/mine", "--json").document["items"]) == 1
    assert program("clean", f"{storage}/mine", "--yes").code == 0
    assert not last.names()


@IN_A_BUCKET
def test_clean_all_leaves_no_last_checkpoint_of_a_shorter_run(
    storage: str, tmp_path: Path, program: Program
) -> None:
    """Nothing would list it when the sweep's own files are gone."""
    last = last_checkpoint(played(storage, tmp_path), 4000)
    opened(storage, tmp_path, defaults={"env_steps": 8000})
    assert program("clean", f"{storage}/mine", "--all", "--yes").code == 0
    assert not last.names()


def test_clean_keeps_the_last_checkpoint_from_which_a_run_of_the_plan_starts(
    storage: str, tmp_path: Path, program: Program
) -> None:
    last = last_checkpoint(played(storage, tmp_path), 4000)
    longer = opened(storage, tmp_path, defaults={"env_steps": 8000})  # and interrupted at once
    assert longer.continued_from(longer.plan.nodes[0]) == 4000
    assert program("clean", f"{storage}/mine", "--yes").code == 0
    assert last.names()
    own = longer.store.work_folder(longer.plan.nodes[0].key)
    with own.new_checkpoint(6000) as new:
        (new.folder / "x").touch()
    again = opened(storage, tmp_path, defaults={"env_steps": 8000})
    assert again.continued_from(again.plan.nodes[0]) is None, "it resumes from its own"
    assert program("clean", f"{storage}/mine", "--unfinished", "--yes").code == 0
    assert not last.names()


def from_handoff(storage: str, tmp_path: Path, name: str = "mine") -> OpenSweep:
    """A sweep of one run from a handoff in `tmp_path`, which has been copied into the storage."""
    folder = write_estimator(tmp_path / "given", music_u())
    stage = {"name": "r", "variant": "music-r", "init_from": {"checkpoint": str(folder)}}
    sweep = opened(storage, tmp_path, name=name, seeds=[0], stages=[stage])
    import_checkpoints(sweep.plan, sweep.store)
    return sweep


def test_a_sweep_resumes_from_the_handoff_in_its_storage(
    storage: str, tmp_path: Path, program: Program
) -> None:
    """The folder of the option is on another machine, or was trained again."""
    sweep = from_handoff(storage, tmp_path)
    (node,) = sweep.plan.nodes
    (tmp_path / "given").rename(tmp_path / "moved")
    for _ in ("begun with the folder", "gone on without it"):
        again = open_sweep_module.open_started(sweep_files.find_sweep(f"{storage}/mine", None))
        assert [one.key for one in again.plan.nodes] == [node.key]
        keep_record(again)
    assert program("status", f"{storage}/mine").code == 0


@IN_A_BUCKET
def test_clean_deletes_a_handoff_unless_another_sweep_starts_from_it(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = from_handoff(storage, tmp_path)
    (node,) = sweep.plan.nodes
    assert node.input is not None
    from_handoff(storage, tmp_path, "other")
    (kept,) = program("clean", f"{storage}/mine", "--all", "--json").document["kept"]
    assert kept["what"] == f"result of {node.input.key} (imported): other has it too"
    for name, left in (("mine", True), ("other", False)):
        assert program("clean", f"{storage}/{name}", "--all", "--yes").code == 0
        assert sweep.store.is_finished(node.input.key) is left


SEARCH: dict[str, Any] = {
    "space": {"tac.alpha": {"choice": [0.1, 0.2, 0.3]}},
    "sampler": "grid",
    "storage": "postgresql://me@host/studies",
    "study": "together",
}


def test_clean_keeps_runs_that_another_sweep_of_the_same_study_needs(
    storage: str, tmp_path: Path, program: Program
) -> None:
    """The plan of each sweep has only the trials that it judged itself."""
    stages = [
        {"name": "pretrain", "variant": "music-u"},
        {"name": "tune", "variant": "music-r", "init_from": "pretrain", "search": SEARCH},
    ]
    alone = [{"name": "apart", "variant": "tac"}]
    mine, other = (opened(storage, tmp_path, name=n, stages=stages + alone) for n in ("mine", "b"))
    mine.plan.add_trial("tune", 0, {"tac.alpha": 0.1}, [0, 1, 2], "trial0")
    other.plan.add_trial("tune", 1, {"tac.alpha": 0.2}, [0, 1, 2], "trial1")
    for sweep in (mine, other):
        keep_record(sweep)
    done = {node.label: node for node in mine.plan.nodes if node.stage != "apart"}
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / HISTORY).write_bytes(b"")
    for node in done.values():
        result = RunResult(label=node.label, env_steps=1, seconds=1.0, metrics={})
        mine.store.publish(node.key, tmp_path / "made", result)
    asked = program("clean", f"{storage}/mine", "--all", "--json").document
    assert len(done) == 6
    assert {item["path"].rpartition("/")[2] for item in asked["kept"][:-1]} == {
        node.key for node in done.values()
    }
    assert asked["kept"][-1]["path"] == "postgresql://host/studies"
    assert "study 'together/tune'" in asked["kept"][-1]["what"]
    assert program("clean", f"{storage}/mine", "--all", "--yes").code == 0
    assert all(mine.store.is_finished(node.key) for node in done.values())


def test_clean_is_refused_while_a_sweep_runs_that_shares_runs(
    storage: str, tmp_path: Path, program: Program
) -> None:
    played(storage, tmp_path)
    apart = opened(storage, tmp_path, name="apart", seeds=[7])
    with StateFile(apart) as state_file:
        assert program("clean", f"{storage}/mine").code == 0
        state_file.end("stopped")
    other = opened(storage, tmp_path, name="other", seeds=[0])
    with StateFile(other) as state_file:
        refused = program("clean", f"{storage}/mine", "--all", "--yes")
        assert (refused.code, "mine shares 3 with other: stop that first" in refused.errors) == (
            2,
            True,
        )
        state_file.end("stopped")
    assert program("clean", f"{storage}/mine").code == 0


DAMAGED = [
    ("state.json", [], ("status", "clean")),
    ("state.json", ["driver", "outcome"], ("status", "compare", "clean")),
    ("state.json", ["stages", 0, "runs"], ("status", "clean")),
    ("plan.json", [], ("compare", "clean")),
    ("plan.json", ["nodes", 0, "label"], ("status", "compare", "clean")),
    ("config.json", [], ("status", "compare", "best", "clean")),
]


@IN_A_BUCKET
@pytest.mark.parametrize(("file", "path", "commands"), DAMAGED)
def test_a_damaged_record_ends_commands_with_its_place(
    storage: str,
    tmp_path: Path,
    program: Program,
    file: str,
    path: list[str | int],
    commands: tuple[str, ...],
) -> None:
    played(storage, tmp_path)
    location = opened(storage, tmp_path, name="other").location
    with StateFile(open_started(location)):
        pass
    document: Any = [location.read(file)]
    *above, last = [0, *path]
    functools.reduce(operator.getitem, above, document)[last] = [5]
    location.keep(file, as_json(document[0]))
    place = ".".join(map(str, path))
    message = f"other/{file} must be a sweep's {file[:-5]} as its driver writes it: {place}"
    for command in commands:
        said = program(command, f"{storage}/other")
        assert (said.code, message in said.errors) == (2, True)
    # The runs that another sweep shares with it are unknown.
    said = program("clean", f"{storage}/mine", "--all", "--yes")
    assert (said.code, message in said.errors) == (2, True)
    assert program("status", f"{storage}/mine").code == 0


@IN_A_BUCKET
def test_stop_reaches_the_driver(
    storage: str, tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    received = threading.Event()
    for name in ("LOCAL_SECONDS", "REMOTE_SECONDS"):
        monkeypatch.setattr(f"music_rllib.sweep.listeners.state_file.{name}", 0.2)
    before = signal.signal(signal.SIGINT, lambda *_: received.set())
    try:
        sweep = opened(storage, tmp_path)
        with StateFile(sweep) as state_file:
            assert sweep_files.is_alive(sweep.location.read("state.json"))
            refused = program("clean", f"{storage}/mine")
            assert (refused.code, "must not be running" in refused.errors) == (2, True)
            asked = program("stop", f"{storage}/mine", "--wait", "0")
            assert (asked.code, "was told to stop" in asked.output) == (0, True)
            assert received.wait(60)
            state_file.end("stopped")
    finally:
        signal.signal(signal.SIGINT, before)
    again = program("stop", f"{storage}/mine", "--json").document
    assert again == {"sweep": "mine", "was_running": False, "state": "stopped"}


def test_stop_reaches_a_driver_that_is_starting(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = opened(storage, tmp_path)
    with driver_lock.driving(sweep.location) as drivers:
        asked = program("stop", f"{storage}/mine", "--wait", "0")
        assert (asked.code, "was told to stop" in asked.output) == (0, True)
        assert StateFile(sweep, drivers.stop_before)._stop_requested()
    with driver_lock.driving(sweep.location) as drivers:
        assert not StateFile(sweep, drivers.stop_before)._stop_requested(), "for an earlier driver"


def test_a_driver_that_was_killed_is_interrupted(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = opened(storage, tmp_path)
    with StateFile(sweep) as state_file:
        pass
    state = sweep.location.read("state.json")
    state["driver"] |= {"ended": None, "outcome": "running", "pid": 2**22 + 1}
    sweep.location.keep(sweep_files.STATE, sweep_files.as_json(state))
    assert state_file is not None
    assert program("status", f"{storage}/mine", "--json").document["state"] == "interrupted"


def test_nothing_runs_after_a_crash(storage: str, tmp_path: Path, program: Program) -> None:
    sweep = opened(storage, tmp_path)
    node = sweep.plan.nodes[0]
    with contextlib.suppress(RuntimeError), StateFile(sweep) as state_file:
        sweep.scheduler.start(node.key)
        state_file.started(node)
        raise RuntimeError("out of luck")
    state = program("status", f"{storage}/mine", "--json").document
    assert (state["state"], state["running"]) == ("failed", [])
    assert state["stages"][0]["runs"] == {"interrupted": 1, "waiting": 8}
    shown = program("status", f"{storage}/mine").output
    assert node.label not in shown
    assert "interrupted" in shown


def test_a_run_that_queues_for_a_core_does_not_run_yet(
    storage: str, tmp_path: Path, program: Program
) -> None:
    """Tune gets more runs than there are cores, so that none is idle."""
    sweep = opened(storage, tmp_path)
    at_work, queued = sweep.plan.nodes[:2]
    with StateFile(sweep) as state_file:
        for node in (at_work, queued):
            sweep.scheduler.start(node.key)
        state_file.started(at_work)
        assert [state_file.status(node.key) for node in (at_work, queued)] == [
            Status.STARTED,
            Status.WAITING,
        ]
        state_file.end("stopped")
    state = sweep.location.read("state.json")
    assert [one["run"] for one in state["running"]] == [at_work.label]
    assert state["stages"][0]["runs"] == {"started": 1, "waiting": 8}


def test_the_recorded_configuration_is_the_sweeps(storage: str, tmp_path: Path) -> None:
    from music_rllib.experiment.open_sweep import open_started
    from music_rllib.experiment.sweep_files import find_sweep

    sweep = opened(storage, tmp_path)
    found = open_started(find_sweep(f"{storage}/mine", None))
    assert [node.key for node in found.plan.nodes] == [node.key for node in sweep.plan.nodes]
    assert found.storage == storage


def test_a_sweep_is_found_by_any_path_to_its_folder(
    tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = str(tmp_path / "results")
    for name in ("mine", "push.yaml"):
        opened(storage, tmp_path, name=name)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/latest").symlink_to(f"{storage}/mine")
    (tmp_path / "results/mine/report").mkdir()
    monkeypatch.chdir(tmp_path / "results/mine/report")
    for place in ("..", "../", "../../../elsewhere/latest"):
        assert sweep_files.find_sweep(place, None).place == f"{storage}/mine"
    assert program("status", f"{storage}/push.yaml", "--json").document["sweep"] == "push.yaml"
    monkeypatch.setenv("HOME", f"{storage}/mine")
    assert sweep_files.find_sweep("~", None).place == f"{storage}/mine"


def test_a_file_uri_names_one_folder(tmp_path: Path, program: Program) -> None:
    played(f"file://{tmp_path}/a%20b", tmp_path)
    assert [path.name for path in tmp_path.glob("a*")] == ["a b"]
    for place in (f"file://{tmp_path}/a%20b/mine", f"{tmp_path}/a b/mine"):
        assert program("compare", place, "--json").document["conditions"]


def test_an_analysis_plan_is_recorded_and_changes_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: Program
) -> None:
    monkeypatch.chdir(tmp_path)
    plain, planned = tmp_path / "plain.yaml", tmp_path / "planned.yaml"
    plain.write_text(yaml.safe_dump(SWEEP))
    folder = tmp_path / "results/mine"
    keys = {node["key"] for node in program("plan", str(plain), "--json").document["nodes"]}
    assert not folder.exists()  # `plan` writes nothing without an analysis plan

    def recorded(**analysis: Any) -> list[Any]:
        asked = {"hypotheses": ["q = 1.5 better than q = 1"], **analysis}
        planned.write_text(yaml.safe_dump(SWEEP | {"analysis": asked}))
        document = program("plan", str(planned), "--json").document
        assert {node["key"] for node in document["nodes"]} == keys
        assert document["analysis_plan"] == json.loads((folder / "analysis_plan.json").read_text())
        versions: list[Any] = document["analysis_plan"]
        return versions

    assert [one["version"] for one in recorded()] == [1]
    assert [one["version"] for one in recorded()] == [1]
    versions = recorded(margin=0.1)
    assert [(one["version"], one["plan"]["margin"]) for one in versions] == [(1, 0.05), (2, 0.1)]
    text = (folder / "analysis_plan.md").read_text()
    assert "failed run counts with the worst value" in text
    assert versions[1]["hash"] in text
    assert "- q = 1.5 better than q = 1" in text
    (folder / "analysis_plan.json").write_text(json.dumps(versions).replace("0.05", "0.4"))
    refused = program("plan", str(planned))
    assert (refused.code, "as they were recorded" in refused.errors) == (2, True)


def test_plan_names_hypotheses_about_finished_runs_when_it_records_them(
    storage: str, tmp_path: Path, program: Program
) -> None:
    played(storage, tmp_path, runs=1)
    planned = tmp_path / "planned.yaml"
    analysis = {"hypotheses": ["q = 1.5 better than q = 1"]}
    planned.write_text(yaml.safe_dump({**SWEEP, "storage": storage, "analysis": analysis}))
    message = (
        "Not planned by this version, because runs of it have finished: q = 1.5 better than q = 1"
    )
    assert message in in_one_line(program("plan", str(planned)).output)
    assert "Not planned" not in program("plan", str(planned)).output  # recorded before


def test_plan_as_json_with_more_seeds(
    tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("sweep.yaml").write_text(yaml.safe_dump(SWEEP | {"resources": {"num_cpus": 1}}))
    plan = program("plan", "sweep.yaml", "--seeds", "5", "--json").document
    assert plan["seeds"] == [0, 1, 2, 3, 4]
    assert len(plan["nodes"]) == 15
    assert plan["env_steps_left"] == 15 * 4000
    listed = program("plan", "sweep.yaml", "--seeds", "4,9", "--json").document
    assert listed["seeds"] == [4, 9]
    assert plan["remarks"] == []
    bad = program("plan", "sweep.yaml", "--seeds", "many")
    assert (bad.code, "--seeds must be a number of seeds" in bad.errors) == (2, True)


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        ("speeds:Missing", "must name a subclass of IntrinsicReward in speeds"),
        ("speeds:Speed", "intrinsic.settings must fit speeds:Speed: missing a required"),
    ],
)
def test_plan_refuses_an_own_reward_that_does_not_fit(
    reward: str, message: str, tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("speeds.py").write_text(
        "from music_rllib.intrinsic.interface import IntrinsicReward\n"
        "class Speed(IntrinsicReward):\n"
        "    def __init__(self, sizes, *, power):\n"
        "        super().__init__(sizes)\n"
        "    def bonus(self, batch):\n"
        "        return batch.states[:, 0]\n"
    )
    Path("sweep.yaml").write_text(yaml.safe_dump(SWEEP))
    refused = program("plan", "sweep.yaml", f"intrinsic.reward={reward}")
    assert (refused.code, message in refused.errors) == (2, True)


@IN_A_BUCKET
def test_a_damaged_run_is_named_by_every_command_and_trained_again_when_asked(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = played(storage, tmp_path)
    good, bad = sweep.plan.nodes[0], sweep.plan.nodes[4]
    label = ShortLabels.of(node.label for node in sweep.plan.nodes)
    history = next(file for file in sweep.store.paths(bad.key) if file.endswith(HISTORY))
    with sweep.store._root.filesystem.open_output_stream(history) as sink:
        sink.write(b"")
    place, file = f"{storage}/mine", str(tmp_path / "sweep.yaml")
    for arguments in (
        ("run", file, "--storage", storage),
        ("plan", file, "--storage", storage),
        ("resume", place),
        ("best", place),
        ("compare", place),
    ):
        said = program(*arguments)
        assert said.code == 2, arguments
        assert "1 finished run is damaged" in said.errors
        assert f"{label(bad.label)}: {history} must have " in said.errors
        assert "--retrain-damaged" in said.errors
        assert label(good.label) not in said.errors
    said = program("status", place, "--json")
    assert said.code == 1
    (damaged,) = json.loads(said.output)["damaged"]
    assert damaged["run"] == bad.label
    said = program("status", place)
    assert (said.code, f"DAMAGED {label(bad.label)}: " in said.output) == (1, True)

    removed: list[str] = []
    again = open_sweep(sweep.config, sweep.plan, storage, lenient=True)
    assert not sweep.store.is_sound(bad.key)
    remove_damaged(again, removed.append)
    assert not sweep.store.is_finished(bad.key)
    assert [line.split(":")[0] for line in removed] == [label(bad.label)]
    assert again.scheduler.next_ready() == bad
    assert len(again.finished) == 8
    tracked = "mlflow.tracking_uri=http://127.0.0.1:9"  # a plan does not ask it
    assert program("plan", file, "--storage", storage, tracked).code == 0
    assert program("status", place).code == 0


def test_earlier_trials_of_a_search_are_verified_too(tmp_path: Path) -> None:
    """Its trials are not part of the plan before the search starts."""
    search = {"space": {"tac.lr": {"float": [1e-4, 1e-2]}}, "trials": 4}
    stages = [{"name": "train", "variant": "tac", "search": search}]
    storage = str(tmp_path / "results")
    sweep = opened(storage, tmp_path, stages=stages, seeds=[0])
    sweep.plan.add_trial("train", 0, {"tac.lr": 1e-3}, [0], "trial0")
    keep_record(sweep)
    (node,) = sweep.plan.nodes
    with contextlib.suppress(KeyError):  # the scheduler does not know it, which is enough here
        finish(sweep, StateFile(sweep), node, 0.5, tmp_path / "made")
    (tmp_path / "results/nodes" / node.key / "handoff/handoff.json").write_text("{ }")
    with pytest.raises(DamagedError, match=rf"{node.label}: .*handoff\.json must have 2 bytes"):
        opened(storage, tmp_path, stages=stages, seeds=[0])


def test_a_search_requests_no_more_runs_once_its_finalists_run(tmp_path: Path) -> None:
    """The unused budget of trials that were stopped early is not counted as remaining."""
    search = {
        "space": {"tac.lr": {"float": [1e-4, 1e-2]}},
        "trials": 4,
        "final": {"trials": 1, "seeds": 2},
    }
    stages = [{"name": "train", "variant": "tac", "search": search}]
    storage = str(tmp_path / "results")
    sweep = opened(storage, tmp_path, stages=stages, seeds=[0])

    def env_steps_to_come() -> Any:
        with StateFile(sweep) as state_file:
            state_file.end("stopped")
        return sweep.location.read("state.json")["env_steps"]["to_come"]

    sweep.plan.add_trial("train", 0, {"tac.lr": 1e-3}, [0], "trial0")
    assert env_steps_to_come() == (3 + 2) * 4000
    sweep.plan.add_trial("train", 0, {"tac.lr": 1e-3}, [1000, 1001], "final0")
    assert env_steps_to_come() == 0


def test_reused_runs_count_as_finished_in_the_lines_of_stages(tmp_path: Path, storage: str) -> None:
    with StateFile(opened(storage, tmp_path)) as state_file:
        state_file._state["stages"] = [
            {"name": "train", "runs": {"waiting": 3, "reused": 4, "finished": 1}}
        ]
        assert state_file.headline()[0] == ["train: 5 finished (4 reused), 3 waiting"]


def test_a_report_made_on_another_machine_can_be_opened_on_this_one() -> None:
    page = "http://mlflow:5000/#/experiments/1/runs/2"
    output = (
        "missing: x\nq = 2 against q = 1: worse.\n"
        f"Report: /head/r/index.html\nPicture: /head/a.png\nAttached to MLflow: {page}"
    )
    answer, command, report, attached = execution.elsewhere(output, "s3://bucket/sweeps/s")
    assert answer == "q = 2 against q = 1: worse."
    assert command == "On your machine: music-rllib report s3://bucket/sweeps/s"
    assert report.startswith("Report: /head/r/index.html (on ")
    assert attached == f"Attached to MLflow: {page}"


def test_slurm_writes_a_job_array_and_submits_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: Program
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "tune_configs" / "smoke.yaml", "my sweep.yaml")
    command = ["slurm", "my sweep.yaml", "seeds=3", "--array=8", "--time=1-12", "--sbatch=-A me"]
    assert "sbatch --array=1-8 smoke.slurm.sh" in program(*command).output
    body = Path("smoke.slurm.sh").read_text()
    options = set(itertools.takewhile(lambda line: line.startswith("#"), body.splitlines()))
    assert {"#SBATCH --job-name=smoke", "#SBATCH --time=1-12", "#SBATCH -A me"} <= options
    assert "-m music_rllib run 'my sweep.yaml' seeds=3\n" in body
    assert subprocess.run(["sh", "-n", "smoke.slurm.sh"], check=False).returncode == 0

    stub = tmp_path / "bin" / "sbatch"
    stub.parent.mkdir()
    stub.write_text('#!/bin/sh\necho "$@" >> submitted; wc -l < submitted\n')
    stub.chmod(0o755)
    monkeypatch.setenv("PATH", str(stub.parent), prepend=os.pathsep)
    assert "job 1 (8 tasks), then job 2" in program(*command, "--submit").output
    first, second = Path("submitted").read_text().splitlines()
    assert first == "--parsable --array=1-8 smoke.slurm.sh"
    assert second == "--parsable --dependency=afterany:1 smoke.slurm.sh"
    stub.write_text(
        '#!/bin/sh\ncase "$*" in *--array*) echo 7;; *) echo too many jobs >&2; exit 1;; esac\n'
    )
    half = program(*command, "--submit")
    assert (half.code, "too many jobs. Job 7 (8 tasks) is submitted" in half.errors) == (1, True)
    assert "sbatch --dependency=afterany:7 smoke.slurm.sh" in half.errors
    stub.write_text("#!/bin/sh\necho no such partition >&2; exit 1\n")
    refused = program(*command, "--submit")
    assert (refused.code, "no such partition" in refused.errors) == (2, True)

    twice = program(*command, "resources.num_cpus=8")
    assert (twice.code, "--cpus sets it for each task" in twice.errors) == (2, True)
    Path("smoke.slurm.sh").write_text("mine")
    refused = program(*command)
    assert (refused.code, "must not be a file of another origin" in refused.errors) == (2, True)
    for wrong, said in (
        ("--time=5h", "--time must be a time of Slurm"),
        ("--partition=a\n#b", "on one line"),
        ("--sbatch=account=me", "--sbatch and --partition must"),
        ("tac.gamma=7", "< 1"),
        ("resources.cpus_per_run=16", "must be <= num_cpus (8), got 16"),
        ("--storage=s3://bucket/x", "mlflow.tracking_uri must be set if storage is not a local"),
    ):
        refused = program(*command, wrong)
        assert (refused.code, said in refused.errors) == (2, True)


def test_plan_names_only_new_hypotheses_about_stages_with_results(
    storage: str, tmp_path: Path, program: Program
) -> None:
    played(storage, tmp_path, runs=1)
    later = {**SWEEP["stages"][0], "name": "later", "tac": {"lr": 0.002}}
    one, other = (f"stage = {s}, q = 1.5 against stage = {s}, q = 1" for s in ("train", "later"))

    def said(*hypotheses: str, **changes: object) -> str:
        analysis = {"hypotheses": list(hypotheses), **changes}
        document = {**SWEEP, "storage": storage, "stages": [*SWEEP["stages"], later]}
        (tmp_path / "planned.yaml").write_text(yaml.safe_dump({**document, "analysis": analysis}))
        output = in_one_line(program("plan", str(tmp_path / "planned.yaml")).output)
        return output.partition("Not planned by this version")[2]

    first = said(one, other)
    assert one in first
    assert other not in first
    assert said(one, other, question="Why?") == "", "an earlier version had both"
    assert one in said(one, other, margin=0.2), "that is another test of it"


def test_resume_refuses_a_folder_that_was_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[str] = []
    monkeypatch.setattr(driver, "run", lambda config, **_: started.append(config.name))
    folder = kept_sweep(tmp_path)
    resume(str(folder))
    folder.rename(tmp_path / "t")
    with pytest.raises(BadInputError, match=f"folder with its name, s, got {tmp_path / 't'}: ren"):
        resume(str(tmp_path / "t"))
    assert started == ["s"]


def test_a_relative_database_of_a_search_is_recorded_with_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    space = {"tac.lr": {"choice": [0.001, 0.002]}}
    search = {"space": space, "trials": 2, "storage": "sqlite:///q.db"}
    folder = kept_sweep(tmp_path, stages=[{"name": "a", "variant": "tac", "search": search}])
    (stage,) = sweep_files.find_sweep(str(folder), None).config().stages
    assert stage.search is not None
    assert stage.search.storage == f"sqlite:///{tmp_path}/q.db"


def test_a_record_of_which_only_a_part_was_written_can_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opened(name: str) -> OpenSweep:
        search = {"space": {"tac.lr": {"choice": [0.001, 0.002]}}, "trials": 2}
        stage = {"name": name, "variant": "tac", "search": search}
        config = loaded(tmp_path, {"name": "s", "tasks": ["FetchReach"], "stages": [stage]})
        return open_sweep(config, make_plan(config), str(tmp_path / "results"))

    first = opened("tune")
    first.plan.add_trial("tune", 0, {"tac.lr": 0.001}, [0], "trial0")
    keep_record(first)
    keep = sweep_files.SweepLocation.keep
    written: list[Any] = []

    def full(location: sweep_files.SweepLocation, file: Any, text: Any) -> None:
        if written:
            raise StorageError("must be writable: No space left on device")
        written.append(file)
        keep(location, file, text)

    monkeypatch.setattr(sweep_files.SweepLocation, "keep", full)
    with pytest.raises(StorageError):
        keep_record(opened("search"))
    open_started(first.location)


def test_compare_refuses_a_metric_that_only_another_stage_has(
    storage: str, tmp_path: Path, program: Program
) -> None:
    first, second = ({"name": name, "variant": "tac"} for name in ("a", "b"))
    sweep = opened(storage, tmp_path, stages=[first, second | {"tac": {"alpha": 0.1}}], seeds=[0])
    with StateFile(sweep) as state_file:
        for node in sweep.plan.nodes:
            metric = names.EVAL_DISPLACEMENT if node.stage == "a" else names.EVAL_SUCCESS
            finish(sweep, state_file, node, 0.5, tmp_path / "made", metric)
        state_file.end("finished")
    arguments = ["--stage", "b", "--metric", names.EVAL_DISPLACEMENT]
    said = program("compare", f"{storage}/mine", *arguments)
    assert said.code == 2
    assert f"{names.EVAL_SUCCESS} in stage b, got '{names.EVAL_DISPLACEMENT}'" in said.errors


def test_compare_shows_the_stage_of_a_recorded_plan_as_the_report_does(
    storage: str, tmp_path: Path, program: Program
) -> None:
    """Also if the sweep file has no `analysis` anymore."""
    later = {**SWEEP["stages"][0], "name": "later", "tac": {"lr": 0.002}}
    stages = {"stages": [*SWEEP["stages"], later]}
    planned = {"analysis": {"hypotheses": ["q = 1.5 against q = 1"], "stage": "train"}, **stages}
    (tmp_path / "planned.yaml").write_text(yaml.safe_dump({**SWEEP, "storage": storage, **planned}))
    assert program("plan", str(tmp_path / "planned.yaml")).code == 0
    sweep = opened(storage, tmp_path, **stages)
    with StateFile(sweep) as state_file:
        for node in sweep.plan.nodes:
            finish(sweep, state_file, node, 0.5, tmp_path / "made")
        state_file.end("finished")
    reported = study_of(read_sweep(f"{storage}/mine").sweep).stage
    assert reported is not None
    assert program("compare", f"{storage}/mine", "--json").document["stage"] == reported.name


def test_a_comparison_of_stages_names_different_environments(
    storage: str, tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    her: dict[str, Any] = {"name": "her", "variant": "tac"}
    stages = [her, her | {"name": "other", "tac": {"lr": 0.01}}]
    analysis = {"hypotheses": ["stage = other against stage = her"]}
    sweep = opened(storage, tmp_path, stages=stages, analysis=analysis)
    record_plan(sweep)
    publish = sweep.store.publish
    with StateFile(sweep) as state_file:
        for node in sweep.plan.nodes:
            environment = {"mujoco": "3.8.0" if node.stage == "her" else "3.8.1"}
            in_it = functools.partial(publish, environment=environment)
            monkeypatch.setattr(sweep.store, "publish", in_it)
            finish(sweep, state_file, node, 0.3, tmp_path / "made")
        state_file.end("finished")
    (line,) = program("compare", f"{storage}/mine", "--json").document["environments"]
    assert "2 versions of its environment" in line


def test_compare_and_the_report_agree_without_the_tasks_reward(
    storage: str, tmp_path: Path, program: Program
) -> None:
    stages = [{"name": "explore", "variant": "music-u", "grid": {"tac.entropic_index": [1.0, 2.0]}}]
    sweep = opened(storage, tmp_path, seeds=list(range(5)), stages=stages)
    with StateFile(sweep) as state_file:
        for node in sweep.plan.nodes:
            finish(sweep, state_file, node, 0.1, tmp_path / "made")
        state_file.end("finished")
    logged = read_sweep(f"{storage}/mine").sweep
    document = program("compare", f"{storage}/mine", "--json").document
    assert document["answer"] == answer(logged, study_of(logged))
    assert document["comparisons"] == []
    assert "Final values" in program("compare", f"{storage}/mine").output
    asked = program("compare", f"{storage}/mine", "--stage", "explore", "--json").document
    assert len(asked["comparisons"]) == 1


def test_stop_leaves_a_driver_alone_that_writes_its_report(
    storage: str, tmp_path: Path, program: Program
) -> None:
    sweep = opened(storage, tmp_path)
    with driver_lock.driving(sweep.location) as drivers:
        with StateFile(sweep, drivers.stop_before) as state_file:
            state_file.end("finished")
        asked = program("stop", f"{storage}/mine", "--wait", "0", "--json").document
    assert asked == {"sweep": "mine", "was_running": False, "state": "finished"}
    assert sweep.location.read(sweep_files.STOP) is None


def test_the_last_line_of_a_watch_ends(storage: str, tmp_path: Path, program: Program) -> None:
    played(storage, tmp_path)
    assert program("status", f"{storage}/mine", "--watch").output.endswith("\n")
