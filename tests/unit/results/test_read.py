"""A sweep is its current plan: every command and page shows the same runs of it."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from music_rllib import load_sweep, names
from music_rllib.experiment.open_sweep import OpenSweep, open_sweep
from music_rllib.experiment.plan import Node, make_plan
from music_rllib.experiment.record import keep_record
from music_rllib.experiment.scheduler import Failure
from music_rllib.program import main
from music_rllib.report.build import limitations
from music_rllib.report.page import failures_table
from music_rllib.results.analysis import analyse
from music_rllib.results.read import read_sweep
from music_rllib.results.study import study_of
from music_rllib.store.history import HISTORY, Report, RunResult, last_values, to_json_lines
from music_rllib.store.storage import DamagedError
from music_rllib.sweep.listeners.state_file import StateFile
from tests.sweep_files import loaded

PAUSE = 3_600_000
"""Milliseconds between two sittings."""
CODE = {names.TAG_GIT_COMMIT: "c0ffee", f"{names.TAG_VERSION_PREFIX}torch": "2.0"}


def reports(q: float, seed: int, steps: int) -> list[Report]:
    """A report every 500 steps, with a rising success rate."""
    return [
        Report(
            env_steps=at,
            seconds=at / 100,
            timestamp_ms=1_700_000_000_000 + 10 * at + PAUSE * (at > 1000),
            metrics={
                names.EVAL_SUCCESS: round(at / steps * (0.9 - 0.2 * q) + 0.01 * seed, 6),
                names.EVAL_EPISODES: 20.0,
                names.SHANNON_ENTROPY: q,
                names.ENTROPY: float("nan"),
            },
        )
        for at in range(500, steps + 1, 500)
    ]


def opened_sweep(
    folder: Path, stage: dict[str, Any], steps: int = 2000, seeds: int = 3, name: str = "s"
) -> OpenSweep:
    """A sweep with one stage that a driver has started."""
    content = {
        "name": name,
        "tasks": ["FetchPush"],
        "seeds": seeds,
        "defaults": {"env_steps": steps, "evaluation": {"interval": 500, "episodes": 20}},
        "stages": [{"name": "train", "variant": "tac", **stage}],
    }
    config = loaded(folder, content, storage=str(folder / "results"))
    opened = open_sweep(config, make_plan(config), config.storage)
    keep_record(opened)
    return opened


def publish(sweep: OpenSweep, node: Node, history: list[Report]) -> None:
    """Store a run as finished."""
    with TemporaryDirectory() as folder:
        (Path(folder) / HISTORY).write_bytes(to_json_lines(history))
        last = history[-1]
        result = RunResult(
            label=node.label,
            env_steps=last.env_steps,
            seconds=last.seconds,
            metrics=last_values(history),
        )
        sweep.store.publish(node.key, Path(folder), result, provenance=CODE)


def play(
    folder: Path,
    steps: int = 2000,
    seeds: int = 3,
    qs: tuple[float, ...] = (1.0, 2.0),
    *,
    name: str = "s",
    stops_after: int | None = None,
) -> OpenSweep:
    """Run a sweep without training, or only its first runs; the next run has a checkpoint."""
    opened = opened_sweep(folder, {"grid": {"tac.entropic_index": list(qs)}}, steps, seeds, name)
    left = [node for node in opened.plan.nodes if not opened.store.is_finished(node.key)]
    with StateFile(opened) as state_file:
        for number, node in enumerate(left):
            q = float(node.run.tac.entropic_index)  # type: ignore[arg-type]
            history = reports(q, node.run.seed, steps)
            if number == stops_after:
                with opened.store.work_folder(node.key).new_checkpoint(500) as draft:
                    (draft.folder / HISTORY).write_bytes(to_json_lines(history[:1]))
                break
            publish(opened, node, history)
        state_file.end("finished" if stops_after is None else "stopped")
    return opened


class Shown:
    """The output of commands, report and frames for a sweep."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str], name: str = "s") -> None:
        self.place = str(folder / "results" / name)
        capsys.readouterr()
        self.compared, self.status = (
            self._json(capsys, command) for command in ("compare", "status")
        )
        assert main(["best", self.place, "--json"]) == 0
        self.best = json.loads(capsys.readouterr().out)
        self.read = read_sweep(self.place).sweep
        self.frames = load_sweep(self.place)

    def _json(self, capsys: pytest.CaptureFixture[str], command: str) -> Any:
        assert main([command, self.place, "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    def agreed(self) -> dict[str, tuple[int, float]]:
        """Number of runs and mean of each condition, after checking that all outputs agree."""
        (analysis,) = analyse(self.read)
        finals = analysis.scopes[0].finals
        found = {one.condition.label: (one.runs, one.value) for one in finals}
        compared = {row["condition"]: row["seeds"] for row in self.compared["conditions"]}
        assert compared == {label: runs for label, (runs, _) in found.items()}
        rows = self.frames.conditions
        means = zip(rows["condition"], rows["runs"], rows["mean"], strict=True)
        assert {label: (runs, mean) for label, runs, mean in means} == found
        first = max(found, key=lambda label: found[label][1])
        assert f"train {first}" in self.best["why"]
        return found

    def earlier(self) -> str | None:
        """The sentence about runs of earlier plans, after checking that all outputs agree."""
        sentence: str | None = self.read.earlier
        assert self.compared["earlier"] == self.status["earlier"] == sentence
        assert self.frames.earlier == sentence
        said = limitations(self.read, analyse(self.read))
        assert [line for line in said if "earlier version" in line] == [sentence] * bool(sentence)
        return sentence


STEPS, SEEDS, VALUES = {"steps": 4000}, {"seeds": 2}, {"qs": (1.0, 1.5)}
NOT_SHOWN = "of an earlier version of this sweep are not shown (see plan.json)."


@pytest.mark.parametrize(
    ("changes", "earlier"),
    [
        ([{}], None),
        ([{"seeds": 5}], None),
        ([STEPS], f"6 runs {NOT_SHOWN}"),
        ([SEEDS], f"2 runs {NOT_SHOWN}"),
        ([VALUES], f"3 runs {NOT_SHOWN}"),
        (
            [STEPS, STEPS | VALUES],
            f"9 runs {NOT_SHOWN}",
        ),
        ([STEPS, {}], f"6 runs {NOT_SHOWN}"),
    ],
    ids=["twice", "more seeds", "steps", "fewer seeds", "values", "steps and values", "back"],
)
def test_commands_and_report_agree_on_a_changed_sweep(
    changes: list[dict[str, Any]],
    earlier: str | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for change in [{}, *changes]:
        opened = play(tmp_path, **change)
    shown = Shown(tmp_path, capsys)
    assert {run.node_key for run in shown.read.runs} == {node.key for node in opened.plan.nodes}
    qs, seeds = changes[-1].get("qs", (1.0, 2.0)), len(opened.plan.seeds)
    assert {label: runs for label, (runs, _) in shown.agreed().items()} == {
        f"q = {q:g}": seeds for q in qs
    }
    assert shown.earlier() == earlier


def test_a_renamed_sweep_has_its_own_plan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    play(tmp_path)
    play(tmp_path, steps=4000, name="longer")
    short, longer = Shown(tmp_path, capsys), Shown(tmp_path, capsys, "longer")
    assert short.agreed() == longer.agreed()
    assert {run.budget for run in short.read.runs} == {2000}
    assert {run.budget for run in longer.read.runs} == {4000}
    assert (short.earlier(), longer.earlier()) == (None, None)


def test_an_interrupted_sweep_shows_runs_up_to_their_checkpoints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    play(tmp_path)
    opened = play(tmp_path, steps=4000, stops_after=4)
    shown = Shown(tmp_path, capsys)
    assert {label: runs for label, (runs, _) in shown.agreed().items()} == {"q = 1": 3, "q = 2": 1}
    assert shown.earlier() == f"6 runs {NOT_SHOWN}"
    assert [run.status for run in shown.read.runs] == ["FINISHED"] * 4 + ["KILLED", "SCHEDULED"]
    steps, values = shown.read.series(4, names.EVAL_SUCCESS)
    assert (steps.tolist(), values.tolist()) == (
        [500],
        [reports(2, 1, 4000)[0].metrics[names.EVAL_SUCCESS]],
    )
    curves = shown.frames.curves
    assert set(curves[curves.key == opened.plan.nodes[4].key].env_steps) == {0, 500}
    play(tmp_path, steps=4000)
    assert {runs for runs, _ in Shown(tmp_path, capsys).agreed().values()} == {3}


def test_a_running_sweep_has_running_runs(tmp_path: Path) -> None:
    opened = play(tmp_path, stops_after=1)
    with StateFile(opened) as state_file:
        assert [run.status for run in read_sweep(str(opened.folder)).sweep.runs][:3] == [
            "FINISHED",
            "RUNNING",
            "SCHEDULED",
        ]
        state_file.failed(opened.plan.nodes[1], Failure("no <luck>", tmp_path / "log"))
        state_file.end("failed")
    failed = read_sweep(str(opened.folder)).sweep
    assert (failed.status, failed.runs[1].status) == ("FAILED", "FAILED")
    assert failed.runs[1].failure == "no <luck>"


def test_a_changed_search_shows_the_trials_of_its_plan(tmp_path: Path) -> None:
    """A driver that only starts keeps the recorded trials."""

    def begun(low: float) -> OpenSweep:
        search = {"space": {"tac.alpha": {"float": [low, 0.5]}}, "trials": 3}
        return opened_sweep(tmp_path, {"search": search})

    sweep = begun(0.1)
    for number, alpha in enumerate((0.2, 0.3, 0.4)):
        sweep.plan.add_trial("train", number, {"tac.alpha": alpha}, [0, 1, 2], f"trial{number}")
    for node in sweep.plan.nodes:
        publish(sweep, node, reports(1.0, node.run.seed, 2000))
    keep_record(sweep)  # as a driver does for each new trial
    before = read_sweep(str(sweep.folder)).sweep
    assert [run.status for run in before.runs] == ["FINISHED"] * 9
    begun(0.1)
    again = read_sweep(str(sweep.folder)).sweep
    assert ([run.node_key for run in again.runs], again.earlier) == (
        [run.node_key for run in before.runs],
        None,
    )
    begun(0.15)
    changed = read_sweep(str(sweep.folder)).sweep
    assert not changed.runs
    assert changed.earlier == f"9 runs {NOT_SHOWN}"


def test_damaged_runs_raise_or_count_as_unfinished(tmp_path: Path) -> None:
    opened = play(tmp_path)
    bad = opened.plan.nodes[2]
    (Path(opened.store.path(bad.key)) / HISTORY).write_text("no reports")
    place = str(opened.folder)
    with pytest.raises(DamagedError, match="must have"):
        read_sweep(place)
    read = read_sweep(place, lenient=True)
    assert read.damaged is not None
    assert bad.label in read.damaged
    assert [run.status for run in read.sweep.runs].count("FINISHED") == 5
    study = study_of(read.sweep)
    assert [claim.why for claim in study.claims] == ["1 of 6 planned runs is not finished"]
    assert sum(mean.scores.failed for mean in study.means) == 0, "a damaged run is no bad one"
    (row,) = failures_table(read.sweep).rows
    assert row[0] == bad.label
    assert limitations(read.sweep, ()) == []


def test_a_run_is_read_with_its_reports_and_code_versions(tmp_path: Path) -> None:
    opened = play(tmp_path, seeds=1, qs=(1.0,))
    sweep = read_sweep(str(opened.folder)).sweep
    for name in (names.EVAL_SUCCESS, names.ENTROPY):
        wanted = [report.metrics[name] for report in reports(1.0, 0, 2000)]
        steps, values = sweep.series(0, name)
        assert steps.tolist() == [500, 1000, 1500, 2000]
        np.testing.assert_array_equal(values, wanted)
    assert sweep.series(0, names.SETTING_ENTROPIC_INDEX)[0].tolist() == [0]
    run = sweep.runs[0]
    assert run.started == 1_700_000_000_000, "when it began, not when it first reported"
    assert run.seconds == pytest.approx(20.0), "without the pause"
    at, seconds = sweep.seconds_at(0)
    assert dict(zip(at, seconds, strict=True)) == {500: 5, 1000: 10, 1500: 15, 2000: 20}
    assert sweep.column(0, names.EVAL_SUCCESS).time.tolist() == [
        report.timestamp_ms for report in reports(1.0, 0, 2000)
    ]
    assert CODE.items() <= sweep.tags.items()
    assert CODE.items() <= run.tags.items()
    only = read_sweep(str(opened.folder), metrics=[names.EVAL_SUCCESS]).sweep
    assert set(only.history) == {names.EVAL_SUCCESS}


def test_adding_to_an_export_replaces_changed_runs(
    tmp_path: Path,
) -> None:
    """Other seeds are kept; runs with changed settings under the same name are replaced."""
    export = tmp_path / "published"

    def exported(*options: str) -> dict[str, int | None]:
        place = str(tmp_path / "results" / "s")
        assert main(["report", place, "--export", str(export), *options]) == 0
        return {run.name[-5:]: run.budget for run in read_sweep(str(export)).sweep.runs}

    play(tmp_path, seeds=2, qs=(1.0,))
    assert exported() == {"seed0": 2000, "seed1": 2000}
    assert [run.seconds for run in read_sweep(str(export)).sweep.runs] == [20.0, 20.0]
    play(tmp_path, seeds=1, qs=(1.0,), steps=4000)
    assert exported("--add") == {"seed0": 4000, "seed1": 2000}
    assert exported() == {"seed0": 4000}


def test_runs_of_an_earlier_algorithm_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = play(tmp_path, seeds=1)
    for module in ("experiment.plan", "experiment.run_info"):
        monkeypatch.setattr(f"music_rllib.{module}.ALGORITHM_VERSION", "next")
    read = read_sweep(str(opened.folder)).sweep
    assert {run.status for run in read.runs} == {"FINISHED"}
    assert {run.tags[names.TAG_ALGORITHM] for run in read.runs} == {opened.plan.algorithm}
    play(tmp_path, seeds=1)
    retrained = read_sweep(str(opened.folder)).sweep
    assert retrained.earlier == f"2 runs {NOT_SHOWN}"
