"""Two sweeps in one report: what was set otherwise, and what came of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from music_rllib import names
from music_rllib.report.build import build_report
from music_rllib.report.page import render
from music_rllib.report.pieces import DASH, Cell
from music_rllib.report.side_by_side import side_by_side
from music_rllib.results.archive import read_archive

DATA = Path(__file__).parents[3] / "docs" / "results" / "data"


def test_the_page_of_two_sweeps_says_what_differs() -> None:
    first = read_archive(DATA / "proof-fetch-reach")
    changed = [replace(run, params={**run.params, "tac.alpha": "0.125"}) for run in first.runs]
    second = replace(first, name="other", runs=changed)
    both = side_by_side(first, second)
    assert len(both.runs) == 2 * len(first.runs), "runs of the same node are two"
    made = build_report(both, beside=(first, second))
    assert made.limitations == []
    settings, results = made.differences
    ((_, setting, before, after),) = settings.rows
    assert (setting, after) == ("tac.alpha", "0.125")
    assert before == first.runs[0].params["tac.alpha"]
    ((*_, mean, other, gap, _),) = results.rows
    assert mean == other
    assert isinstance(gap, Cell)
    assert float(gap.text) == 0
    assert made.together is not None
    (scope,) = made.together.scopes
    assert {final.seeds for final in scope.finals} == {3}
    page = render(made)
    assert page.count("<h2>Differences</h2>") == 1
    same = side_by_side(first, first)
    assert {run.stage.partition(":")[0] for run in same.runs} == {
        "proof-fetch-reach (first)",
        "proof-fetch-reach (second)",
    }


def test_conditions_that_their_pretraining_tells_apart_find_each_other() -> None:
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
    _, results = build_report(side_by_side(first, second), beside=(first, second)).differences
    assert any("pre: music.lr" in str(label) for _, _, label, *_ in results.rows)
    assert all(DASH not in (mean, other) for *_, mean, other, _, _ in results.rows)


def test_what_is_missing_is_said_of_the_sweep_that_lacks_it() -> None:
    first = read_archive(DATA / "proof-fetch-reach")
    second = replace(first, name="other", runs=first.runs[:-1])
    (missing,) = build_report(side_by_side(first, second), beside=(first, second)).limitations
    assert missing.startswith("other: 1 run not begun")
