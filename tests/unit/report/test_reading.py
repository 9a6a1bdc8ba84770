"""What a reader of the page and the tables sees: words, numbers and captions."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest

from music_rllib import names
from music_rllib.report.build import build_report
from music_rllib.report.figures.choice import AGAINST_ENTROPY, SETTINGS, overview
from music_rllib.report.figures.draw import drawn_figure
from music_rllib.report.page import render
from music_rllib.report.two_sweeps import joined_sweeps
from music_rllib.results.analysis import analyse
from music_rllib.results.analysis_plan import with_plan
from music_rllib.results.data import Points, Sweep
from music_rllib.results.search_tables import search_in_words
from music_rllib.results.study import study_of
from music_rllib.results.tables import study_tables
from music_rllib.sweep.views.results import measured
from tests.unit.report.test_page import (
    TRIALS,
    climbing,
    compared,
    of_stages,
    one_run,
    returning,
    searched,
    sweep_of,
)
from tests.unit.results import test_study


def question(sweep: Sweep) -> str:
    found = re.search(r'class="question">([^<]*)', render(build_report(sweep)))
    assert found is not None
    return found[1]


def test_the_question_of_a_search_counts_the_compared_runs() -> None:
    fresh = [(q, seed, "final1", 0.6) for q in ("1", "1.2") for seed in (7, 8)]
    sweep = searched(*TRIALS, *fresh)
    steps = {"final1": "200000"}
    runs = [
        replace(run, params={**run.params, "env_steps": steps.get(run.tags["part"], "20000")})
        for run in sweep.runs
    ]
    found = question(replace(sweep, runs=runs))
    assert "(2 seeds, 200,000 environment steps per run)" in found


def test_the_question_states_the_budgets_that_runs_have() -> None:
    budgets = {"FetchReach": "3000", "FetchPush": "50000"}
    runs = [
        (one_run(q, seed, task=task, params={"env_steps": budgets[task]}), climbing(0.5))
        for task, q, seed in itertools.product(budgets, ("1", "2"), range(2))
    ]
    assert "3,000 to 50,000 environment steps per run" in question(sweep_of(runs))


def test_the_question_names_the_stage_of_the_comparisons() -> None:
    assert "in stage plain on FetchPush" in question(of_stages("with-a-rather-long-name", "plain"))
    assert "in stage" not in question(of_stages("pretrain", "plain"))


def test_a_caption_names_the_stages_that_it_is_about() -> None:
    first = compared({"1": [0.5] * 12, "2": [0.6] * 12})
    second = replace(compared({"1": [0.5], "2": [0.6]}), name="other")
    page = render(build_report(joined_sweeps(first, second), both=(first, second)))
    assert "smoke: finetune: Mean over up to 12 seeds" in page
    assert "other: finetune: Each line is a single run." in page


def test_differences_of_returns_have_no_exponents() -> None:
    one, two = [9000.0, 9100, 9200, 9300, 9400], [11000.0, 11200, 11100, 11300, 11500]
    comparisons, _ = study_tables(study_of(returning({"1": one, "2": two})))
    ((_, _, gap, *_),) = comparisons.cells
    assert gap.text == "+1,020"


def test_large_returns_have_no_exponent() -> None:
    values = (12345.6, -1234567.0, -5.25, -20.0)
    found = [measured(names.EVAL_RETURN, value) for value in values]
    assert found == ["12,346", "-1,234,567", "-5.25", "-20"]


def test_a_q_of_each_task_has_a_name_in_the_legend() -> None:
    metrics = [names.EVAL_SUCCESS, names.SHANNON_ENTROPY]
    runs = [
        (
            one_run(q, seed, task=task, params={"tac.alpha": alpha}, alpha=alpha),
            Points(metrics, [200_000] * 2, [0, 0], [0.5, 0.1]),
        )
        for task, q in (("FetchPush", "1"), ("FetchSlide", "2"))
        for alpha in ("0.1", "0.2")
        for seed in (0, 1)
    ]
    drawings = build_report(sweep_of(runs)).drawings
    (drawing,) = [one for one in drawings if one.title == AGAINST_ENTROPY]
    assert [label for label, _ in drawing.legend] == ["q of each task"]


@pytest.mark.parametrize("more", [(), ("0.3", "1", "2")])
def test_values_of_alpha_beside_zero_do_not_overlap(more: tuple[str, ...]) -> None:
    runs = [
        (one_run("1", seed, params={"tac.alpha": alpha}, alpha=alpha), climbing(0.5 + 0.01 * seed))
        for alpha in ("0", "0.01", "0.02", "0.05", "0.1", "0.2", "0.5", *more)
        for seed in range(3)
    ]
    (drawing,) = [one for one in build_report(sweep_of(runs)).drawings if one.group == SETTINGS]
    figure = drawn_figure(drawing.subplots, drawing.legend, 4.3)
    figure.draw_without_rendering()
    labels = [label for label in figure.axes[0].get_xticklabels() if label.get_text()]
    boxes = [label.get_window_extent() for label in labels]
    assert len(boxes) > 2
    assert not any("$" in label.get_text() for label in labels)
    assert all(one.x1 <= other.x0 for one, other in itertools.pairwise(boxes))


def test_differences_of_returns_have_no_margin_in_their_caption() -> None:
    def caption(sweep: Sweep) -> str:
        drawings = build_report(sweep).drawings
        return next(one.caption for one in drawings if one.title == "Differences")

    assert "margin" not in caption(returning({"1": [-9, -8, -7], "2": [-5, -4, -6]}))
    assert "shaded margin" in caption(compared({"1": [0.5, 0.6], "2": [0.7, 0.9]}))


def test_two_sweeps_do_not_compare_success_by_chance() -> None:
    first = of_stages("pretrain", "plain")
    second = replace(first, name="other")
    _, results = build_report(joined_sweeps(first, second), both=(first, second)).differences
    assert {row[0] for row in results.rows} == {"plain"}


def test_seeds_that_differ_are_in_their_order() -> None:
    first = compared({"1": [0.5] * 20})
    second = replace(compared({"1": [0.5]}), name="other")
    settings, _ = build_report(joined_sweeps(first, second), both=(first, second)).differences
    assert any("0, 1, 2, 3, 4, 5 and 14 more" in map(str, row) for row in settings.rows)


def test_a_search_without_a_scored_trial_is_described() -> None:
    search = {
        "mode": "independent",
        "sampler": "tpe",
        "objectives": [{"name": "success", "direction": "maximize"}],
        "arms": [{"trials": [{"state": "running"}] * 2}],
    }
    assert search_in_words(search).endswith("trials: 2 running.")
    assert search_in_words({**search, "arms": []}).endswith("trials: none.")


def test_a_legend_of_long_labels_does_not_hide_the_lines() -> None:
    runs = [
        (one_run(q, seed, task=task, params={"intrinsic.settings.a_long_name": x}), climbing(0.5))
        for task, q in itertools.product("ABC", ("1", "2"))
        for x in ("0.967725", "0.146333")
        for seed in (0, 1)
    ]
    sweep = sweep_of(runs)
    _, below = overview(sweep, [one.stage for one in analyse(sweep)])
    assert len(below) == 4


def test_a_stage_that_a_hypothesis_compares_is_not_called_uncompared() -> None:
    rng = np.random.default_rng(0)
    runs = [
        run
        for stage, height in (("her", 0.2), ("music", 0.4))
        for run in test_study.cells(rng, 5, ("1", height), stage=stage)
    ]
    planned = test_study.plan("stage = music better than stage = her", stage="music")
    report = build_report(test_study.sweep_of(runs, with_plan((), planned, test_study.DONE - 1)))
    start = "stage = music against stage = her on FetchPush: superior"
    assert any(start in line for line in report.answer)
    assert "no comparison." not in render(report)
