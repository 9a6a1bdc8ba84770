"""A sweep in MLflow: the runs' names, and the view behind its link."""

from __future__ import annotations

import json
from collections.abc import Iterable
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from music_rllib import names
from music_rllib.config.load import load_config
from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.open_sweep import OpenSweep, open_sweep
from music_rllib.experiment.plan import Plan, make_plan
from music_rllib.experiment.run_info import RunInfo, run_name
from music_rllib.report.cli import _note
from music_rllib.results import tables
from music_rllib.store.history import Report
from music_rllib.sweep import execution
from music_rllib.sweep.listeners.mlflow_view import comparison_view
from music_rllib.tracking.listener import MlflowListener
from music_rllib.tracking.run_queue import RunQueue
from music_rllib.tracking.sender import Pending
from tests.played_search import publish
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


def view_of(folder: Path, **document: Any) -> Any:
    swept = loaded(folder, {"name": "s", "tasks": ["FetchPush"], "seeds": 1, **document})
    view = comparison_view(make_plan(swept), swept.stage(), "c0ffee", 1.5)
    return json.loads(json.loads(view)["state"])


def test_the_view_begins_with_the_metric_of_its_own_stage(tmp_path: Path) -> None:
    state = view_of(
        tmp_path,
        environments={"Run": {"env_id": "HalfCheetah-v5", "horizon": 1000, "success_key": None}},
        stages=[
            {"name": "warm", "variant": "tac", "tasks": ["Run"]},
            {"name": "train", "variant": "tac", "grid": {"tac.entropic_index": [1.0, 1.5]}},
        ],
    )
    assert state["compareRunCharts"][0]["metricKey"] == names.EVAL_SUCCESS
    grouped = [key["groupByData"] for key in state["groupBy"]["groupByKeys"]]
    assert grouped == [names.TAG_ENTROPIC_INDEX]


LINEAR = {"schedule": "linear", "start": 1, "end": 2}


@pytest.mark.parametrize(
    ("setting", "values", "param"),
    [
        ("tac.lr", [0.001, 0.003], "tac.lr"),
        (
            "tac.entropic_index",
            [LINEAR | {"begin": begin} for begin in (0.1, 0.5)],
            "tac.entropic_index.begin",
        ),
        (
            "tac.alpha",
            [{"learned": True, "target_entropy": entropy} for entropy in (-4, -2)],
            "tac.alpha.target_entropy",
        ),
    ],
)
def test_conditions_of_the_same_words_have_their_own_lines(
    tmp_path: Path, setting: str, values: list[Any], param: str
) -> None:
    stages = [{"name": "train", "variant": "tac", "grid": {setting: values}}]
    keys = view_of(tmp_path, stages=stages)["groupBy"]["groupByKeys"]
    assert {"mode": "param", "groupByData": param} in keys


class RecordedTracker:
    """Records what a driver sends to MLflow."""

    def __init__(self) -> None:
        self.mirrored: list[str] = []
        self.current: list[list[str]] = []
        self.store = SimpleNamespace(ui_command=str)

    def mirror(self, info: RunInfo, read: object) -> None:
        self.mirrored.append(info.node_key)

    def keep_current(self, keys: Iterable[str]) -> None:
        self.current.append(sorted(keys))

    def is_running(self, key: str) -> bool:
        return False

    def pending(self) -> Pending:
        return Pending(records=0, error=None)

    def comparison_url(self) -> str:
        return ""

    def look_again(self, *_: object, **__: object) -> None: ...

    close = undelivered_message = look_again


@pytest.mark.parametrize("shares", [False, True])
def test_runs_of_other_drivers_are_left_to_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shares: bool
) -> None:
    """Whichever driver began first: MLflow has each run once, and keeps those of others current."""
    document = {"name": "s", "tasks": ["FetchReach"], "seeds": 2}
    document |= {"stages": [{"name": "train", "variant": "tac"}]}
    swept = loaded(tmp_path, document, storage=str(tmp_path / "results"))
    opened = open_sweep(swept, make_plan(swept), swept.storage)
    metrics = {names.EVAL_EPISODES: 2.0, names.EVAL_SUCCESS: 0.5}
    report = Report(env_steps=200_000, seconds=1.0, timestamp_ms=1, metrics=metrics)

    def compute(opened: OpenSweep, display: object, log: MlflowListener, *_: object) -> None:
        for node in opened.plan.nodes:  # another driver, which began later, has computed them
            result = publish(opened, node, [report])
            opened.scheduler.finish(node.key)
            log.finished(node, result)

    monkeypatch.setattr(execution, "_compute", compute)
    monkeypatch.setattr(execution, "report_at_end", lambda _: None)
    tracker: Any = RecordedTracker()
    drivers: Any = SimpleNamespace(stop_before=None, others=lambda: ["another driver"])
    console = Console(file=StringIO())
    execution.compute_and_report(console, opened, tracker, [], drivers, None, shares=shares)
    assert tracker.mirrored == [], "the other driver logs them"
    begun = [] if shares else [sorted(node.key for node in opened.plan.nodes)]
    assert tracker.current == begun, "the plan may lack runs of the other driver"


def test_a_resumed_run_has_the_name_of_its_place_in_the_present_plan() -> None:
    changed: dict[str, str] = {}
    experiment: Any = SimpleNamespace(
        find=lambda *_, **__: SimpleNamespace(run_id="r", tags={}, is_complete=False),
        last_steps=lambda _: {},
        known_id=lambda _: None,
        begin_run=lambda run_id, tags, params: changed.update(tags),
        log=lambda *_, **__: None,
    )
    queue = RunQueue(experiment, "k")
    queue.start(RunInfo(node_key="k", name="q=1.5 alpha=0.2 seed 0 FetchPush train", config={}))
    queue.send()
    assert changed["mlflow.runName"] == "q=1.5 alpha=0.2 seed 0 FetchPush train"


def test_a_long_description_keeps_its_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """MLflow cuts off tags of more than 8,000 characters."""
    row = [SimpleNamespace(text="q = 1.5, α = 0.0123 and more words")] * 6
    table = SimpleNamespace(heads=[("head", "")] * 6, cells=[row] * 60)
    monkeypatch.setattr(tables, "performance_tables", lambda _: [table])
    made: Any = SimpleNamespace(
        analyses=[SimpleNamespace(stage=SimpleNamespace(name="train"))],
        study=SimpleNamespace(stage=None),
        drawings=[SimpleNamespace(stage="train", name="curves")],
    )
    note = _note("**the answer**", made, "0" * 32)
    assert len(note) <= 8000
    lines = note.splitlines()
    assert lines[-1].startswith("![report/figures/curves.png]")
    shown = sum(line.startswith("| q = 1.5") for line in lines)
    assert f"The report has {60 - shown} more rows." in lines
