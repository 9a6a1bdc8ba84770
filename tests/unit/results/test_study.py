"""Studies of sweeps with planted effects, from histories to sentences."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from scipy import stats

from music_rllib import names
from music_rllib.experiment.plan import make_plan
from music_rllib.report.figures.choice import drawings_of_stages, study_drawings
from music_rllib.report.figures.draw import files
from music_rllib.results.analysis import alpha_lines, curve
from music_rllib.results.analysis_plan import (
    AnalysisPlan,
    PlanVersion,
    analysis_plan,
    checked_plans,
    with_plan,
)
from music_rllib.results.analysis_plan import as_document as plans_as_document
from music_rllib.results.answer import answer, claim_in_words, power_in_words
from music_rllib.results.claims import Verdict, contrast, verdict_of
from music_rllib.results.conditions import find_stages
from music_rllib.results.data import LastValues, Points, RunRecord, Sweep, columns
from music_rllib.results.scores import measure_on, scores_of, with_pretraining
from music_rllib.results.statistics import (
    Estimate,
    difference_text,
    interval_text,
    number,
    p_text,
    seeds_needed,
)
from music_rllib.results.study import Study, study_of
from music_rllib.results.tables import study_tables
from music_rllib.sweep.views.results import console_table
from tests import played_sweep
from tests.sweep_files import loaded

BUDGET = 10_000
STEPS = np.arange(1000, BUDGET + 1, 1000)
EPISODES = 50
DONE = 1_000_000
"""Time of every evaluation in ms."""


def plan(*hypotheses: str, margin: float | None = 0.05, **changes: Any) -> AnalysisPlan:
    fields: dict[str, Any] = {
        "question": "Does q matter?",
        "hypotheses": hypotheses,
        "stage": "train",
        "metric": "auc",
        "primary_metric": "",
        "margin": margin,
        "seeds": "",
        "control": "α tuned for each q",
        "budget": {"FetchPush": BUDGET},
        "test": "",
    }
    return AnalysisPlan(**fields | changes)


def run(
    settings: Mapping[str, str],
    seed: int,
    height: float,
    rng: np.random.Generator,
    task: str = "FetchPush",
    **tags: str,
) -> tuple[RunRecord, Points]:
    """A run whose success rate rises linearly to twice its mean `height`."""
    rates = np.clip(2 * height * STEPS / BUDGET, 0, 1)
    values = list(rng.binomial(EPISODES, rates) / EPISODES)
    points = Points(
        [names.EVAL_EPISODES] * len(STEPS) + [names.EVAL_SUCCESS] * len(STEPS),
        [*STEPS, *STEPS],
        [DONE] * 2 * len(STEPS),
        [float(EPISODES)] * len(STEPS) + values,
    )
    stage = tags.pop("stage", "train")
    key = f"{stage}{','.join(settings.values())}{task}{seed}{tags}"
    record = RunRecord(
        run_id=key,
        name="",
        status="FINISHED",
        params={"env_steps": str(BUDGET), "task.success_key": "is_success", **settings},
        tags={
            names.TAG_NODE_KEY: key,
            names.TAG_STAGE: stage,
            names.TAG_TASK: task,
            names.TAG_SEED: str(seed),
            names.TAG_VARIANT: "tac",
            names.TAG_ENTROPIC_INDEX: settings["tac.entropic_index"],
            names.TAG_ALPHA: settings.get("tac.alpha", "0.05"),
            **tags,
        },
    )
    return record, points


def cells(
    rng: np.random.Generator, seeds: int, *cells: tuple[Any, ...], **tags: str
) -> list[tuple[RunRecord, Points]]:
    """A run for each seed of each cell: q, possibly alpha, and the height."""
    runs = []
    for q, *alpha, height in cells:
        settings = {"tac.entropic_index": q} | ({"tac.alpha": alpha[0]} if alpha else {})
        runs += [run(settings, seed, height, rng, **tags) for seed in range(seeds)]
    return runs


def sweep_of(runs: Sequence[tuple[RunRecord, Points]], plans: Sequence[PlanVersion] = ()) -> Sweep:
    records, histories = [record for record, _ in runs], columns(points for _, points in runs)
    return Sweep(name="s", runs=records, history=histories, plans=plans)


def study(
    heights: Mapping[str, float], seeds: int, rng: np.random.Generator, spread: float = 0.03
) -> list[tuple[RunRecord, Points]]:
    """A run for each q and seed; conditions share a part of each seed's success."""
    shared = rng.normal(0, 0.05, seeds)
    return [
        run({"tac.entropic_index": q}, seed, height + shared[seed] + rng.normal(0, spread), rng)
        for q, height in heights.items()
        for seed in range(seeds)
    ]


BEFORE = with_plan((), plan("q = 1.5 against q = 1"), DONE - 1)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_the_difference_is_a_difference_of_areas(rng: np.random.Generator) -> None:
    sweep = sweep_of(study({"1": 0.2, "1.5": 0.4}, 6, rng, spread=0.0), BEFORE)
    (claim,) = study_of(sweep).planned
    first, second = (
        [np.trapezoid([v[0], *v], [0, *STEPS]) / BUDGET for v in values]
        for values in (_values(sweep, "1.5"), _values(sweep, "1"))
    )
    assert float(claim.contrast.difference.value) == pytest.approx(np.mean(first) - np.mean(second))
    assert claim.contrast.paired
    assert claim.measure.words == "mean success over 10,000 steps"


def _values(sweep: Sweep, q: str) -> list[np.ndarray]:
    positions = [i for i, record in enumerate(sweep.runs) if record.entropic_index == q]
    return [sweep.series(position, names.EVAL_SUCCESS)[1] for position in positions]


def test_planned_and_exploratory_comparisons_are_separate(rng: np.random.Generator) -> None:
    runs = study({"1": 0.2, "1.5": 0.4, "2": 0.2}, 8, rng)
    found = study_of(sweep_of(runs, BEFORE))
    assert [one.hypothesis.text for one in found.planned if one.hypothesis] == [
        "q = 1.5 against q = 1"
    ]
    # The planned pair is not repeated, and the others do not change its p-value.
    pairs = {(one.first, one.second) for one in found.unplanned}
    assert pairs == {("q = 2", "q = 1"), ("q = 2", "q = 1.5")}
    alone = study_of(sweep_of(runs[:16], BEFORE))
    assert found.planned[0].p_value == alone.planned[0].p_value
    said = answer(sweep_of(runs, BEFORE), found)
    assert len(said) <= 10
    assert said[0].startswith("Question: Does q matter? (planned 1970-01-01 00:16 UTC, before")
    assert "q = 1.5 against q = 1 on FetchPush: superior, +0." in said[1]
    assert "(95% CI 0." in said[1]
    assert "; collapses in up to 18% of seeds are not excluded" in said[1]
    assert {(one.verdict, one.why, one.p_value) for one in found.unplanned} == {
        (Verdict.NONE, "exploratory: not in the plan", None)
    }
    assert "8 per condition, paired; 24 of 24 runs" in " ".join(said)
    assert "Control: α tuned for each q." in said


def test_without_planned_results_there_is_no_answer(
    rng: np.random.Generator,
) -> None:
    runs = study({"1": 0.2, "1.25": 0.4}, 8, rng)
    sweep = sweep_of(runs, BEFORE)
    found = study_of(sweep)
    assert [(one.first, one.planned) for one in found.unplanned] == [("q = 1.25", False)]
    said = " ".join(answer(sweep, found))
    assert "No planned comparison can be tested yet" in said
    assert "superior" not in said
    assert "Not tested: q = 1.5 against q = 1: no run of q = 1.5 that may be compared" in said


@pytest.mark.parametrize(
    ("alphas", "expected"),
    [
        ({"1": ["0.05"], "2": ["0.1"]}, "α varies with q (0.05, 0.1)"),
        ({"1": ["0.05", "0.1"]}, "α varies (0.05, 0.1)"),
        ({"1": ["0.05", "0.1"], "2": ["0.05", "0.1"]}, "α varies (0.05, 0.1)"),
        ({"1": ["0.05"], "2": ["0.05"]}, "none, one α (0.05) for all: policies of different q"),
    ],
)
def test_without_a_plan_the_control_is_read_from_the_runs(
    alphas: Mapping[str, Sequence[str]], expected: str, rng: np.random.Generator
) -> None:
    runs = cells(rng, 5, *((q, one, 0.3) for q, values in alphas.items() for one in values))
    sweep = sweep_of(runs)
    assert f"Control: {expected}" in " ".join(answer(sweep, study_of(sweep)))


def test_a_plan_recorded_after_a_result_does_not_count(rng: np.random.Generator) -> None:
    runs = study({"1": 0.2, "1.5": 0.4}, 8, rng)
    late = with_plan((), plan("q = 1.5 better than q = 1"), DONE)
    found = study_of(sweep_of(runs, late))
    assert (found.plan, found.planned) == (None, ())
    (claim,) = found.unplanned
    assert claim.confirmed is True
    assert "after the first run had finished: not planned" in answer(sweep_of(runs, late), found)[0]
    # Unfinished runs have no result.
    begun = [(replace(record, status="RUNNING"), points) for record, points in runs]
    assert study_of(sweep_of(begun, late)).plan is not None


def test_a_hypothesis_about_finished_runs_is_not_planned_but_the_others_are(
    rng: np.random.Generator,
) -> None:
    """A plan may compare new runs with those of an earlier study."""
    known = study({"1": 0.2}, 8, rng)
    new = cells(rng, 8, ("1", 0.3), ("1.5", 0.4), stage="finetune")
    times = [DONE + 5] * len(new[0][1].times)
    later = [(record, points._replace(times=times)) for record, points in new]
    between_q, between_stages = (
        "q = 1.5 better than q = 1",
        "stage = finetune, q = 1 better than stage = train, q = 1",
    )
    plans = with_plan((), plan(between_q, between_stages, stage="finetune"), DONE + 1)
    sweep = sweep_of([*known, *later], plans)
    found = study_of(sweep)
    assert [(one.hypothesis.text, one.verdict) for one in found.planned if one.hypothesis] == [
        (between_q, Verdict.SUPERIOR)
    ]
    alone = study_of(sweep_of(later, with_plan((), plan(between_q, stage="finetune"), DONE + 1)))
    assert found.planned[0].p_value == alone.planned[0].p_value
    (other,) = found.unplanned
    assert other.hypothesis is not None
    assert (other.hypothesis.text, other.verdict, other.why) == (
        between_stages,
        Verdict.NONE,
        "exploratory: runs of it had finished before the plan",
    )
    said = answer(sweep, found)[0]
    assert "before its first run finished" in said
    assert "not planned, because runs of it had finished: stage = finetune, q = 1 better" in said


def test_a_plan_that_changes_after_a_result_keeps_its_planned_claims(
    rng: np.random.Generator,
) -> None:
    runs = study({"1": 0.2, "1.5": 0.4}, 8, rng)
    first = with_plan((), plan("q = 1.5 worse than q = 1"), 5)
    both = with_plan(first, plan("q = 1.5 better than q = 1", margin=0.3), DONE + 1)
    found = study_of(sweep_of(runs, both))
    assert [(one.margin, one.confirmed) for one in found.planned] == [(0.05, False)]
    assert [(one.margin, one.confirmed) for one in found.unplanned] == [(0.3, None)]
    assert found.unplanned[0].verdict is Verdict.NONE
    assert "changed afterwards: hypotheses, margin)" in answer(sweep_of(runs, both), found)[0]


def test_a_hypothesis_is_planned_by_the_last_version_before_its_result(
    rng: np.random.Generator,
) -> None:
    """A stage and a hypothesis about it are added when an earlier stage has finished."""
    train = study({"1": 0.2, "1.5": 0.4}, 8, rng)
    tune = cells(rng, 8, ("1", 0.2), ("1.5", 0.4), stage="tune")
    later = [
        (record, points._replace(times=[DONE + 5] * len(points.times))) for record, points in tune
    ]
    old, new = "q = 1.5 against q = 1", "stage = tune, q = 1.5 against stage = tune, q = 1"
    first = with_plan((), plan(old), DONE - 1)

    def planned(*hypotheses: str, **changes: Any) -> tuple[list[str], str]:
        versions = with_plan(first, plan(*hypotheses, **changes), DONE + 1)
        sweep = sweep_of([*train, *later], versions)
        found = study_of(sweep)
        texts = [one.hypothesis.text for one in found.planned if one.hypothesis]
        assert all(one.verdict is Verdict.SUPERIOR for one in found.planned)
        return texts, answer(sweep, found)[0]

    texts, said = planned(old, new)
    assert texts == [old, new]
    assert "before the first run of each new hypothesis finished; version 2" in said
    assert "1 already in version 1" in said
    # A hypothesis about the finished stage, or another test of it, comes too late.
    texts, said = planned(old, new, "q = 1.5 better than q = 1")
    assert (texts, "q = 1.5 better than q = 1" in said) == ([old, new], True)
    texts, said = planned(old, new, margin=0.1)
    assert (texts, said[-28:]) == ([old, new], "changed afterwards: margin).")
    texts, said = planned(old, new, seeds="0, 1")
    assert (texts, said[-27:]) == ([old, new], "changed afterwards: seeds).")
    assert "changed" not in planned(old, new, seeds="train: ; tune: 0, 1")[1]
    # A hypothesis that is left out after its result is still tested.
    texts, said = planned(new)
    assert texts == [old, new]
    assert f"dropped after results: {old}" in said
    assert "dropped" not in planned(old, new)[1]


def test_a_plan_grows_by_a_stage_that_becomes_the_default(rng: np.random.Generator) -> None:
    """Without `analysis.stage` a hypothesis is about the last stage."""
    train = study({"1": 0.2, "1.5": 0.4}, 8, rng)
    of_train = "stage = train, q = 1.5 against stage = train, q = 1"
    of_tune = "q = 1.5 against q = 1"
    first = with_plan((), plan(of_tune), DONE - 1)
    both = with_plan(first, plan(of_tune, stage="tune", seeds="train: 0, 1; tune: 8"), DONE + 1)
    found = study_of(sweep_of(train, both))
    (claim,) = found.planned
    # The label has the stage, because the last version means another one.
    assert (claim.verdict, found.dropped) == (
        Verdict.SUPERIOR,
        ("stage = train, tac.entropic_index = 1.5 against stage = train, tac.entropic_index = 1",),
    )
    assert (claim.first, found.family) == ("stage = train, q = 1.5", 2)
    # Also if both name their stages, and if nothing of the new stage has a result.
    first = with_plan((), plan(of_train), DONE - 1)
    grown = with_plan(first, plan(of_train, of_tune, stage="tune"), DONE + 1)
    waiting = replace(train[0][0], status="SCHEDULED")
    waiting = replace(waiting, tags={**waiting.tags, names.TAG_STAGE: "tune"})
    for runs in (train, [*train, (waiting, Points())]):
        sweep = sweep_of(runs, grown)
        found = study_of(sweep)
        assert [one.verdict for one in found.planned] == [Verdict.SUPERIOR]
        assert (found.family, found.late, found.dropped) == (2, (), ())
        assert "superior" in answer(sweep, found)[1]


def test_a_late_hypothesis_does_not_make_others_of_its_version_late(
    rng: np.random.Generator,
) -> None:
    train = study({"1": 0.2, "1.5": 0.4}, 8, rng)
    old, late = "q = 1.5 against q = 1", "q = 1.5 better than q = 1"
    new = "stage = tune, q = 1.5 against stage = tune, q = 1"
    versions = with_plan((), plan(old), DONE - 1)
    versions = with_plan(versions, plan(late, new), DONE + 1)
    tune = cells(rng, 8, ("1", 0.2), ("1.5", 0.4), stage="tune")
    tune = [(one, points._replace(times=[DONE + 5] * len(points.times))) for one, points in tune]
    found = study_of(sweep_of([*train, *tune], versions))
    assert [one.hypothesis.text for one in found.planned if one.hypothesis] == [old, new]
    assert (found.late, found.dropped) == ((late,), (old,))


def test_settings_that_a_hypothesis_does_not_name_are_averaged(rng: np.random.Generator) -> None:
    q_1 = ("1", "0.01", 0.1), ("1", "0.1", 0.3), ("1", "1", 0.9)
    runs = cells(rng, 5, *q_1, ("1.5", "0.01", 0.2), ("1.5", "0.1", 0.4))
    (claim,) = study_of(sweep_of(runs, BEFORE)).planned
    assert (len(claim.pairs), claim.contrast.seeds) == (2, (5, 5))
    assert "on FetchPush, averaged over the 2 settings that both have: " in claim_in_words(claim)
    assert float(claim.contrast.difference.value) == pytest.approx(0.1, abs=0.03)
    one = with_plan((), plan("q = 1.5, alpha = 0.1 against q = 1, alpha = 0.01"), 5)
    (claim,) = study_of(sweep_of(runs, one)).planned
    assert (len(claim.pairs), claim.first) == (1, "q = 1.5, α = 0.1")
    assert float(claim.contrast.difference.value) == pytest.approx(0.3, abs=0.03)
    vague = with_plan((), plan("q = 1.5, alpha = 0.1 against q = 1"), 5)
    assert "must name more settings" in study_of(sweep_of(runs, vague)).untested[0]


def test_sensitivity_to_alpha_has_a_line_for_each_q(rng: np.random.Generator) -> None:
    alphas = (("0.1", 0.3), ("0.01", 0.1), ("0.02", 0.2))
    runs = cells(rng, 4, *((q, *alpha) for q in ("1", "1.5") for alpha in alphas))
    found = study_of(sweep_of(runs))
    lines = alpha_lines(found.means)
    assert [[alpha for alpha, _ in line] for line in lines] == [[0.01, 0.02, 0.1]] * 2
    assert [{mean.condition.entropic_index for _, mean in line} for line in lines] == [
        {"1"},
        {"1.5"},
    ]
    values = [float(mean.estimate.value) for _, mean in lines[0]]
    np.testing.assert_allclose(values, [0.1, 0.2, 0.3], atol=0.04)
    differences, profile, area = study_drawings(found)
    assert [len(drawing.subplots) for drawing in (differences, profile, area)] == [1, 1, 1]
    assert [label for label, _ in area.legend] == ["q = 1", "q = 1.5"]
    assert files(area.subplots, area.legend)
    comparisons, means = study_tables(found)
    assert (len(comparisons.rows), len(means.rows)) == (15, 6)


def test_many_conditions_are_compared_with_q_1_at_equal_settings(rng: np.random.Generator) -> None:
    grid = itertools.product(("1", "1.5", "2", "3"), ("0.01", "0.1"), (0.2,))
    runs = cells(rng, 2, *grid)
    pairs = [(one.first, one.second) for one in study_of(sweep_of(runs)).unplanned]
    assert ("q = 2, α = 0.1", "q = 1, α = 0.1") in pairs
    assert len(pairs) == 6


def test_many_conditions_without_equal_settings_are_compared_with_the_first(
    rng: np.random.Generator,
) -> None:
    runs = cells(rng, 2, ("1", "0.05", 0.2), *((f"{q}", f"0.{q}", 0.2) for q in range(2, 8)))
    found = study_of(sweep_of(runs)).unplanned
    assert len(found) == 6
    (reference,) = {claim.second for claim in found}
    assert reference == "q = 1, α = 0.05"


def own_alphas(rng: np.random.Generator) -> list[tuple[RunRecord, Points]]:
    return cells(rng, 6, ("1", "0.15", 0.3), ("1.5", "0.05", 0.33), ("2", "0.05", 0.3))


def test_tables_fit_a_console_of_80_columns(rng: np.random.Generator) -> None:
    for table in study_tables(study_of(sweep_of(own_alphas(rng), BEFORE))):
        console = Console(width=80, file=io.StringIO(), record=True)
        console.print(console_table(table))
        printed = console.export_text()
        words = {word for row in table.cells for cell in row for word in cell.text.split()}
        assert all(word in printed for word in words)


def test_a_planned_comparison_is_not_repeated_under_another_label(
    rng: np.random.Generator,
) -> None:
    sweep = sweep_of(own_alphas(rng), BEFORE)
    found = study_of(sweep)
    assert [claim.first for claim in found.planned] == ["q = 1.5"]
    assert [(claim.first, claim.second) for claim in found.unplanned] == [
        ("q = 2, α = 0.05", "q = 1, α = 0.15"),
        ("q = 2, α = 0.05", "q = 1.5, α = 0.05"),
    ]
    # Another metric is another comparison; the plan has no margin for it.
    other = study_of(sweep, metric=names.EVAL_EPISODES)
    assert len(other.unplanned) == 3
    assert {claim.margin for claim in other.unplanned} == {None}


def test_a_plan_with_metric_final_compares_final_values(rng: np.random.Generator) -> None:
    final = with_plan((), plan("q = 1.5 against q = 1", metric="final"), DONE - 1)
    found = study_of(sweep_of(own_alphas(rng), final))
    claims = (*found.planned, *found.unplanned)
    assert {claim.measure.words for claim in claims} == {"final success"}
    assert {mean.measure.kind for mean in found.means} == {"final"}
    comparisons, means = study_tables(found)
    assert comparisons.title == "Comparisons by the final value"
    assert means.title == "Final value of each condition"


def test_a_condition_without_results_counts_in_the_family(rng: np.random.Generator) -> None:
    hypotheses = ("q = 1.5 against q = 1", "q = 2 against q = 1")
    two = with_plan((), plan(*hypotheses), DONE - 1)
    runs = own_alphas(rng)
    runs[12:] = [(replace(record, status="KILLED"), points) for record, points in runs[12:]]
    sweep = sweep_of(runs, two)
    found = study_of(sweep)
    assert "12 of 18 runs finished" in " ".join(answer(sweep, found))
    assert "q = 2 against q = 1: no seed has finished in both" in found.untested[0]
    assert found.planned[0].p_value == pytest.approx(2 * float(found.planned[0].contrast.p_value))


def test_verdicts_do_not_change_when_another_task_or_comparison_finishes(
    rng: np.random.Generator,
) -> None:
    """What is planned and has no result, or an interim one, counts with p = 1."""
    tasks = ("FetchPush", "FetchSlide")
    runs = {
        (task, q): cells(rng, 8, (q, h), task=task)
        for task in tasks
        for q, h in (("1", 0.3), ("1.5", 0.33), ("2", 0.5))
    }
    both = plan(
        "q = 1.5 against q = 1",
        "q = 2 against q = 1",
        budget=dict.fromkeys(tasks, BUDGET),
        seeds=", ".join(map(str, range(8))),
    )
    plans = with_plan((), both, DONE - 1)

    def found_with(*parts: tuple[str, str], waiting: str | None = None) -> Study:
        chosen = [one for part in parts for one in runs[part]]
        if waiting:
            some = run({"tac.entropic_index": "1"}, 0, 0.3, rng, task=waiting)[0]
            chosen.append((replace(some, status="SCHEDULED"), Points()))
        return study_of(sweep_of(chosen, plans))

    push = found_with(("FetchPush", "1"), ("FetchPush", "1.5"))
    for found in (push, found_with(("FetchPush", "1"), ("FetchPush", "1.5"), waiting=tasks[1])):
        (claim,) = found.planned
        assert found.family == 6
        assert claim.p_value == pytest.approx(min(1, 6 * float(claim.contrast.p_value)))
        assert "q = 1.5 against q = 1 on FetchSlide: no seed" in found.untested[0]
    # Two seeds of q = 2 with a clear difference are not a result yet.
    chosen = [*runs[tasks[0], "1"], *runs[tasks[0], "1.5"], *runs[tasks[0], "2"][:3]]
    interim = study_of(sweep_of(chosen, plans)).planned
    assert interim[0].p_value == push.planned[0].p_value
    assert (interim[1].p_value, interim[1].verdict) == (1.0, Verdict.NONE)
    # Without a plan, too.
    alone = study_of(sweep_of([*runs[tasks[0], "1"], *runs[tasks[0], "1.5"]]))
    assert alone.family == 1
    of_slide = [(replace(one, status="SCHEDULED"), Points()) for one, _ in runs[tasks[1], "1"]]
    more = study_of(sweep_of([*runs[tasks[0], "1"], *runs[tasks[0], "1.5"], *of_slide]))
    assert (more.family, len(more.unplanned)) == (3, 1)


def test_the_family_is_that_of_the_compared_metric(rng: np.random.Generator) -> None:
    """Rates are also compared over all tasks, and returns are not."""
    runs = []
    for task in ("FetchPush", "FetchSlide"):
        for record, points in study({"1": 0.2, "1.5": 0.4}, 8, rng):
            tags = {**record.tags, names.TAG_TASK: task, names.TAG_NODE_KEY: record.run_id + task}
            params = {**record.params, "task.success_key": "None"}
            both = Points(
                [*points.metrics, *[names.EVAL_RETURN] * len(points.metrics)],
                [*points.steps, *points.steps],
                [*points.times, *points.times],
                [*points.values, *(value - 10 for value in points.values)],
            )
            runs.append((replace(record, tags=tags, params=params), both))
    sweep = sweep_of(runs)
    for metric, family in ((None, 2), (names.EVAL_SUCCESS, 3)):
        found = study_of(sweep, metric=metric)
        assert (found.family, len(found.claims)) == (family, family)
        for claim in found.claims:
            assert claim.p_value is not None
            assert claim.p_value >= float(claim.contrast.p_value)


def test_a_hypothesis_is_about_the_tasks_of_both_stages(rng: np.random.Generator) -> None:
    runs = [
        *cells(rng, 6, ("1", 0.2), stage="her", task="FetchPush"),
        *cells(rng, 6, ("1", 0.2), stage="her", task="FetchSlide"),
        *cells(rng, 6, ("1", 0.4), stage="music", task="FetchPush"),
    ]
    budget = {"FetchPush": BUDGET, "FetchSlide": BUDGET}
    text = "stage = music against stage = her"
    versions = with_plan((), plan(text, stage="her", budget=budget), 5)
    found = study_of(sweep_of(runs, versions))
    assert (found.family, found.untested) == (1, ())
    # Over two common tasks, there is a comparison over both.
    more = [
        *cells(rng, 6, ("1", 0.4), stage="music", task="FetchSlide"),
        *cells(rng, 6, ("1", 0.2), stage="her", task="FetchPickAndPlace"),
    ]
    budget["FetchPickAndPlace"] = BUDGET
    versions = with_plan((), plan(text, stage="her", budget=budget), 5)
    found = study_of(sweep_of([*runs, *more], versions))
    assert (found.family, len(found.planned), found.untested) == (3, 3, ())


def test_the_answer_counts_runs_of_all_planned_stages(rng: np.random.Generator) -> None:
    """The displayed stage need not be the compared one."""
    train = study({"1": 0.3, "1.5": 0.3}, 8, rng)
    train[0] = (replace(train[0][0], status="FAILED"), train[0][1])
    tune = cells(rng, 8, ("1", 0.0), ("1.5", 0.0), stage="tune")
    text = "stage = train, q = 1.5 against stage = train, q = 1"
    sweep = sweep_of([*train, *tune], with_plan((), plan(text, stage="tune"), 5))
    said = " ".join(answer(sweep, study_of(sweep)))
    assert "31 of 32 runs finished. 1 failed run counts with the worst value" in said
    assert "80% power" in said
    assert "of a bound" not in said


@pytest.mark.parametrize(
    "p_value, text", [(0.0499, "p = 0.0499"), (0.0501, "p = 0.0501"), (0.05, "p = 0.05")]
)
def test_a_p_value_is_on_its_side_of_the_decision(p_value: float, text: str) -> None:
    assert p_text(p_value) == text


def test_small_differences_have_the_decimals_of_their_interval() -> None:
    estimate = Estimate(value=np.array(0.0042), lower=np.array(0.0011), upper=np.array(0.0073))
    assert (difference_text(estimate), interval_text(estimate)) == ("+0.004", "0.001 to 0.007")
    wide = Estimate(value=np.array(-1523.4), lower=np.array(-2000.0), upper=np.array(-9.5))
    assert (difference_text(wide), interval_text(wide)) == ("-1,523", "-2,000 to -10")


def test_stages_with_and_without_a_search_are_compared_side_by_side(
    rng: np.random.Generator,
) -> None:
    her = cells(rng, 6, ("1", 0.2), stage="her")
    searched = [
        *cells(rng, 2, ("1", "0.1", 0.4), stage="tune", part="trial0"),
        *cells(rng, 6, ("1", "0.2", 0.4), stage="tune", part="final0"),
    ]
    text = "stage = tune better than stage = her"
    sweep = sweep_of([*her, *searched], with_plan((), plan(text, stage="tune"), 5))
    found = study_of(sweep)
    assert [dict(mean.condition.others)["stage"] for mean in found.means] == ["her", "tune"]
    # The figure of all stages shows the same runs.
    (drawing, *_) = drawings_of_stages(sweep, find_stages(sweep))
    assert len(drawing.legend) == 2


def test_runs_that_all_failed_have_no_result(rng: np.random.Generator) -> None:
    runs = study({"1": 0.3, "1.5": 0.3}, 8, rng)
    sweep = sweep_of([(replace(one, status="FAILED"), points) for one, points in runs], BEFORE)
    assert answer(sweep, study_of(sweep))[1:] == ["No run has a result: 16 failed or diverged."]


def test_returns_that_all_diverged_are_named() -> None:
    record, _ = run({"tac.entropic_index": "1"}, 0, 0.3, np.random.default_rng(0))
    record = replace(record, params={**record.params, "task.success_key": "None"})
    points = Points([names.EVAL_RETURN] * 2, [0, BUDGET], [DONE] * 2, [-10.0, np.nan])
    sweep = sweep_of([(record, points)])
    assert answer(sweep, study_of(sweep))[1:] == ["No run has a result: 1 failed or diverged."]


def test_failed_runs_have_the_worst_score_and_unfinished_ones_block_a_verdict(
    rng: np.random.Generator,
) -> None:
    runs = study({"1": 0.3, "1.5": 0.3}, 12, rng)

    def with_status(status: str) -> tuple[Sweep, Study]:
        ended = [
            (
                replace(record, status=status)
                if record.entropic_index == "1.5" and i % 12 < 3
                else record,
                points,
            )
            for i, (record, points) in enumerate(runs)
        ]
        sweep = sweep_of(ended, BEFORE)
        return sweep, study_of(sweep)

    sweep, found = with_status("FAILED")
    (claim,) = found.planned
    assert [mean.scores.failed for mean in found.means] == [0, 3]
    assert claim.contrast.seeds == (12, 12)
    assert claim.verdict is not Verdict.EQUIVALENT
    (worse,) = (mean for mean in found.means if mean.condition.entropic_index == "1.5")
    assert sorted(worse.scores.by_seed.values())[:3] == [0.0] * 3
    assert worse.scores.finished == 9
    assert "3 failed runs count with the worst value" in " ".join(answer(sweep, found))
    _, found = with_status("RUNNING")
    assert found.planned[0].why == "3 of 24 planned runs are not finished"
    # A planned seed that has not started counts as unfinished.
    more = with_plan((), plan("q = 1.5 against q = 1", seeds=", ".join(map(str, range(13)))), 5)
    (claim,) = study_of(sweep_of(runs, more)).planned
    assert claim.why == "2 of 26 planned runs are not finished"


@pytest.mark.parametrize("reward_range, worst", [("[-1.0, 0.0]", -50.0), ("None", -20.0)])
def test_a_failed_run_has_the_smallest_return_or_the_worst_observed(
    reward_range: str, worst: float
) -> None:
    runs = []
    for seed in range(6):
        record, points = run({"tac.entropic_index": "1"}, seed, 0.3, np.random.default_rng(0))
        params = {
            "task.success_key": "None",
            "task.reward_range": reward_range,
            "task.horizon": "50",
        }
        points = Points([names.EVAL_RETURN] * 2, [0, BUDGET], [DONE] * 2, [-10.0 - 2 * seed] * 2)
        runs.append((replace(record, params={**record.params, **params}), points))
    # One run diverged to NaN.
    diverged = Points([names.EVAL_RETURN] * 2, [0, BUDGET], [DONE] * 2, [-10.0, np.nan])
    sweep = sweep_of(
        [*runs, (replace(runs[0][0], tags={**runs[0][0].tags, names.TAG_SEED: "9"}), diverged)]
    )
    found = study_of(sweep)
    (mean,) = found.means
    assert mean.scores.by_seed["9"] == worst
    assert len(mean.scores.by_seed) == 7
    said = " ".join(answer(sweep, found))
    assert "7 of 7 runs finished. 1 failed or diverged run counts with the worst value" in said


def test_a_failed_run_has_one_score_in_a_report() -> None:
    """Without a range of rewards, it is the worst of the stage, also in a comparison of two q."""
    runs = []
    for q, level in (("1", -10.0), ("1.5", -9.0), ("2", -90.0)):
        for seed in range(5):
            record, _ = run({"tac.entropic_index": q}, seed, 0.3, np.random.default_rng(0))
            params = {**record.params, "task.success_key": "None"}
            status = "FAILED" if (q, seed) == ("1.5", 0) else "FINISHED"
            points = Points([names.EVAL_RETURN] * 2, [0, BUDGET], [DONE] * 2, [level] * 2)
            runs.append((replace(record, params=params, status=status), points))
    found = study_of(sweep_of(runs, BEFORE))
    means = {mean.condition.entropic_index: float(mean.estimate.value) for mean in found.means}
    assert means["1.5"] == pytest.approx((-90 - 4 * 9) / 5)
    (claim,) = found.planned
    assert float(claim.contrast.difference.value) == pytest.approx(means["1.5"] - means["1"])


def test_three_seeds_have_an_interval_but_no_verdict(
    rng: np.random.Generator,
) -> None:
    sweep = sweep_of(study({"1": 0.1, "1.5": 0.4}, 3, rng), BEFORE)
    found = study_of(sweep)
    said = answer(sweep, found)[1]
    assert found.planned[0].verdict is Verdict.NONE
    assert "on FetchPush: 3 seeds: no verdict below 5, +0." in said
    assert "95% CI" in said
    assert "p =" not in said


def test_equivalence_shows_the_90_percent_interval_and_tost_p(rng: np.random.Generator) -> None:
    sweep = sweep_of(study({"1": 0.3, "1.5": 0.3}, 40, rng, spread=0.01), BEFORE)
    found = study_of(sweep)
    said = answer(sweep, found)[1]
    assert "equivalent within 0.05" in said
    assert "90% CI" in said
    assert "TOST p < 0.001" in said
    assert "exclude" not in said, "40 seeds would have shown them"


def test_conditions_at_a_bound_do_not_count_for_seeds_needed(
    rng: np.random.Generator,
) -> None:
    runs = cells(rng, 4, ("1", "0.15", 0.3), ("1.5", "0.05", 0.0))
    found = study_of(sweep_of(runs, BEFORE))
    assert len(found.planned) == 1
    assert power_in_words(found.planned, found.means, 1) is None


def test_stages_and_task_means_at_a_bound_do_not_count_either(rng: np.random.Generator) -> None:
    def seeds_needed(tasks: Sequence[str], hypothesis: str, stages: Mapping[str, float]) -> Any:
        runs = [
            run({"tac.entropic_index": q}, seed, height, rng, stage=stage, task=task)
            for stage, height in stages.items()
            for q in ("1", "1.5")
            for task in tasks
            for seed in range(5)
        ]
        versions = with_plan((), plan(hypothesis, stage=next(iter(stages))), 5)
        found = study_of(sweep_of(runs, versions))
        (claim, *_) = found.planned
        return power_in_words([claim], found.means, 1)

    between = "stage = a, q = 1 against stage = b, q = 1"
    assert seeds_needed(["FetchPush"], between, {"a": 0.3, "b": 0.3}) is not None
    between_q = "q = 1.5 against q = 1"
    both = ["FetchPush", "FetchSlide"]
    assert "spread does not show" in seeds_needed(both, between_q, {"a": 0.0})
    first, second = (cells(rng, 5, ("1", h), stage=s) for s, h in (("a", 0.3), ("b", 0.0)))
    versions = with_plan((), plan("stage = a against stage = b", stage="a"), 5)
    found = study_of(sweep_of([*first, *second], versions))
    assert len(found.planned) == 1
    assert power_in_words(found.planned, found.means, 1) is None


def test_only_fresh_seeds_of_a_search_are_compared(
    rng: np.random.Generator,
) -> None:
    grid = itertools.product(("1", "1.5"), ("0.01", "0.1"), (0.45,))
    searched = cells(rng, 2, *grid, part="trial0")
    fresh = [
        run({"tac.entropic_index": q, "tac.alpha": a}, 10**6 + seed, height, rng, part="final0")
        for q, a, height in (("1", "0.01", 0.2), ("1.5", "0.1", 0.4))
        for seed in range(6)
    ]
    sweep = sweep_of([*searched, *fresh], BEFORE)
    found = study_of(sweep)
    (claim,) = found.planned
    assert claim.verdict is Verdict.SUPERIOR
    assert claim.contrast.seeds == (6, 6)
    assert "paired, not used for selection" in " ".join(answer(sweep, found))


def test_a_hypothesis_can_compare_stages(rng: np.random.Generator) -> None:
    her, music = (cells(rng, 5, ("1", h), stage=s) for s, h in (("her", 0.2), ("music", 0.4)))
    one = with_plan((), plan("stage = music better than stage = her", stage="music"), 5)
    study = study_of(sweep_of([*her, *music], one))
    (claim,) = study.planned
    assert claim.confirmed is True
    assert [mean.condition.label for mean in study.means] == [
        "q = 1, stage = her",
        "q = 1, stage = music",
    ]
    assert study.unplanned == ()


@pytest.mark.parametrize(
    ("hypothesis", "setting", "values"),
    [
        ("{} = true against {} = false", "tac.normalise_observations", ("True", "False")),
        ("{} = [-50, 0] against {} = null", "tac.target_bounds", ("[-50.0, 0.0]", "None")),
        ("{} = 1e-3 against {} = .002", "tac.lr", ("0.001", "0.002")),
    ],
)
def test_values_of_hypotheses_match_params_in_any_spelling(
    hypothesis: str, setting: str, values: Sequence[str], rng: np.random.Generator
) -> None:
    runs = [
        run({"tac.entropic_index": "1.0", setting: value}, seed, 0.3, rng)
        for value in values
        for seed in range(3)
    ]
    one = with_plan((), plan(hypothesis.format(setting, setting)), 5)
    found = study_of(sweep_of(runs, one))
    assert (found.untested, len(found.planned)) == ((), 1)


def test_pairs_are_compared_only_if_all_seeds_are_shared(rng: np.random.Generator) -> None:
    runs = study({"1": 0.2, "1.5": 0.4}, 8, rng)
    assert study_of(sweep_of(runs, BEFORE)).planned[0].contrast.paired
    del runs[3]
    (claim,) = study_of(sweep_of(runs, BEFORE)).planned
    assert (claim.contrast.paired, claim.contrast.seeds) == (False, (8, 7))


def test_runs_are_compared_over_the_planned_or_smallest_budget(
    rng: np.random.Generator,
) -> None:
    runs = study({"1": 0.3, "1.5": 0.3}, 3, rng)
    planned = with_plan((), plan("q = 1.5 against q = 1", budget={"FetchPush": 4000}), DONE - 1)
    assert study_of(sweep_of(runs, planned)).planned[0].measure.horizon == 4000
    short = [
        (replace(record, params={**record.params, "env_steps": "5000"}), points)
        if record.entropic_index == "1"
        else (record, points)
        for record, points in runs
    ]
    (claim,) = study_of(sweep_of(short)).unplanned
    assert claim.measure.horizon == 5000
    found = study_of(sweep_of(short, BEFORE))
    assert (found.planned, len(found.untested)) == ((), 1)


def test_seeds_needed_are_unknown_at_a_bound(rng: np.random.Generator) -> None:
    def at(height: float) -> str:
        found = study_of(sweep_of(study({"1": height, "1.5": height}, 4, rng)))
        return power_in_words(found.claims, found.means, 1) or ""

    assert "spread does not show" in at(0.0)
    assert "for 80% power" in at(0.3)


# The plan -----------------------------------------------------------------------------------------


def test_each_change_of_a_plan_is_a_version() -> None:
    one, other = plan("q = 2 against q = 1"), plan("q = 2 worse than q = 1")
    versions = with_plan(with_plan(with_plan((), one, 5), one, 6), other, 7)
    assert [(v.version, v.recorded_ms, v.plan) for v in versions] == [(1, 5, one), (2, 7, other)]
    assert checked_plans(plans_as_document(versions)) == versions
    assert one.hash != other.hash


def test_an_edited_plan_is_refused() -> None:
    document = plans_as_document(with_plan((), plan("q = 2 against q = 1"), 5))
    document[0]["plan"]["margin"] = 0.2
    with pytest.raises(ValueError, match="the hash that it was recorded with"):
        checked_plans(document)


def test_a_margin_of_success_is_not_named_beside_a_return(rng: np.random.Generator) -> None:
    def of_task(task: str, key: str, metric: str) -> list[tuple[RunRecord, Points]]:
        settings = [{"tac.entropic_index": q, "task.success_key": key} for q in ("1", "1.5")]
        made = [run(own, seed, 0.3, rng, task) for own in settings for seed in range(6)]
        swapped = {names.EVAL_SUCCESS: metric}
        return [
            (record, points._replace(metrics=[swapped.get(one, one) for one in points.metrics]))
            for record, points in made
        ]

    runs = of_task("Reacher", "None", names.EVAL_RETURN)
    runs += of_task("FetchPush", "is_success", names.EVAL_SUCCESS)
    sweep = sweep_of(runs)
    said = " ".join(answer(sweep, study_of(sweep)))
    assert "Metric: mean return" in said
    assert "margin" not in said
    assert "standard deviation" not in said


def test_auc_total_counts_the_steps_of_pretraining(rng: np.random.Generator) -> None:
    """Two runs from scratch and from pretraining with equal curves of their own."""
    runs, q = [], {"tac.entropic_index": "1"}
    for seed in range(5):
        source = {names.TAG_NODE_KEY: f"u{seed}"}
        runs += [
            run(q, seed, 0.1, rng, stage="pretrain", **source),
            run(q, seed, 0.4, rng, stage="music-r", **{names.TAG_SOURCE_NODE: f"u{seed}"}),
        ]
        record, points = run(q, seed, 0.4, rng, stage="her")
        longer = {**record.params, "env_steps": str(2 * BUDGET)}
        steps = [2 * step for step in points.steps]
        runs.append((replace(record, params=longer), points._replace(steps=steps)))
    text = "stage = music-r against stage = her"
    claims = {}
    for metric, total in (("auc", BUDGET), ("auc_total", 2 * BUDGET)):
        planned = plan(text, metric=metric, stage="music-r", budget={"FetchPush": total})
        (claims[metric],) = study_of(sweep_of(runs, with_plan((), planned, 5))).planned
    # Over 10,000 steps of each: a mean of 0.4 against the first half of the slower rise.
    assert float(claims["auc"].contrast.difference.value) == pytest.approx(0.2, abs=0.03)
    # Over 20,000: the mean of 0.1 and 0.4 against 0.4.
    whole = claims["auc_total"]
    assert float(whole.contrast.difference.value) == pytest.approx(-0.15, abs=0.03)
    assert whole.measure.words == "mean success over 20,000 steps, pretraining included"
    # A round of whole episodes can end after the budget.
    late = [
        (
            record,
            points._replace(
                steps=[s + 30 * (s >= int(record.params["env_steps"])) for s in points.steps]
            ),
        )
        for record, points in runs
    ]
    (claim,) = study_of(sweep_of(late, with_plan((), planned, 5))).planned
    assert float(claim.contrast.difference.value) == pytest.approx(-0.15, abs=0.03)


def test_a_pair_is_a_seed_in_any_order_of_the_runs(rng: np.random.Generator) -> None:
    runs = study({"1": 0.2, "1.5": 0.4}, 8, rng)
    (expected,) = study_of(sweep_of(runs, BEFORE)).planned
    (found,) = study_of(sweep_of([*runs[:8], *reversed(runs[8:])], BEFORE)).planned
    assert found.contrast.paired
    assert found.contrast.p_values == pytest.approx(expected.contrast.p_values)


def test_both_sides_of_a_verdict_need_five_seeds(rng: np.random.Generator) -> None:
    runs = study({"1": 0.1, "1.5": 0.4}, 8, rng)
    del runs[4:8]
    (claim,) = study_of(sweep_of(runs, BEFORE)).planned
    assert (claim.contrast.seeds, claim.verdict) == ((8, 4), Verdict.NONE)
    assert claim.why == "4 seeds: no verdict below 5"


def test_a_lower_value_of_a_minimised_metric_is_superior_and_a_failure_the_highest(
    rng: np.random.Generator,
) -> None:
    runs = study({"1": 0.2, "1.5": 0.4}, 8, rng)
    (claim,) = study_of(sweep_of(runs), metric=names.EVAL_SUCCESS, maximised=False).unplanned
    assert claim.verdict is Verdict.WORSE
    runs[0] = (replace(runs[0][0], status="FAILED"), runs[0][1])
    found = study_of(sweep_of(runs), metric=names.EVAL_SUCCESS, maximised=False)
    assert found.means[0].scores.by_seed["0"] == 1.0
    returns = [
        (
            one,
            points._replace(
                metrics=[{names.EVAL_SUCCESS: "own"}.get(m, m) for m in points.metrics]
            ),
        )
        for one, points in runs
    ]
    found = study_of(sweep_of(returns), metric="own", maximised=False)
    scores = [x for mean in found.means for x in mean.scores.by_seed.values()]
    assert found.means[0].scores.by_seed["0"] == max(scores) > 0.35


def test_equivalence_takes_precedence_over_a_small_difference() -> None:
    assert verdict_of(0.01, 0.001, 0.001) is Verdict.EQUIVALENT


@pytest.mark.parametrize(
    ("seeds", "far", "margin", "count"),
    [(16, 7.3, None, 0), (16, 7.5, None, 1), (16, 7.5, 8.0, 0), (15, 99.0, None, 0)],
)
def test_a_seed_has_collapsed_at_five_robust_deviations(
    seeds: int, far: float, margin: float | None, count: int
) -> None:
    """Half of the differences at 1 and half at -1: a median absolute deviation of 1."""
    scores = np.resize([1.0, -1.0], seeds)
    scores[0] = far
    found = contrast(scores, 0 * scores, paired=True, margin=margin)
    assert int(found.collapsed) == count


def test_a_margin_of_returns_is_not_one_of_success_rates(rng: np.random.Generator) -> None:
    plans = with_plan((), plan("q = 1.5 against q = 1", margin=5.0), DONE - 1)
    (claim,) = study_of(sweep_of(study({"1": 0.2, "1.5": 0.4}, 8, rng), plans)).planned
    assert claim.margin == 0.05


def test_tasks_of_other_budgets_are_averaged_over_the_budget(rng: np.random.Generator) -> None:
    runs = [
        x
        for t in ("FetchPush", "FetchSlide")
        for x in cells(rng, 5, ("1", 0.2), ("1.5", 0.4), task=t)
    ]
    budget = {"FetchPush": BUDGET, "FetchSlide": BUDGET // 2}
    plans = with_plan((), plan("q = 1.5 against q = 1", budget=budget), DONE - 1)
    words = {one.task: one.measure.words for one in study_of(sweep_of(runs, plans)).planned}
    assert words == {
        "all tasks": "mean success over the budget",
        "FetchPush": "mean success over 10,000 steps",
        "FetchSlide": "mean success over 5,000 steps",
    }


def test_seeds_that_tie_on_two_tasks_have_the_error_of_their_episodes() -> None:
    rng = np.random.default_rng(0)
    runs = [
        x
        for t in ("FetchPush", "FetchSlide")
        for x in cells(rng, 5, ("1", 0.0), ("1.5", 0.0), task=t)
    ]
    budget = dict.fromkeys(("FetchPush", "FetchSlide"), BUDGET)
    plans = with_plan((), plan("q = 1.5 against q = 1", budget=budget), DONE - 1)
    both, *_ = study_of(sweep_of(runs, plans)).planned
    rate = 0.5 / (EPISODES + 1)
    of_a_score = rate * (1 - rate) / (EPISODES * len(STEPS))
    error = np.sqrt(2 * (2 * of_a_score / 2**2) / 5)  # two sides; two tasks; five seeds
    half = stats.t.ppf(0.95, 4) * error
    assert float(both.contrast.within.upper) == pytest.approx(half)


@pytest.mark.parametrize("reward_range, worst", [("[1.0, 2.0]", 1.0), ("[-2.0, 3.0]", -100.0)])
def test_the_smallest_return_of_a_positive_reward_is_that_of_one_step(
    reward_range: str, worst: float
) -> None:
    record, _ = run({"tac.entropic_index": "1"}, 0, 0.3, np.random.default_rng(0))
    params = {"task.success_key": "None", "task.reward_range": reward_range, "task.horizon": "50"}
    record = replace(record, params={**record.params, **params}, status="FAILED")
    points = Points([names.EVAL_RETURN], [BUDGET], [DONE], [60.0])
    other = replace(record, status="FINISHED", tags={**record.tags, names.TAG_SEED: "1"})
    (mean,) = study_of(sweep_of([(record, points), (other, points)])).means
    assert mean.scores.by_seed["0"] == worst


def test_only_episodes_up_to_the_compared_budget_count(rng: np.random.Generator) -> None:
    plans = with_plan((), plan("q = 1.5 against q = 1", budget={"FetchPush": 4000}), DONE - 1)
    sweep = sweep_of(study({"1": 0.2, "1.5": 0.4}, 5, rng), plans)

    (stage,) = find_stages(sweep)
    measure = measure_on(sweep, "FetchPush", stage.runs, "auc", horizon=4000)
    assert scores_of(sweep, stage.conditions[0], "FetchPush", measure).episodes == 4 * EPISODES


def test_steps_after_the_budget_of_a_pretraining_do_not_count(rng: np.random.Generator) -> None:
    q = {"tac.entropic_index": "1"}
    before, points = run(q, 0, 0.1, rng, stage="u", **{names.TAG_NODE_KEY: "u0"})
    late = points._replace(steps=[step + 30 * (step == BUDGET) for step in points.steps])
    after = run(q, 0, 0.4, rng, stage="r", **{names.TAG_SOURCE_NODE: "u0"})
    steps, _ = with_pretraining(sweep_of([(before, late), after])).series(1, names.EVAL_SUCCESS)
    assert steps.tolist() == [*STEPS[:-1], *(BUDGET + STEPS)]
    # An evaluation at the budget, and one of the second run at its step 0: the later one counts.
    start = after[1]._replace(steps=[step - 1000 for step in after[1].steps])
    sweep = with_pretraining(sweep_of([(before, points), (after[0], start)]))
    steps, values = sweep.series(1, names.EVAL_SUCCESS)
    assert steps.tolist() == [*STEPS, *(BUDGET + STEPS[:-1])]
    assert values[len(STEPS) - 1] == start.values[len(STEPS)]


def test_a_result_is_there_when_its_run_has_ended(rng: np.random.Generator) -> None:
    """A plan may be recorded while runs train, until the last evaluation of the first that ends."""
    runs = [
        (one, points._replace(times=[DONE - 1000 + s // 10 for s in points.steps]))
        for one, points in study({"1": 0.2, "1.5": 0.4}, 5, rng)
    ]
    for at, planned in ((DONE - 1, 1), (DONE, 0)):
        sweep = sweep_of(runs, with_plan((), plan("q = 1.5 against q = 1"), at))
        assert len(study_of(sweep).planned) == planned


@pytest.mark.parametrize("paired", [True, False])
@pytest.mark.parametrize("level", [0.05, 0.05 / 6])
@pytest.mark.parametrize("size", [0.05, 0.1])
def test_the_planned_number_of_seeds_has_80_percent_power_and_one_less_has_not(
    paired: bool, level: float, size: float
) -> None:
    rng, spread, draws = np.random.default_rng(0), 0.06, 20_000
    seeds, _ = seeds_needed(size, spread, paired=paired, level=level)
    assert seeds is not None

    def power(n: int) -> float:
        if paired:
            p = stats.ttest_1samp(rng.normal(size, spread, (n, draws)), 0).pvalue
        else:
            own = spread / np.sqrt(2)
            p = stats.ttest_ind(
                rng.normal(size, own, (n, draws)), rng.normal(0, own, (n, draws))
            ).pvalue
        return float(np.mean(p < level))

    assert power(seeds) > 0.79
    assert power(seeds - 1) < 0.81


def test_a_curve_has_no_value_after_the_last_evaluation_of_a_run(rng: np.random.Generator) -> None:
    """A run that failed early does not go on at its last value."""

    def points(*rates: float) -> Points:
        steps = [1000 * (i + 1) for i in range(len(rates))]
        return Points([names.EVAL_SUCCESS] * len(rates), steps, [DONE] * len(rates), list(rates))

    runs = [
        (run({"tac.entropic_index": "1"}, seed, 0.3, rng)[0], p)
        for seed, p in enumerate((points(0.2, 0.4, 0.9), points(0.4, 0.6)))
    ]
    sweep = sweep_of(runs)
    found = curve(sweep, find_stages(sweep)[0].conditions[0], "FetchPush", names.EVAL_SUCCESS)
    assert found is not None
    np.testing.assert_allclose(found.estimate.value, [0.3, 0.5, 0.9])
    assert found.runs.tolist() == [2, 2, 1]


def test_seeds_needed_are_those_of_the_whole_family(rng: np.random.Generator) -> None:

    runs = study({"1": 0.3, "1.5": 0.33, "2": 0.31}, 6, rng, spread=0.06)
    sweep = sweep_of(runs)
    found = study_of(sweep)
    values = {m.condition.entropic_index: m.scores.by_seed for m in found.means}
    pairs = (("1.5", "1"), ("2", "1"), ("2", "1.5"))
    gaps = [np.std([values[a][k] - values[b][k] for k in values[a]], ddof=1) for a, b in pairs]
    spread = float(np.sqrt(np.mean(np.square(gaps))))
    one, other = seeds_needed(0.05, spread, paired=True, level=0.05 / 3)
    said = " ".join(answer(sweep, found))
    assert (
        f"differences is {number(spread)}: for 80% power, a difference of 0.05 needs {one} seeds, "
        f"and equivalence within it needs {other} seeds."
    ) in said


def test_planned_fresh_seeds_that_have_not_begun_count_as_unfinished(
    rng: np.random.Generator,
) -> None:
    runs = [
        run({"tac.entropic_index": q}, 10**6 + seed, height, rng, part="final0")
        for q, height in (("1", 0.2), ("1.5", 0.4))
        for seed in range(6)
    ]
    asked = plan("q = 1.5 against q = 1", seeds="8 fresh ones; 0, 1 for the tuning")
    (claim,) = study_of(sweep_of(runs, with_plan((), asked, 5))).planned
    assert claim.why == "4 of 16 planned runs are not finished"


def test_versions_are_read_in_the_order_of_their_times() -> None:
    versions = with_plan(
        with_plan((), plan("q = 2 against q = 1"), 5), plan("q = 3 against q = 1"), 7
    )
    assert checked_plans(plans_as_document(versions)[::-1]) == versions


def test_a_plan_has_hypotheses() -> None:
    with pytest.raises(ValueError, match="must be two different conditions"):
        plan("q is large")


@pytest.mark.parametrize("budgets", [(5000, 9000), (9000, 5000)])
def test_stages_are_compared_over_their_smallest_budget(
    budgets: tuple[int, int], tmp_path: Path
) -> None:
    stages = [
        {"name": n, "variant": "tac", "env_steps": s} for n, s in zip("ab", budgets, strict=True)
    ]
    document: dict[str, Any] = {"name": "s", "tasks": ["FetchPush"], "stages": stages}
    document["analysis"] = {"hypotheses": ["stage = b against stage = a"]}
    found = analysis_plan(loaded(tmp_path, document))
    assert found is not None
    assert found.budget == {"FetchPush": 5000}


def test_all_stages_before_a_stage_count_in_auc_total(tmp_path: Path) -> None:
    stages = [
        {"name": "u", "variant": "music-u", "env_steps": 4000},
        {"name": "m", "variant": "music-r", "init_from": "u", "env_steps": 5000},
        {
            "name": "f",
            "variant": "music-f",
            "init_from": "m",
            "env_steps": 6000,
            "grid": {"tac.entropic_index": [1.0, 2.0]},
        },
    ]
    document: dict[str, Any] = {"name": "s", "tasks": ["FetchPush"], "stages": stages}
    document["analysis"] = {"hypotheses": ["q = 2 against q = 1"], "metric": "auc_total"}
    found = analysis_plan(loaded(tmp_path, document))
    assert found is not None
    assert found.budget == {"FetchPush": 15_000}


def test_a_reward_with_and_without_its_own_setting_are_two_conditions(tmp_path: Path) -> None:
    for values, words in (
        ([{}, {"hidden": 128}], "hidden = 128"),
        ([{"hidden": 128}, {"hidden": 128, "features": 32}], "features = 32"),
    ):
        stage = {"name": "train", "variant": "tac", "grid": {"intrinsic.settings": values}}
        defaults = {"env_steps": 2000, "intrinsic": {"reward": "rnd"}}
        document = {"name": "s", "tasks": ["FetchPush"], "seeds": [0, 1], "stages": [stage]}
        plan = make_plan(loaded(tmp_path, document | {"defaults": defaults}))
        (found,) = find_stages(LastValues(plan).sweep({}))
        assert [(one.label, len(one.runs)) for one in found.conditions] == [
            ("q = 1", 2),
            (f"q = 1, intrinsic.settings.{words}", 2),
        ]


def test_tasks_with_their_own_q_share_a_condition() -> None:
    rng = np.random.default_rng(0)
    runs = [
        run({"tac.entropic_index": q, "tac.alpha": alpha}, seed, 0.3, rng, task, alpha=alpha)
        for task, q in (("FetchPush", "1"), ("FetchSlide", "1.5"))
        for alpha in ("0.05", "0.1")
        for seed in range(5)
    ]
    found = study_of(sweep_of(runs))
    assert found.stage is not None
    assert [one.label for one in found.stage.conditions] == ["α = 0.05", "α = 0.1"]
    assert (len(found.unplanned), found.family) == (3, 3)
    alone = [one for one in runs if one[0].params["tac.alpha"] == "0.1"]
    (condition,) = find_stages(sweep_of(alone))[0].conditions
    assert condition.label == "q of each task"


def test_a_metric_that_no_run_reported_is_no_failure() -> None:
    sweep = sweep_of(study({"1": 0.2, "1.5": 0.3}, 5, np.random.default_rng(0)))
    sentences = answer(sweep, study_of(sweep, metric=names.MI_BOUND))
    assert sentences[1] == "No finished run has reported the metric."


def test_an_alpha_of_each_task_is_not_averaged_over(tmp_path: Path) -> None:
    plan = analysis_plan(loaded(tmp_path, played_sweep.with_alpha_of_each_task()))
    assert plan is not None
    text = "α of its own for each task: 0.05 on FetchPush, 0.1 on FetchSlide"
    assert plan.control == text
    rng = np.random.default_rng(0)
    runs = [
        run({"tac.entropic_index": q}, seed, 0.3, rng, task, alpha=alpha)
        for task, alpha in (("FetchPush", "0.05"), ("FetchSlide", "0.1"))
        for q in ("1", "1.5")
        for seed in range(5)
    ]
    sweep = sweep_of(runs)
    assert f"Control: {text}." in answer(sweep, study_of(sweep))


def test_seeds_needed_count_the_error_of_the_episodes() -> None:
    x = np.array([0.30, 0.31, 0.29, 0.30, 0.32, 0.30, 0.31, 0.30])
    y = np.array([0.30, 0.30, 0.30, 0.31, 0.31, 0.30, 0.30, 0.31])
    for paired in (True, False):
        found = contrast(x, y, paired=paired, margin=0.05, noise=0.025)
        np.testing.assert_allclose(found.spread, 0.025 * np.sqrt(8))
        wide = contrast(x, y, paired=paired, margin=0.05, noise=1e-6)
        np.testing.assert_allclose(
            wide.spread, (x - y).std(ddof=1) if paired else np.hypot(x.std(ddof=1), y.std(ddof=1))
        )


def of_return(task: str, budget: int, rng: np.random.Generator) -> list[tuple[RunRecord, Points]]:
    """Runs of a task without success."""
    made = cells(rng, 6, ("1", 0.3), ("1.5", 0.3), task=task)
    return [
        (
            replace(r, params={**r.params, "task.success_key": "None", "env_steps": str(budget)}),
            p._replace(
                metrics=[{names.EVAL_SUCCESS: names.EVAL_RETURN}.get(m, m) for m in p.metrics]
            ),
        )
        for r, p in made
    ]


def test_the_metric_of_each_task_is_named() -> None:
    rng = np.random.default_rng(0)
    runs = cells(rng, 6, ("1", 0.2), ("1.5", 0.3)) + of_return("Swing", 8000, rng)
    sweep = sweep_of(runs)
    said = answer(sweep, study_of(sweep))
    area = "(area under the learning curve)"
    start = (
        f"Metric: mean success over 10,000 steps {area} on FetchPush; "
        f"mean return over 8,000 steps {area} on Swing; equivalence margin 0.05"
    )
    assert any(line.startswith(start) for line in said)
    assert "standard deviation" not in " ".join(said), "only the return is undecided"


def test_a_single_condition_has_its_result_on_each_task() -> None:
    rng = np.random.default_rng(0)
    runs = cells(rng, 5, ("1", 0.2)) + cells(rng, 5, ("1", 0.4), task="FetchSlide")
    line = answer(sweep_of(runs), study_of(sweep_of(runs)))[1]
    assert "q = 1 on FetchPush, mean success over 10,000 steps 0.2" in line
    assert "q = 1 on FetchSlide, mean success over 10,000 steps 0.4" in line


def test_many_conditions_are_not_all_compared() -> None:
    runs = cells(np.random.default_rng(0), 5, *[(f"{q:g}", 0.3) for q in np.arange(1, 2.4, 0.2)])
    said = answer(sweep_of(runs), study_of(sweep_of(runs)))[0]
    assert said.endswith("planned in advance: each condition is compared with a reference.")


def test_a_hypothesis_that_later_names_its_stage_is_the_same() -> None:
    rng = np.random.default_rng(0)
    her = cells(rng, 6, ("1", 0.2), ("2", 0.3), stage="her")
    train = [
        (one, points._replace(times=[DONE + 5] * len(points.times)))
        for one, points in cells(rng, 6, ("1", 0.25), ("2", 0.3), stage="train")
    ]
    short, full = "q = 2 against q = 1", "stage = her, q = 2 against stage = her, q = 1"
    versions = with_plan((), plan(short, stage="her"), DONE - 1)
    versions = with_plan(versions, plan(full, short, stage="train"), DONE + 1)
    found = study_of(sweep_of([*her, *train], versions))
    assert (found.late, found.dropped, found.unplanned) == ((), (), ())
    assert [one.hypothesis and one.hypothesis.sides[0] for one in found.planned] == [
        {"stage": "her", "tac.entropic_index": "2"},
        {"tac.entropic_index": "2"},
    ]
    once = with_plan((), plan(full, short, stage="her"), DONE - 1)
    assert study_of(sweep_of(her, once)).family == 1


def test_success_on_another_task_does_not_count_in_auc_total(tmp_path: Path) -> None:
    source = {"stage": "push", "task": "FetchPush"}
    stages = [
        {"name": "push", "variant": "tac", "tasks": ["FetchPush"]},
        {"name": "transfer", "variant": "music-f", "init_from": source},
    ]
    content = {"name": "s", "tasks": ["FetchPickAndPlace"], "stages": stages}
    plan = make_plan(loaded(tmp_path, content | {"defaults": {"env_steps": 4000}}))
    steps, metric = [0, 2000, 4000], [names.EVAL_SUCCESS] * 3
    points = [Points(metric, steps, steps, [value] * 3) for value in (0.9, 0.1)]
    sweep = with_pretraining(replace(LastValues(plan).sweep({}), history=columns(points)))
    found, values = sweep.series(1, names.EVAL_SUCCESS)
    assert (found.tolist(), values.tolist()) == ([4000, 6000, 8000], [0.1] * 3)
    assert sweep.runs[1].budget == 8000


def second_stage(rng: np.random.Generator, stage: str) -> list[tuple[RunRecord, Points]]:
    """Runs that end after a plan was extended by their hypothesis."""
    runs = cells(rng, 6, ("1", 0.3), ("1.5", 0.5), stage=stage)
    return [
        (record, points._replace(times=[DONE + 100] * len(points.times))) for record, points in runs
    ]


def test_seeds_needed_are_for_the_margin_of_their_hypothesis(rng: np.random.Generator) -> None:
    train = cells(rng, 6, ("1", 0.30), ("1.5", 0.33))
    later = plan("stage = second, q = 1.5 against stage = second, q = 1", margin=0.2)
    versions = with_plan(with_plan((), plan("q = 1.5 against q = 1"), DONE - 1), later, DONE + 1)
    sweep = sweep_of([*train, *second_stage(rng, "second")], versions)
    text = " ".join(answer(sweep, study_of(sweep)))
    assert "equivalence margin 0.05 or 0.2" in text
    assert "a difference of 0.05 needs" in text


def test_each_comparison_has_its_own_measure(rng: np.random.Generator) -> None:
    first = plan("q = 1.5 against q = 1", budget={"FetchPush": 6000})
    later = plan("stage = long, q = 1.5 against stage = long, q = 1", budget={"FetchPush": BUDGET})
    versions = with_plan(with_plan((), first, DONE - 1), later, DONE + 1)
    train = cells(rng, 6, ("1", 0.3), ("1.5", 0.4))
    found = study_of(sweep_of([*train, *second_stage(rng, "long")], versions))
    figure = next(one for one in study_drawings(found) if one.title == "Differences")
    axes = Figure().subplots()
    figure.subplots[0].draw(axes)
    label = axes.get_xlabel().replace("\n", " ")
    short, whole = "mean success over 6,000 steps", "mean success over 10,000 steps"
    assert label == f"difference of the {short} or {whole}"
    rows = [str(row[1]) for row in study_tables(found)[0].rows]
    assert rows[0].endswith(f", {short}")
    assert rows[1].endswith(f", {whole}")


def test_a_single_mean_lies_in_its_shown_interval(rng: np.random.Generator) -> None:
    metrics = [names.EVAL_EPISODES] * len(STEPS) + [names.EVAL_SUCCESS] * len(STEPS)
    runs = []
    for seed, rate in enumerate([0.002, 0.004, 0.003, 0.005, 0.004]):
        record, _ = run({"tac.entropic_index": "1"}, seed, 0.0, rng)
        values = [50.0] * len(STEPS) + [rate] * len(STEPS)
        runs.append((record, Points(metrics, [*STEPS, *STEPS], [DONE] * 2 * len(STEPS), values)))
    sweep = sweep_of(runs)
    assert "steps 0.004 (95% CI 0.001 to 0.009)" in answer(sweep, study_of(sweep))[1]


def test_a_caption_counts_the_seeds_of_a_line(rng: np.random.Generator) -> None:
    her = cells(rng, 5, ("1", 0.3), stage="her")
    tuned = [
        run({"tac.entropic_index": "1"}, seed, 0.4, rng, stage="tuned", part=part)
        for part, seeds in (("trial0", range(2)), ("final0", range(1000, 1005)))
        for seed in seeds
    ]
    sweep = sweep_of([*her, *tuned])
    (drawing,) = drawings_of_stages(sweep, find_stages(sweep))
    assert drawing.caption.startswith("Mean over up to 5 seeds")
    assert "Very thin lines are single seeds." in drawing.caption


def test_means_of_final_values_name_failed_runs(rng: np.random.Generator) -> None:
    final = with_plan((), plan("q = 1.5 against q = 1", metric="final"), DONE - 1)
    runs = cells(rng, 6, ("1", 0.3), ("1.5", 0.4))
    runs[0] = (replace(runs[0][0], status="FAILED"), runs[0][1])
    _, means = study_tables(study_of(sweep_of(runs, final)))
    assert means.note == "A failed run counts with the worst value."
