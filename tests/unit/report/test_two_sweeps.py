"""A report on two sweeps: differences of settings and of results."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

from music_rllib import names
from music_rllib.report.build import build_report, write_report
from music_rllib.report.page import render
from music_rllib.report.two_sweeps import difference_tables, joined_sweeps
from music_rllib.results.archive import read_archive
from music_rllib.results.statistics import Estimate
from tests.unit.report.test_page import compared

DATA = Path(__file__).parents[3] / "docs" / "results" / "data"


def test_settings_and_results_that_differ_are_in_tables() -> None:
    first = read_archive(DATA / "proof-fetch-reach")
    changed = [replace(run, params={**run.params, "tac.alpha": "0.125"}) for run in first.runs]
    second = replace(first, name="other", runs=changed)
    both = joined_sweeps(first, second)
    assert len(both.runs) == 2 * len(first.runs), "a run of both sweeps counts twice"
    made = build_report(both, both=(first, second))
    assert made.limitations == []
    settings, results = made.differences
    ((_, setting, before, after),) = settings.rows
    assert (setting, after) == ("tac.alpha", "0.125")
    assert before == first.runs[0].params["tac.alpha"]
    ((*_, mean, other, gap),) = results.rows
    assert mean == other
    assert isinstance(gap, Estimate)
    assert float(gap.value) == 0
    page = render(made)
    assert page.count("<h2>Differences</h2>") == 1
    moved = [replace(run, tags={**run.tags, names.TAG_STAGE: "new"}) for run in changed]
    tables = difference_tables(first, replace(second, runs=moved), ())
    stage = first.runs[0].stage
    assert [row[:2] for row in tables[0].rows] == [
        ("new", "the stage itself"),
        (stage, "the stage itself"),
    ]
    same = joined_sweeps(first, first)
    assert {run.stage.partition(":")[0] for run in same.runs} == {
        "proof-fetch-reach (first)",
        "proof-fetch-reach (second)",
    }


def test_conditions_that_differ_in_their_pretraining_are_matched() -> None:
    first = read_archive(DATA / "proof-fetch-reach")
    source, other, *rest = first.runs
    runs = [
        replace(
            run, tags={**run.tags, names.TAG_STAGE: "pre"}, params={**run.params, "music.lr": lr}
        )
        for run, lr in ((source, "0.1"), (other, "0.2"))
    ]
    runs += [
        replace(run, tags={**run.tags, names.TAG_SOURCE_NODE: runs[position % 2].node_key})
        for position, run in enumerate(rest)
    ]
    first = replace(first, runs=runs)
    second = replace(first, name="other")
    _, results = build_report(joined_sweeps(first, second), both=(first, second)).differences
    assert any("pre: music.lr" in str(label) for _, _, label, *_ in results.rows)
    assert all(
        isinstance(value, Estimate) for *_, one, other, _ in results.rows for value in (one, other)
    )


def test_both_sweeps_have_an_answer() -> None:
    first = read_archive(DATA / "proof-fetch-reach")
    second = replace(first, name="a")
    made = build_report(joined_sweeps(first, second), both=(first, second))
    for name in ("proof-fetch-reach", "a"):
        assert sum(line.startswith(f"{name}: ") for line in made.answer) >= 2
    assert "How do proof-fetch-reach and a differ?" in render(made)


def test_both_sweeps_have_comparisons(tmp_path: Path) -> None:
    first = compared({"1": [0.5, 0.6], "1.5": [0.6, 0.8]})
    second = replace(compared({"1": [0.2, 0.3], "2": [0.4, 0.4]}), name="other")
    made = build_report(joined_sweeps(first, second), both=(first, second))
    stages = {d.stage for d in made.drawings if d.title == "Differences"}
    assert stages == {"smoke: finetune", "other: finetune"}
    page = write_report(made, tmp_path).read_text()
    for title in ("smoke", "other"):
        assert f"<h3>{title}: Comparisons by the area under the curve" in page
    rows = csv.DictReader((tmp_path / "tables/comparisons.csv").read_text().splitlines())
    pairs = [(row["sweep"], row["first"]) for row in rows]
    assert pairs == [("smoke", "q = 1.5"), ("other", "q = 2")]


def test_missing_runs_are_reported_with_their_sweep() -> None:
    first = read_archive(DATA / "proof-fetch-reach")
    *runs, last = first.runs
    second = replace(first, name="other", runs=[*runs, replace(last, status="SCHEDULED")])
    (missing,) = build_report(joined_sweeps(first, second), both=(first, second)).limitations
    assert missing.startswith("other: 1 run not begun")
