"""Checkpoints of a worker's runs; a run that only counts its steps replaces the training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ray.tune.trainable import trainable

from music_rllib import names
from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.fingerprint import digest_of
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.experiment.plan import continuation_key, node_key
from music_rllib.store.handoff import Spaces
from music_rllib.store.node_store import NodeStore
from music_rllib.training import worker
from music_rllib.training.job import NodeJob
from music_rllib.training.run_storage import RunStorage
from music_rllib.training.worker import CAUSE, PAUSED, RunTrainable


class Counting:
    """A run with 200 steps in each report."""

    will_compile, replay_mb = False, 0.0
    spaces = Spaces(observation_size=4, goal_size=2, action_low=(-1, -1), action_high=(1, 1))

    def __init__(self, run: RunSettings, *_: object, **__: object) -> None:
        self.run, self.env_steps, self._begun = run, 0, False

    @property
    def finished(self) -> bool:
        return self.env_steps >= self.run.env_steps

    def advance(self, **_: object) -> dict[str, float]:
        self.env_steps += 200 * self._begun
        self._begun = True
        return {names.EVAL_EPISODES: 1.0, names.EVAL_SUCCESS: 0.5}

    def save(self, draft: Any, **_: object) -> None:
        (draft.folder / "steps").write_text(str(self.env_steps))

    def restore(self, saved: Any, **_: object) -> None:
        self.env_steps, self._begun = int((saved.folder / "steps").read_text()), True

    def divergence(self, reports: object) -> None: ...

    def network_weights(self) -> dict[str, dict[str, Any]]:
        arrays = {"0.weight": np.zeros((4, 6), np.float32), "0.bias": np.zeros(4, np.float32)}
        return {"policy": arrays}

    def close(self) -> None: ...


def job(storage: Path, env_steps: int, until: int | None = None) -> NodeJob:
    document = {
        "task": BUILT_IN_TASKS["PointCarry"],
        "variant": "tac",
        "seed": 0,
        "env_steps": env_steps,
        "evaluation": {"interval": 200, "episodes": 2},
        "tac": {"random_steps": 100},
    }
    run = RunSettings.model_validate(document)
    key = node_key(run, None)
    source: dict[str, Any] = {"source_key": None, "source_task": None}
    return NodeJob(key=key, label="x", run=run, storage=str(storage), until=until, **source)


def compute(node: NodeJob) -> list[dict[str, Any]]:
    trial, found = RunTrainable(config=node.to_tune()), list[dict[str, Any]]()
    try:
        while not (found and found[-1]["done"]):
            found.append(trial.train())
            assert CAUSE not in found[-1], found[-1]
    finally:
        trial.stop()
    return found


@pytest.fixture(autouse=True)
def _counting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainable, "DEFAULT_STORAGE_PATH", str(tmp_path))
    monkeypatch.setattr(worker, "_training_run", lambda: Counting)
    monkeypatch.setattr(RunStorage, "check_environment", lambda _: None)


@pytest.mark.parametrize("shorter", [False, True])
def test_a_paused_run_keeps_its_reports_in_the_storage(tmp_path: Path, shorter: bool) -> None:
    """Also if it continues a finished shorter run that has reached the rung."""
    if shorter:
        compute(job(tmp_path, 400))
    longer = job(tmp_path, 800, until=200)
    assert compute(longer)[-1][PAUSED] == (400 if shorter else 200)
    assert NodeStore(str(tmp_path)).work_folder(longer.key).lines()


def test_the_end_of_a_run_of_another_environment_does_not_keep_out_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new = ({"source lab_env.py": text} for text in ("old", "new"))

    def train(env: dict[str, str], env_steps: int) -> tuple[list[dict[str, Any]], NodeJob]:
        use = lambda storage: setattr(storage, "_environment", env)  # noqa: E731
        monkeypatch.setattr(RunStorage, "check_environment", use)
        environments = {"environment": env, "same_environments": frozenset({digest_of(env)})}
        node = job(tmp_path, env_steps).model_copy(update=environments)
        return compute(node), node

    train(old, 800)
    _, node = train(new, 400)
    kept = NodeStore(str(tmp_path)).continuation(continuation_key(node.run, None))
    assert kept.environment() == new
    results, _ = train(new, 600)
    assert any("continues a finished run" in note for one in results for note in one["notes"])
