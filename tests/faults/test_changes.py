"""A sweep whose configuration has changed since it was last run."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from ray import ObjectRef
from ray.air.execution._internal.actor_manager import RayActorManager
from ray.tune import PlacementGroupFactory
from ray.tune.search import Searcher

from music_rllib.errors import BadInputError
from music_rllib.experiment.open_sweep import OpenSweep, continued_runs_text, open_sweep
from music_rllib.experiment.plan import Node, continuation_key, make_plan
from music_rllib.experiment.record import changes_since, keep_record
from music_rllib.experiment.scheduler import Listener
from music_rllib.store import lease as lease_module
from music_rllib.store.history import RunResult
from music_rllib.store.lease import Lease, LeaseFile
from music_rllib.store.storage import open_storage
from music_rllib.sweep.driver_lock import alone, driving
from music_rllib.tune.runner import DagSearcher, SharedRuns, _forget_ended
from tests.sweep_files import loaded

RESULT = RunResult(label="l", env_steps=1200, seconds=1.0, metrics={})


def opened(folder: Path, document: dict[str, Any]) -> OpenSweep:
    config = loaded(folder, document)
    return open_sweep(config, make_plan(config), str(folder / "results"))


def finish(sweep: OpenSweep, folder: Path, *labels: str) -> None:
    (folder / "made").mkdir(exist_ok=True)
    for node in sweep.plan.nodes:
        if node.label in labels:
            sweep.store.publish(node.key, folder / "made", RESULT)


def test_changed_settings_and_affected_runs_are_listed(
    tmp_path: Path, sweep_document: dict[str, Any]
) -> None:
    first = opened(tmp_path, sweep_document)
    assert changes_since(first) is None, "the first time"
    keep_record(first)
    finish(first, tmp_path, "pretrain/Point/seed0")
    begun = next(node for node in first.plan.nodes if node.label.startswith("finetune"))
    begun_values = begun.label.split("/")[2].replace("tac.entropic_index", "q")
    with first.store.work_folder(begun.key).new_checkpoint(800):
        pass
    assert changes_since(opened(tmp_path, sweep_document)) is None, "nothing has changed"

    sweep_document["stages"][1]["grid"]["tac.entropic_index"] = [1.0, 1.5, 2.0]
    sweep_document["seeds"] = [0, 1]
    assert changes_since(opened(tmp_path, sweep_document)) is None, "additions change nothing"

    sweep_document["defaults"]["tac"]["lr"] = 0.01
    changes = changes_since(opened(tmp_path, sweep_document))
    assert changes is not None
    assert changes.differences == ("tac.lr: 0.001 -> 0.01 (3 runs)",)
    assert set(changes.lost) == {
        "pretrain/seed0: is finished",
        f"finetune/{begun_values}/seed0: is at 800 env steps",
    }
    text = str(changes)
    assert text.startswith("the configuration of sweep 'points' has changed")
    assert "--accept-changes" in text
    assert "--name NEW" in text


def test_more_env_steps_continue_finished_runs_without_a_question(
    tmp_path: Path, sweep_document: dict[str, Any]
) -> None:
    sweep_document["stages"] = sweep_document["stages"][:1]
    first = opened(tmp_path, sweep_document)
    keep_record(first)
    finish(first, tmp_path, "pretrain/Point/seed0")
    assert continued_runs_text(first) == []
    sweep_document["defaults"]["env_steps"] = 2000
    changes = changes_since(opened(tmp_path, sweep_document))
    assert changes is not None
    assert changes.differences == ("env_steps: 1200 -> 2000 (1 run)",)
    assert changes.lost == (
        "seed0: is finished; it has kept no checkpoint of its end (checkpoints.finished_mb, or its "
        "env_steps are not a multiple of evaluation.interval and of 1,000)",
    )

    (node,) = first.plan.nodes
    with first.store.continuation(continuation_key(node.run, None)).new_checkpoint(1200):
        pass
    sweep = opened(tmp_path, sweep_document)
    assert changes_since(sweep) is None
    assert continued_runs_text(sweep) == [
        "1 run continues a finished run with fewer env_steps: 1,200 env steps less to train."
    ]

    # A schedule over the budget would have had other values from the start.
    q = {"schedule": "linear", "start": 2.0, "end": 1.0}
    sweep_document["defaults"] |= {"env_steps": 1200}
    sweep_document["defaults"]["tac"]["entropic_index"] = q
    linear = opened(tmp_path, sweep_document)
    keep_record(linear)
    finish(linear, tmp_path, "pretrain/Point/seed0")
    sweep_document["defaults"]["env_steps"] = 2000
    changes = changes_since(opened(tmp_path, sweep_document))
    assert changes is not None
    assert changes.lost == (
        "seed0: is finished; tac.entropic_index would have had other values with the new env_steps",
    )


def test_a_new_version_of_the_algorithm_is_named(
    tmp_path: Path, sweep_document: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = opened(tmp_path, sweep_document)
    keep_record(first)
    finish(first, tmp_path, "pretrain/Point/seed0")
    monkeypatch.setattr("music_rllib.experiment.plan.ALGORITHM_VERSION", "next")
    changes = changes_since(opened(tmp_path, sweep_document))
    assert changes is not None
    (line,) = changes.differences
    assert line.startswith("version of the algorithm: ")
    assert line.endswith(" -> next")


def test_the_program_starts_nothing_until_changes_are_accepted(
    sweep_program: Any, sweep_document: dict[str, Any]
) -> None:
    sweep_document["stages"] = sweep_document["stages"][:1]
    first = opened(sweep_program.folder, sweep_document)
    keep_record(first)
    finish(first, sweep_program.folder, "pretrain/Point/seed0")
    sweep_document["defaults"]["tac"]["lr"] = 0.01
    sweep_program.write(sweep_document)
    code, output, errors = sweep_program.run()
    assert code == 2
    assert "tac.lr: 0.001 -> 0.01 (1 run)" in errors
    assert "starting a local Ray" not in output
    code, output, errors = sweep_program.run(command="plan")
    assert code == 0
    assert "tac.lr: 0.001 -> 0.01 (1 run)" in output


@pytest.mark.thorough
def test_accepted_changes_are_trained(sweep_program: Any, sweep_document: dict[str, Any]) -> None:
    sweep_document["stages"] = sweep_document["stages"][:1]
    first = opened(sweep_program.folder, sweep_document)
    keep_record(first)
    finish(first, sweep_program.folder, "pretrain/Point/seed0")
    sweep_document["defaults"]["tac"]["lr"] = 0.01
    sweep_program.write(sweep_document)
    code, output, errors = sweep_program.run("--accept-changes")
    assert code == 0, output + errors
    assert "] seed0: finished" in output
    assert len(list((sweep_program.folder / "results" / "nodes").iterdir())) == 2


def test_drivers_know_of_each_other_and_not_of_a_dead_one(
    tmp_path: Path, sweep_document: dict[str, Any]
) -> None:
    sweep = opened(tmp_path, sweep_document)
    with driving(sweep.location) as one:
        one.check_alone()
        with driving(sweep.location) as other:
            assert [lease.owner for lease in one.others()] == [other.owner]
            match = rf"got sweep 'points' \(process {os.getpid()} on .*: stop it first"
            with pytest.raises(BadInputError, match=match):
                one.check_alone()
    child = os.fork()
    if child == 0:
        with driving(sweep.location), alone(sweep.location, print):
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    with driving(sweep.location) as one, alone(sweep.location, print) as waited:
        assert (one.others(), waited) == ([], False)


def test_drivers_prepare_one_after_another(
    tmp_path: Path, sweep_document: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("music_rllib.sweep.driver_lock.WAIT_SECONDS", 0.05)
    sweep = opened(tmp_path, sweep_document)
    said: list[str] = []
    with alone(sweep.location, said.append) as waited:
        assert not waited
        file = LeaseFile(open_storage(sweep.storage) / "points", "driver.json")
        theirs = file.read()
        assert theirs is not None
        threading.Timer(0.2, file.release, [theirs.owner]).start()
        with alone(sweep.location, said.append) as waited:
            assert waited
    assert said == [f"waits for {theirs}, which prepares or ends"]


class Seen(Listener):
    """Labels of the runs that other processes computed and finished."""

    def __init__(self) -> None:
        self.events: list[str] = []

    def left(self, node: Node, holder: str) -> None:
        self.events.append(f"{node.label} left to {holder.partition(' (')[0]}")

    def finished(self, node: Node, result: RunResult) -> None:
        self.events.append(f"{node.label} finished")


def test_a_driver_takes_the_next_free_run(
    tmp_path: Path, sweep_document: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The driver waits for a parent trained elsewhere, and takes over from a dead process."""
    sweep_document["seeds"] = [0, 1]
    sweep, seen = opened(tmp_path, sweep_document), Seen()
    shared = SharedRuns(sweep, [seen])
    shared._seconds = 0.0
    searcher = DagSearcher(sweep.scheduler, lambda node: {"label": node.label}, shared=shared)
    theirs, mine = (node for node in sweep.plan.nodes if node.stage == "pretrain")
    other = Lease.of_this_process("sweep 'other'", 3600.0)  # its clock is fast
    other = other.model_copy(update={"machine": "another", "pid": 7})
    lease = sweep.store.work_folder(theirs.key).lease
    assert lease.acquire(other) is None
    assert searcher.suggest("1") == {"label": mine.label}
    assert searcher.suggest("2") is None, "it continues with its trial"
    sweep.scheduler.fail(mine.key)
    assert searcher.suggest("3") == Searcher.FINISHED, "it leaves Tune, and holds no CPU"
    assert not searcher.over
    assert searcher.next() is None
    (tmp_path / "made").mkdir()
    sweep.store.publish(theirs.key, tmp_path / "made", RESULT)
    node = searcher.next()
    assert node is not None
    assert (node.stage, node.run.seed) == ("finetune", 0)
    assert seen.events == [f"{theirs.label} left to sweep 'other'", f"{theirs.label} finished"]
    assert sweep.store.work_folder(node.key).lease.acquire(other) is None
    (second,) = {one["label"] for _ in range(3) if isinstance(one := searcher.suggest(""), dict)}
    assert second != node.label
    monkeypatch.setattr(lease_module, "EXPIRES_SECONDS", 0.0)
    assert searcher.next() == node, "its lease is not renewed"
    worker = sweep.store.work_folder(node.key).lease
    assert worker.acquire(Lease.of_this_process("mine")) is None, "it need not watch it"


def test_tune_keeps_nothing_of_ended_runs() -> None:
    """Ray's own manager keeps results of reused processes, and requests that it canceled."""
    manager = RayActorManager(resource_manager=MagicMock())
    live, cancelled = (
        manager.add_actor(object, {}, PlacementGroupFactory([{"CPU": 1}])) for _ in range(2)
    )
    for actor in (live, cancelled):
        manager.schedule_actor_task(actor, "stop")
    manager.remove_actor(cancelled)
    tasks, futures = (
        manager._pending_actors_to_enqueued_actor_tasks,
        manager._tracked_actors_to_task_futures,
    )
    future, ended = ObjectRef.from_random(), ObjectRef.from_random()
    manager._actor_task_events.track_future(future)
    futures[live] |= {future, ended}
    assert cancelled in tasks
    _forget_ended(manager)
    assert (set(tasks), futures[live]) == ({live}, {future})
