"""From a sweep file to its answer: what is planned, refused, recorded and compared."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from music_rllib import names
from music_rllib.config.problems import ConfigError
from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.tasks import Task
from music_rllib.errors import BadInputError
from music_rllib.experiment.open_sweep import OpenSweep, continued_runs_text, open_sweep
from music_rllib.experiment.plan import Node, continuation_key, make_plan, remarks
from music_rllib.experiment.record import changes_since, keep_record
from music_rllib.program import main
from music_rllib.results.analysis_plan import analysis_plan, plans_in, record_plan
from music_rllib.results.archive import read_archive, write_archive
from music_rllib.results.read import read_sweep
from music_rllib.results.study import Study, study_of, untestable
from music_rllib.store.handoff import Spaces, write_handoff
from music_rllib.store.history import Report
from music_rllib.sweep.listeners.state_file import StateFile
from music_rllib.sweep.preflight import check_environments
from music_rllib.sweep.views.compare import compare_stage
from tests.played_search import publish
from tests.sweep_files import loaded


def document(stages: list[dict[str, Any]] | None = None, **changes: Any) -> dict[str, Any]:
    grid = {"tac.entropic_index": [1.0, 2.0]}
    return {
        "name": "s",
        "tasks": ["FetchPush"],
        "seeds": 5,
        "defaults": {"env_steps": 2000, "evaluation": {"interval": 500, "episodes": 20}},
        "stages": stages or [{"name": "her", "variant": "tac", "grid": grid}],
    } | changes


def opened(folder: Path, content: dict[str, Any]) -> OpenSweep:
    config = loaded(folder, content, storage=str(folder / "results"))
    sweep = open_sweep(config, make_plan(config), config.storage)
    keep_record(sweep)
    return sweep


def play(sweep: OpenSweep, at_ms: int, before: int = 0, nodes: list[Node] | None = None) -> None:
    """As if all runs, or those of `nodes`, had been trained.

    The reports up to 2,000 steps are of `before` ms: those of runs that this one continues.
    """
    with StateFile(sweep) as state_file:
        for node in sweep.plan.nodes if nodes is None else nodes:
            q = float(node.run.tac.entropic_index)  # type: ignore[arg-type]
            history = [
                Report(
                    env_steps=at,
                    seconds=at / 1e6,
                    timestamp_ms=before if before and at <= 2000 else at_ms,
                    metrics={
                        names.EVAL_SUCCESS: at / 4000 * (1 - 0.2 * q) + 0.01 * node.seed,
                        names.EVAL_EPISODES: 20.0,
                    },
                )
                for at in range(500, node.run.env_steps + 1, 500)
            ]
            result = publish(sweep, node, history)
            last = sweep.store.continuation(continuation_key(node.run, node.source_key))
            with last.new_checkpoint(node.run.env_steps):
                pass
            sweep.scheduler.start(node.key)
            sweep.scheduler.finish(node.key)
            state_file.finished(node, result)
        state_file.end("finished")


def planned_and_played(folder: Path, content: dict[str, Any]) -> int:
    """Record the plan of a sweep before its runs; the time of their results in ms."""
    sweep = opened(folder, content)
    ((version,), _) = record_plan(sweep)
    play(sweep, version.recorded_ms + 1)
    return version.recorded_ms + 1


def test_a_hypothesis_about_runs_that_continue_shown_ones_is_late(tmp_path: Path) -> None:
    now = int(time.time() * 1000)
    play(opened(tmp_path, document()), now - 5000)
    analysis = {"hypotheses": ["q = 2 worse than q = 1"]}
    longer = document(analysis=analysis)
    longer["defaults"]["env_steps"] = 4000
    sweep = opened(tmp_path, longer)
    assert record_plan(sweep)[1] == ("q = 2 worse than q = 1",)
    play(sweep, now + 60_000, before=now - 5000)
    study = study_of(read_sweep(str(tmp_path / "results/s")).sweep)
    assert (study.planned, study.late) == ((), ("q = 2 worse than q = 1",))


def test_plan_names_hypotheses_that_no_result_can_test(tmp_path: Path) -> None:
    grid = {"tac.entropic_index": [1.0, 1.5], "tac.alpha": [0.05, 0.1]}
    texts = ["q = 1.5 against q = 1", "q = 1.5, alpha = 0.1 against q = 1"]
    stage = {"name": "her", "variant": "tac", "grid": grid}
    config = loaded(tmp_path, document([stage], analysis={"hypotheses": texts}))
    plan = analysis_plan(config)
    assert plan is not None
    (found,) = untestable(make_plan(config), plan)
    assert found.startswith(texts[1])
    assert "must name more settings" in found


def test_plan_with_other_seeds_or_steps_is_no_new_analysis_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    asked = {"hypotheses": ["q = 2 against q = 1"]}
    sweep = opened(tmp_path, document(analysis=asked))
    record_plan(sweep)
    Path("sweep.yaml").write_text(yaml.safe_dump(document(analysis=asked)))
    for changes in (["--seeds", "12"], ["env_steps=1e6"]):
        assert main(["plan", "sweep.yaml", *changes]) == 0
        assert len(plans_in(sweep.storage, "s")) == 1
    assert main(["plan", "sweep.yaml", "analysis.margin=0.1"]) == 0
    assert len(plans_in(sweep.storage, "s")) == 2


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


def test_more_steps_after_a_result_are_an_exploratory_comparison(tmp_path: Path) -> None:
    """The planned one stays that over the planned steps."""
    analysis = {"hypotheses": ["q = 2 worse than q = 1"]}
    began = planned_and_played(tmp_path, document(analysis=analysis))
    longer = document(analysis=analysis)
    longer["defaults"]["env_steps"] = 4000
    sweep = opened(tmp_path, longer)
    record_plan(sweep)
    play(sweep, began + 60_000, before=began)
    study = study_of(read_sweep(str(tmp_path / "results/s")).sweep)
    (planned,), (unplanned,) = study.planned, study.unplanned
    assert planned.measure.words == "mean success over 2,000 steps"
    assert unplanned.measure.words == "mean success over 4,000 steps"
    assert unplanned.why == "exploratory: over more steps than planned"


ASKED: dict[str, Any] = {"hypotheses": ["q = 2 worse than q = 1"]}


def over(steps: int, **changes: Any) -> dict[str, Any]:
    content = document(**changes)
    content["defaults"]["env_steps"] = steps
    return content


def studied(folder: Path) -> Study:
    return study_of(read_sweep(str(folder / "results/s")).sweep)


def test_a_planned_final_value_is_that_at_the_planned_steps(tmp_path: Path) -> None:
    analysis = ASKED | {"metric": "final"}
    began = planned_and_played(tmp_path, over(2000, analysis=analysis))
    (before,) = studied(tmp_path).planned
    sweep = opened(tmp_path, over(4000, analysis=analysis))
    record_plan(sweep)
    play(sweep, began + 60_000, before=began)
    (planned,) = studied(tmp_path).planned
    assert float(planned.contrast.difference.value) == float(before.contrast.difference.value)
    assert planned.measure.words == "final success at 2,000 steps"


def test_fewer_steps_than_planned_have_no_verdict(tmp_path: Path) -> None:
    began = planned_and_played(tmp_path, over(4000, analysis=ASKED))
    sweep = opened(tmp_path, over(2000, analysis=ASKED))
    record_plan(sweep)
    play(sweep, began + 60_000)
    study = studied(tmp_path)
    assert study.planned == ()
    assert "fewer env_steps than planned" in study.untested[0]


def test_a_later_version_still_knows_the_results_of_shorter_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = int(time.time() * 1000)
    play(opened(tmp_path, over(2000)), now - 5000)
    sweep = opened(tmp_path, over(4000, analysis=ASKED))
    record_plan(sweep)
    play(sweep, now + 60_000, before=now - 5000)
    monkeypatch.setattr("music_rllib.experiment.plan.ALGORITHM_VERSION", "later")
    assert studied(tmp_path).planned == ()


def test_a_hypothesis_about_a_new_stage_that_continues_shown_runs_is_late(tmp_path: Path) -> None:
    short = document()["stages"][0]
    play(opened(tmp_path, document([short])), int(time.time() * 1000) - 5000)
    stages = [short, short | {"name": "long", "env_steps": 4000}]
    sweep = opened(tmp_path, document(stages, analysis=ASKED | {"stage": "long"}))
    assert record_plan(sweep)[1] == tuple(ASKED["hypotheses"])


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


def test_a_new_margin_does_not_move_a_planned_final_value(tmp_path: Path) -> None:
    analysis = ASKED | {"metric": "final"}
    began = planned_and_played(tmp_path, over(2000, analysis=analysis))
    sweep = opened(tmp_path, over(4000, analysis=analysis | {"margin": 0.2}))
    record_plan(sweep)
    play(sweep, began + 60_000, before=began)
    (planned,) = studied(tmp_path).planned
    assert planned.measure.words == "final success at 2,000 steps"


def test_a_planned_final_value_of_an_unchanged_stage_stays(tmp_path: Path) -> None:
    short: dict[str, Any] = document()["stages"][0] | {"name": "short", "tac": {"lr": 0.002}}
    stages = [short, {**document()["stages"][0], "name": "long", "env_steps": 4000}]
    texts = [f"stage = {s}, q = 2 worse than stage = {s}, q = 1" for s in ("short", "long")]
    analysis: dict[str, Any] = {"hypotheses": texts, "metric": "final"}
    planned_and_played(tmp_path, document(stages, analysis=analysis))
    before = studied(tmp_path).planned[1].measure
    fewer = analysis | {"hypotheses": texts[1:]}
    record_plan(opened(tmp_path, document(stages, analysis=fewer)))
    study = studied(tmp_path)
    assert study.planned[1].measure.words == before.words
    assert study.unplanned == ()


def test_compare_names_the_stage_that_it_shows(tmp_path: Path) -> None:
    search = {"space": {"tac.lr": {"float": [0.001, 0.01]}}, "trials": 2}
    search |= {"objective": {"metric": "evaluation/episode_return"}}
    tuned = {"name": "tuned", "variant": "tac", "search": search}
    sweep = opened(tmp_path, document([*document()["stages"], tuned]))
    play(sweep, 1)
    found, _ = compare_stage(sweep.location, None, None, minimize=False)
    assert len(found["comparisons"]) == 1
    assert (found["stage"], found["metric"]) == ("her", "evaluation/success_rate")


def stages_of(short: int, long: int) -> list[dict[str, Any]]:
    base = document()["stages"][0]
    first = base | {"name": "short", "tac": {"lr": 0.002}, "env_steps": short}
    return [first, base | {"name": "long", "env_steps": long}]


@pytest.mark.parametrize(
    ("raised", "words", "more"),
    [
        ((2000, 3000), ("final success at 1,500 steps", "final success at 2,000 steps"), 2),
        ((2000, 2000), ("final success at 1,500 steps", "final success"), 1),
        ((1500, 3000), ("final success", "final success at 2,000 steps"), 1),
    ],
)
def test_planned_final_values_stay_those_of_each_stage(
    tmp_path: Path, raised: tuple[int, int], words: tuple[str, str], more: int
) -> None:
    texts = [f"stage = {s}, q = 2 worse than stage = {s}, q = 1" for s in ("short", "long")]
    analysis: dict[str, Any] = {"hypotheses": texts, "metric": "final", "question": "?"}
    began = planned_and_played(tmp_path, document(stages_of(1500, 2000), analysis=analysis))
    before = [float(claim.contrast.difference.value) for claim in studied(tmp_path).planned]
    again = analysis | {"question": "Still?"}
    sweep = opened(tmp_path, document(stages_of(*raised), analysis=again))
    record_plan(sweep)
    left = [node for node in sweep.plan.nodes if node.key not in sweep.finished]
    play(sweep, began + 60_000, before=began, nodes=left)
    study = studied(tmp_path)
    assert tuple(claim.measure.words for claim in study.planned) == words
    after = [float(claim.contrast.difference.value) for claim in study.planned]
    assert after == pytest.approx(before)
    assert [claim.why for claim in study.unplanned] == [
        "exploratory: over more steps than planned"
    ] * more


def test_all_tasks_over_more_steps_are_compared(tmp_path: Path) -> None:
    def content(push: int, reach: int) -> dict[str, Any]:
        own = {"FetchPush": {"env_steps": push}, "FetchReach": {"env_steps": reach}}
        stage = document()["stages"][0] | {"per_task": own}
        return document([stage], tasks=["FetchPush", "FetchReach"], analysis=ASKED)

    began = planned_and_played(tmp_path, content(2000, 3000))
    sweep = opened(tmp_path, content(4000, 6000))
    record_plan(sweep)
    play(sweep, began + 60_000, before=began)
    assert len({claim.task for claim in studied(tmp_path).unplanned}) == 3


def test_a_planned_final_value_stays_if_its_runs_are_another_stage_now(tmp_path: Path) -> None:
    analysis = ASKED | {"metric": "final", "stage": "her"}
    began = planned_and_played(tmp_path, document(analysis=analysis))
    base = document()["stages"][0]
    stages = [base | {"name": "short"}, base | {"env_steps": 4000}]
    sweep = opened(tmp_path, document(stages, analysis=analysis))
    record_plan(sweep)
    left = [node for node in sweep.plan.nodes if node.key not in sweep.finished]
    play(sweep, began + 60_000, before=began, nodes=left)
    (planned,) = studied(tmp_path).planned
    assert planned.measure.words == "final success at 2,000 steps"


def test_shorter_runs_after_a_result_do_not_move_a_planned_final_value(tmp_path: Path) -> None:
    analysis = ASKED | {"metric": "final"}
    began = planned_and_played(tmp_path, over(2000, analysis=analysis))
    shorter = opened(tmp_path, over(1500, analysis=analysis))
    record_plan(shorter)
    play(shorter, began + 60_000)
    record_plan(opened(tmp_path, over(2000, analysis=analysis)))
    study = studied(tmp_path)
    assert [one.measure.words for one in study.planned] == ["final success"]
    assert study.unplanned == ()


def test_a_task_that_is_added_is_not_over_more_steps(tmp_path: Path) -> None:
    texts = [f"stage = {s}, q = 2 worse than stage = {s}, q = 1" for s in ("short", "long")]
    asked = {"hypotheses": texts}
    began = planned_and_played(tmp_path, document(stages_of(1500, 2000), analysis=asked))
    both = ["FetchPush", "FetchSlide"]
    sweep = opened(tmp_path, document(stages_of(1500, 2000), analysis=asked, tasks=both))
    record_plan(sweep)
    left = [node for node in sweep.plan.nodes if node.key not in sweep.finished]
    play(sweep, began + 60_000, nodes=left)
    assert not [one for one in studied(tmp_path).unplanned if "more steps" in one.why]
