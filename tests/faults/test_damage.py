"""Damaged checkpoints and handoffs are found, named, never executed, and survived if possible.

One node as a trial, in this process; the damage is done to the files of an interrupted run.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from music_rllib.config.schema import Checkpoints
from music_rllib.envs.tasks import Task
from music_rllib.store.lease import Lease
from music_rllib.store.node_store import NodeStore
from music_rllib.training.job import NodeJob
from music_rllib.training.worker import CAUSE, LEFT, NOTES, STOPPED, RunTrainable
from tests.hostile_files import Bomb
from tests.integration.sweep.test_sweep_trainable import (
    compute,
    job,
    nothing_in_the_home_folder,
    numbers,
    point_environment,
    settings,
)
from tests.processes import fresh

__all__ = ["nothing_in_the_home_folder", "point_environment"]

pytestmark = pytest.mark.usefixtures("local_ray")

BOMB = "TOUCHED-BY-A-PICKLE"


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, NodeJob]:
    """The storages of an uninterrupted run, and of the same run after 400 of 600 steps."""
    whole, broken = tmp_path_factory.mktemp("whole"), tmp_path_factory.mktemp("broken")
    compute(job(whole, settings("tac")))
    node = job(broken, settings("tac"))
    compute(node, steps=3)
    return whole, broken, node


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-3])


def bomb(path: Path) -> None:
    """The hashes match, so only the format prevents its execution."""
    path.write_bytes(pickle.dumps(Bomb(path.with_name(BOMB))))
    manifest = path.parent / "manifest.json"
    content = json.loads(manifest.read_text())
    data = path.read_bytes()
    content["files"][path.name] = {
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    manifest.write_text(json.dumps(content))


DAMAGE: list[tuple[str, str, Callable[[Path], None]]] = [
    ("checkpoint", "state.safetensors", flip),
    ("checkpoint", "state.json", truncate),
    ("checkpoint", "history.jsonl", Path.unlink),
    ("checkpoint", "manifest.json", truncate),
    ("checkpoint", "manifest.json", Path.unlink),
    ("part", "trajectories.safetensors", flip),
    ("part", "trajectories.safetensors", Path.unlink),
    ("part", "manifest.json", Path.unlink),
]


@pytest.mark.parametrize(("where", "file", "damage"), DAMAGE)
def test_a_damaged_newest_checkpoint_changes_no_number(
    where: str,
    file: str,
    damage: Callable[[Path], None],
    cut: tuple[Path, Path, NodeJob],
    tmp_path: Path,
) -> None:
    whole, broken, _ = cut
    shutil.copytree(broken, tmp_path, dirs_exist_ok=True)
    node = job(tmp_path, settings("tac"))
    work = tmp_path / "work" / node.key
    newest = NodeStore(str(tmp_path)).work_folder(node.key).names()[-1]
    # The newest part belongs to the newest checkpoint only.
    parts = sorted((work / "parts").iterdir())
    damage((work / newest if where == "checkpoint" else parts[-1]) / file)
    results = compute(node)
    notes = [note for result in results for note in result[NOTES]]
    if (file, damage) != ("manifest.json", Path.unlink) or where == "part":
        assert notes[0].startswith("a damaged checkpoint is skipped: "), notes
        assert file in notes[0]
    assert notes[-1] == "continues at 200 env steps"
    assert numbers(tmp_path, node) == numbers(whole, node)


def test_a_pickle_in_place_of_a_checkpoint_is_never_executed(
    cut: tuple[Path, Path, NodeJob], tmp_path: Path
) -> None:
    _, broken, _ = cut
    node = job(tmp_path, settings("tac"))
    for where, file in (("", "state.safetensors"), ("", "state.json"), ("parts", "trajec*")):
        shutil.rmtree(tmp_path / "work", ignore_errors=True)
        shutil.copytree(broken, tmp_path, dirs_exist_ok=True)
        newest = NodeStore(str(tmp_path)).work_folder(node.key).names()[-1]
        folder = tmp_path / "work" / node.key / (where or newest)
        bomb(sorted(folder.rglob(file))[-1])
        (result,) = compute(node)
        assert "must be a" in result[CAUSE]
        assert not list(tmp_path.rglob(BOMB))


OTHER = Task(
    name="Point",
    env_id="point_env:Point-v0",
    horizon=10,
    agent_indices=(0, 1),
    surrounding_indices=(2, 3),
)


def _of_another_task(folder: Path) -> None:
    path = folder / "handoff" / "handoff.json"
    content = json.loads(path.read_text())
    content["info"]["task"]["horizon"] = OTHER.horizon
    path.write_text(json.dumps(content))


def test_a_run_refuses_a_damaged_handoff(tmp_path: Path) -> None:
    source = job(tmp_path, settings("music-u", env_steps=200))
    compute(source)
    node = job(tmp_path, settings("music-r"), source)
    folder = tmp_path / "nodes" / source.key
    (file,) = folder.rglob("mi_estimator.safetensors")
    good = tmp_path / "good"
    shutil.copytree(folder, good)

    def refused() -> str:
        (result,) = compute(node)
        assert result["done"]
        shutil.rmtree(folder)
        shutil.copytree(good, folder)
        return str(result[CAUSE])

    flip(file)
    assert "mi_estimator.safetensors must have the hash" in refused()
    truncate(file)
    assert "mi_estimator.safetensors must have" in refused()
    (folder / "manifest.json").unlink()
    assert "manifest.json must exist" in refused()
    (folder / "handoff" / "handoff.json").unlink()
    assert "handoff.json must exist" in refused()
    file.write_bytes(pickle.dumps(Bomb(tmp_path / BOMB)))
    assert "mi_estimator.safetensors must have" in refused()
    _of_another_task(folder)
    assert "handoff.json must have" in refused(), "a changed task changes the hash"
    assert not (tmp_path / BOMB).exists()
    assert compute(node)[-1].get(CAUSE) is None, "an intact handoff is used"


def test_a_worker_leaves_a_run_of_another_process(tmp_path: Path) -> None:
    """A worker that outlived its driver, or a worker of another sweep, is not disturbed."""
    node = job(tmp_path, settings("tac"))
    theirs = Lease.of_this_process("sweep 'other'").model_copy(
        update={"machine": "another", "host": "far-away", "pid": 77}
    )
    assert NodeStore(str(tmp_path)).work_folder(node.key).lease.acquire(theirs) is None
    (result,) = compute(node)
    assert "sweep 'other' (process 77 on far-away" in result[LEFT]
    assert (result["reports"], result["done"]) == ("", True)


def test_a_worker_that_lost_its_lease_stops_writing_and_reuses(
    cut: tuple[Path, Path, NodeJob], tmp_path: Path
) -> None:
    """It was suspended; the new owner finishes the run and deletes its folder."""
    whole, _, _ = cut
    node = job(tmp_path, settings("tac"))
    trial = RunTrainable(config=node.to_tune())
    for _ in range(2):  # to its first checkpoint
        trial.train()
    work = NodeStore(str(tmp_path)).work_folder(node.key)
    before = work.names()
    theirs = Lease.of_this_process("sweep 'other'")
    Path(work.lease.path).write_text(theirs.model_dump_json())
    result = trial.train()
    trial.stop()
    assert "another process took over while this one was suspended" in result[NOTES][0]
    assert "sweep 'other'" in result[LEFT]
    assert (result["done"], result["reports"]) == (True, "")
    assert work.names() == before
    assert work.lease.is_owned_by(theirs.owner)
    shutil.copytree(whole / "nodes", tmp_path / "nodes")
    work.clear()
    (last,) = compute(node)
    assert (last["done"], last.get(CAUSE), LEFT in last) == (True, None, True)
    assert not list((tmp_path / "work").iterdir())


@pytest.mark.parametrize("theirs", ["released", "deleted"])
def test_a_worker_whose_lease_nobody_took_continues(
    theirs: str, cut: tuple[Path, Path, NodeJob], tmp_path: Path
) -> None:
    """The new owner has stopped, or the folder was deleted during a checkpoint."""
    whole, _, _ = cut
    node = job(tmp_path, settings("tac"))
    trial = RunTrainable(config=node.to_tune())
    for _ in range(2):  # to its first checkpoint
        trial.train()
    work = NodeStore(str(tmp_path)).work_folder(node.key)
    if theirs == "released":
        Path(work.lease.path).unlink()
    else:
        shutil.rmtree(work.folder.path)
    assert LEFT in trial.train()
    trial.stop()
    *_, last = compute(node)
    assert last.get(CAUSE) is None
    assert numbers(tmp_path, node) == numbers(whole, node)


def test_a_run_saved_between_reports_loses_nothing(
    cut: tuple[Path, Path, NodeJob], tmp_path: Path
) -> None:
    """As after a signal: saved after any round of training, and resumed."""
    whole, _, node = cut
    asked = {"rounds": 0}

    def pauses(trial: RunTrainable, rounds: int) -> None:
        def asked_after_some_rounds() -> bool:
            asked["rounds"] += 1
            return asked["rounds"] > rounds

        trial._stop.asked = asked_after_some_rounds  # type: ignore[method-assign]

    steps = []
    for rounds in (1, 3, 4):
        asked["rounds"] = 0
        trial = RunTrainable(config=job(tmp_path, settings("tac")).to_tune())
        result = trial.train()
        pauses(trial, rounds)
        while not result[STOPPED]:
            result = trial.train()
        assert trial._training is not None
        steps.append(trial._training.env_steps)
        trial.stop()
    assert any(step % 200 for step in steps), steps
    compute(job(tmp_path, settings("tac")))
    assert numbers(tmp_path, node) == numbers(whole, node)


KILLED_WHILE_SAVING = """
import os, sys
from pathlib import Path
from music_rllib.store.node_store import NodeStore

storage, crash_at = sys.argv[1], int(sys.argv[2])
work = NodeStore(storage).work_folder("a" * 20)
count = 0
def tick():
    global count
    count += 1
    if count == crash_at:
        os._exit(9)
for name in ("fsync", "replace", "rename", "unlink", "rmdir", "mkdir"):
    def wrapped(*args, _original=getattr(os, name), **kwargs):
        tick()
        return _original(*args, **kwargs)
    setattr(os, name, wrapped)
with work.new_checkpoint(3000) as draft:
    with draft.new_part("new") as (name, folder):
        (folder / "data").write_bytes(b"3" * 100)
    draft.needs = [name]
    (draft.folder / "state").write_text("3000")
print(count)
"""


def test_a_kill_at_any_step_of_saving_leaves_an_intact_checkpoint(tmp_path: Path) -> None:
    def storage(number: int) -> Path:
        folder = tmp_path / str(number)
        work = NodeStore(str(folder)).work_folder("a" * 20)
        for steps in (1000, 2000):
            with work.new_checkpoint(steps) as draft:
                with draft.new_part("old") as (_, part):
                    (part / "data").write_bytes(b"%d" % steps)
                (draft.folder / "state").write_text(str(steps))
        return folder

    def save(number: int) -> subprocess.CompletedProcess[str]:
        return fresh("-c", KILLED_WHILE_SAVING, storage(number), number, code=None)

    steps = int(save(0).stdout)
    assert steps > 10
    found = set()
    for number in range(1, steps + 1, max(1, steps // 12)):
        assert save(number).returncode == 9
        work = NodeStore(str(tmp_path / str(number))).work_folder("a" * 20)
        with work.newest(lambda text: pytest.fail(text)) as saved:
            assert saved is not None
            found.add((saved.folder / "state").read_text())
            assert all((part / "data").is_file() for part in saved.parts.values())
            assert saved.parts
        work.tidy()
        with work.new_checkpoint(4000) as draft:
            (draft.folder / "state").write_text("4000")
        assert len(work.names()) == 2
    assert found == {"2000", "3000"}


def test_checkpoints_keep_prunes_old_checkpoints(tmp_path: Path) -> None:
    node = job(tmp_path, settings("tac", env_steps=1000)).model_copy(
        update={"checkpoints": Checkpoints(keep=3)}
    )
    compute(node, steps=5)
    work = tmp_path / "work" / node.key
    names = NodeStore(str(tmp_path)).work_folder(node.key).names()
    assert [int(name.split("-")[0]) for name in names] == [400, 600, 800]
    needed = {
        part
        for name in names
        for part in json.loads((work / name / "manifest.json").read_text())["meta"]["parts"]
    }
    assert {path.name for path in (work / "parts").iterdir()} == needed
