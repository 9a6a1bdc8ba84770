"""A user's task is held against its environment before anything is trained."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from music_rllib.config.load import load_sweep
from music_rllib.experiment.plan import make_plan
from music_rllib.sweep.preflight import TaskError, check_environments

PUSH: dict[str, Any] = {
    "env_id": "FetchPush-v4",
    "horizon": 50,
    "agent_indices": "0:3",
    "surrounding_indices": "3:6",
}


def check(folder: Path, task: dict[str, Any], **replay: Any) -> None:
    document = {
        "name": "s",
        "tasks": ["Mine"],
        "environments": {"Mine": task},
        "defaults": {"env_steps": 2000},
        # Only one of the stages has hindsight.
        "stages": [
            {"name": "with", "variant": "tac", "replay": replay},
            {"name": "without", "variant": "tac"},
        ],
    }
    path = folder / "sweep.yaml"
    path.write_text(yaml.safe_dump(document))
    check_environments(make_plan(load_sweep(path)))


@pytest.mark.parametrize(
    "task",
    [
        PUSH,
        PUSH | {"horizon": 20, "success_key": None},
        PUSH | {"horizon": 80, "env_kwargs": {"max_episode_steps": 80}},
    ],
)
def test_a_task_that_fits_passes(task: dict[str, Any], tmp_path: Path) -> None:
    check(tmp_path, task, hindsight_k=4.0)


@pytest.mark.parametrize(
    "task, rule",
    [
        (PUSH | {"env_id": "FetchPsh-v4"}, "env_id must name an environment that can be made"),
        (
            PUSH | {"surrounding_indices": [30]},
            "surrounding_indices must be < 25, the size of the observation, got 30",
        ),
        (
            PUSH | {"horizon": 80},
            "horizon must be <= 50, the environment's own limit, got 80; "
            "env_kwargs: {max_episode_steps: 80} would raise that",
        ),
        (
            PUSH | {"success_key": "is_succes"},
            "success_key must be null or a key of info (is_success), "
            "got 'is_succes' (did you mean 'is_success'?)",
        ),
        (
            {"env_id": "CartPole-v1", "horizon": 100},
            "the action space must be a bounded one-dimensional Box",
        ),
        (
            {"env_id": "Pendulum-v1", "horizon": 200, "success_key": None},
            "must have goals for replay.hindsight_k > 0, its observations have none",
        ),
        (
            {"env_id": "HandManipulatePen-v1", "horizon": 100},
            "replay.hindsight_k must be 0 where compute_reward does not price every row",
        ),
    ],
)
def test_what_does_not_fit_is_said(task: dict[str, Any], rule: str, tmp_path: Path) -> None:
    with pytest.raises(TaskError) as caught:
        check(tmp_path, task, hindsight_k=4.0)
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"environments.Mine: {rule}")


def test_dense_rewards_need_a_distance_for_hindsight_from_moved_episodes(tmp_path: Path) -> None:
    maze = {"env_id": "PointMaze_UMazeDense-v3", "horizon": 100, "success_key": "success"}
    check(tmp_path, maze, hindsight_k=4.0)
    moved: dict[str, Any] = {"hindsight_k": 4.0, "hindsight_episodes": "moved"}
    with pytest.raises(TaskError, match="or the task must have a moved_distance: PointMaze_UMaze"):
        check(tmp_path, maze, **moved)
    check(tmp_path, maze | {"moved_distance": 0.1}, **moved)


def test_all_that_does_not_fit_is_said_at_once(tmp_path: Path) -> None:
    task = {"env_id": "Pendulum-v1", "horizon": 300, "agent_indices": [0]}
    with pytest.raises(TaskError) as caught:
        check(tmp_path, task | {"surrounding_indices": [5]})
    lines = str(caught.value).splitlines()
    assert [line.split()[1] for line in lines] == ["surrounding_indices", "horizon", "success_key"]
    assert "(none)" in lines[2]
