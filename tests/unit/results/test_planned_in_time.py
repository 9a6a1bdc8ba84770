"""Which hypotheses were planned before their results, and over which steps they are tested."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import make_plan
from music_rllib.program import main
from music_rllib.results.analysis_plan import analysis_plan, plans_in, record_plan
from music_rllib.results.study import untestable
from music_rllib.sweep.listeners.state_file import StateFile
from tests import played_search
from tests.played_sweep import (
    ASKED,
    document,
    opened,
    over,
    planned_and_played,
    play,
    stages_of,
    studied,
    with_alpha_of_each_task,
)
from tests.sweep_files import loaded

OF_EACH_STAGE = [
    f"stage = {one}, q = 2 worse than stage = {one}, q = 1" for one in ("short", "long")
]


def test_a_hypothesis_about_runs_that_continue_shown_ones_is_late(tmp_path: Path) -> None:
    now = int(time.time() * 1000)
    play(opened(tmp_path, document()), now - 5000)
    sweep = opened(tmp_path, over(4000, analysis=ASKED))
    assert record_plan(sweep)[1] == tuple(ASKED["hypotheses"])
    play(sweep, now + 60_000, before=now - 5000)
    study = studied(tmp_path)
    assert (study.planned, study.late) == ((), tuple(ASKED["hypotheses"]))


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
    sweep = opened(tmp_path, document(analysis=ASKED))
    record_plan(sweep)
    Path("sweep.yaml").write_text(yaml.safe_dump(document(analysis=ASKED)))
    for changes in (["--seeds", "12"], ["env_steps=1e6"]):
        assert main(["plan", "sweep.yaml", *changes]) == 0
        assert len(plans_in(sweep.storage, "s")) == 1
    assert main(["plan", "sweep.yaml", "analysis.margin=0.1"]) == 0
    assert len(plans_in(sweep.storage, "s")) == 2


def test_more_steps_after_a_result_are_an_exploratory_comparison(tmp_path: Path) -> None:
    """The planned one stays that over the planned steps."""
    began = planned_and_played(tmp_path, document(analysis=ASKED))
    sweep = opened(tmp_path, over(4000, analysis=ASKED))
    record_plan(sweep)
    play(sweep, began + 60_000, before=began)
    study = studied(tmp_path)
    (planned,), (unplanned,) = study.planned, study.unplanned
    assert planned.measure.words == "mean success over 2,000 steps"
    assert unplanned.measure.words == "mean success over 4,000 steps"
    assert unplanned.why == "exploratory: over more steps than planned"


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


def test_a_new_margin_does_not_move_a_planned_final_value(tmp_path: Path) -> None:
    analysis = ASKED | {"metric": "final"}
    began = planned_and_played(tmp_path, over(2000, analysis=analysis))
    sweep = opened(tmp_path, over(4000, analysis=analysis | {"margin": 0.2}))
    record_plan(sweep)
    play(sweep, began + 60_000, before=began)
    (planned,) = studied(tmp_path).planned
    assert planned.measure.words == "final success at 2,000 steps"


def test_a_planned_final_value_of_an_unchanged_stage_stays(tmp_path: Path) -> None:
    stages = stages_of(2000, 4000)
    analysis: dict[str, Any] = {"hypotheses": OF_EACH_STAGE, "metric": "final"}
    planned_and_played(tmp_path, document(stages, analysis=analysis))
    before = studied(tmp_path).planned[1].measure
    fewer = analysis | {"hypotheses": OF_EACH_STAGE[1:]}
    record_plan(opened(tmp_path, document(stages, analysis=fewer)))
    study = studied(tmp_path)
    assert study.planned[1].measure.words == before.words
    assert study.unplanned == ()


def test_each_hypothesis_is_compared_over_the_steps_of_its_stages(tmp_path: Path) -> None:
    texts = [*OF_EACH_STAGE, "stage = long, q = 2 worse than stage = short, q = 1"]
    planned_and_played(tmp_path, document(stages_of(1500, 2000), analysis={"hypotheses": texts}))
    words = [claim.measure.words for claim in studied(tmp_path).planned]
    assert words == [f"mean success over {n} steps" for n in ("1,500", "2,000", "1,500")]


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
    analysis: dict[str, Any] = {"hypotheses": OF_EACH_STAGE, "metric": "final", "question": "?"}
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
    asked = {"hypotheses": OF_EACH_STAGE}
    began = planned_and_played(tmp_path, document(stages_of(1500, 2000), analysis=asked))
    both = ["FetchPush", "FetchSlide"]
    sweep = opened(tmp_path, document(stages_of(1500, 2000), analysis=asked, tasks=both))
    record_plan(sweep)
    left = [node for node in sweep.plan.nodes if node.key not in sweep.finished]
    play(sweep, began + 60_000, nodes=left)
    assert not [one for one in studied(tmp_path).unplanned if "more steps" in one.why]


@pytest.mark.parametrize("metric", ["auc", "final"])
def test_the_planned_comparison_of_an_added_task_keeps_its_steps(
    tmp_path: Path, metric: str
) -> None:
    def content(steps: int) -> dict[str, Any]:
        both = ["FetchPush", "FetchSlide"]
        return over(steps, tasks=both, analysis=ASKED | {"metric": metric})

    planned_and_played(tmp_path, over(2000, analysis=ASKED | {"metric": metric}))
    time.sleep(0.01)
    sweep = opened(tmp_path, content(2000))
    shown = record_plan(sweep)[0][-1].recorded_ms + 1
    left = [node for node in sweep.plan.nodes if node.key not in sweep.finished]
    play(sweep, shown, nodes=left)
    before = {one.task: float(one.contrast.difference.value) for one in studied(tmp_path).planned}
    longer = opened(tmp_path, content(4000))
    record_plan(longer)
    play(longer, shown + 60_000, before=shown)
    study = studied(tmp_path)
    after = {one.task: float(one.contrast.difference.value) for one in study.planned}
    assert after == pytest.approx(before)
    assert {one.task for one in study.unplanned} == before.keys()


@pytest.mark.parametrize("raised", [(1500, 3000), (2000, 3000), (2000, 2000)])
def test_a_planned_final_value_of_two_stages_stays(tmp_path: Path, raised: tuple[int, int]) -> None:
    texts = ["stage = long, q = 2 better than stage = short, q = 2"]
    analysis: dict[str, Any] = {"hypotheses": texts, "metric": "final"}
    began = planned_and_played(tmp_path, document(stages_of(1500, 2000), analysis=analysis))
    (before,) = studied(tmp_path).planned
    sweep = opened(tmp_path, document(stages_of(*raised), analysis=analysis))
    record_plan(sweep)
    left = [node for node in sweep.plan.nodes if node.key not in sweep.finished]
    play(sweep, began + 60_000, before=began, nodes=left)
    study = studied(tmp_path)
    (planned,) = study.planned
    assert float(planned.contrast.difference.value) == float(before.contrast.difference.value)
    assert "more steps" in study.unplanned[0].why


def test_a_planned_final_value_of_longer_runs_is_their_last(tmp_path: Path) -> None:
    grid = {"tac.entropic_index": [1.0, 2.0], "env_steps": [1500, 2000]}
    text = "q = 2, env_steps = 2000 worse than q = 1, env_steps = 2000"
    stage = {"name": "her", "variant": "tac", "grid": grid}
    analysis = {"hypotheses": [text], "metric": "final"}
    planned_and_played(tmp_path, document([stage], analysis=analysis))
    (planned,) = studied(tmp_path).planned
    assert float(planned.contrast.difference.value) == pytest.approx(-0.1)  # at 1,500: -0.075
    assert planned.measure.words == "final success"


def test_final_values_over_all_tasks_do_not_name_the_steps_of_one(tmp_path: Path) -> None:
    def content(push: int, reach: int) -> dict[str, Any]:
        own = {"FetchPush": {"env_steps": push}, "FetchReach": {"env_steps": reach}}
        stage = document()["stages"][0] | {"per_task": own}
        asked = ASKED | {"metric": "final"}
        return document([stage], tasks=["FetchPush", "FetchReach"], analysis=asked)

    began = planned_and_played(tmp_path, content(1500, 2000))
    sweep = opened(tmp_path, content(2000, 3000))
    record_plan(sweep)
    play(sweep, began + 60_000, before=began)
    assert studied(tmp_path).planned[0].measure.words == "final success at the planned steps"


def test_final_values_by_a_plan_without_the_steps_of_each_stage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Plans of earlier versions of the package have the fewest steps of any stage only."""
    analysis: dict[str, Any] = {"hypotheses": OF_EACH_STAGE, "metric": "final"}
    content = document(stages_of(1500, 2000), analysis=analysis)
    with monkeypatch.context() as earlier:
        module = "music_rllib.results.analysis_plan"
        plan = analysis_plan(loaded(tmp_path, content))
        assert plan is not None
        without = plan.model_copy(update={"more_steps": {}})
        earlier.setattr(f"{module}.analysis_plan", lambda _: without)
        planned_and_played(tmp_path, content)
    words = [claim.measure.words for claim in studied(tmp_path).planned]
    assert words == ["final success", "final success"]


def test_plan_names_the_hypotheses_that_the_answer_calls_late(tmp_path: Path) -> None:
    one, two = "q = 2 worse than q = 1", "q = 2 against q = 1"

    def said(*hypotheses: str) -> tuple[OpenSweep, tuple[str, ...]]:
        sweep = opened(tmp_path, document(analysis={"hypotheses": list(hypotheses)}))
        time.sleep(0.01)
        return sweep, record_plan(sweep)[1]

    assert said(one, two)[1] == ()
    sweep, late = said(two)
    assert late == ()
    play(sweep, int(time.time() * 1000) + 1)
    assert said(one, two)[1] == studied(tmp_path).late == (one,)


def test_plan_names_late_hypotheses_about_a_search(tmp_path: Path) -> None:
    search = {
        "mode": "compare",
        "compare": {"tac.entropic_index": [1.0, 2.0]},
        "space": {"tac.alpha": {"choice": [0.05, 0.2]}},
        "trials": 1,
        "startup_trials": 1,
        "final": {"trials": 1, "seeds": 5},
    }
    content = played_search.document(
        {}, stages=[{"name": "tuned", "variant": "tac", "search": search}]
    )
    driver = played_search.Driver(tmp_path, content)
    with StateFile(driver.sweep) as state_file:
        driver.play()
        state_file.end("finished")
    text = "q = 2 against q = 1"
    sweep = opened(tmp_path, content | {"analysis": {"hypotheses": [text]}})
    assert record_plan(sweep)[1] == (text,)


@pytest.mark.parametrize("steps", [2000, 4000])
def test_a_hypothesis_names_the_steps_of_its_own_stage_with_auc_total(
    tmp_path: Path, steps: int
) -> None:
    """Not those with the pretraining, which are 4,000 for the runs of 2,000 steps."""
    grid = {"tac.entropic_index": [1.0, 2.0], "env_steps": [2000, 4000]}
    tune = {"name": "r", "variant": "music-r", "init_from": "u", "grid": grid}
    stages: list[dict[str, Any]] = [{"name": "u", "variant": "music-u"}, tune]
    text = f"q = 2, env_steps = {steps} against q = 1, env_steps = {steps}"
    analysis = {"hypotheses": [text], "metric": "auc_total"}
    planned_and_played(tmp_path, document(stages, analysis=analysis))
    (claim,) = studied(tmp_path).planned
    ((first, second),) = claim.pairs
    assert first.label == f"q = 2, env_steps = {steps}"
    assert second.label == f"q = 1, env_steps = {steps}"


def test_a_hypothesis_does_not_name_the_setting_of_one_task_only(tmp_path: Path) -> None:
    asked = {"hypotheses": ["q = 2, alpha = 0.05 worse than q = 1, alpha = 0.05"]}
    content = with_alpha_of_each_task(analysis=asked)
    config = loaded(tmp_path, content)
    plan = analysis_plan(config)
    assert plan is not None
    assert len([*untestable(make_plan(config), plan)]) == 1
    planned_and_played(tmp_path, content)
    assert studied(tmp_path).planned == ()
