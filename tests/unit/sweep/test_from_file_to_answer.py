"""From a sweep file to its answer: what is planned, refused, recorded and compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from music_rllib.config.problems import ConfigError
from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.tasks import Task
from music_rllib.errors import BadInputError
from music_rllib.experiment.open_sweep import continued_runs_text, open_sweep
from music_rllib.experiment.plan import make_plan, remarks
from music_rllib.experiment.record import changes_since
from music_rllib.program import main
from music_rllib.results.analysis_plan import record_plan
from music_rllib.results.archive import read_archive, write_archive
from music_rllib.results.read import read_sweep
from music_rllib.results.study import study_of
from music_rllib.store.handoff import Spaces, write_handoff
from music_rllib.sweep.preflight import check_environments
from music_rllib.sweep.views.compare import compare_stage
from tests.played_sweep import (
    document,
    opened,
    play,
)
from tests.sweep_files import loaded


def test_points_that_differ_in_settings_of_a_missing_reward_are_named(tmp_path: Path) -> None:
    stage = {"name": "t", "variant": "tac", "grid": {"intrinsic.weight": [0.1, 0.5]}}
    (line,) = remarks(make_plan(loaded(tmp_path, document([stage]))))
    assert line == "t: 5 runs equal to runs of other points of its grid: trained once"
    stage["grid"] = {"intrinsic": [{"reward": "rnd", "weight": w} for w in (0.1, 0.5)]}
    assert len(make_plan(loaded(tmp_path, document([stage]))).nodes) == 10


def test_a_task_whose_runs_are_those_of_another_task_is_named(tmp_path: Path) -> None:
    again = {"env_id": "FetchSlide-v4", "horizon": 50, "mi_reward_weight": 1.0}
    split = {"agent_indices": "0:3", "surrounding_indices": "3:6"}
    content = document(tasks=["FetchSlide", "Slide1"], environments={"Slide1": again | split})
    (line,) = remarks(make_plan(loaded(tmp_path, content)))
    assert line.startswith("her on Slide1: 10 runs equal to runs of her on FetchSlide: ")


def test_a_longer_run_continues_beside_a_setting_that_changes_no_result(tmp_path: Path) -> None:
    mine: dict[str, Any] = {"env_id": "Pendulum-v1", "horizon": 100, "success_key": None}
    stage = {"name": "train", "variant": "tac"}
    content = document([stage], tasks=["Mine"], seeds=[0], environments={"Mine": mine})
    play(opened(tmp_path, content), 1)
    mine["reward_range"] = [-20.0, 0.0]
    content["defaults"]["env_steps"] = 4000
    config = loaded(tmp_path, content, storage=str(tmp_path / "results"))
    sweep = open_sweep(config, make_plan(config), config.storage)
    assert continued_runs_text(sweep)
    assert changes_since(sweep) is None


def test_status_and_best_choose_the_same_stage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = {"tac.entropic_index": [1.0, 2.0]}
    first: dict[str, Any] = {"name": "first", "variant": "tac", "grid": grid}
    stages = [first, first | {"name": "last", "tac": {"lr": 0.002}}]
    analysis = {"hypotheses": ["q = 2 against q = 1"], "stage": "first"}
    play(opened(tmp_path, document(stages, analysis=analysis)), 1)
    found = []
    for command in ("status", "best"):
        assert main([command, str(tmp_path / "results/s"), "--json"]) == 0
        answer = json.loads(capsys.readouterr().out)
        found.append((answer["best"] if command == "status" else answer)["stage"])
    assert found == ["first", "first"]


@pytest.mark.parametrize(
    ("task", "metric"),
    [
        ("FetchReach", "evaluation/object_displacement"),
        ("FetchPush", "mutual_information/bound"),
        ("FetchPush", "system/training_seconds"),
    ],
)
def test_an_objective_that_no_run_reports_is_refused(
    tmp_path: Path, task: str, metric: str
) -> None:
    space = {"tac.alpha": {"float": [0.1, 0.2]}}
    search = {"space": space, "trials": 3, "objective": {"metric": metric}}
    stage = {"name": "t", "variant": "tac", "search": search}
    with pytest.raises(ConfigError, match=r"objective\.metric must be a metric "):
        loaded(tmp_path, document([stage], tasks=[task]))


def test_the_environment_of_a_handoff_need_not_be_installed(tmp_path: Path) -> None:
    lab: dict[str, Any] = {"env_id": "their_lab:Lab-v0", "horizon": 50}
    run = RunSettings(task=Task(name="Lab", **lab), variant="tac", seed=0)
    networks = ("policy", "critics", "value", "value_target", "normaliser")
    weights = {name: {"a": np.zeros(2, np.float32)} for name in networks}
    source = {"checkpoint": str(tmp_path / "theirs"), "task": "Lab"}
    stage = {"name": "next", "variant": "music-f", "init_from": source}
    bounds: dict[str, Any] = {"action_low": (-1.0,) * 4, "action_high": (1.0,) * 4}
    for size in (25, 10):
        spaces = Spaces(observation_size=size, goal_size=3, **bounds)
        write_handoff(tmp_path / "theirs/handoff", weights, run.handoff_info("0" * 20, 1, spaces))
        plan = make_plan(loaded(tmp_path, document([stage], environments={"Lab": lab})))
        if size == 25:
            assert check_environments(plan) == []
            continue
        with pytest.raises(BadInputError, match=r"\(25, 3, 4\), got Lab with \(10, 3, 4\)"):
            check_environments(plan)


def test_an_export_tells_conditions_apart_by_their_paths(tmp_path: Path) -> None:
    paths = ["/data/a/enc.pt", "/data/b/enc.pt"]
    reward = {"reward": "my_rewards:Surprise"}
    grid = {"intrinsic.settings.weights": paths}
    stage = {"name": "t", "variant": "tac", "intrinsic": reward, "grid": grid}
    text = " better than ".join(f"intrinsic.settings.weights = {one}" for one in paths)
    sweep = opened(tmp_path, document([stage], analysis={"hypotheses": [text]}))
    ((version,), _) = record_plan(sweep)
    play(sweep, version.recorded_ms + 1)
    write_archive(read_sweep(str(tmp_path / "results/s")).sweep, tmp_path / "out")
    found = study_of(read_archive(tmp_path / "out"))
    assert (len(found.means), len(found.planned), found.untested) == (2, 1, ())


def test_compare_names_the_stage_that_it_shows(tmp_path: Path) -> None:
    search = {"space": {"tac.lr": {"float": [0.001, 0.01]}}, "trials": 2}
    search |= {"objective": {"metric": "evaluation/episode_return"}}
    tuned = {"name": "tuned", "variant": "tac", "search": search}
    sweep = opened(tmp_path, document([*document()["stages"], tuned]))
    play(sweep, 1)
    found, _ = compare_stage(sweep.location, None, None, minimize=False)
    assert len(found["comparisons"]) == 1
    assert (found["stage"], found["metric"]) == ("her", "evaluation/success_rate")
