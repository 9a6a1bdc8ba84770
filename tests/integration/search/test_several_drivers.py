"""Several drivers of a search show the same sweep, and runs of a search are trained again.

A formula replaces the training of runs; the studies' database and the node store are real.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import time
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from music_rllib.experiment.open_sweep import (
    OpenSweep,
    decide,
    found_runs,
    open_sweep,
    remove_damaged,
    remove_runs,
)
from music_rllib.experiment.record import keep_record
from music_rllib.experiment.sweep_files import CONFIG, PLAN, STATE, SweepLocation, as_json
from music_rllib.program import main
from music_rllib.search import searches as searches_module
from music_rllib.search.outcome import outcome
from music_rllib.search.study import SCORES
from music_rllib.store.lease import Lease, LeaseFile, process_start
from music_rllib.sweep.commands.status import state_of
from music_rllib.sweep.driver_lock import DRIVERS
from music_rllib.sweep.listeners.state_file import StateFile
from tests.played_search import Driver, document


def play_in_turns(folder: Path, trials: int, turns: int) -> list[Driver]:
    """Two drivers of one sweep that have computed one run in each turn."""
    content = document({"concurrent": 3, "trials": trials}, seeds=[0])
    drivers = [Driver(folder, content, seed=seed, leases=True) for seed in (0, 1)]
    keep_record(drivers[0].sweep)
    for driver in drivers * turns:
        with contextlib.suppress(AssertionError):  # it only waits
            driver.play(stop_after=len(driver.computed) + 1, slots=1)
    return drivers


def written(driver: Driver, end: str | None = None) -> dict[str, Any]:
    """The state that a driver writes, also into the storage."""
    with StateFile(driver.sweep) as state:
        state.searches = functools.partial(outcome, driver.controller, thorough=False)
        driver.controller.refresh()
        state._update()
        state._write()
        if end:
            driver.controller.stop()
            state.end(end)
    return state._state


def test_each_driver_of_a_study_shows_the_trials_of_all(tmp_path: Path) -> None:
    drivers = play_in_turns(tmp_path, trials=6, turns=3)
    for driver in drivers:
        state = written(driver)
        assert state["searches"][0]["arms"][0]["judged"] == 5
        assert state["stages"][1]["trials"] == 5
        assert state["env_steps"] == {"done": 6 * 4000, "left": 0, "to_come": 4000}
        place = str(driver.sweep.folder)
        assert main(["best", place, "--output", str(tmp_path / "best")]) == 0
        plan = json.loads((driver.sweep.folder / PLAN).read_text())
        assert len(plan["trials"]) == 5


def test_the_plan_of_stopped_drivers_has_the_runs_of_all(tmp_path: Path) -> None:
    """`clean` finds the checkpoints of interrupted runs there."""
    drivers = play_in_turns(tmp_path, trials=8, turns=2)
    begun = []
    for driver in drivers:
        driver.controller.refresh()
        driver.controller.propose()
        node = driver.sweep.scheduler.next_ready()
        assert node is not None
        driver.sweep.scheduler.start(node.key)
        begun.append(node.key)
    assert begun[0] != begun[1]
    for driver in drivers:
        written(driver, end="stopped")
    assert {node["key"] for node in drivers[0].sweep.location.nodes()} >= {*begun}


def test_deleted_runs_of_a_trial_that_was_stopped_after_some_seeds_are_trained_again(
    tmp_path: Path,
) -> None:
    values = (1.5, 1.25, 2.5, 2.25)
    search = {
        "trials": 4,
        "concurrent": 1,
        "sampler": "random",
        "points_to_evaluate": [{"tac.entropic_index": q, "tac.alpha": 0.05} for q in values],
        "pruning": {"rungs": [{"seeds": 2}], "warm_up": 1},
    }
    first = Driver(tmp_path, document(search))
    first.play()
    keep_record(first.sweep)
    assert first.trials()[1]["state"] == "pruned"

    def remove(sweep: OpenSweep) -> OpenSweep:
        again, _ = decide(sweep, found_runs(sweep), ["trial1"], all_changed=False, keep=True)
        return remove_runs(sweep, again, print)

    driver = Driver(tmp_path, document(search), change=remove)
    driver.play()
    assert len(driver.computed) == 2
    assert driver.sweep.finished == first.sweep.finished
    assert driver.trials() == first.trials()


def test_a_damaged_pretraining_of_a_trial_is_trained_again(tmp_path: Path) -> None:
    space = {"tac.alpha": {"choice": [0.05]}, "pretrain:music.lr": {"choice": [0.001, 0.01]}}
    content = document({"space": space, "sampler": "grid", "trials": None}, seeds=[0])
    first = Driver(tmp_path, content)
    first.play()
    keep_record(first.sweep)
    source = next(node for node in first.sweep.plan.nodes if node.stage == "pretrain")

    def repair(sweep: OpenSweep) -> OpenSweep:
        (Path(sweep.storage) / "nodes" / source.key / "history.jsonl").write_bytes(b"x")
        sweep = open_sweep(sweep.config, sweep.plan, sweep.storage, lenient=True)
        remove_damaged(sweep, print)
        return remove_runs(sweep, [], print)

    driver = Driver(tmp_path, content, change=repair)
    driver.play()
    assert driver.computed == [f"{source.key}/None"]


def test_a_run_below_the_threshold_counts_its_own_budget_at_a_rung(tmp_path: Path) -> None:
    steps_to = {"read": "steps_to", "threshold": 2.0}
    search = {"trials": 1, "pruning": {"rungs": [{"env_steps": 5000}]}, "objective": steps_to}
    content = document(search, seeds=[0], tasks=["FetchPush", "FetchSlide"])
    content["stages"][1]["per_task"] = {"FetchSlide": {"env_steps": 6000}}
    driver = Driver(tmp_path, content)
    driver.play()
    (trial,) = driver.controller.searches[0].studies[0].trials()
    assert trial.user_attrs[SCORES] == {"0": [[[4000.0, 5000.0]]], "1": [[[4000.0, 6000.0]]]}


def test_drivers_that_create_a_database_at_the_same_moment_both_use_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create, tries = searches_module._storage, list[object]()

    def storage(url: Any) -> Any:
        tries.append(url)
        if len(tries) == 1:  # as SQLite answers the second of two drivers
            raise OperationalError("CREATE", {}, Exception("table trials already exists"))
        return create(url)

    monkeypatch.setattr(searches_module, "_storage", storage)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    searches_module.open_studies(f"sqlite:///{tmp_path}/x.db")
    assert len(tries) == 2


def test_a_sweep_runs_until_its_last_driver_stops(tmp_path: Path) -> None:
    location = SweepLocation(storage=str(tmp_path), name="s")
    mine, parent = Lease.of_this_process("sweep 's'"), os.getppid()
    other = {"owner": "b", "pid": parent, "process_started": process_start(parent)}
    driver = {name: getattr(mine, name) for name in ("pid", "host", "machine", "process_started")}
    driver |= {"started": 0.0, "ended": time.time(), "heartbeat": time.time(), "outcome": "stopped"}
    state: dict[str, Any] = {
        "sweep": "s",
        "driver": driver,
        "stages": [],
        "running": [],
        "best": None,
    }
    state |= {"env_steps": {"done": 0, "left": 0, "to_come": 0}, "searches": [], "failures": []}
    for file, content in ((STATE, state), (CONFIG, {"stages": []}), (PLAN, {"nodes": []})):
        location.keep(file, as_json(content))
    for lease in (mine, mine.model_copy(update=other)):
        LeaseFile(location.files / DRIVERS, f"{lease.owner}.json").acquire(lease)
    assert state_of(location)["state"] == "running"
    LeaseFile(location.files / DRIVERS, "b.json").release("b")
    assert state_of(location)["state"] == "stopped"
