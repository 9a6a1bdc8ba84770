"""`evaluate`: a run's policy plays episodes, which are counted and recorded as videos."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from music_rllib.envs.make import make_env
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task
from music_rllib.policy import Policy, PolicyNetwork, load_policy
from music_rllib.policy.rollout import open_task, play
from music_rllib.policy.video import FORMATS, VideoError, film, find_renderer, write_video
from music_rllib.program import main
from tests.conftest import IN_CI
from tests.integration.conftest import ENVIRONMENTS
from tests.processes import fresh

REACH = BUILT_IN_TASKS["FetchReach"]


def policy_file(
    path: Path, task: Task, weight: np.ndarray[Any, Any], goal_size: int, high: float = 1.0
) -> Path:
    """A policy of one layer; `about` has the metadata of a run's policy."""
    actions, inputs = weight.shape
    network = PolicyNetwork(
        weights=(weight.astype(np.float32),),
        biases=(np.zeros(actions, np.float32),),
        mean=np.zeros(inputs, np.float32),
        inverse_std=np.ones(inputs, np.float32),
        clip=5.0,
        low=-np.full(actions, high, np.float32),
        high=np.full(actions, high, np.float32),
        goal_size=goal_size,
        about={
            "task": task.model_dump(mode="json"),
            "variant": "tac",
            "seed": 0,
            "node_key": "0" * 20,
            "env_steps": 1000,
            "max_episode_steps": task.horizon,
        },
    )
    path.write_bytes(network.to_bytes())
    return path


@pytest.fixture
def good(tmp_path: Path) -> Path:
    """Solves FetchReach by hand: it moves the gripper straight towards the goal."""
    weight = np.zeros((4, 13))
    for axis in range(3):
        weight[axis, axis], weight[axis, 10 + axis] = -8.0, 8.0
    return policy_file(tmp_path / "good.safetensors", REACH, weight, 3)


@pytest.fixture
def idle(tmp_path: Path) -> Path:
    return policy_file(tmp_path / "idle.safetensors", REACH, np.zeros((4, 13)), 3)


def load(path: Path) -> Policy:
    from music_rllib.policy import load_policy

    return load_policy(path)


def test_a_good_policy_and_an_idle_one(
    good: Path, idle: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    documents = []
    for path in (good, idle, good):
        assert main(["evaluate", str(path), "--episodes", "8", "--seed", "5", "--json"]) == 0
        documents.append(json.loads(capsys.readouterr().out))
    best, worst, again = documents
    assert (best["success_rate"], best["episodes"]) == (1.0, 8)
    assert best["success_rate_interval"][0] == pytest.approx(0.631, abs=0.001)  # Clopper-Pearson
    assert worst["success_rate"] < 0.5
    assert worst["success_rate_interval"][1] < 1.0
    assert [one["seed"] for one in best["results"]] == [one["seed"] for one in worst["results"]]
    assert best == again, "equal seeds give equal episodes"
    assert main(["evaluate", str(good), "--episodes", "2"]) == 0
    shown = capsys.readouterr().out
    assert "success at the last step" in shown
    assert "100 %" in shown


@pytest.mark.parametrize(
    "arguments, complaint",
    [
        (["nothing"], "'nothing' must be a folder, or the key or label of a run"),
        (["GOOD", "--video", "film.avi"], "--video must end in .mp4 or .gif"),
        (["GOOD", "--video", "no/where/film.gif"], "--video must be in a folder that exists"),
    ],
)
def test_bad_input_is_named(
    good: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], complaint: str
) -> None:
    assert main(["evaluate", *(str(good) if a == "GOOD" else a for a in arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert complaint in captured.err
    assert captured.out == ""


@pytest.mark.parametrize("option", ["--episodes", "--video-episodes"])
def test_numbers_are_checked(good: Path, option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(good), option, "0"]) == 2
    assert f"Invalid value for '{option}'" in capsys.readouterr().err


def needs_a_renderer() -> None:
    name, why_not = find_renderer()
    if name is None:
        (pytest.fail if IN_CI else pytest.skip)(str(why_not))


def test_success_and_goal_are_in_the_picture(
    good: Path, idle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    needs_a_renderer()
    video = tmp_path / "film.gif"
    command = ["evaluate", str(good), "--episodes", "1", "--seed", "5", "--video", str(video)]
    assert main(command) == 0
    assert f"Video: {video}" in capsys.readouterr().out
    with Image.open(video) as film_:
        assert film_.n_frames >= REACH.horizon  # type: ignore[attr-defined]
        film_.seek(film_.n_frames - 1)  # type: ignore[attr-defined]
        last = np.asarray(film_.convert("RGB"), int)
    green, vermilion = (0, 158, 115), (213, 94, 0)
    assert _share(last[-20:], green) > 0.4, "the line below says that the goal is reached"
    assert _share(last[-20:], vermilion) == 0
    frames, (result,) = film(load(idle), 1, 5, "idle")
    first = np.asarray(frames[0], int)
    red = (first[..., 0] > 150) & (first[..., 1] < 60) & (first[..., 2] < 60)
    assert red.sum() > 4, "the goal is a red ball"
    assert result.success is False
    assert _share(np.asarray(frames[-1], int)[-20:], vermilion) > 0.4


def _share(picture: np.ndarray[Any, Any], colour: tuple[int, int, int]) -> float:
    return float((np.abs(picture - np.array(colour)).max(-1) < 24).mean())


def test_a_film_shows_the_counted_episodes(good: Path) -> None:
    needs_a_renderer()
    policy = load(good)
    _, filmed = film(policy, 2, 3, "two")
    env = open_task(policy)
    counted = list(play(policy, env, 2, 3))
    env.close()
    assert [one.seed for one in filmed] == [one.seed for one in counted]
    assert [one.success for one in filmed] == [one.success for one in counted]


def test_an_environment_with_a_size_and_bounds_of_its_own_is_filmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its name resembles MuJoCo's; a saturated action is 0.1 in float32, which is larger."""
    monkeypatch.syspath_prepend(ENVIRONMENTS)
    task = Task(name="Mine", env_id="point_env:HandOver-v0", horizon=20)
    weight = np.full((2, 6), 100.0)
    policy = load_policy(policy_file(tmp_path / "p.safetensors", task, weight, 2, high=0.1), [task])
    frames, results = film(policy, 1, 0, "mine")
    assert len(frames) > 20
    assert results[0].env_steps == 20


@pytest.mark.parametrize("ending", FORMATS)
def test_the_files_are_videos(tmp_path: Path, ending: str) -> None:
    shades = np.linspace(0, 255, 12).astype(np.uint8)
    frames = [np.full((66, 48, 3), shade, np.uint8) for shade in shades]
    path = tmp_path / f"film{ending}"
    write_video(path, frames)
    data = path.read_bytes()
    assert data[:4] == b"GIF8" if ending == ".gif" else data[4:8] == b"ftyp"
    with pytest.raises(VideoError, match=r"must end in \.mp4 or \.gif"):
        write_video(tmp_path / "film.avi", frames)


def test_a_missing_renderer_is_named_with_the_packages_to_install(
    good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a renderer that this machine does not have."""
    make_env(REACH.env_id).close()  # here MuJoCo is loaded, in the next test it is not
    monkeypatch.setenv("MUJOCO_GL", "osmesa" if find_renderer()[0] != "osmesa" else "glfw")
    if find_renderer("osmesa")[0] is not None:
        pytest.skip("every way of drawing works here")
    video = tmp_path / "film.gif"
    assert main(["evaluate", str(good), "--episodes", "1", "--video", str(video)]) == 2
    said = capsys.readouterr().err
    assert "drawing without a screen does not work here (osmesa: " in said
    assert "libegl1" in said
    assert not video.exists()


def test_a_fresh_process_reports_that_mujoco_does_not_load_with_a_renderer(good: Path) -> None:
    """Only loading MuJoCo reads the variable, and PyOpenGL's error does not name it."""
    # MuJoCo sets the other variable in a process that has rendered; it would be used.
    inherited = {key: text for key, text in os.environ.items() if key != "PYOPENGL_PLATFORM"}
    if find_renderer("osmesa")[0] is not None:
        pytest.skip("osmesa works here")
    environment = inherited | {"MUJOCO_GL": "osmesa"}
    play = ("-m", "music_rllib", "evaluate", good, "--episodes", 1)
    done = fresh(*play, code=2, env=environment)
    assert "MuJoCo can't be loaded with MUJOCO_GL=osmesa" in done.stderr
    assert "unset it, or install" in done.stderr
    assert "Traceback" not in done.stderr
