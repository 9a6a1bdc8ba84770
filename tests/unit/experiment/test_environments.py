"""Results and checkpoints of a different environment are not used without consent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from music_rllib import names
from music_rllib.envs.fingerprint import Fingerprint
from music_rllib.errors import BadInputError
from music_rllib.experiment.open_sweep import (
    FoundRun,
    OpenSweep,
    accept_environments,
    changed_text,
    decide,
    found_runs,
    open_sweep,
    remove_runs,
)
from music_rllib.experiment.plan import Node, continuation_key, make_plan
from music_rllib.experiment.record import changes_since, keep_record
from music_rllib.experiment.scheduler import Status
from music_rllib.results.analysis import mixed
from music_rllib.results.data import RunRecord
from music_rllib.store.history import RunResult
from music_rllib.store.lease import Lease
from music_rllib.sweep.clean import remove_started, started_from
from tests.sweep_files import loaded

OLD = {"package mujoco": "3.8.0", "source lab_env.py": "a"}
NEW = {"package mujoco": "3.8.1", "source lab_env.py": "b"}
RESULT = RunResult(label="l", env_steps=400, seconds=1.0, metrics={})


def opened(folder: Path, environment: Fingerprint, name: str = "s", **defaults: Any) -> OpenSweep:
    """A sweep of two tasks; runs of the second stage start from runs on Lab."""
    lab = {"horizon": 20, "agent_indices": [0], "surrounding_indices": [1]}
    document = {
        "name": name,
        "tasks": ["Lab", "Field"],
        "environments": {"Lab": {"env_id": "a:A", **lab}, "Field": {"env_id": "b:B", **lab}},
        "defaults": {
            "env_steps": 400,
            "tac": {"random_steps": 100},
            "evaluation": {"interval": 200},
            **defaults,
        },
        "stages": [
            {"name": "pretrain", "variant": "music-u", "tasks": ["Lab"]},
            {
                "name": "finetune",
                "variant": "music-r",
                "tasks": ["Field"],
                "init_from": {"stage": "pretrain", "task": "Lab"},
            },
        ],
    }
    config, storage = loaded(folder, document), str(folder / "results")
    environments = {"Lab": environment, "Field": {"source field.py": "f"}}
    return open_sweep(config, make_plan(config), storage, environments=environments)


def finish(sweep: OpenSweep, node: Node, environment: Fingerprint | None, folder: Path) -> None:
    (folder / "made").mkdir(exist_ok=True)
    sweep.store.publish(node.key, folder / "made", RESULT, environment)


def finished(folder: Path, environment: Fingerprint | None = OLD) -> OpenSweep:
    sweep = opened(folder, OLD)
    pretrain, finetune = sweep.plan.nodes
    finish(sweep, pretrain, environment, folder)
    finish(sweep, finetune, sweep.environments.now["Field"], folder)
    return sweep


def text_of(sweep: OpenSweep) -> str | None:
    return changed_text(sweep, found_runs(sweep))


def again_of(sweep: OpenSweep, retrain: list[str], *, all_changed: bool = False) -> list[FoundRun]:
    return decide(sweep, found_runs(sweep), retrain, all_changed=all_changed, keep=True)[0]


@pytest.mark.parametrize("name", ["s", "another"])
def test_a_changed_environment_is_named_with_its_runs_and_under_every_name(
    tmp_path: Path, name: str
) -> None:
    finished(tmp_path)
    assert text_of(opened(tmp_path, OLD, name)) is None
    lines = str(text_of(opened(tmp_path, NEW, name))).splitlines()
    assert lines[:2] == [
        "the environment of Lab has changed since 1 run used it: mujoco 3.8.0 -> 3.8.1, "
        "lab_env.py changed",
        "  pretrain/Lab/seed0: is finished",
    ]
    assert [option in lines[2] for option in ("--retrain", "--keep-runs")] == [True, True]
    assert len(lines) == 3


def test_checkpoints_and_ends_of_shorter_runs_are_checked(tmp_path: Path) -> None:
    first = opened(tmp_path, OLD)
    pretrain = first.plan.nodes[0]
    place = first.store.continuation(continuation_key(pretrain.run, None))
    with place.new_checkpoint(400, OLD):
        pass
    longer = opened(tmp_path, NEW, env_steps=800)
    assert "would continue a run of 400 env steps" in str(text_of(longer))
    with first.store.work_folder(longer.plan.nodes[0].key).new_checkpoint(200, OLD):
        pass
    longer = opened(tmp_path, NEW, env_steps=800)
    assert "is at 200 env steps" in str(text_of(longer))
    assert text_of(opened(tmp_path, OLD, env_steps=800)) is None
    remove_runs(longer, again_of(longer, ["Lab"]), print)
    assert not found_runs(longer)
    assert not place.names()


def test_a_run_that_is_extended_twice_does_not_lose_its_checkpoint(tmp_path: Path) -> None:
    """The finished end of 400 steps is shorter than the checkpoint of the run with 800."""
    first = finished(tmp_path)
    pretrain = first.plan.nodes[0]
    with first.store.continuation(continuation_key(pretrain.run, None)).new_checkpoint(400, OLD):
        pass
    second = opened(tmp_path, OLD, env_steps=800)
    assert changes_since(second) is None
    keep_record(second)
    with first.store.work_folder(second.plan.nodes[0].key).new_checkpoint(600, OLD):
        pass
    assert "is at 600 env steps" in str(changes_since(opened(tmp_path, OLD, env_steps=1200)))


def test_runs_that_start_from_a_retrained_run_are_retrained(tmp_path: Path) -> None:
    finished(tmp_path)
    sweep = opened(tmp_path, NEW)
    pretrain, finetune = sweep.plan.nodes
    assert not again_of(sweep, [])
    again = again_of(sweep, [], all_changed=True)
    assert [run.label for run in again] == [pretrain.label, finetune.label]
    assert again_of(sweep, ["pretrain/seed0"]) == again
    assert [r.label for r in again_of(sweep, ["Field"])] == [finetune.label]
    with pytest.raises(BadInputError, match=r"--retrain must name a task or a run .* got 'Fild'"):
        again_of(sweep, ["Fild"])
    lease = Lease.of_this_process("sweep 'other'")
    work = sweep.store.work_folder(finetune.key).lease
    assert work.acquire(lease) is None
    with pytest.raises(BadInputError, match=r"must not be running to be retrained, .* sweep 'oth"):
        remove_runs(sweep, again, print)
    assert sweep.store.is_finished(pretrain.key), "nothing was deleted"
    work.release(lease.owner)
    sweep = remove_runs(sweep, again, print)
    assert [sweep.scheduler[node.key] for node in sweep.plan.nodes] == [Status.WAITING] * 2
    assert not sweep.store.is_finished(pretrain.key)


def test_runs_of_other_sweeps_that_start_from_a_retrained_run_are_deleted(tmp_path: Path) -> None:
    """Their keys do not change, so they would be reused."""
    done = finished(tmp_path)
    keep_record(opened(tmp_path, NEW, "another"))
    pretrain, finetune = done.plan.nodes
    (started,) = started_from(done.location, [pretrain.key])
    assert (started["key"], started["label"]) == (finetune.key, f"another: {finetune.label}")
    said: list[str] = []
    remove_started(done.store, [started], said.append)
    assert not done.store.is_finished(finetune.key)
    assert said == [f"another: {finetune.label}: deleted, it starts from a run to be retrained"]
    # Also if the run is in an earlier plan only.
    other = opened(tmp_path, NEW, "another", env_steps=500)
    keep_record(other)
    labels = [one["label"] for one in started_from(done.location, [pretrain.key])]
    assert labels == [f"another: {finetune.label} (earlier version)"]


def test_a_damaged_manifest_does_not_hide_the_choice_to_retrain(tmp_path: Path) -> None:
    sweep = finished(tmp_path)
    key = sweep.plan.nodes[0].key
    Path(sweep.store.path(key), "manifest.json").write_text('{"version"')
    now = sweep.environments.now
    damaged = open_sweep(
        sweep.config, make_plan(sweep.config), sweep.storage, environments=now, lenient=True
    )
    assert key in damaged.damaged
    assert key in {run.key for run in found_runs(damaged)}


def test_a_decision_applies_to_every_sweep_in_the_storage(tmp_path: Path) -> None:
    finished(tmp_path)
    sweep = opened(tmp_path, NEW)
    sweep = accept_environments(sweep, found_runs(sweep), print)
    assert text_of(sweep) is None
    for environment in (NEW, OLD):
        assert text_of(opened(tmp_path, environment, "another")) is None
    newest = NEW | {"source lab_env.py": "c"}
    assert "lab_env.py changed" in str(text_of(opened(tmp_path, newest)))
    first, later = opened(tmp_path, OLD), opened(tmp_path, NEW)
    assert first.environments.earliest("Lab") == later.environments.earliest("Lab")
    assert first.environments.earliest("Lab") != opened(tmp_path, newest).environments.earliest(
        "Lab"
    )


def test_runs_without_a_recorded_environment_are_used(tmp_path: Path) -> None:
    finished(tmp_path, None)
    assert text_of(opened(tmp_path, NEW)) is None


def test_a_comparison_names_runs_of_several_environments() -> None:
    def run(name: str, digest: str, task: str = "Lab", status: str = "FINISHED") -> RunRecord:
        tags = {names.TAG_TASK: task, names.TAG_ENVIRONMENT: digest}
        return RunRecord(run_id=name, name=name, status=status, tags=tags)

    runs = [run("seed0", "aaaaaaaa"), run("seed1", "bbbbbbbb"), run("seed2", "")]
    others = [run("seed0", "bbbbbbbb", "Field"), run("seed3", "cccccccc", status="KILLED")]
    assert not list(mixed([runs[0], runs[2], *others]))
    (line,) = mixed([*runs, *others])
    assert line == (
        "Runs on Lab are compared that used 2 versions of its environment: seed0 (aaaaaa); "
        "seed1 (bbbbbb)."
    )
