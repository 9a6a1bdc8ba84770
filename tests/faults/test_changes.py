"""A sweep whose configuration has changed since it was last run."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from music_rllib.config.load import load_config
from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.open_sweep import OpenSweep, open_sweep
from music_rllib.experiment.plan import continuation_key, make_plan
from music_rllib.experiment.record import changes_since, continued_runs_text, keep_record
from music_rllib.store import lease as lease_module
from music_rllib.store.history import RunResult
from music_rllib.store.lease import Lease, LeaseFile
from music_rllib.store.storage import StorageError, open_storage
from music_rllib.sweep.driver_lock import hold_driver_lock

RESULT = RunResult(label="l", env_steps=1200, seconds=1.0, metrics={})


def opened(folder: Path, document: dict[str, Any]) -> OpenSweep:
    path = folder / "sweep.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    config: SweepConfig = load_config(path)
    storage = folder / "results"
    return open_sweep(config, make_plan(config), str(storage))


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


def test_a_second_driver_is_refused_and_a_dead_one_does_not_count(
    tmp_path: Path, sweep_document: dict[str, Any]
) -> None:
    sweep = opened(tmp_path, sweep_document)
    file = LeaseFile(open_storage(str(sweep.folder)), "driver.json")
    theirs = Lease.of_this_process("sweep 'points'")
    assert file.acquire(theirs) is None
    match = rf"points must be used by one process at a time.*\(process {os.getpid()} on "
    with pytest.raises(StorageError, match=match), hold_driver_lock(sweep):
        pass
    file.release(theirs.owner)

    child = os.fork()
    if child == 0:
        file.acquire(Lease.of_this_process("sweep 'points'"))
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert file.read() is not None
    with hold_driver_lock(sweep):
        assert file.is_owned_by(str(getattr(file.read(), "owner", None)))
    assert file.read() is None


def test_a_suspended_driver_exits_if_another_one_has_its_sweep(
    tmp_path: Path, sweep_document: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It continues if the other driver has ended."""
    monkeypatch.setattr(lease_module, "EXPIRES_SECONDS", 0.4)
    sweep = opened(tmp_path, sweep_document)
    file = LeaseFile(open_storage(str(sweep.folder)), "driver.json")
    ended: list[int] = []
    said: list[str] = []
    monkeypatch.setattr("music_rllib.sweep.driver_lock.end_process", ended.append)
    theirs = Lease.of_this_process("sweep 'points'", 60.0)
    with hold_driver_lock(sweep, said.append):
        mine = file.read()
        assert mine is not None
        file.release(mine.owner)
        wait_until(lambda: file.read() is not None)
        again = file.read()
        assert again is not None
        assert (again.owner != mine.owner, ended) == (True, [])
        Path(file.path).write_text(theirs.model_dump_json())
        wait_until(lambda: bool(ended))
    assert ended == [1]
    assert "points has been taken over by sweep 'points'" in said[0]
    assert file.is_owned_by(theirs.owner)


def wait_until(happened: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.02)
