"""A declared task is compared with its environment before training."""

from pathlib import Path
from typing import Any

import pytest

from music_rllib.errors import BadInputError
from music_rllib.experiment.plan import make_plan
from music_rllib.sweep.preflight import check_environments
from tests.integration.conftest import ENVIRONMENTS
from tests.sweep_files import loaded

PUSH: dict[str, Any] = {
    "env_id": "FetchPush-v4",
    "horizon": 50,
    "agent_indices": "0:3",
    "surrounding_indices": "3:6",
}


def check(folder: Path, *tasks: dict[str, Any], **replay: Any) -> list[str]:
    names = [f"T{i}" for i in range(len(tasks))]
    document = {
        "name": "s",
        "tasks": names,
        "environments": dict(zip(names, tasks, strict=True)),
        "defaults": {"env_steps": 2000},
        # Only one of the stages has hindsight.
        "stages": [
            {"name": "with", "variant": "tac", "replay": replay},
            {"name": "without", "variant": "tac"},
        ],
    }
    return check_environments(make_plan(loaded(folder, document)))


MISFITS: list[tuple[dict[str, Any], str]] = [
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
        {"env_id": "CartPole-v1", "horizon": 100},
        "the action space must be a bounded one-dimensional Box",
    ),
    (
        {"env_id": "HandManipulatePen-v1", "horizon": 100},
        "replay.hindsight_k must be 0 if compute_reward does not compute each row",
    ),
]


def test_tasks_that_do_not_fit_are_named(tmp_path: Path) -> None:
    fits = PUSH | {"horizon": 80, "env_kwargs": {"max_episode_steps": 80}}
    with pytest.raises(BadInputError) as caught:
        check(tmp_path, *(task for task, _ in MISFITS), fits, hindsight_k=4.0)
    lines = str(caught.value).splitlines()
    for i, (line, (_, rule)) in enumerate(zip(lines, MISFITS, strict=True)):
        assert line.startswith(f"environments.T{i}: {rule}")


def test_dense_rewards_need_a_distance_for_hindsight_from_moved_episodes(tmp_path: Path) -> None:
    maze = {"env_id": "PointMaze_UMazeDense-v3", "horizon": 100, "success_key": "success"}
    moved: dict[str, Any] = {"hindsight_k": 4.0, "hindsight_episodes": "moved"}
    with pytest.raises(BadInputError) as caught:
        check(tmp_path, maze, maze | {"moved_distance": 0.1}, **moved)
    (line,) = str(caught.value).splitlines()
    assert line.startswith("environments.T0: ")
    assert "or the task must have a moved_distance: PointMaze_UMaze" in line


def test_all_problems_are_reported_at_once(tmp_path: Path) -> None:
    task = {"env_id": "Pendulum-v1", "horizon": 300, "agent_indices": [0]}
    with pytest.raises(BadInputError) as caught:
        check(tmp_path, task | {"surrounding_indices": [5]}, hindsight_k=4.0)
    lines = str(caught.value).splitlines()
    rules = ["surrounding_indices", "horizon", "must", "environments.T0:"]
    assert [line.split()[1] for line in lines] == rules
    assert lines[3].startswith("also: environments.T0: success_key 'is_success' was not in info")


def test_an_agent_needs_a_source_of_the_same_sizes(tmp_path: Path) -> None:
    def played(source: str) -> list[str]:
        document = {
            "name": "s",
            "tasks": [source, "FetchPush"],
            "defaults": {"env_steps": 2000},
            "stages": [
                {"name": "first", "variant": "tac"},
                {
                    "name": "next",
                    "variant": "music-f",
                    "tasks": ["FetchPush"],
                    "init_from": {"stage": "first", "task": source},
                },
            ],
        }
        return check_environments(make_plan(loaded(tmp_path, document)))

    with pytest.raises(BadInputError) as caught:
        played("FetchReach")
    assert str(caught.value) == (
        "init_from.task must have observations, goals and actions of the sizes of FetchPush, "
        "(25, 3, 4), got FetchReach with (10, 3, 4)"
    )
    assert not played("FetchSlide")


FATAL = """
import os, sys, threading, time
import gymnasium as gym
from point_env import Point

class Loud(Point):
    def step(self, action):
        os.write(1, b"x" * 200_000)
        os.write(2, b"y" * 200_000)
        if threading.active_count() < 50:  # faulthandler writes at most 100
            threading.Thread(target=time.sleep, args=(3600,)).start()
        return super().step(action)

class Aborts(Point):
    def reset(self, **arguments):
        print("\\ncannot open display", file=sys.stderr, flush=True)
        os.abort()

class Ends(Point):
    def step(self, action):
        os._exit(0)

class Stops(Point):
    def step(self, action):
        raise KeyboardInterrupt

class UnreadableError(Exception):
    def __init__(self, first, second):
        super().__init__(first)
    def __str__(self):
        raise ValueError

class Raises(Point):
    def close(self):
        raise UnreadableError(1, 2)

for kind in (Loud, Aborts, Ends, Stops, Raises):
    gym.register(f"{kind.__name__}-v0", entry_point=kind)
"""


def test_an_environment_that_ends_its_process_is_named_and_the_others_are_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of them would end the driver."""
    (tmp_path / "fatal_env.py").write_text(FATAL)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(ENVIRONMENTS))

    def lines(*names: str) -> list[str]:
        return check(tmp_path, *({"env_id": f"fatal_env:{n}-v0", "horizon": 20} for n in names))

    with pytest.raises(BadInputError) as caught:
        lines("Loud", "Aborts", "Ends", "Stops", "Raises")
    aborted, ended, stopped, _ = str(caught.value).splitlines()
    assert (
        "T1: reset(seed=2147483647) must not end its process, which died of SIGABRT at" in aborted
    )
    assert aborted.endswith(": cannot open display")
    assert ended.startswith("environments.T2: step() must not end its process, which ended with")
    assert "T3: step() must not raise, it raised KeyboardInterrupt" in stopped
    (closed,) = lines("Loud", "Raises")
    assert closed.startswith("environments.T1: close() must not raise, it raised UnreadableError")
