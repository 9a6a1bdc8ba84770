"""Tracking against real MLflow stores: an sqlite file, and servers that are killed."""

from __future__ import annotations

import dataclasses
import gc
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mlflow
import numpy as np
import pytest
from mlflow import MlflowClient
from mlflow.entities import Run
from mlflow.models import Model
from mlflow.tracking._tracking_service import utils as tracking_utils

from music_rllib import names
from music_rllib.errors import TrackingError
from music_rllib.experiment.run_info import RunInfo
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.policy import PolicyNetwork
from music_rllib.store.history import Report
from music_rllib.tracking.policy_model import write_model
from music_rllib.tracking.run_queue import StoredRun
from music_rllib.tracking.store import SweepRecord
from music_rllib.tracking.tracker import SweepRun, Tracker
from tests.integration.conftest import runs_by_name
from tests.integration.mlflow_server import MlflowServer
from tests.processes import fresh

MakeTracker = Callable[..., Tracker]
STEPS = list(range(2000, 22_000, 2000))


def values(step: int) -> dict[str, float]:
    return {
        names.EVAL_SUCCESS: step / 100_000,
        names.EVAL_SUCCESS_ANY: step / 50_000,
        names.MI_BOUND: step / 200_000,
        names.SYSTEM_MEMORY: 900.0,
    }


def report(step: int, metrics: dict[str, float] | None = None, time: float = 0.0) -> Report:
    """`time` in seconds, relative to a moment in 2023."""
    ms = 1_700_000_000_000 + round(time * 1000)
    values_then = values(step) if metrics is None else metrics
    return Report(env_steps=step, seconds=time, timestamp_ms=ms, metrics=values_then)


def later(steps: Iterable[int]) -> list[Report]:
    """Reports of these steps, measured now."""
    now = time.time() - 1_700_000_000
    return [report(step, time=now + step / 1000) for step in steps]


def stored(steps: Iterable[int] = (), policy: bytes | None = None) -> Callable[[], StoredRun]:
    read_policy = None if policy is None else lambda: policy
    return lambda: StoredRun([report(step, time=step) for step in steps], read_policy)


def run_info(node_key: str, **changes: object) -> RunInfo:
    fields: dict[str, object] = {
        "node_key": node_key,
        "name": f"finetune/{node_key}",
        "config": {"tac": {"entropic_index": 1.5}, "seed": 0},
        "tags": {names.TAG_TASK: "FetchPush", names.TAG_SEED: 0, names.TAG_TRIAL: None},
        "settings": {names.SETTING_ENTROPIC_INDEX: 1.5},
    }
    return RunInfo(**{**fields, **changes})  # type: ignore[arg-type]


class FreshStore(NamedTuple):
    """A store that a first sweep created, and its output."""

    database: Path
    screen: str


ONE_SWEEP = """
import sys
from music_rllib.tracking.tracker import Tracker
config = {"name": "smoke", "seeds": [0]}
Tracker(sweep_name=sys.argv[1], storage=sys.argv[2], config=config).close()
"""


@pytest.fixture(scope="module")
def fresh_store(tmp_path_factory: pytest.TempPathFactory) -> FreshStore:
    """Created once, because MLflow's tables take seconds and a copy does not."""
    folder = tmp_path_factory.mktemp("first")
    done = fresh("-c", ONE_SWEEP, "first", folder)
    return FreshStore(folder / "mlflow.db", done.stdout + done.stderr)


@pytest.fixture
def storage(tmp_path: Path, fresh_store: FreshStore) -> Path:
    folder = tmp_path / "results"
    folder.mkdir()
    shutil.copy(fresh_store.database, folder)
    return folder


@pytest.fixture
def tracker_on(storage: Path) -> Iterator[MakeTracker]:
    """Opens trackers on the test's storage, and closes them after the test."""
    opened: list[Tracker] = []

    def make(**changes: object) -> Tracker:
        fields: dict[str, object] = {
            "sweep_name": "smoke",
            "storage": str(storage),
            "config": {"name": "smoke", "seeds": [0]},
        }
        opened.append(Tracker(**{**fields, **changes}))  # type: ignore[arg-type]
        return opened[-1]

    yield make
    for tracker in opened:
        tracker.close(timeout=0.0)


def client_of(storage: Path) -> MlflowClient:
    return MlflowClient(f"sqlite:///{storage}/mlflow.db")


def runs_of(client: MlflowClient) -> dict[str, Run]:
    return runs_by_name(client, "smoke")


def logged_steps(client: MlflowClient, run: Run, metric: str = names.EVAL_SUCCESS) -> list[int]:
    return [point.step for point in client.get_metric_history(run.info.run_id, metric)]


def test_a_run_of_another_environment_replaces_the_earlier_one(
    storage: Path, tracker_on: MakeTracker
) -> None:
    """Also a run whose result was deleted to train it again."""

    def info(environment: str) -> RunInfo:
        return run_info("a", tags={names.TAG_ENVIRONMENT: environment})

    def logged(tracker: Tracker) -> list[int]:
        assert not tracker.close()
        (run,) = (
            r for r in runs_of(client_of(storage)).values() if names.TAG_NODE_KEY in r.data.tags
        )
        return logged_steps(client_of(storage), run)

    tracker = tracker_on()
    tracker.mirror(info("old"), stored([2000, 4000]))
    assert logged(tracker) == [2000, 4000]
    tracker = tracker_on()
    tracker.mirror(info("old"), stored([6000]))
    assert logged(tracker) == [2000, 4000], "MLflow has all of it"
    tracker = tracker_on()
    tracker.mirror(info("new"), stored([2000, 6000]))
    assert logged(tracker) == [2000, 6000]
    tracker = tracker_on()
    tracker.start(info("newest"))
    tracker.log("a", [report(4000)])
    assert logged(tracker) == [4000]
    tracker = tracker_on()
    tracker.forget("a")
    tracker.start(info("newest"))
    tracker.log("a", [report(2000)])
    assert logged(tracker) == [2000]


def test_a_run_that_was_trained_again_replaces_the_complete_one(
    storage: Path, tracker_on: MakeTracker
) -> None:
    """In this sweep, or in another sweep that shares the run."""

    def logged(tracker: Tracker) -> list[tuple[int, float]]:
        assert not tracker.close()
        (run,) = (
            r for r in runs_of(client_of(storage)).values() if names.TAG_NODE_KEY in r.data.tags
        )
        history = client_of(storage).get_metric_history(run.info.run_id, names.EVAL_SUCCESS)
        return [(point.step, point.value) for point in history]

    def of(result: str) -> RunInfo:
        return run_info("a", tags={names.TAG_RESULT: result})

    tracker = tracker_on()
    tracker.mirror(of("1"), stored([2000, 4000]))
    assert logged(tracker) == [(2000, 0.02), (4000, 0.04)]
    again = [report(2000, {names.EVAL_SUCCESS: 0.5})]
    tracker = tracker_on()
    tracker.start(run_info("a"))
    tracker.log("a", again)
    assert tracker.flush(20.0)
    tracker.mirror(of("2"), lambda: StoredRun(again))
    assert logged(tracker) == [(2000, 0.5)]
    tracker = tracker_on()
    tracker.mirror(of("3"), stored([6000]))
    assert logged(tracker) == [(6000, 0.06)]
    tracker = tracker_on()
    tracker.mirror(of("3"), stored([8000]))
    assert logged(tracker) == [(6000, 0.06)], "MLflow has all of it"


# An embedded store ------------------------------------------------------------------------------


def test_a_sweep_as_mlflow_shows_it(storage: Path, tracker_on: MakeTracker) -> None:
    tracker = tracker_on(
        config={"seeds": [0], "mlflow": {"tracking_uri": "http://me:hunter2@mlflow"}}
    )
    tracker.start(run_info("pre"))
    tracker.log("pre", [report(2000, time=0.25)])
    tracker.mirror(run_info("pre"), lambda: StoredRun([report(2000, time=0.25)]))
    tracker.start(run_info("fine", source_node="pre"))
    cause = "ValueError: http://me:hunter2@host is down"
    tracker.end("fine", "FAILED", {names.TAG_FAILURE: cause})
    assert tracker.flush(20.0)
    assert tracker._experiment.known_id("fine") is not None
    deadline = time.monotonic() + 20
    while tracker._runs:
        assert time.monotonic() < deadline, "delivered runs stay in memory"
        time.sleep(0.05)
    assert not tracker.close("FAILED")

    client = client_of(storage)
    runs = runs_of(client)
    parent, pre, fine = runs["smoke"], runs["finetune/pre"], runs["finetune/fine"]
    assert [run.info.status for run in (parent, pre, fine)] == ["FAILED", "FINISHED", "FAILED"]
    assert {run.data.tags[names.TAG_PARENT_RUN] for run in (pre, fine)} == {parent.info.run_id}
    assert names.TAG_INCOMPLETE not in pre.data.tags
    assert pre.data.params == {"tac.entropic_index": "1.5", "seed": "0"}
    assert pre.data.tags[names.TAG_TASK] == "FetchPush"
    assert pre.data.tags[names.TAG_VERSION_PREFIX + "torch"]
    assert pre.data.metrics == {**values(2000), names.SETTING_ENTROPIC_INDEX: 1.5}
    (point,) = client.get_metric_history(pre.info.run_id, names.EVAL_SUCCESS)
    assert (point.step, point.timestamp) == (2000, 1_700_000_000_250)
    assert fine.data.tags[names.TAG_SOURCE_RUN] == pre.info.run_id
    found = client.list_artifacts(parent.info.run_id, "config")
    assert [item.path for item in found] == [names.ARTIFACT_SWEEP_CONFIG]
    assert (storage / "mlartifacts" / "smoke" / parent.info.run_id).is_dir()
    assert fine.data.tags[names.TAG_FAILURE] == "ValueError: http://host is down"
    for path in storage.rglob("*"):
        assert path.is_dir() or b"hunter2" not in path.read_bytes(), path


def test_a_resumed_sweep_continues_its_runs(storage: Path, tracker_on: MakeTracker) -> None:
    first = tracker_on()
    first.start(run_info("a"))
    first.log("a", later(STEPS[:6]))
    first.close("KILLED")
    client = client_of(storage)
    cut = runs_of(client)["finetune/a"]
    assert cut.info.status == "KILLED"

    resources = {"num_cpus": 2}  # they do not change the sweep
    second = tracker_on(config={"name": "smoke", "seeds": [0], "resources": resources})
    second.start(run_info("a"))
    second.log("a", later(STEPS[:4]))  # its checkpoint's history, and the reports after it
    second.log("a", later(STEPS[4:]))
    assert second.flush(20.0)
    assert {run.info.status for run in runs_of(client).values()} == {"RUNNING"}
    second.mirror(run_info("a"), stored(STEPS))
    second.close()

    runs = runs_of(client)
    assert runs["finetune/a"].info.run_id == cut.info.run_id
    assert runs["finetune/a"].info.status == "FINISHED"
    for metric in values(0):
        assert logged_steps(client, runs["finetune/a"], metric) == STEPS
    assert runs["smoke"].data.params == {
        "name": "smoke",
        "seeds": "[0]",
        "resources.num_cpus": "2",
    }


def test_a_changed_plan_has_its_own_parent_run_and_current_runs(
    storage: Path, tracker_on: MakeTracker
) -> None:
    """The params of a plan never change, and runs of other plans stay with their parents."""
    client, parents = client_of(storage), []
    plans = ({"a": 600}, {"a": 600, "b": 600}, {"c": 1000}, {"a": 600, "b": 600})
    for plan in plans:
        tracker = tracker_on(
            config={"name": "smoke", "runs": list(plan), "steps": [*plan.values()]}
        )
        parents.append(tracker.parent_run_id)
        for key in plan:
            tracker.mirror(run_info(key), stored([2000]))
        tracker.keep_current(plan)
        assert not tracker.close()
        found = client.search_runs([tracker.experiment_id])
        own = [run for run in found if run.data.tags[names.TAG_KIND] == names.KIND_SWEEP]
        current = [run for run in found if run.data.tags[names.TAG_CURRENT] == names.CURRENT]
        (parent,) = [run for run in own if run in current]
        assert parent.info.run_id == tracker.parent_run_id
        assert parent.data.params["steps"] == str([*plan.values()])
        children = [run for run in current if run is not parent]
        assert {run.data.tags[names.TAG_NODE_KEY] for run in children} == set(plan)
        assert {run.data.tags[names.TAG_PARENT_RUN] for run in children} == {parent.info.run_id}
        wanted = f"tags.{names.TAG_CURRENT} = '{names.CURRENT}' and tags.kind = 'run'"
        assert len(client.search_runs([tracker.experiment_id], wanted)) == len(plan)
    assert len(set(parents)) == 3
    assert parents[3] == parents[1]
    assert len(found) == 3 + 3, "each run is there once"


def test_runs_of_a_killed_driver_end_when_they_leave_the_plan(
    storage: Path, tracker_on: MakeTracker
) -> None:
    killed = tracker_on()
    for key in ("a", "b"):
        killed.start(run_info(key))
    assert killed.flush(20.0)
    killed._sender.stop()
    tracker = tracker_on(config={"name": "smoke", "seeds": [0, 1]})
    tracker.start(run_info("a"))
    tracker.keep_current(["a"])
    assert tracker.flush(20.0)
    found = client_of(storage).search_runs([tracker.experiment_id])
    states = sorted((run.info.run_name, run.info.status) for run in found)
    assert states == [
        *(("finetune/a", "RUNNING"), ("finetune/b", "KILLED")),
        *(("smoke", "KILLED"), ("smoke", "RUNNING")),
    ]


def test_a_start_that_fails_keeps_the_sweeps_runs_in_mlflow(
    storage: Path, tracker_on: MakeTracker
) -> None:
    tracker = tracker_on()
    tracker.close()
    client_of(storage).delete_experiment(tracker.experiment_id)
    before = SweepRecord.read(str(storage), "smoke")
    assert before is not None
    assert before.run_id
    with pytest.raises(TrackingError, match="must not be deleted"):
        tracker_on()
    assert SweepRecord.read(str(storage), "smoke") == before


def test_another_driver_continues_the_runs_from_the_storage_alone(
    storage: Path, tracker_on: MakeTracker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a new pod, which has only the first one's bucket and server."""
    kept: dict[str, str] = {}  # stands for a bucket
    monkeypatch.setattr(SweepLocation, "write", lambda _, path, text: kept.update({path: text}))
    monkeypatch.setattr(
        SweepLocation, "read", lambda _, path: json.loads(kept[path]) if path in kept else None
    )
    uri = f"sqlite:///{storage}/mlflow.db"
    for driver, steps in (("one", STEPS[:6]), ("two", STEPS)):
        monkeypatch.setenv("HOME", str(tmp_path / driver))
        tracker = tracker_on(storage="s3://lab/results", tracking_uri=uri)
        tracker.start(run_info("a"))
        tracker.log("a", later(steps))
        tracker.flush(5.0)  # the bucket does not exist, so only artifacts are missing
        assert "records" in str(tracker.undelivered_message())
        tracker.close("KILLED", timeout=0.0)
        assert not [file for file in (tmp_path / driver).rglob("*") if file.is_file()]

    client = client_of(storage)
    run = runs_of(client)["finetune/a"]
    assert logged_steps(client, run) == STEPS
    assert logged_steps(client, run, names.SETTING_ENTROPIC_INDEX) == [0]


def test_a_failed_run_that_succeeds_later_has_no_failure_tag(
    storage: Path, tracker_on: MakeTracker
) -> None:
    tracker = tracker_on()
    tracker.start(run_info("a"))
    tracker.end("a", "FAILED", {names.TAG_FAILURE: "no luck"})
    assert tracker.flush(20.0)
    tracker.mirror(run_info("a"), stored([2000]))
    assert tracker.flush(20.0)
    run = runs_of(client_of(storage))["finetune/a"]
    assert run.info.status == "FINISHED"
    assert names.TAG_FAILURE not in run.data.tags


def test_a_run_that_is_paused_many_times_loses_nothing(
    storage: Path, tracker_on: MakeTracker
) -> None:
    """As a search pauses a run at each rung."""
    tracker = tracker_on()
    for number, step in enumerate(STEPS):
        tracker.start(run_info("a"))
        tracker.log("a", later(STEPS[: number + 1]))
        tracker.end("a", "KILLED")
        if step % 4000:
            time.sleep(0.06)  # the next one begins while this one is delivered
        else:
            tracker.flush(20)
    assert not tracker.close()
    assert logged_steps(client_of(storage), runs_of(client_of(storage))["finetune/a"]) == STEPS


def test_a_deleted_sweep_that_starts_again_has_new_runs(
    storage: Path, tracker_on: MakeTracker
) -> None:
    parents = []
    for _ in range(2):
        tracker = tracker_on()
        parents.append(tracker.parent_run_id)
        tracker.close()
        shutil.rmtree(storage / "smoke")
    assert parents[0] != parents[1]


def test_a_reused_node_is_logged_once(storage: Path, tracker_on: MakeTracker) -> None:
    tracker = tracker_on()
    code = {names.TAG_GIT_COMMIT: "of its training"}
    of_store = StoredRun([report(step, time=step) for step in STEPS], provenance=code)
    trial = run_info("old", tags={names.TAG_PART: "trial3"})
    tracker.mirror(trial, stored(STEPS))
    tracker.mirror(trial, lambda: of_store)
    tracker.start(run_info("new", source_node="old"))
    tracker.log("new", later([2000]))
    tracker.mirror(run_info("new", source_node="old"), lambda: StoredRun(later([2000])))
    tracker.close()
    run_id = tracker._experiment.known_id("old")
    again = tracker_on()

    def read() -> StoredRun:
        raise AssertionError("MLflow has all of it")

    # Its stage has another name now, and is no search.
    place = {names.TAG_STAGE: "renamed", names.TAG_TRIAL: 3}
    again.mirror(run_info("old", name="renamed/old", tags=place), read)
    assert not again.close()
    assert again._experiment.known_id("old") == run_id

    client = client_of(storage)
    runs = runs_of(client)
    old, new = runs["renamed/old"], runs["finetune/new"]
    assert (old.data.tags[names.TAG_STAGE], old.data.tags[names.TAG_TRIAL]) == ("renamed", "3")
    assert names.TAG_PART not in old.data.tags
    assert logged_steps(client, old) == STEPS
    assert old.data.tags[names.TAG_GIT_COMMIT] == "of its training"
    assert (old.info.start_time, old.info.end_time) == (1_700_002_000_000, 1_700_020_000_000)
    assert new.data.tags[names.TAG_SOURCE_RUN] == old.info.run_id


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """A policy's file: one layer that outputs the first two of three inputs."""
    network = PolicyNetwork(
        weights=(np.eye(2, 3, dtype=np.float32),),
        biases=(np.zeros(2, np.float32),),
        mean=np.zeros(3, np.float32),
        inverse_std=np.ones(3, np.float32),
        clip=5.0,
        low=-np.ones(2, np.float32),
        high=np.ones(2, np.float32),
        goal_size=1,
        about={"env_steps": 20_000},
    )
    file = tmp_path / "packed.safetensors"
    file.write_bytes(network.to_bytes())
    return file


def test_many_reused_runs_are_sent_in_few_requests(
    tracker_on: MakeTracker, policy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Histories are sent before policies."""
    calls: list[str] = []

    def watch(name: str) -> None:
        request = getattr(MlflowClient, name)

        def call(*arguments: Any, **options: Any) -> Any:
            calls.append(name)
            return request(*arguments, **options)

        monkeypatch.setattr(MlflowClient, name, call)

    tracker = tracker_on()
    assert tracker.flush(20.0)
    for name in ("create_run", "get_run", "log_batch", "set_terminated", "create_logged_model"):
        watch(name)
    keys = [f"run{number}" for number in range(6)]
    for key in keys:
        tracker.mirror(run_info(key), stored(STEPS, policy.read_bytes()))
    while not calls:  # the end of the sweep's own run would be sent first
        time.sleep(0.01)
    assert not tracker.close(timeout=60.0)
    assert calls[:18] == ["create_run", "log_batch", "set_terminated"] * 6
    assert calls.count("create_logged_model") == 6


# Loads the model where this package can't be imported, and computes an action.
ELSEWHERE = """
import sys, warnings
sys.modules["music_rllib"] = None
warnings.simplefilter("ignore")
import mlflow, numpy
mlflow.set_tracking_uri(sys.argv[1])
model = mlflow.pyfunc.load_model(sys.argv[2])
dictionary = {"observation": numpy.array([0.5, 9.0]), "desired_goal": numpy.zeros(1)}
batch = numpy.array([[0.0, -0.5, 1.0]])
print([model.predict(dictionary).tolist(), model.predict(batch).tolist()])
"""


def test_a_final_policy_is_a_model_that_loads_and_acts(
    storage: Path, tracker_on: MakeTracker, policy: Path
) -> None:
    tracker = tracker_on()
    tracker.start(run_info("a"))
    for _ in range(2):  # as after a crash before the run was marked as complete
        tracker.mirror(run_info("a"), stored([2000], policy.read_bytes()))
        assert tracker.flush(60.0), tracker.pending()
    assert not tracker.close(timeout=60.0)
    client = client_of(storage)
    run = runs_of(client)["finetune/a"]
    (model,) = client.search_logged_models([run.info.experiment_id])
    kept = tracking_utils._artifact_repos_cache
    assert not {run.info.run_id, model.model_id} & kept.keys(), "in memory, for good"
    assert (model.name, model.status, model.source_run_id) == ("policy", "READY", run.info.run_id)
    assert model.tags[names.TAG_TASK] == "FetchPush"
    assert run.outputs is not None
    assert [output.model_id for output in run.outputs.model_outputs] == [model.model_id]
    files = [path for path in (storage / "mlartifacts").rglob("*") if path.is_file()]
    assert not [path for path in files if path.suffix in {".pkl", ".pt", ".pickle"}]
    done = fresh("-c", ELSEWHERE, f"sqlite:///{storage}/mlflow.db", model.model_uri)
    single, batch = json.loads(done.stdout)
    np.testing.assert_allclose(single, np.tanh([0.5, 5.0]), atol=1e-6)
    np.testing.assert_allclose(batch, [np.tanh([0.0, -0.5])], atol=1e-6)


@pytest.mark.filterwarnings("ignore:.*type hint:UserWarning")  # when MLflow is first imported
def test_each_model_has_its_own_policy_and_leaves_nothing_in_memory(
    tmp_path: Path, policy: Path
) -> None:
    alive = []
    for run in range(3):
        network = dataclasses.replace(
            PolicyNetwork.from_file(policy),
            biases=(np.full(2, run, np.float32),),
            about={"seed": run},
        )
        policy.write_bytes(network.to_bytes())
        folder = tmp_path / f"model-{run}"
        write_model(policy, folder, run_id=f"run-{run}", model_id=f"m-{run}")
        gc.collect()
        alive.append(sum(type(thing) is type for thing in gc.get_objects()))
    assert alive[0] == alive[1] == alive[2], "classes of the model's code"
    for run in range(3):
        described = Model.load(tmp_path / f"model-{run}")
        assert (described.run_id, described.model_id) == (f"run-{run}", f"m-{run}")
        assert (described.metadata or {})["seed"] == run
        loaded = mlflow.pyfunc.load_model(str(tmp_path / f"model-{run}"))
        acted = loaded.predict(np.zeros(3, np.float32))
        np.testing.assert_allclose(acted, np.tanh([run, run]), atol=1e-6)


def test_more_metrics_than_the_limit_of_a_request(storage: Path, tracker_on: MakeTracker) -> None:
    tracker = tracker_on()
    tracker.start(run_info("a", config={f"p{i:03}": i for i in range(150)}))
    for step in range(1, 8):
        tracker.log("a", [report(step, {f"group/{i:03}": float(step) for i in range(400)})])
    tracker.log("a", [report(8, {f"wide/{i:04}": 1.0 for i in range(1500)})])
    tracker.log("a", [report(9, {"odd/nan": float("nan")})])
    assert not tracker.close()
    client = client_of(storage)
    run = runs_of(client)["finetune/a"]
    assert len(run.data.params) == 150
    assert len(run.data.metrics) == 400 + 1500 + 1 + 1
    assert logged_steps(client, run, "group/399") == list(range(1, 8))


def test_a_deleted_run_does_not_delay_the_others(
    storage: Path, tracker_on: MakeTracker, caplog: pytest.LogCaptureFixture
) -> None:
    tracker = tracker_on()
    for key in ("gone", "kept"):
        tracker.start(run_info(key))
        tracker.log(key, [report(2000)])
    assert tracker.flush(20.0)
    client = client_of(storage)
    client.delete_run(runs_of(client)["finetune/gone"].info.run_id)
    for key in ("gone", "kept"):
        tracker.mirror(run_info(key), stored([2000, 4000]))
    left = tracker.close(timeout=20.0)
    assert left.records == 2, "its history and its policy"
    assert "does not get all of a run" in caplog.text
    message = tracker.undelivered_message()
    assert message is not None
    assert f"music-rllib resume {storage}/smoke" in message

    again = tracker_on()
    again.mirror(run_info("gone"), stored([2000, 4000]))  # it gets a new run with its whole history
    assert not again.close(timeout=20.0)
    runs = runs_of(client)
    assert logged_steps(client, runs["finetune/kept"]) == [2000, 4000]
    assert logged_steps(client, runs["finetune/gone"]) == [2000, 4000]


def test_a_report_is_attached_to_the_sweeps_run(
    storage: Path, tracker_on: MakeTracker, tmp_path: Path
) -> None:
    tracker = tracker_on()
    tracker.close()
    (tmp_path / "report.html").write_text("page")
    run = SweepRun(store=tracker.store, experiment_id="1", run_id=tracker.parent_run_id)
    run.attach(tmp_path, ["report.html"], "report", "**q = 1.5 is better**")
    (found,) = client_of(storage).list_artifacts(run.run_id, "report")
    assert found.path == "report/report.html"
    noted = runs_of(client_of(storage))["smoke"].data.tags[names.TAG_NOTE]
    assert noted == "**q = 1.5 is better**"


def test_a_moved_storage_keeps_its_artifacts(
    storage: Path, tracker_on: MakeTracker, tmp_path: Path
) -> None:
    # In another process, because MLflow caches a run's place of artifacts.
    fresh("-c", ONE_SWEEP, "smoke", storage)
    moved = tmp_path / "moved"
    storage.rename(moved)
    tracker = tracker_on(storage=str(moved))
    tracker.start(run_info("a"))
    tracker.close()
    assert not storage.exists(), "nothing is written into the earlier folder"
    for run in runs_of(client := client_of(moved)).values():
        place = f"/{run.info.run_id}/artifacts"
        assert run.info.artifact_uri == f"{moved.as_uri()}/mlartifacts/smoke{place}"
    assert client.list_artifacts(tracker.parent_run_id)


def test_tracking_prints_nothing(fresh_store: FreshStore) -> None:
    assert fresh_store.screen == ""


def test_a_second_store_starts_from_empty_tables_of_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has none of the first store's other data."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        monkeypatch.chdir(folder)
        Tracker(sweep_name=f"of {name}", storage=str(folder), config={}).close()
        experiments = client_of(folder).search_experiments()
        assert {one.name for one in experiments} == {"Default", f"of {name}"}
        assert all(str(folder) in str(one.artifact_location) for one in experiments)
        (kept,) = (tmp_path / "cache" / "music_rllib").iterdir()
        assert kept.name == f"mlflow-{mlflow.__version__}.db"


# A killed driver ----------------------------------------------------------------------------------

DRIVER = """
import sys, time
from music_rllib import names
from music_rllib.store.history import Report
from music_rllib.experiment.run_info import RunInfo
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.tracking.tracker import Tracker
tracker = Tracker(sweep_name="smoke", storage=sys.argv[1], config={"name": "smoke", "seeds": [0]})
tracker.start(RunInfo(node_key="a", name="finetune/a", config={"seed": 0}))
for step in range(1, 10_000):
    metrics = {names.EVAL_SUCCESS: float(step)}
    now = round(time.time() * 1000)
    tracker.log("a", [Report(env_steps=step, seconds=0, timestamp_ms=now, metrics=metrics)])
    print(step, flush=True)
    time.sleep(0.002)
"""


def test_a_killed_driver_leaves_neither_gaps_nor_duplicates(
    storage: Path, tracker_on: MakeTracker
) -> None:
    command = [sys.executable, "-c", DRIVER, str(storage)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as driver:
        assert driver.stdout is not None
        reached = next(int(line) for line in driver.stdout if int(line) >= 300)
        driver.kill()  # SIGKILL, probably during a request

    tracker = tracker_on()
    tracker.start(run_info("a", config={"seed": 0}, settings={}))
    # The history of its checkpoint, and repeated steps.
    now = time.time() - 1_700_000_000
    steps = range(1, reached + 50)
    tracker.log("a", [report(step, {names.EVAL_SUCCESS: float(step)}, now) for step in steps])
    assert not tracker.close("KILLED")
    client = client_of(storage)
    points = client.get_metric_history(
        runs_of(client)["finetune/a"].info.run_id, names.EVAL_SUCCESS
    )
    last = max(point.step for point in points)
    assert last >= reached + 49
    assert [point.step for point in points] == list(range(1, last + 1))
    assert all(point.value == point.step for point in points)


# A killed server ----------------------------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def server(
    tmp_path_factory: pytest.TempPathFactory, fresh_store: FreshStore
) -> Iterator[MlflowServer]:
    """Started before the first test, because its start is slow; the last test waits for it."""
    folder = tmp_path_factory.mktemp("server")
    shutil.copy(fresh_store.database, folder)
    server = MlflowServer(folder)
    server.start()
    yield server
    server.signal(signal.SIGKILL)


def test_a_view_is_saved_if_mlflow_has_a_known_version(tracker_on: MakeTracker) -> None:
    tracker = tracker_on()
    # Without a kind, MLflow shows the pages of language models.
    tags = tracker._experiment.client.get_experiment(tracker.experiment_id).tags
    assert tags["mlflow.experimentKind"] == "custom_model_development"
    plain = tracker.comparison_url()
    tracker.keep_view("{}", ["2.0", "3"])
    assert tracker.comparison_url() == f"{plain}&viewStateShareKey={tracker.sweep_id}"
    other = tracker_on(sweep_name="other")
    other.keep_view("{}", ["2.0", "4"])
    assert "viewStateShareKey" not in other.comparison_url()


def test_a_server_killed_while_logging_loses_and_duplicates_nothing(
    server: MlflowServer, tracker_on: MakeTracker, policy: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The server is killed and restarted; later it hangs, and the next driver sends the rest."""
    server.wait()
    tracker = tracker_on(tracking_uri=server.uri)
    tracker.start(run_info("a"))
    steps = list(range(1, 401))
    for step in steps[:100]:
        tracker.log("a", [report(step, time=step)])
        time.sleep(0.005)
    server.signal(signal.SIGKILL)
    tracker.log("a", [report(step, time=step) for step in steps[100:200]])
    tracker.start(run_info("b"))  # a run whose first request reaches a dead server
    tracker.log("b", [report(1)])
    assert not tracker.flush(1.0)
    assert tracker.pending().error is not None

    server.start()
    server.wait()
    assert tracker.flush(30.0), tracker.pending()
    assert caplog.text.count("does not accept records") == 1

    server.signal(signal.SIGSTOP)
    ends = {"a": stored(steps, policy.read_bytes()), "b": stored([1], policy.read_bytes())}
    for key, read in ends.items():
        tracker.mirror(run_info(key), read)
    left = tracker.close(timeout=1.0)
    assert left.records > 0
    server.signal(signal.SIGCONT)
    again = tracker_on(tracking_uri=server.uri)
    for key, read in ends.items():
        again.mirror(run_info(key), read)
    assert not again.close(timeout=60.0)

    client = MlflowClient(server.uri)
    runs = runs_of(client)
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    for metric in values(0):
        assert logged_steps(client, runs["finetune/a"], metric) == steps
    assert logged_steps(client, runs["finetune/b"]) == [1]
    models = client.search_logged_models([runs["finetune/a"].info.experiment_id])
    assert {model.source_run_id for model in models} == {
        run.info.run_id for name, run in runs.items() if name.startswith("finetune/")
    }
    assert len(models) == 2
    assert {model.status for model in models} == {"READY"}
