"""A sweep in MLflow: the runs' names, and the view behind its link."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from music_rllib import names
from music_rllib.config.load import load_config
from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.plan import Plan, make_plan
from music_rllib.experiment.run_info import run_name
from music_rllib.sweep.listeners.mlflow_view import comparison_view
from tests.sweep_files import loaded

ROOT = Path(__file__).parents[3]
STAGES: list[dict[str, Any]] = [
    {"name": "pretrain", "variant": "music-u"},
    {
        "name": "finetune",
        "variant": "music-r",
        "init_from": "pretrain",
        "grid": {
            "tac.alpha": [0.1, 0.2],
            "tac.entropic_index": [1.0, 1.5],
            "tac.lr": [0.001],
        },
    },
]


def config(folder: Path, tasks: list[str]) -> SweepConfig:
    return loaded(folder, {"name": "s", "tasks": tasks, "seeds": 2, "stages": STAGES})


def plan(folder: Path, tasks: list[str]) -> Plan:
    return make_plan(config(folder, tasks))


def test_a_run_s_name_begins_with_its_varied_settings(tmp_path: Path) -> None:
    called = [run_name(node) for node in plan(tmp_path, ["FetchPush", "FetchSlide"]).nodes]
    assert len(set(called)) == len(called)
    assert "seed 1 FetchSlide pretrain" in called
    assert "q=1.5 alpha=0.2 lr=0.001 seed 0 FetchPush finetune" in called


def test_the_view_has_a_line_for_each_condition_of_the_compared_stage(tmp_path: Path) -> None:
    swept = config(tmp_path, ["FetchPush", "FetchSlide"])
    view = json.loads(comparison_view(make_plan(swept), swept.stage(), "c0ffee", 1.5))
    assert (view["name"], view["createdAt"]) == ("s: comparison", 1500)
    state = json.loads(view["state"])
    current = "tags.sweep_id = 'c0ffee' and tags.current = 'yes'"
    assert state["searchFilter"] == f"{current} and tags.stage = 'finetune'"
    grouped = [key["groupByData"] for key in state["groupBy"]["groupByKeys"]]
    assert grouped == [names.TAG_ENTROPIC_INDEX, names.TAG_ALPHA, names.TAG_TASK]
    assert state["compareRunCharts"][0]["metricKey"] == names.EVAL_SUCCESS
    known = {section["uuid"] for section in state["compareRunSections"]}
    assert {chart["metricSectionId"] for chart in state["compareRunCharts"]} <= known
    opened = [section["name"] for section in state["compareRunSections"] if section["display"]]
    assert opened == ["Comparison"]


def test_the_view_of_a_search_has_its_trials_of_which_none_is_planned_yet() -> None:
    swept = load_config(ROOT / "tune_configs" / "search.yaml")
    stage = swept.stage()
    state = json.loads(json.loads(comparison_view(make_plan(swept), stage, "c0ffee", 1.5))["state"])
    assert state["searchFilter"].endswith(f"tags.stage = '{stage.name}'")
    assert stage.search is not None
    assert "tac.alpha" in stage.search.space
    grouped = [key["groupByData"] for key in state["groupBy"]["groupByKeys"]]
    assert names.TAG_ALPHA in grouped
