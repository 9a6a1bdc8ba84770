"""Exports of sweeps and of the best policy keep files of the user, and name no places."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from music_rllib.config.yaml_file import Dumper
from music_rllib.errors import BadInputError
from music_rllib.experiment.plan import make_plan
from music_rllib.results.archive import read_archive, write_archive
from music_rllib.results.data import LastValues, ReportError, Sweep
from music_rllib.store.node_store import NodeStore
from music_rllib.sweep import export
from tests.sweep_files import loaded


@pytest.mark.parametrize("name", ["run.yaml", "run.json"])
def test_best_keeps_files_of_the_user(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tmp_path / "made"
    (made / "handoff").mkdir(parents=True)
    (made / "handoff" / "handoff.json").write_text("{}")
    (made / "run.json").write_text("{}")
    store = NodeStore(str(tmp_path / "results"))
    store.publish("k", made)
    monkeypatch.setattr(export, "sweep_of_run", lambda *_: {"name": "g-best"})
    opened: Any = SimpleNamespace(store=store)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / name).write_text("by hand")
    with pytest.raises(BadInputError, match=f"which has {name}"):
        export._export(opened, "k", mine, {"task": "FetchReach"})
    assert [file.name for file in mine.iterdir()] == [name]
    for _ in range(2):  # an earlier export is replaced
        export._export(opened, "k", tmp_path / "out", {"task": "FetchReach"})


def test_a_sweep_file_of_the_user_is_no_export(tmp_path: Path) -> None:
    (tmp_path / "sweep.json").write_text('{"name": "mine", "stages": []}')
    (tmp_path / "metrics.csv").write_text("mine")
    with pytest.raises(ReportError, match=r"sweep\.json, metrics\.csv"):
        write_archive(Sweep(name="g", runs=[], history={}), tmp_path)
    assert "stages" in (tmp_path / "sweep.json").read_text()
    assert (tmp_path / "metrics.csv").read_text() == "mine"
    for _ in range(2):
        write_archive(Sweep(name="g", runs=[], history={}), tmp_path / "new")


def test_an_export_has_no_paths_of_an_environment(tmp_path: Path) -> None:
    paths = {"xml_file": "/home/anna/lab/arm.xml", "files": ["/home/anna/a.xml"], "frame_skip": 5}
    own = {"Arm": {"env_id": "lab:Arm-v0", "horizon": 5, "env_kwargs": paths}}
    stages = [{"name": "train", "variant": "tac"}]
    document = {"name": "g", "tasks": ["Arm"], "environments": own, "stages": stages}
    config = loaded(tmp_path, document)
    text = yaml.dump(dict(config.document), Dumper=Dumper, width=10**6)
    sweep = replace(LastValues(make_plan(config)).sweep({}), config=text)
    write_archive(sweep, tmp_path / "out", "csv")
    for file in (tmp_path / "out").iterdir():
        assert "anna" not in file.read_text(), file.name
    kept = read_archive(tmp_path / "out")
    assert kept.config is not None
    arguments = yaml.safe_load(kept.config)["environments"]["Arm"]["env_kwargs"]
    assert arguments["xml_file"] == "arm.xml"
    assert kept.runs[0].params["task.env_kwargs.xml_file"] == "arm.xml"
