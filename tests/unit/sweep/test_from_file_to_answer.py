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
from music_rllib.experiment.plan import Node, make_plan, remarks
from music_rllib.experiment.record import changes_since
from music_rllib.experiment.scheduler import Scheduler, Status
from music_rllib.program import main
from music_rllib.report.build import build_report
from music_rllib.report.cli import _note
from music_rllib.results.analysis_plan import record_plan
from music_rllib.results.archive import read_archive, write_archive
from music_rllib.results.read import read_sweep
from music_rllib.results.study import study_of
from music_rllib.store.handoff import Spaces, write_handoff
from music_rllib.sweep.preflight import check_environments
from music_rllib.sweep.views.compare import compare_stage
from tests.played_sweep import (
    ASKED,
    document,
    opened,
    planned_and_played,
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
    alone = {"name": "last", "variant": "tac", "tac": {"lr": 0.002}}
    analysis = {"hypotheses": ["q = 2 against q = 1"], "stage": "first"}
    for last, changes, chosen in (
        (alone | {"grid": grid}, {"analysis": analysis}, "first"),
        (alone, {}, "last"),
    ):
        (tmp_path / chosen).mkdir()
        play(opened(tmp_path / chosen, document([first, last], **changes)), 1)
        found = []
        for command in ("status", "best"):
            assert main([command, str(tmp_path / chosen / "results/s"), "--json"]) == 0
            answer = json.loads(capsys.readouterr().out)
            found.append((answer["best"] if command == "status" else answer)["stage"])
        assert found == [chosen, chosen]


def test_status_names_runs_that_another_sweep_has_finished(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = opened(tmp_path, document())
    play(first, 1, nodes=list(first.plan.nodes)[:4])
    other = opened(tmp_path, document(name="other"))
    play(other, 1, nodes=[node for node in other.plan.nodes if node.key not in other.finished])
    assert main(["status", str(first.folder)]) == 0
    assert "6 more runs are finished in the storage since then" in capsys.readouterr().out


def test_the_note_in_mlflow_has_the_conditions_of_its_answer(tmp_path: Path) -> None:
    grid = {"name": "grid", "variant": "tac", "grid": {"tac.entropic_index": [1.0, 2.0]}}
    alone = {"name": "alone", "variant": "tac", "tasks": ["FetchSlide"], "tac": {"lr": 0.002}}
    planned_and_played(tmp_path, document([grid, alone], analysis=ASKED | {"stage": "grid"}))
    made = build_report(read_sweep(str(tmp_path / "results/s")).sweep)
    note = _note(made.answer[1], made, "0" * 32)
    assert "| q = 2&emsp;|" in note
    assert "grid-success-rate" in note
    assert "FetchSlide" not in note


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


def test_commands_do_not_go_through_all_runs_for_each_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    having = Scheduler.having
    passes = []

    def counted(self: Scheduler, *statuses: Status) -> list[Node]:
        passes.append(statuses)
        return having(self, *statuses)

    counts = []
    for seeds in (2, 20):
        folder = tmp_path / str(seeds)
        folder.mkdir()
        sweep = opened(folder, document(seeds=seeds))
        play(sweep, 1, nodes=list(sweep.plan.nodes)[:seeds])
        monkeypatch.setattr(Scheduler, "having", counted)
        for words in (["plan", str(folder / "sweep.yaml")], ["compare"]):
            place = str(folder / "results")
            where = ["--storage", place] if words[0] == "plan" else [f"{place}/s"]
            assert main([*words, *where]) == 0
        counts.append(len(passes))
        passes.clear()
        monkeypatch.setattr(Scheduler, "having", having)
    assert counts[0] == counts[1]
