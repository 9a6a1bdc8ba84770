"""Handoffs from outside of a sweep: found, told apart, unchanged, and repaired."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from music_rllib.config.problems import ConfigError
from music_rllib.config.run_settings import RunSettings, variant_music
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.experiment.open_sweep import open_sweep, remove_damaged
from music_rllib.experiment.plan import make_plan
from music_rllib.program import main
from music_rllib.store.handoff import HandoffError, open_handoff, write_handoff
from music_rllib.store.node_store import NodeStore
from music_rllib.sweep.listeners.state_file import StateFile
from music_rllib.sweep.preflight import import_checkpoints
from tests.handoffs import music_u, write_estimator
from tests.hostile_files import SPACES
from tests.sweep_files import loaded
from tests.unit.sweep.test_commands import finish, from_handoff


def test_a_handoff_that_changes_while_the_sweep_starts_is_not_imported(tmp_path: Path) -> None:
    folder = write_estimator(tmp_path / "given", music_u())
    stage = {"name": "r", "variant": "music-r", "init_from": {"checkpoint": str(folder)}}
    content = {"name": "s", "tasks": ["FetchPush"], "stages": [stage]}
    plan = make_plan(loaded(tmp_path, content))
    others = {"mi_estimator": {"w": np.ones((4, 4), np.float32)}}
    write_handoff(folder, others, music_u().handoff_info("1" * 20, 50, SPACES))
    store = NodeStore(str(tmp_path / "results"))
    with pytest.raises(HandoffError, match="given must not change while the sweep starts"):
        import_checkpoints(plan, store)
    assert not store.is_finished(plan.imports[0].key)


def test_a_task_of_the_same_name_is_told_apart(tmp_path: Path) -> None:
    task = BUILT_IN_TASKS["PointCarry"].model_copy(update={"name": "Lab"})
    music = variant_music("music-u", task)
    base: dict[str, Any] = {"task": task, "variant": "music-u", "seed": 0, "music": music}
    folder = write_estimator(tmp_path / "lab", RunSettings.model_validate(base))
    own = task.model_dump(mode="json", exclude={"name"})
    stage = {"name": "r", "variant": "music-r", "init_from": {"checkpoint": str(folder)}}
    content = {"name": "s", "tasks": ["Lab"], "stages": [stage]}
    for change, words in (
        ({"horizon": 60}, "horizon is 50 there and 60 here"),
        ({"seed_range": [0, 9]}, r"seed_range is \[0, 2147483647\] there and \[0, 9\] here"),
    ):
        with pytest.raises(ConfigError, match=f"must be of task Lab, got one of Lab; {words}"):
            loaded(tmp_path, content | {"environments": {"Lab": own | change}})


def test_a_damaged_imported_handoff_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    storage = str(tmp_path / "results")
    sweep = from_handoff(storage, tmp_path)
    (node,) = sweep.plan.nodes
    with StateFile(sweep) as state_file:
        finish(sweep, state_file, node, 0.7, tmp_path / "made")
        state_file.end("finished")
    assert node.input is not None
    file = Path(sweep.store.path(node.input.key), "handoff", "mi_estimator.safetensors")
    file.write_bytes(file.read_bytes()[:-1])
    assert main(["status", f"{storage}/mine"]) == 1
    assert main(["resume", f"{storage}/mine", "--retrain-damaged"]) == 2
    assert "run the sweep's YAML file with --retrain-damaged" in capsys.readouterr().err
    again = open_sweep(sweep.config, make_plan(sweep.config), storage, lenient=True)
    remove_damaged(again, print)
    import_checkpoints(again.plan, again.store)
    assert again.store.is_sound(node.input.key)


def test_a_handoff_is_found_in_a_node_that_was_copied_from_a_bucket(tmp_path: Path) -> None:
    store = NodeStore(str(tmp_path / "results"))
    write_estimator(tmp_path / "made/handoff", music_u())
    store.publish("k", tmp_path / "made")
    node, prefix = Path(store.path("k")), "0" * 32 + "/"
    (node / prefix).mkdir()
    (node / "handoff").rename(node / prefix / "handoff")
    manifest = node / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"prefix": prefix}))
    assert store.is_sound("k")
    assert open_handoff(node)[0] == node / prefix / "handoff"
