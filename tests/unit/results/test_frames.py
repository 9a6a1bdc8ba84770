"""Frames of a sweep, and exports."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest

from music_rllib import load_sweep, names
from music_rllib.errors import BadInputError
from music_rllib.experiment.plan import make_plan
from music_rllib.results.archive import Format, read_archive, write_archive
from music_rllib.results.data import LastValues, Points, ReportError, Sweep, columns
from music_rllib.results.frames import frames_of
from music_rllib.results.read import read_sweep
from music_rllib.store.history import RunResult
from tests.sweep_files import loaded

DOCS = Path(__file__).parents[3] / "docs"
EXPORT = DOCS / "results" / "data" / "v3-fetch-push-music-f"


def test_joined_frames_equal_the_export() -> None:
    sweep, frames = read_archive(EXPORT), load_sweep(EXPORT)
    assert frames.name == sweep.name
    assert list(frames.runs.index) == [run.node_key for run in sweep.runs]
    assert dict(frames.runs.dtypes[["q", "tac.lr", "score"]]) == dict.fromkeys(
        ("q", "tac.lr", "score"), "float64"
    )
    joined = frames.curves.join(frames.runs, on="key")
    assert len(joined) == sum(len(column.run) for column in sweep.history.values())
    for position, run in enumerate(sweep.runs):
        steps, values = sweep.series(position, names.EVAL_DISPLACEMENT)
        of_run = joined[(joined.key == run.node_key) & (joined.metric == names.EVAL_DISPLACEMENT)]
        assert of_run.env_steps.tolist() == steps.tolist()
        assert of_run.value.tolist() == values.tolist()
        assert set(of_run.stage) == {run.stage}
    started = frames.runs.loc[frames.runs.source.dropna()]
    assert set(started.stage) == {"pretrain"}
    again = frames.runs.groupby(["stage", "task", "condition"]).score.mean()
    said = frames.conditions.set_index(["stage", "task", "condition"])["mean"]
    pd.testing.assert_series_equal(again.sort_index(), said.sort_index(), check_names=False)


def test_a_name_in_a_storage_is_not_an_export_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_archive(read_archive(EXPORT), tmp_path / "mine")
    assert read_sweep("mine").sweep.name == read_archive(EXPORT).name
    assert read_sweep("./mine", "elsewhere").sweep.name == read_archive(EXPORT).name
    with pytest.raises(BadInputError, match="elsewhere/mine"):
        read_sweep("mine", "elsewhere")


def test_a_csv_export_gives_the_same_frames(tmp_path: Path) -> None:
    write_archive(read_archive(EXPORT), tmp_path / "csv", "csv")
    first, second = load_sweep(EXPORT), load_sweep(tmp_path / "csv")
    for name in ("runs", "curves", "conditions"):
        pd.testing.assert_frame_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize("name", ["runs.csv", "search.json", "config.json"])
def test_files_that_are_no_export_are_kept(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine")
    if name == "config.json":  # the folder of a sweep, into which an export was once written
        (tmp_path / "sweep.json").write_text("{}")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ReportError, match=f"must be a new folder .*{name}"):
        write_archive(read_archive(EXPORT), tmp_path)
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / name).read_text() == "mine"


@pytest.mark.parametrize("file_format", get_args(Format))
def test_an_export_without_runs_can_be_read(tmp_path: Path, file_format: Format) -> None:
    write_archive(replace(read_archive(EXPORT), runs=[], history={}), tmp_path, file_format)
    again = read_archive(tmp_path)
    assert (list(again.runs), dict(again.history)) == ([], {})


def test_frames_without_runs_have_the_same_types() -> None:
    whole = load_sweep(EXPORT)
    empty = frames_of(replace(read_archive(EXPORT), runs=[], history={}))
    for name in ("runs", "curves", "conditions"):
        frame = getattr(empty, name)
        assert frame.empty
        assert dict(frame.dtypes) == dict(getattr(whole, name).dtypes[frame.columns])


def test_a_failed_run_without_a_report_keeps_its_q() -> None:
    """Otherwise it is missing in `groupby("q")`, and only there."""
    sweep = read_archive(EXPORT)
    history = {
        name: column.select(column.run != 0) if name.startswith("setting") else column
        for name, column in sweep.history.items()
    }
    whole, lacking = frames_of(sweep), frames_of(replace(sweep, history=history))
    columns = ["q", "alpha", "mi_reward_weight"]
    pd.testing.assert_frame_equal(lacking.runs[columns], whole.runs[columns])
    pd.testing.assert_series_equal(lacking.conditions["q"], whole.conditions["q"])


def test_the_notebook_reproduces_its_outputs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run every code cell and compare its output as text."""
    monkeypatch.chdir(DOCS)
    mpl.use("Agg")
    notebook = json.loads((DOCS / "first_results.ipynb").read_text(encoding="utf-8"))
    namespace: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        *steps, last = ast.parse("".join(cell["source"])).body
        exec(compile(ast.Module(steps, []), "cell", "exec"), namespace)
        if not isinstance(last, ast.Expr):
            continue
        value = eval(compile(ast.Expression(last.value), "cell", "eval"), namespace)
        shown = ["".join(output["data"]["text/plain"]) for output in cell["outputs"]]
        assert shown in ([repr(value)], ["<Figure>"])


def test_the_last_of_several_values_at_a_step_counts() -> None:
    points = Points(
        ("loss", "loss", "loss", "success"), (10, 20, 20, 20), (1, 9, 5, 3), (0.1, 0.2, 0.3, 0.4)
    )
    loss = columns([points])["loss"]
    assert (loss.step.tolist(), loss.value.tolist()) == ([10, 20], [0.1, 0.2])
    assert columns([points])["success"].value.tolist() == [0.4]


def test_an_export_has_no_absolute_paths(tmp_path: Path) -> None:
    config = "storage: /home/anna/r\nstages:\n- search:\n    storage: sqlite:////home/anna/x/s.db\n"
    config += "mlflow:\n  tracking_uri: sqlite:////home/anna/y/mlflow.db\n"
    config += "quoted:\n  storage: '/home/anna: x/results'\n"
    sweep = read_archive(EXPORT)
    failure = {names.TAG_FAILURE: "no module 'x' (it is not in /home/anna/x, see s3://b/c/d)"}
    failed = replace(sweep.runs[0], tags={**sweep.runs[0].tags, **failure})
    sweep = replace(sweep, runs=[failed, *sweep.runs[1:]])
    write_archive(replace(sweep, config=config), tmp_path)
    assert "anna" not in (tmp_path / "sweep.json").read_text()
    kept = read_archive(tmp_path)
    assert kept.runs[0].failure == "no module 'x' (it is not in x, see s3://b/c/d)"
    assert kept.config is not None
    assert "  storage: 'results'\n" in kept.config


def test_an_export_on_a_full_disk_keeps_the_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_archive(read_archive(EXPORT), tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("music_rllib.results.archive._write_json", full)
    with pytest.raises(ReportError, match="No space left"):
        write_archive(replace(read_archive(EXPORT), runs=[], history={}), tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def of_stage(
    folder: Path, stage: dict[str, Any], tasks: Iterable[str] = ("FetchPush",), *, done: bool = True
) -> Sweep:
    """A sweep of two seeds whose runs have finished, or have no report yet."""
    plan = make_plan(
        loaded(
            folder,
            {
                "name": "s",
                "tasks": list(tasks),
                "seeds": 2,
                "stages": [{"name": "train", "variant": "tac", **stage}],
            },
        )
    )
    values = {names.EVAL_SUCCESS: 0.5, names.EVAL_EPISODES: 20.0}
    results = {
        n.key: RunResult(label=n.label, env_steps=n.run.env_steps, seconds=1.0, metrics=values)
        for n in plan.nodes
    }
    return LastValues(plan).sweep(results if done else {})


def test_a_task_s_condition_has_its_own_q(tmp_path: Path) -> None:
    qs = {"FetchPush": 1.0, "FetchSlide": 2.0}
    stage: dict[str, Any]
    stage = {"per_task": {task: {"tac": {"entropic_index": q}} for task, q in qs.items()}}
    found = frames_of(of_stage(tmp_path, stage, qs)).conditions.set_index("task")["q"]
    assert {task: found[task] for task in qs} == qs
    assert np.isnan(found["all tasks"])
    stage = {"grid": {"tac.entropic_index": [1.5]}}
    assert set(frames_of(of_stage(tmp_path, stage, qs)).conditions["q"]) == {1.5}


@pytest.mark.parametrize(
    ("setting", "q", "alpha"),
    [
        (
            {"entropic_index": {"follows": "shannon_entropy", "points": [[-4.0, 2.0], [2.0, 1.0]]}},
            1.0,
            0.2,
        ),
        (
            {"entropic_index": {"follows": "success_rate", "points": [[0.0, 2.0], [1.0, 1.0]]}},
            2.0,
            0.2,
        ),
        ({"alpha": 0.123456789}, 1.0, 0.123456789),
        ({"alpha": {"learned": True, "initial": 0.3}}, 1.0, 0.3),
        ({"alpha": {"schedule": "linear", "start": 0.1234567, "end": 0.1}}, 1.0, 0.1234567),
        (
            {"alpha": {"schedule": "piecewise", "points": [[0, 0.1234567], [5, 0.1]]}},
            1.0,
            0.1234567,
        ),
        ({"alpha": {"value": 0.1234567, "matched_width": 0.3}}, 1.0, 0.1234567),
        (
            {
                "alpha": {
                    "value": {"schedule": "piecewise", "points": [[0, 0.1234567], [5, 0.1]]},
                    "matched_width": 0.3,
                }
            },
            1.0,
            0.1234567,
        ),
    ],
)
def test_a_run_without_a_report_has_its_initial_settings(
    tmp_path: Path, setting: dict[str, Any], q: float, alpha: float
) -> None:
    frame = frames_of(of_stage(tmp_path, {"tac": setting}, done=False)).runs
    assert (set(frame.q), set(frame.alpha)) == ({q}, {alpha})


def test_the_storage_of_a_sweep_can_be_a_path(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="must be a sweep that was started"):
        load_sweep("nope", storage=tmp_path)
