"""Reports on sweeps in every state, from runs in memory: sentences, tables and figures."""

from __future__ import annotations

import csv
import io
import json
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from itertools import pairwise, product
from pathlib import Path
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
import scipy.stats
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

import music_rllib
from music_rllib import names
from music_rllib.report import build
from music_rllib.report.build import WANTED, build_report, made_files, write_report
from music_rllib.report.charts import _mean_at, chart_data, curves_csv
from music_rllib.report.figures.choice import (
    AGAINST_ENTROPY,
    EXPLORATION_AGAINST_ENTROPY,
    SETTINGS,
)
from music_rllib.report.figures.draw import TEXT_WIDTH, drawn_figure, files
from music_rllib.report.figures.plots import Subplot
from music_rllib.report.page import SweepReport, render
from music_rllib.results.analysis import THRESHOLDS, analyse
from music_rllib.results.answer import answer
from music_rllib.results.conditions import SIDE_BY_SIDE, find_stages
from music_rllib.results.data import Points, RunRecord, Sweep, columns
from music_rllib.results.study import study_of
from music_rllib.results.tables import performance_tables
from tests.unit.report.conftest import no_files

STEPS = range(20_000, 200_001, 20_000)


def one_run(
    q: str,
    seed: int,
    *,
    task: str = "FetchPush",
    stage: str = "finetune",
    status: str = "FINISHED",
    params: Mapping[str, str] | None = None,
    **tags: str,
) -> RunRecord:
    key = f"{stage}-{task}-{q}-{seed}-{sorted((params or {}).items())}-{sorted(tags.items())}"
    return RunRecord(
        run_id=f"id-{key}",
        name=f"{stage}/{task}/q={q}/seed{seed}",
        status=status,
        started=0,
        ended=60_000 if status == "FINISHED" else None,
        params={
            "seed": str(seed),
            "env_steps": "200000",
            "tac.entropic_index": q,
            "task.name": task,
            "music.mi_reward_weight": "0.5" if task == "FetchSlide" else "1.0",
            **(params or {}),
        },
        tags={
            names.TAG_NODE_KEY: key,
            names.TAG_STAGE: stage,
            names.TAG_VARIANT: "music-r",
            names.TAG_TASK: task,
            names.TAG_SEED: str(seed),
            names.TAG_ENTROPIC_INDEX: q,
            names.TAG_MI_REWARD_WEIGHT: "0.5" if task == "FetchSlide" else "1",
            **tags,
        },
    )


def climbing(final: float, upto: int = 200_000) -> Points:
    """Success rises in a straight line to `final` at the end of the budget."""
    steps = [step for step in STEPS if step <= upto]
    values = [final * step / STEPS[-1] for step in steps]
    return Points([names.EVAL_SUCCESS] * len(steps), steps, steps, values)


def sweep_of(
    runs: Sequence[tuple[RunRecord, Points]], *, status: str = "FINISHED", config: str | None = None
) -> Sweep:
    return Sweep(
        name="smoke",
        status=status,
        started=0,
        source="sqlite:////results/mlflow.db",
        tags={names.TAG_GIT_COMMIT: "c0ffee"},
        config=config,
        runs=[run for run, _ in runs],
        history=columns(points for _, points in runs),
    )


def compared(finals: Mapping[str, Sequence[float]], **changes: str) -> Sweep:
    return sweep_of(
        [
            (one_run(q, seed, **changes), climbing(final))  # type: ignore[arg-type]
            for q, values in finals.items()
            for seed, final in enumerate(values)
        ]
    )


def curve_rows(report: SweepReport) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(curves_csv(report.drawings))))


def answer_to(sweep: Sweep) -> str:
    return " ".join(answer(sweep, study_of(sweep)))


# Sentences ----------------------------------------------------------------------------------------


def test_stages_with_the_same_file_name_have_different_figures() -> None:
    runs = [
        (one_run(q, seed, stage=stage), climbing(0.1 * seed))
        for stage in ("run_1", "run-1")
        for q in ("1", "1.5")
        for seed in range(3)
    ]
    drawings = build_report(sweep_of(runs)).drawings
    assert len({drawing.name for drawing in drawings}) == len(drawings)


def test_runs_without_a_seed_and_with_an_infinite_return_are_reported() -> None:
    record, points = one_run("1", 0), climbing(0.5)
    record = replace(record, params={**record.params, "task.success_key": "None"})
    endless = Points([names.EVAL_RETURN] * 2, [1, 2], [1, 2], [1.0, np.inf])
    nameless = {tag: text for tag, text in record.tags.items() if tag != names.TAG_SEED}
    runs = [(record, endless), (replace(record, tags=nameless), points)]
    assert render(build_report(sweep_of(runs)))


def test_runs_with_diverged_critics_are_listed() -> None:
    """With an intrinsic reward, a step has at least -1.5: -60 is too low at gamma 0.95."""
    known = {"task.reward_range": "[-1.0, 0.0]", "tac.gamma": "0.95"}

    def run(
        seed: int,
        critics: float,
        params: Mapping[str, str],
        weight: float = 0.5,
        of: str = names.MI_REWARD_WEIGHT,
    ) -> tuple[RunRecord, Points]:
        logged = [(names.Q_MEAN, critics), (of, weight)]
        metrics = [name for name, _ in logged for _ in range(2)]
        values = [part * value for _, value in logged for part in (1.0, 0.5)]
        points = Points(metrics, [1000, 2000] * 2, [1, 2] * 2, values)
        return one_run("2", seed, params=params), points

    report = build_report(
        sweep_of(
            [
                run(0, -59.0, known),
                run(1, -61.0, known),
                run(2, -61.0, known | {"task.reward_range": "None"}),
                run(3, -41.0, known, 0.0),
                run(4, -41.0, known | {"music.task_reward": "False"}),
                run(5, -59.0, known, of=names.INTRINSIC_WEIGHT),
                run(6, -41.0, known | {"music.task_reward": "False", "task.reward_range": "None"}),
            ]
        )
    )
    (said,) = [line for line in report.limitations if "critics" in line]
    assert said.startswith("The critics of 4 runs diverged, to values that no reward explains")
    assert [seed for seed in range(7) if f"seed{seed}" in said] == [1, 3, 4, 6]


LOW, HIGH = [0.3, 0.32, 0.35, 0.31, 0.3], [0.9, 0.92, 0.88, 0.95, 0.9]


@pytest.mark.parametrize("seeds", [4, 5])
def test_final_values_have_no_test_and_verdicts_need_five_seeds(seeds: int) -> None:
    """Completely separate conditions: only the study has verdicts on the page."""
    report = build_report(compared({"1": LOW[:seeds], "1.5": HIGH[:seeds]}))
    page = render(report)
    shown = Page(page).text
    (details,) = re.findall(r'<p class="soft details">([^<]*)', page)
    assert details.startswith("Metric: mean success over 200,000 steps")
    assert ("superior" in shown) == (seeds == 5)
    assert (f"{seeds} seeds: no verdict below 5" in shown) == (seeds < 5)
    for word in ("ermutation", "winner", "is ahead", "by chance", "Decided"):
        assert word not in shown
    assert '<td class="number">100%</td>' in page, "the probability of improvement"


def searched(*runs: tuple[str, int, str, float]) -> Sweep:
    """A search's runs, as (q, seed, part, final success rate)."""
    return sweep_of(
        [(one_run(q, seed, part=part), climbing(final)) for q, seed, part, final in runs]
    )


TRIALS = [("1", 0, "trial0", 0.5), ("1.2", 0, "trial1", 1.0), ("1.4", 0, "trial2", 0.9)]


def test_trials_of_a_search_are_not_compared_on_its_seeds() -> None:
    sweep = searched(*TRIALS)
    (analysis,) = analyse(sweep)
    assert len(analysis.scopes[0].compared) < 2
    assert len(analysis.scopes[0].finals) == 3, "the table has them"
    said = "No run on fresh seeds has finished: trials are not compared on the seeds that"
    assert said in answer_to(sweep)


def test_the_answer_of_a_search_is_about_fresh_seeds() -> None:
    fresh = [("1.2", seed, "final1", 0.6) for seed in (7, 8)]
    fresh += [("1", seed, "final0", 0.7) for seed in (7, 8)]
    said = answer_to(searched(*TRIALS, *fresh))
    assert "q = 1.2 against q = 1 on FetchPush: 2 seeds: no verdict below 5, -0." in said
    assert "1.4" not in said, "this trial has no runs on fresh seeds"


def test_figures_of_a_search_show_fresh_seeds_if_there_are_any() -> None:
    fresh = [(q, seed, "final1", 0.6) for q in ("1", "1.2") for seed in (7, 8)]

    def drawn(sweep: Sweep) -> set[str]:
        (curves, *_) = build_report(sweep).drawings
        return {label for label, _ in curves.legend}

    assert drawn(searched(*TRIALS)) == {f"q = {q}, seeds = search" for q in ("1", "1.2", "1.4")}
    assert drawn(searched(*TRIALS, *fresh)) == {f"q = {q}, seeds = fresh" for q in ("1", "1.2")}
    waiting = [(one_run(q, 7, part="final1", status="SCHEDULED"), Points()) for q in ("1", "1.2")]
    trials = [(one_run(q, seed, part=part), climbing(end)) for q, seed, part, end in TRIALS]
    assert "FetchPush" in render(build_report(sweep_of([*trials, *waiting])))


def test_final_entropies_are_in_a_table_and_a_figure() -> None:
    sweep = compared({"1": [0.5, 0.6, 0.7], "2": [0.4, 0.5, 0.6]})
    last, entropies = STEPS[-1], {"1": [-0.4, -0.3, -0.2], "2": [0.2, 0.3, 0.4]}
    values = [value for q in entropies for value in entropies[q]]
    shannon = columns([Points([names.SHANNON_ENTROPY], [last], [0], [value]) for value in values])
    sweep = replace(sweep, history={**sweep.history, **shannon})
    report = build_report(sweep)
    row = row_of(render(report), "FetchPush", "q = 2", "0.30")
    # Student's: .1/sqrt(3) times 4.303.
    assert row[0] == "0.05 to 0.55"
    (drawing,) = [one for one in report.drawings if one.title == AGAINST_ENTROPY]
    axes = drawn_figure(drawing.subplots, drawing.legend, TEXT_WIDTH).axes[0]
    points = sorted(
        point for line in axes.lines for point in np.asarray(line.get_xydata()).tolist()
    )
    # Area under a straight line from 0.1 * final to final, constant before its first point.
    areas = [0.505 * final for final in (0.5, 0.6, 0.7, 0.4, 0.5, 0.6)]
    expected = sorted(zip(values, areas, strict=True))
    np.testing.assert_allclose(points, expected, rtol=1e-6)


def test_differences_have_their_intervals_and_the_margin() -> None:
    report = build_report(compared({"1": LOW, "1.5": HIGH}))
    (drawing,) = [one for one in report.drawings if one.title == "Differences"]
    axes = drawn_figure(drawing.subplots, drawing.legend, TEXT_WIDTH).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["q = 1.5 against q = 1"]
    gaps = 0.505 * (np.array(HIGH) - LOW)  # as above
    zero, *ends, point = (np.asarray(line.get_xdata(), float) for line in axes.lines)
    np.testing.assert_allclose(zero, 0.0)
    np.testing.assert_allclose(point, gaps.mean())
    for level, found in zip((0.95, 0.9), ends, strict=True):
        interval = scipy.stats.t.interval(level, len(gaps) - 1, gaps.mean(), scipy.stats.sem(gaps))
        np.testing.assert_allclose(found, interval)
    (margin,) = axes.patches
    box = margin.get_extents().transformed(axes.transData.inverted())
    np.testing.assert_allclose([box.x0, box.x1], [-0.05, 0.05])
    figure = drawn_figure(drawing.subplots, [], 4.3)
    figure.draw_without_rendering()
    label = figure.axes[0].xaxis.label.get_window_extent()
    assert 0 <= label.x0 < label.x1 <= figure.bbox.x1


def test_exploration_is_that_of_training_episodes_in_the_first_quarter() -> None:
    runs = [(one_run(q, seed), climbing(0.9)) for q in ("1", "2") for seed in (0, 1)]
    sweep = sweep_of(runs)
    quarter = STEPS[-1] // 4
    steps = [0, quarter // 2, quarter, quarter + 1, STEPS[-1]]

    def values(first: float) -> Points:
        early = [9.0, first, first + 0.2, 9.0, 9.0]
        names_ = [names.SHANNON_ENTROPY] * 5 + [names.TRAIN_DISPLACEMENT] * 5
        return Points(names_, steps * 2, [0] * 10, early + [value / 10 for value in early])

    early = columns([values(first) for first in (1.0, 1.2, 2.0, 2.4)])
    history = {**sweep.history, **early}
    sweep = replace(sweep, history={name: history[name] for name in WANTED if name in history})
    (drawing,) = [
        one for one in build_report(sweep).drawings if one.title == EXPLORATION_AGAINST_ENTROPY
    ]
    axes = drawn_figure(drawing.subplots, drawing.legend, TEXT_WIDTH).axes[0]
    drawn = [np.asarray(line.get_xydata()) for line in axes.lines]
    # For each q its two runs, then their mean.
    expected = [[[1.1], [1.3]], [[1.2]], [[2.1], [2.5]], [[2.3]]]
    for points, entropies in zip(drawn, expected, strict=True):
        np.testing.assert_allclose(points, np.array(entropies) * [1.0, 0.1])


def test_a_failed_run_has_no_final_value_and_is_censored_in_times_to_a_threshold() -> None:
    failed = one_run("1", 1, status="FAILED")
    sweep = sweep_of([(one_run("1", 0), climbing(0.9)), (failed, climbing(0.9, upto=60_000))])
    (analysis,) = analyse(sweep)
    (final,) = analysis.scopes[0].finals
    assert final.seeds == 1
    assert float(final.estimate.value) == pytest.approx(0.9)
    half = next(one for one in analysis.times if one.threshold == THRESHOLDS[0])
    assert (sum(half.reached), len(half.reached), float(half.median.value)) == (1, 2, 120_000)


def test_only_seeds_that_finished_on_every_task_count_over_all_tasks() -> None:
    """Otherwise a condition that fails on the hard task would look better."""
    runs = [
        (one_run("1", seed, task=task), climbing(final))
        for task, finals in (("FetchPush", [0.9, 0.8]), ("FetchSlide", [0.3]))
        for seed, final in enumerate(finals)
    ]
    over_all, push, _ = analyse(sweep_of(runs))[0].scopes
    assert float(over_all.finals[0].estimate.value) == pytest.approx(0.6)
    assert (over_all.finals[0].seeds, over_all.finals[0].runs) == (1, 2)
    assert push.finals[0].seeds == 2


def test_the_interval_of_a_task_is_that_of_its_own_episodes() -> None:
    runs = []
    for task, episodes in (("FetchPush", 100.0), ("FetchSlide", 5.0)):
        points = Points(
            [names.EVAL_SUCCESS, names.EVAL_EPISODES], [9] * 2, [9] * 2, [1.0, episodes]
        )
        runs += [(one_run("1", seed, task=task), points) for seed in range(5)]
    _, *scopes = analyse(sweep_of(runs))[0].scopes
    lower = [float(scope.finals[0].estimate.lower) for scope in scopes]
    assert lower == pytest.approx([0.025 ** (1 / 500), 0.025 ** (1 / 25)])


# Conditions ---------------------------------------------------------------------------------------


def labels(sweep: Sweep, stage: int = 0) -> list[str]:
    return [condition.label for condition in find_stages(sweep)[stage].conditions]


def test_tasks_with_their_own_settings_share_a_condition() -> None:
    """MUSIC-r's weight is 1, and 0.5 on FetchSlide."""
    runs = [
        (one_run(q, seed, task=task), climbing(0.5))
        for task in ("FetchPush", "FetchSlide")
        for q in ("2", "1.5", "10")
        for seed in (0, 1)
    ]
    assert labels(sweep_of(runs)) == ["q = 1.5", "q = 2", "q = 10"]


def test_conditions_differ_in_settings_and_in_their_source() -> None:
    sources = [one_run(q, 0, stage="pretrain") for q in ("1", "2")]
    runs = [
        one_run("1.5", 0, params={"tac.lr": lr}, source_node=source.node_key)
        for lr in ("0.001", "0.0003")
        for source in sources
    ]
    sweep = sweep_of([(run, climbing(0.5)) for run in (*sources, *runs)])
    assert labels(sweep, 1) == [
        "q = 1.5, tac.lr = 0.0003, pretrain: q = 1",
        "q = 1.5, tac.lr = 0.0003, pretrain: q = 2",
        "q = 1.5, tac.lr = 0.001, pretrain: q = 1",
        "q = 1.5, tac.lr = 0.001, pretrain: q = 2",
    ]


def test_a_number_and_a_mapping_are_different_conditions() -> None:
    weights = {"intrinsic.weight": "0.5"}, {"intrinsic.weight.start": "0.5"}
    runs = [one_run("1", seed, params=params) for params in weights for seed in (0, 1)]
    assert labels(sweep_of([(run, climbing(0.5)) for run in runs])) == [
        "q = 1, intrinsic.weight = 0.5",
        "q = 1, intrinsic.weight.start = 0.5",
    ]


def test_runs_that_start_from_each_other_have_a_page() -> None:
    cycle = []
    for own, source in ("ab", "ba"):
        run = one_run("1", 0, stage=own)
        tags = {names.TAG_NODE_KEY: own, names.TAG_SOURCE_NODE: source}
        cycle.append((replace(run, tags={**run.tags, **tags}), climbing(0.5)))
    assert "Stage a" in render(build_report(sweep_of(cycle)))


def test_schedules_with_the_same_label_are_different_conditions() -> None:
    runs = [
        one_run("1 to 2", seed, params={"tac.entropic_index.begin": begin})
        for begin in ("0.1", "0.3")
        for seed in (0, 1)
    ]
    found = labels(sweep_of([(run, climbing(0.5)) for run in runs]))
    assert len(found) == 2
    assert all(label.startswith("q = 1 to 2 (") for label in found)


# The page ---------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Text, ids and everything that a browser would fetch."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text = ""
        self.ids: list[str] = []
        self.fetched: list[str] = []
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.handlers: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.tags.add(tag)
        self.handlers += [name for name in found if name.startswith("on")]
        self.ids += [str(found["id"])] if "id" in found else []
        for name in ("src", "href", "xlink:href", "srcset", "data"):
            if tag != "a" and not str(found.get(name, "#")).startswith("#"):
                self.fetched.append(f"{tag} {name}={found[name]}")
        if tag not in ("meta", "br", "img", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def row_of(page: str, *begin: str) -> list[str]:
    """The other cells of the only table row that begins with these cells."""
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in page.split("<tr>")]
    (found,) = [row[len(begin) :] for row in rows if row[: len(begin)] == list(begin)]
    return found


def partial() -> Sweep:
    failure = "ValueError: <b>state</b> is NaN\n  in step"
    return sweep_of(
        [
            (one_run("1", 0), climbing(0.9)),
            (
                one_run("1", 1, status="FAILED", failure=failure),
                climbing(0.4, 40_000),
            ),
            (one_run("1.5", 0, status="RUNNING"), climbing(0.9, 100_000)),
            (one_run("1.5", 1, status="KILLED"), Points((), (), (), ())),
        ],
        status="RUNNING",
    )


SWEEPS: dict[str, Callable[[], tuple[Sweep, Sequence[str]]]] = {
    "empty": lambda: (
        sweep_of([], status="RUNNING"),
        ["No run has begun", "Sweeprunning"],
    ),
    "nothing evaluated": lambda: (
        sweep_of([(one_run("1", 0, status="RUNNING"), Points((), (), (), ()))]),
        [
            "No evaluation yet on",
            "No run that may be compared has finished yet",
            "1 run still running",
        ],
    ),
    "partial": lambda: (
        partial(),
        [
            "1 run failed",
            "1 run still running",
            "1 run stopped before the end",
            "Failed runs",
            "ValueError: <b>state</b> is NaN",
            "no run of q = 1.5 has finished",
        ],
    ),
    "single seed": lambda: (
        compared({"1": [0.5], "1.5": [0.6]}),
        ["has one seed (0)", "no interval", "1 seed: no verdict below 5"],
    ),
    "single q": lambda: (
        compared({"1.5": [0.5, 0.6, 0.7]}),
        ["has one condition (q = 1.5): no comparison", "0.60"],
    ),
    "odd name": lambda: (compared({"1.5": [0.5]}, task="My<Task>&"), ["My<Task>&"]),
    "NaN": lambda: (
        sweep_of(
            [(one_run("1", 0), Points([names.EVAL_SUCCESS] * 2, [1, 2], [1, 2], [0.5, np.nan]))]
        ),
        ["No run has a result: 1 failed or diverged."],
    ),
}


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize("state", SWEEPS)
def test_any_state_of_a_sweep_has_a_page(state: str) -> None:
    sweep, expected = SWEEPS[state]()
    shown = Page(render(build_report(sweep)))
    for words in expected:
        assert words in shown.text
    assert not shown.fetched
    assert not shown.open
    assert len(shown.ids) == len(set(shown.ids))
    assert "nan" not in re.findall(r"[a-z]+", shown.text.replace("NaN", ""))


SCRIPT = "\"'><script>steal()</script><img src=//evil/x onerror=steal()><!-- $x_{1$ {{ 7*7 }} &"


def hostile() -> Sweep:
    """A sweep with a script in each of its texts."""
    tags = {names.TAG_ALPHA: SCRIPT, "failure": SCRIPT, "variant": SCRIPT}
    runs = [
        one_run(q, seed, task=SCRIPT, stage=stage, params={SCRIPT: q}, **tags)
        for stage in (SCRIPT, f"{SCRIPT}2")
        for q in ("1", SCRIPT)
        for seed in (0, 1)
    ]
    runs.append(one_run("1", 2, task=SCRIPT, stage=SCRIPT, status="FAILED", **tags))  # type: ignore[arg-type]
    runs = [replace(run, name=SCRIPT, run_id=f"{SCRIPT}{i}") for i, run in enumerate(runs)]
    search = {
        "stage": SCRIPT,
        "mode": SCRIPT,
        "sampler": SCRIPT,
        "objectives": [{"name": SCRIPT, "direction": SCRIPT}],
        "arms": [
            {
                "values": {SCRIPT: SCRIPT},
                "importance": {SCRIPT: 0.5},
                "trials": [
                    {"number": 0, "state": SCRIPT, "values": {SCRIPT: SCRIPT}, "reason": SCRIPT}
                ],
            }
        ],
        "ranking": [{"trial": SCRIPT, "values": {SCRIPT: SCRIPT}, "failure": SCRIPT}],
    }
    return replace(
        sweep_of([(run, climbing(0.5)) for run in runs], status=SCRIPT, config=SCRIPT),
        name=SCRIPT,
        source=f"http://{SCRIPT}",
        tags={names.TAG_GIT_COMMIT: SCRIPT, f"{names.TAG_VERSION_PREFIX}{SCRIPT}": SCRIPT},
        searches=[search],
    )


@pytest.mark.usefixtures("drawn")
def test_a_script_in_any_text_of_a_sweep_is_escaped() -> None:
    made = replace(build_report(hostile()), command=SCRIPT, limitations=[SCRIPT])
    page = render(made)
    shown, harmless = Page(page), Page(render(build_report(compared({"1": LOW, "1.5": HIGH}))))
    assert shown.tags <= harmless.tags | {"nav", "a", "pre"}
    assert not shown.handlers
    assert not shown.fetched
    assert not shown.open
    # Every text is complete: none ended a tag or was parsed as a formula.
    assert shown.text.count(SCRIPT) > 50
    assert page.count("&lt;script&gt;steal()") == page.count("script&gt;steal()")
    labels = re.findall(r'<div role="img" aria-label="([^"]*)"', page)
    assert unescape(labels[0]) == f"Success rate, {SCRIPT}"
    of_each_kind = list({drawing.title: drawing for drawing in made.drawings}.values())
    for drawing in of_each_kind:
        drawn = files(drawing.subplots, drawing.legend)
        elements = ElementTree.fromstring(drawn[".svg"]).iter()
        assert "script" not in {element.tag.rpartition("}")[2] for element in elements}


def returning(finals: Mapping[str, Sequence[float]], task: str = "Reacher") -> Sweep:
    """A task without success; the return of each run rises from -100 to its final value."""
    runs = []
    for q, values in finals.items():
        for seed, final in enumerate(values):
            curve = [-100 + (final + 100) * step / STEPS[-1] for step in STEPS]
            names_ = [names.EVAL_RETURN] * len(curve)
            run = one_run(q, seed, task=task, params={"task.success_key": "None"})
            runs.append((run, Points(names_, list(STEPS), list(STEPS), curve)))
    return sweep_of(runs)


def test_the_primary_metric_of_a_task_without_success_is_the_return() -> None:
    sweep = returning({"1": [-9, -8, -7, -9.5, -8.5], "1.5": [-5, -4, -6, -4.5, -5.5]})
    report = build_report(sweep)
    page = render(report)
    shown = Page(page)
    assert "No evaluation yet" not in shown.text
    assert "q = 1.5 against q = 1 on Reacher: superior" in shown.text
    drawn = {drawing.title: drawing for drawing in report.drawings}
    assert list(drawn) == ["Return", "Final return", "Differences"]
    assert "return of an episode" in page
    assert {row["metric"] for row in curve_rows(report)} == {names.EVAL_RETURN}
    assert not report.analyses[0].times, "the task has no success rate"
    assert row_of(page, "Reacher", "q = 1.5", "return") == [
        *("-5.00", "-5.98 to -4.02", "-6.00 -5.50 -5.00 -4.50 -4.00", "5", "5")
    ]


def test_tasks_with_and_without_success_are_not_averaged() -> None:
    both = [
        compared({"1": [0.5, 0.6], "1.5": [0.6, 0.7]}),
        returning({"1": [-9, -8], "1.5": [-5, -4]}),
    ]
    runs = [run for sweep in both for run in sweep.runs]
    points = []
    for sweep in both:
        metric = sweep.primary_metric(sweep.runs[0].task)
        for position in range(len(sweep.runs)):
            steps, values = sweep.series(position, metric)
            points.append(Points([metric] * len(steps), list(steps), list(steps), list(values)))
    report = build_report(sweep_of(list(zip(runs, points, strict=True))))
    (analysis,) = report.analyses
    assert [(scope.name, scope.metric) for scope in analysis.scopes] == [
        ("FetchPush", names.EVAL_SUCCESS),
        ("Reacher", names.EVAL_RETURN),
    ]
    titles = [drawing.title for drawing in report.drawings]
    assert {"Success rate", "Return", "Final success rate", "Final return"} <= set(titles)
    assert all(len(d.subplots) == 1 for d in report.drawings), "each on its own task"


STAGES = {"pretrain": "music-u", "plain": "tac", "with-a-rather-long-name": "music-r"}


def of_stages(*stages: str) -> Sweep:
    return sweep_of(
        [
            (one_run(q, seed, stage=stage, variant=STAGES[stage]), climbing(0.5))
            for stage in stages
            for q in ("1.0", "1.5")
            for seed in range(2)
        ]
    )


def test_stages_that_train_for_the_task_share_a_figure() -> None:
    report = build_report(of_stages(*STAGES))
    (drawing,) = [one for one in report.drawings if one.stage == SIDE_BY_SIDE]
    named = [(label, style.color, style.line) for label, style in drawing.legend]
    assert [label for label, _, _ in named] == [
        f"{stage}, q = {q}" for stage in list(STAGES)[1:] for q in ("1.0", "1.5")
    ]
    colors = [color for _, color, _ in named]
    assert colors[0] == colors[2] != colors[1] == colors[3]
    assert len(set(named)) == 4, "stages have lines of their own"
    page = render(report)
    assert f'id="subplots-{drawing.name}"' in page
    for one in (of_stages("pretrain", "plain"), of_stages("plain")):
        assert SIDE_BY_SIDE not in {drawing.stage for drawing in build_report(one).drawings}


def test_success_by_chance_is_shown_only_if_no_stage_trains_for_the_task() -> None:
    def drawn(*stages: str) -> set[str]:
        report = build_report(of_stages(*stages))
        titles = ("Final success rate", AGAINST_ENTROPY)
        found = {one.stage for one in report.drawings if one.metric or one.title in titles}
        assert {row[0] for row in performance_tables(report.analyses)[0].rows} == found
        return found

    assert drawn("pretrain", "plain") == {"plain"}
    assert drawn("pretrain") == {"pretrain"}


@pytest.mark.parametrize("stages", [("plain", "pretrain"), ("pretrain", "plain")])
def test_the_large_figure_is_of_a_stage_that_trains_for_the_task(stages: Sequence[str]) -> None:
    sweep = of_stages(*stages)
    metrics = [names.EVAL_SUCCESS, names.EVAL_DISPLACEMENT]
    points = Points(metrics, [200_000] * 2, [0, 0], [0.5, 0.1])
    report = build_report(replace(sweep, history=columns(points for _ in sweep.runs)))
    data = chart_data(report.sweep, report.drawings)
    assert data["stages"][data["main"]]["name"] == "plain"
    assert 'id="learning-curves"' in render(report)


def test_a_condition_of_the_page_has_one_style() -> None:
    report = build_report(of_stages(*STAGES))
    found: dict[str, set[tuple[str, str]]] = {}
    for stage in chart_data(report.sweep, report.drawings)["stages"]:
        for one in stage["conditions"]:
            found.setdefault(one["key"], set()).add((one["color"], one["dashes"]))
    assert all(len(styles) == 1 for styles in found.values())
    assert len({*map(tuple, found.values())}) == 4


def test_a_condition_has_one_style_if_a_setting_has_subplots_of_its_own() -> None:
    runs = [
        (one_run(q, 0, stage=stage, params={"tac.alpha": alpha}, alpha=alpha), climbing(0.5))
        for stage in ("a", "b")
        for q, alpha in (("1", "0.1"), ("1.5", "0.2"), ("2", "0.3"), ("3", "0.4"))
    ]
    report = build_report(sweep_of(runs))
    both, *stages = sorted(
        chart_data(report.sweep, report.drawings)["stages"], key=lambda one: not one["together"]
    )
    assert both["faceted"]
    styles = {one["key"]: (one["color"], one["dashes"]) for one in both["conditions"]}
    for one in (one for stage in stages for one in stage["conditions"]):
        assert styles[one["key"]] == (one["color"], one["dashes"])


def test_small_values_keep_their_digits() -> None:
    page = render(build_report(returning({"1": [0.005] * 5, "2": [0.003, 0.0032] * 2})))
    assert row_of(page, "Reacher", "q = 2", "return")[:1] == ["0.0031"]


def test_a_legend_stays_inside_its_figure() -> None:
    report = build_report(of_stages(*STAGES))
    (drawing,) = [one for one in report.drawings if one.stage == SIDE_BY_SIDE]
    for subplots in (drawing.subplots, drawing.subplots * 2, drawing.subplots * 3):
        figure = drawn_figure(subplots, drawing.legend, TEXT_WIDTH)
        figure.draw_without_rendering()
        box, whole = figure.legends[0].get_window_extent(), figure.bbox
        assert 0 <= box.x0 < box.x1 <= whole.x1
        assert 0 <= box.y0 < box.y1 < figure.axes[0].get_window_extent().y0


@pytest.mark.parametrize(
    ("width", "font", "count"), [(4.3, 10, 1), *((7.16, 8, n) for n in (1, 3))]
)
def test_long_labels_of_axes_stay_inside_their_figure(width: float, font: int, count: int) -> None:
    def draw(axes: Axes) -> None:
        label = "mean success over 1,000,000 steps, pretraining included"
        axes.set(xlabel=f"{label} τ", ylabel=label)

    title = "FetchPickAndPlace, intrinsic.reward = disagreement"
    with mpl.rc_context({"font.size": font}):
        figure = drawn_figure([Subplot(title=title, draw=draw)] * count, [], width)
        figure.draw_without_rendering()
    titles = [axes.title.get_window_extent() for axes in figure.axes]
    assert all(one.x1 < other.x0 for one, other in pairwise(titles))
    for axes in figure.axes:
        for label in (axes.title, axes.xaxis.label, axes.yaxis.label):
            box, whole = label.get_window_extent(), figure.bbox
            assert whole.x0 <= box.x0 < box.x1 <= whole.x1
            assert whole.y0 <= box.y0 < box.y1 <= whole.y1


def test_a_new_report_removes_old_figures_and_equal_sweeps_have_equal_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other files in the folder stay. Several processes draw the same as one."""
    figures = tmp_path / "figures"
    figures.mkdir()
    (figures / "mine.png").touch()
    made = []
    # No process is forked beside other threads.
    for stage, threads in (("new", 1), ("old", 2), ("new", 2)):
        monkeypatch.setattr(threading, "active_count", lambda threads=threads: threads)
        monkeypatch.setattr(build, "files", no_files if stage == "old" else files)
        report = build_report(compared({"1": [0.5], "1.5": [0.7]}, stage=stage))
        write_report(report, tmp_path)
        drawn = ("overview", *(drawing.name for drawing in report.drawings))
        shown = {"mine.png", *(f"{name}{kind}" for name in drawn for kind in (".png", ".svg"))}
        found = sorted(path for path in figures.iterdir() if not path.name.startswith("."))
        assert {path.name for path in found} == shown
        made.append([path.read_bytes() for path in found])
    assert made[0] == made[2] != made[1]
    assert {name for name in made_files(tmp_path) if "figures" in name} == {
        f"figures/{name}" for name in shown - {"mine.png"}
    }


def test_a_hostile_list_of_files_deletes_nothing_outside_the_report(tmp_path: Path) -> None:
    (tmp_path / "report" / "figures").mkdir(parents=True)
    kept = tmp_path / "figures" / "x.png"
    kept.parent.mkdir()
    kept.touch()
    listed = ["../figures/x.png", str(kept), "figures/../../figures/x.png", "figures/..", 3]
    (tmp_path / "report" / "figures" / ".made.json").write_text(json.dumps(listed))
    assert made_files(tmp_path / "report") == []
    write_report(build_report(compared({"1": [0.5]})), tmp_path / "report")
    assert kept.exists()


def test_wall_time_never_decreases_along_a_curve() -> None:
    """The mean of the remaining runs may be smaller than the mean of all runs."""
    steps = np.arange(0.0, 500.0, 100.0)
    slow, quick = (steps[:4], 2 * steps[:4]), (steps, steps)
    assert _mean_at(steps, [slow, quick]) == [0.0, 150.0, 300.0, 450.0, 450.0]
    assert _mean_at(steps, [quick, quick]) == steps.tolist()
    assert _mean_at(steps, []) is None
    assert _mean_at(steps, [(steps[:2], np.full(2, np.nan))]) == [None] * 5


# Settings -----------------------------------------------------------------------------------------


def grid_of_settings() -> Sweep:
    """q has a large effect, α a small one, the weight none; three seeds each."""
    runs = []
    for q, alpha, weight in product(("1", "2"), ("0.01", "0.1"), ("0.5", "1")):
        for seed in range(3):
            final = 0.3 + 0.5 * (q == "2") + 0.05 * (alpha == "0.1") + 0.01 * seed
            params = {"tac.alpha": alpha, "music.mi_reward_weight": weight}
            tags = {names.TAG_ALPHA: alpha, names.TAG_MI_REWARD_WEIGHT: weight}
            runs.append((one_run(q, seed, params=params, **tags), climbing(final)))
    return sweep_of(runs)


def test_each_combination_of_q_and_weight_has_a_line_over_alpha() -> None:
    (drawing,) = [one for one in build_report(grid_of_settings()).drawings if one.group == SETTINGS]
    assert [label for label, _ in drawing.legend] == [
        f"q = {q}, MI weight = {weight}" for q in ("1", "2") for weight in ("0.5", "1")
    ]
    styles = [style for _, style in drawing.legend]
    assert len({style.color for style in styles}) == 2
    assert len({(style.color, style.dashes) for style in styles}) == 4


def test_similar_colors_have_different_dashes_and_markers() -> None:
    drawing = build_report(compared({"1": [0.5, 0.6], "1.07177": [0.6, 0.7], "1.5": [0.6, 0.7]}))
    solid = [not style.dashes for _, style in drawing.drawings[0].legend]
    assert solid == [True, False, True]
    markers = [style.marker for _, style in drawing.drawings[0].legend]
    assert len(set(markers)) == 3, "points have no lines"


def test_a_condition_has_the_same_style_in_every_figure() -> None:
    fresh = [(q, seed, "final1", 0.6) for q in ("1", "1.2", "1.4") for seed in (7, 8)]
    drawings = build_report(searched(*TRIALS, ("1.15", 0, "trial3", 0.1), *fresh)).drawings
    lines = {drawing.title: [style.line for _, style in drawing.legend] for drawing in drawings}
    curves, areas = lines["Success rate"], lines["Performance profile of the area under the curve"]
    assert curves == areas


# Many conditions ----------------------------------------------------------------------------------


def test_a_large_grid_has_a_subplot_for_each_value_of_a_setting() -> None:
    alphas, indices = ("0.01", "0.1", "1"), ("1", "1.5", "2")
    sweep = sweep_of(
        [
            (one_run(q, seed, params={"tac.alpha": alpha}, alpha=alpha), climbing(0.5))
            for q, alpha, seed in product(indices, alphas, range(2))
        ]
    )
    report = build_report(sweep)
    (analysis,) = report.analyses
    assert len(analysis.stage.conditions) == 9
    titles = [f"FetchPush, α = {alpha}" for alpha in alphas]
    for title in ("Success rate", "Final success rate"):
        (drawing,) = [one for one in report.drawings if one.title == title]
        assert [panel.title for panel in drawing.subplots] == titles
    curves = {(row["stage"], row["task"], row["condition"]) for row in curve_rows(report)}
    assert curves == {
        ("finetune", "FetchPush", f"q = {q}, α = {alpha}") for q, alpha in product(indices, alphas)
    }
    page = re.search(r'<script[^>]*id="data"[^>]*>(.*?)</script>', render(report))
    assert page is not None
    data = json.loads(page.group(1))
    (drawn,) = data["stages"]
    assert drawn["subplots"] == titles
    # A q has one checkbox and one color in all subplots.
    switches = {one["key"]: one["color"] for one in drawn["conditions"]}
    assert list(switches) == [f"finetune, q = {q}" for q in indices]


def test_subplots_with_many_lines_have_no_bands() -> None:
    many = compared({f"1.{n}": [0.5, 0.6] for n in range(1, 10)})
    few = compared({f"1.{n}": [0.5, 0.6] for n in range(1, 9)})
    for sweep, has_bands in ((many, False), (few, True)):
        (drawing,) = [d for d in build_report(sweep).drawings if d.title == "Success rate"]
        assert ("95% confidence band" in drawing.caption) is has_bands
        axes = drawn_figure(drawing.subplots, [], TEXT_WIDTH).axes[0]
        assert any(isinstance(one, PolyCollection) for one in axes.collections) is has_bands


def test_the_curve_comes_before_small_text_and_each_file_is_linked(tmp_path: Path) -> None:
    report = build_report(compared({"1": [0.5], "1.5": [0.6]}))
    page = write_report(report, tmp_path).read_text()
    curve, details, groups = (
        page.index(f'id="{name}"') for name in ("curves", "details", "groups")
    )
    assert curve < details < groups
    links = re.findall(r'<a href="([^"#]+)" download>', page)
    assert {Path(link).suffix for link in links} == {".svg", ".png", ".csv"}
    assert {"tables/comparisons.csv", "tables/runs.csv"} <= set(links)
    assert all((tmp_path / link).is_file() for link in links)
    assert "download>" not in render(report, live=True)


def test_paper_shows_whole_tables() -> None:
    css = Path(music_rllib.__file__).with_name("report").joinpath("page.css").read_text()
    printed = css.partition("@media print {")[2]
    assert re.search(r"th, td, td\.long \{ white-space: normal;", printed)
