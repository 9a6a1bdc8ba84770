"""Output for the user: the plan, progress with and without a terminal, the results."""

import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console, RenderableType

from music_rllib import names
from music_rllib.command_line import clock, percent
from music_rllib.config.schema import SweepConfig
from music_rllib.config.tac_settings import LearnedAlpha, setting_text
from music_rllib.experiment.plan import Plan, make_plan
from music_rllib.experiment.scheduler import Failure, Scheduler
from music_rllib.report.figures.plots import color_of
from music_rllib.schedules import Linear, Piecewise
from music_rllib.store.history import Report, RunResult
from music_rllib.store.storage import resolve_storage, sweep_folder
from music_rllib.sweep.listeners.screen import Display
from music_rllib.sweep.views.plan import alpha_rows, plan_view
from music_rllib.sweep.views.results import results_table
from tests.sweep_files import loaded

DOCUMENT: dict[str, Any] = {
    "name": "s",
    "tasks": ["FetchPush"],
    "seeds": [0, 1],
    "defaults": {"env_steps": 2000, "tac": {"random_steps": 0}},
    "stages": [
        {"name": "pretrain", "variant": "music-u"},
        {
            "name": "finetune",
            "variant": "music-r",
            "init_from": "pretrain",
            "env_steps": 5000,
            "grid": {"tac.entropic_index": [1.0, 1.5], "tac.alpha": [0.1]},
        },
    ],
}


def changed(folder: Path, **changes: Any) -> SweepConfig:
    return loaded(folder, DOCUMENT | changes)


@pytest.fixture
def config(tmp_path: Path) -> SweepConfig:
    return changed(tmp_path)


@pytest.fixture
def plan(config: SweepConfig) -> Plan:
    return make_plan(config)


def screen(*, terminal: bool = False) -> tuple[Console, io.StringIO]:
    text = io.StringIO()
    return Console(file=text, width=200, highlight=False, force_terminal=terminal), text


def shown(view: RenderableType) -> str:
    console, text = screen()
    console.print(view)
    return text.getvalue()


def report(env_steps: int, seconds: float, **metrics: float) -> Report:
    return Report(env_steps=env_steps, seconds=seconds, timestamp_ms=0, metrics=metrics)


def test_the_plan_counts_runs_budgets_and_finished_runs(config: SweepConfig, plan: Plan) -> None:
    text = shown(plan_view(config, plan, {plan.nodes[0].key}))
    rows = {line.split()[0]: line.split()[1:] for line in text.splitlines()}
    assert rows["finetune"] == ["2", "4", "5,000", "20,000", "0"]
    assert rows["pretrain"][-1] == "1"
    stage = "finetune: music-r on FetchPush from pretrain, 2 seeds\n  tac.entropic_index: 1, 1.5"
    summary = "6 runs, 24,000 env steps in total, 1 finished earlier and reused, 22,000 env steps"
    assert stage in text
    assert summary in text


def test_settings_that_vary_together_are_shown_together(tmp_path: Path) -> None:
    tuned = [{"entropic_index": 1.0, "alpha": 0.15}, {"entropic_index": 1.5, "alpha": 0.05}]
    stage = {"name": "her", "variant": "tac", "grid": {"tac": tuned}}
    config = changed(tmp_path, stages=[stage])
    plan = make_plan(config)
    text = shown(plan_view(config, plan, set()))
    assert "\n  tac.entropic_index, tac.alpha: 1, 0.15; 1.5, 0.05\n" in text
    labels = {node.label for node in plan.nodes if node.run.seed == 0}
    point = "tac.entropic_index={},tac.alpha={}".format
    assert {label.split("/")[-2] for label in labels} == {point(1, 0.15), point(1.5, 0.05)}


def test_the_plan_shows_the_alpha_of_a_control_at_each_q(tmp_path: Path) -> None:
    alpha = {"value": 0.05, "matched_width": 0.1}
    ramp = {"schedule": "linear", "start": 1.0, "end": 2.0}
    stages = [
        {
            "name": "fixed",
            "variant": "tac",
            "tac": {"alpha": alpha},
            "grid": {"tac.entropic_index": [2.0, 1.0]},
        },
        {
            "name": "joint",
            "variant": "tac",
            "tac": {"alpha": alpha, "entropic_index": ramp, "entropy_form": "joint"},
        },
        {"name": "plain", "variant": "tac", "grid": {"tac.alpha": [0.05, 0.1]}},
    ]
    rows = alpha_rows(make_plan(changed(tmp_path, stages=stages)))
    # G = q^(-1/2) (sqrt(2 pi) sigma)^(1-q) at q = 2; of four dimensions, its fourth power.
    pressure = 2**-0.5 / ((2 * math.pi) ** 0.5 * 0.1)
    assert [(row["stage"], row["q"]) for row in rows] == [
        ("fixed", "1"),
        ("fixed", "2"),
        ("joint", "1 to 2"),
    ]
    assert [row["at_start"] for row in rows] == pytest.approx([0.05, 0.05 / pressure, 0.05])
    assert rows[2]["at_end"] == pytest.approx(0.05 / pressure**4)
    config = changed(tmp_path, stages=stages)
    assert "0.05 matched at 0.1" in shown(plan_view(config, make_plan(config), ()))


def test_alpha_of_a_q_that_follows_a_measurement_ends_at_its_last_point(tmp_path: Path) -> None:
    q = {"follows": "success_rate", "points": [[0.2, 2.0], [0.9, 1.0]], "monotone": True}
    alpha = {"value": 0.05, "matched_width": 0.1}
    stage = {"name": "her", "variant": "tac", "grid": {"tac.entropic_index": [q, 1.0]}}
    plan = make_plan(changed(tmp_path, stages=[stage | {"tac": {"alpha": alpha}}]))
    row = alpha_rows(plan)[1]
    assert (row["q"], row["q_at_start"], row["at_end"]) == ("2 to 1 by success rate", 2.0, 0.05)
    assert color_of(row["q"]) == color_of("1"), "it has that of its last value"


def test_results_have_a_row_per_run_in_any_state(plan: Plan) -> None:
    scheduler = Scheduler(plan, finished=[plan.nodes[1].key])
    scheduler.start(plan.nodes[0].key)
    scheduler.fail(plan.nodes[0].key)
    scheduler.start(plan.nodes[3].key)
    metrics = {names.EVAL_SUCCESS: 0.25, names.EVAL_SUCCESS_ANY: 0.5, names.MI_REWARD: -0.5}
    metrics |= {names.SHANNON_ENTROPY: 0.29, names.ENTROPY: -0.121}
    result = RunResult(label="x", env_steps=2000, seconds=125, metrics=metrics)
    table = results_table(plan, scheduler.__getitem__, {plan.nodes[1].key: result})
    rows = [line.split() for line in shown(table).splitlines()[3:]]
    assert rows[1] == [
        "pretrain/seed1", "25", "%", "50", "%", "0.29", "2,000", "2:05", "reused",
    ]  # fmt: skip
    assert [row[-1] for row in rows] == [
        "failed", "reused", "skipped", "interrupted", "skipped", "started",
    ]  # fmt: skip
    assert rows[4][0] == "finetune/q=1.5,alpha=0.1/seed0"
    result.metrics[names.EVAL_DISPLACEMENT] = 0.123
    table = results_table(plan, scheduler.__getitem__, {plan.nodes[1].key: result})
    rows = [line.split() for line in shown(table).splitlines()[3:]]
    assert rows[1] == [
        "pretrain/seed1", "-", "-", "0.12", "m", "0.29", "2,000", "2:05", "reused",
    ], "without the task's reward, success is chance"  # fmt: skip


def test_most_runs_that_have_not_started_share_a_row(tmp_path: Path) -> None:
    plan = make_plan(changed(tmp_path, seeds=200))
    last = plan.nodes[-1]
    scheduler = Scheduler(plan, finished=[last.key])
    result = RunResult(label="x", env_steps=2000, seconds=125, metrics={names.EVAL_SUCCESS: 0.25})
    table = results_table(plan, scheduler.__getitem__, {last.key: result})
    rows = [line.split() for line in shown(table).splitlines()[3:]]
    assert [row[-1] for row in rows] == ["started"] * 10 + ["reused", "started"]
    assert rows[-1][:3] == ["and", f"{len(plan.nodes) - 11:,}", "more"]


class Clock:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def play(
    display: Display, plan: Plan, scheduler: Scheduler, time: Clock
) -> Callable[[float], None]:
    """One run that finishes, and one that fails."""
    good, bad = plan.nodes[:2]

    def wait(seconds: float) -> None:
        time.now += seconds
        display.tick()

    for node in (good, bad):
        scheduler.start(node.key)
        display.started(node)
    wait(5)
    display.reported(good, [report(500, 5.0)])
    wait(5)
    display.reported(
        good, [report(1000, 10.0, **{names.EVAL_EPISODES: 5, names.EVAL_SUCCESS: 0.2})]
    )
    wait(1)
    scheduler.fail(bad.key)
    display.failed(bad, Failure("RuntimeError: the gripper fell off", Path("/logs/bad.txt")))
    display.skipped(plan.nodes[3], bad)
    wait(1)
    return wait


def test_without_a_terminal_there_are_plain_lines(plan: Plan) -> None:
    console, text = screen()
    scheduler, time = Scheduler(plan, finished=()), Clock()
    with Display(console, plan, scheduler, time) as display:
        wait = play(display, plan, scheduler, time)
        wait(8)
        scheduler.finish(plan.nodes[0].key)
        metrics = {names.EVAL_SUCCESS: 0.4, names.EVAL_SUCCESS_ANY: 0.6}
        result = RunResult(label="x", env_steps=2000, seconds=20.4, metrics=metrics)
        display.reported(plan.nodes[0], [report(2000, 20.4, **metrics)])
        display.finished(plan.nodes[0], result)
    assert text.getvalue().splitlines() == [
        "[  0:00] pretrain/seed0: started",
        "[  0:00] pretrain/seed1: started",
        "[  0:10] pretrain/seed0: 1,000 of 2,000 env steps, 100 steps/s, 0:10 left, "
        "success 20 % (any step -)",
        "[  0:11] pretrain/seed1: FAILED: RuntimeError: the gripper fell off",
        "[  0:11]     whole traceback: /logs/bad.txt",
        "[  0:11] finetune/q=1,alpha=0.1/seed1: skipped, it starts from pretrain/seed1",
        "[  0:20] pretrain/seed0: finished, success 40 % (any step 60 %), 2,000 env steps in 0:20",
    ]


def test_a_run_prints_its_progress_every_30_seconds(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(names.VARIABLE_PROGRESS)
    console, text = screen()
    scheduler, time = Scheduler(plan, finished=()), Clock()
    with Display(console, plan, scheduler, time) as display:
        time.now += 20  # the run waits
        scheduler.start(plan.nodes[0].key)
        display.started(plan.nodes[0])
        for second in range(1, 100):
            time.now += 1
            metrics = {names.EVAL_EPISODES: 5, names.EVAL_SUCCESS: 0.2} if second < 20 else {}
            display.reported(plan.nodes[0], [report(10 * second, second, **metrics)])
    _, first, *more = text.getvalue().splitlines()
    assert first == (
        "[  0:50] pretrain/seed0: 300 of 2,000 env steps, 10 steps/s, 2:50 left, "
        "success 20 % (any step -)"
    )
    assert len(more) == 2


def test_a_terminal_shows_a_live_table(plan: Plan) -> None:
    console, text = screen(terminal=True)
    scheduler, time = Scheduler(plan, finished=()), Clock()
    with Display(console, plan, scheduler, time) as display:
        play(display, plan, scheduler, time)
        live = text.getvalue()
    assert "1,000 / 2,000" in live
    assert "100" in live
    assert "20 %" in live
    assert "0 of 6 runs finished, 1,000 of 24,000 env steps, 0:12 passed" in live
    # Left are 1,000 steps of this run and two runs of 5,000, at 100 per second.
    assert "about 1:50 left" in live


REACHER = {"Reacher": {"env_id": "Reacher-v5", "horizon": 50, "success_key": None}}


def test_tasks_without_success_are_shown_by_their_return(tmp_path: Path) -> None:
    stages = [{"name": "train", "variant": "tac"}]
    tasks = ["Reacher", "FetchReach"]
    config = changed(tmp_path, environments=REACHER, tasks=tasks, stages=stages, seeds=[0])
    plan = make_plan(config)
    metrics = {names.EVAL_RETURN: -5.25, names.EVAL_EPISODES: 5.0}
    success = {names.EVAL_SUCCESS: 0.5, names.EVAL_RETURN: -20.0}
    for terminal in (False, True):
        console, text = screen(terminal=terminal)
        with Display(console, plan, Scheduler(plan, finished=()), time := Clock()) as display:
            display.started(plan.nodes[0])
            time.now += 10
            display.reported(plan.nodes[0], [report(1000, 10.0, **metrics)])
            display.tick()
        assert "return -5.25" in text.getvalue()
        assert "success" not in text.getvalue()
    console, text = screen()
    with Display(console, plan, Scheduler(plan, finished=())) as display:
        result = RunResult(label="x", env_steps=2000, seconds=20, metrics=metrics)
        display.finished(plan.nodes[0], result)
    assert "finished, return -5.25, 2,000 env steps" in text.getvalue()
    assert "Reacher (return), FetchReach" in shown(plan_view(config, plan, set()))
    results = {
        node.key: RunResult(label="x", env_steps=2000, seconds=20, metrics=found)
        for node, found in zip(plan.nodes, (metrics, success), strict=True)
    }
    finished = Scheduler(plan, finished=list(results))
    table = results_table(plan, finished.__getitem__, results)
    rows = [line.split()[1:-3] for line in shown(table).splitlines()[3:]]
    assert rows == [["-", "-", "-5.25"], ["50", "%", "-", "-20"]]


def test_no_cell_is_cut(tmp_path: Path) -> None:
    """A narrow screen shows everything, on several lines if necessary."""
    grid = {"tac.entropic_index": [1.0, 1.5], "tac.alpha": [0.05, 0.1]}
    stage = {"name": "train-all-of-it", "variant": "tac", "env_steps": 1_000_000, "grid": grid}
    tasks = ["Reacher", "FetchPickAndPlace"]
    config = changed(tmp_path, environments=REACHER, tasks=tasks, stages=[stage])
    plan = make_plan(config)
    metrics = {names.EVAL_RETURN: -1234.5, names.EVAL_SUCCESS: 0.25, names.EVAL_SUCCESS_ANY: 0.5}
    result = RunResult(label="x", env_steps=1_000_000, seconds=40_000, metrics=metrics)
    scheduler = Scheduler(plan, finished=[plan.nodes[0].key])
    text = io.StringIO()
    console = Console(file=text, width=80, highlight=False, force_terminal=True)
    with Display(console, plan, scheduler, time := Clock()) as display:
        for node in plan.nodes[1:4]:
            scheduler.start(node.key)
            display.started(node)
        time.now += 10
        for node in plan.nodes[1:4]:
            display.reported(node, [report(900_000, 10.0, **metrics)])
        console.print(display._view())
    console.print(plan_view(config, plan, set()))
    results = {node.key: result for node in plan.nodes[:3]}
    console.print(results_table(plan, scheduler.__getitem__, results))
    assert "…" not in text.getvalue()
    for word in ("25 %", "-1234", "interrupted", "1,000,000", "seed1"):
        assert word in text.getvalue()


def test_what_a_failed_run_has_spent_stays_spent(plan: Plan) -> None:
    console, _ = screen(terminal=True)
    scheduler, time = Scheduler(plan, finished=()), Clock()
    with Display(console, plan, scheduler, time) as display:
        play(display, plan, scheduler, time)
        scheduler.fail(plan.nodes[0].key)
        display.failed(plan.nodes[0], Failure("RuntimeError: it broke", Path("/logs/x.txt")))
        assert display._summary().startswith("0 of 6 runs finished, 1,000 of 24,000 env steps")


def test_random_steps_do_not_count_for_the_speed_of_learning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("music_rllib.sweep.listeners.screen.PROGRESS_SECONDS", 0.0)
    plan = make_plan(changed(tmp_path, defaults={"tac": {"random_steps": 1000}}))
    node, console = plan.nodes[-1], screen()
    with Display(console[0], plan, Scheduler(plan, finished=()), time := Clock()) as display:
        display.started(node)
        for seconds, steps in ((1, 500), (1, 1000), (10, 1500), (10, 2000)):
            time.now += seconds
            display.reported(node, [report(steps, time.now)])
    *early, learns = console[1].getvalue().splitlines()
    assert not any("steps/s" in line for line in early)
    assert "50 steps/s, 1:00 left" in learns


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "-"), (0, "0:00"), (59.6, "1:00"), (3599, "59:59"), (3600, "1:00:00")],
)
def test_clock(seconds: float | None, text: str) -> None:
    assert clock(seconds) == text


def test_words() -> None:
    assert setting_text(1.0) == "1"
    assert setting_text(1.25) == "1.25"
    assert setting_text(Linear(start=1, end=2)) == "1 to 2"
    assert setting_text(Piecewise(points=((0, 1.0), (5, 3.0), (9, 2.0)))) == "1 to 3 to 2"
    assert setting_text(LearnedAlpha(learned=True)) == "learned"
    assert percent(None) == "-"
    assert percent(0.345) == "34 %"


def test_storage_is_the_same_place_for_every_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert resolve_storage("results") == (f"{tmp_path}/results", None)
    assert resolve_storage("s3://bucket/x") == ("s3://bucket/x", None)
    monkeypatch.setenv("RAY_JOB_CONFIG_JSON_ENV_VAR", "{}")
    place, remark = resolve_storage("results")
    assert place == "/home/somebody/results"
    assert remark is not None
    assert "using /home/somebody/results" in remark
    assert resolve_storage("/data/results") == ("/data/results", None)
    assert sweep_folder("/data/results", "mine") == Path("/data/results/mine")
    assert sweep_folder("s3://b/x", "mine") != sweep_folder("s3://b/y", "mine")
    assert sweep_folder("s3://b/x", "mine").is_relative_to("/home/somebody")
