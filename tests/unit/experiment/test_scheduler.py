"""The order of nodes, and the effects of a failure."""

import random
from pathlib import Path
from typing import Any

import pytest
from ray.tune.error import TuneError
from ray.tune.search import Searcher

from music_rllib.experiment.plan import Plan, make_plan
from music_rllib.experiment.scheduler import Scheduler, Status
from music_rllib.tune.runner import DagSearcher, _file_error
from tests.sweep_files import loaded

STAGES: list[dict[str, Any]] = [
    {"name": "a", "variant": "music-u"},
    {
        "name": "b",
        "variant": "music-r",
        "init_from": "a",
        "grid": {"tac.entropic_index": [1.0, 1.5, 2.0]},
    },
    {"name": "c", "variant": "music-r", "init_from": "b", "tac": {"gamma": 0.9}},
]


def plan_of(folder: Path, stages: list[dict[str, Any]]) -> Plan:
    document = {"name": "s", "tasks": ["FetchPush"], "seeds": [0, 1], "stages": stages}
    return make_plan(loaded(folder, document))


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    """Two pretrained nodes, three finetuned nodes from each, and one more from each of those."""
    return plan_of(tmp_path, STAGES)


def test_nodes_wait_for_their_inputs(plan: Plan) -> None:
    scheduler = Scheduler(plan, finished=())
    first, second = scheduler.next_ready(), None
    assert first is not None
    scheduler.start(first.key)
    second = scheduler.next_ready()
    assert second is not None
    assert [first.label, second.label] == ["a/FetchPush/seed0", "a/FetchPush/seed1"]
    scheduler.start(second.key)
    assert scheduler.next_ready() is None
    assert not scheduler.all_handed_out
    scheduler.finish(second.key)
    third = scheduler.next_ready()
    assert third is not None
    assert third.label == "b/FetchPush/tac.entropic_index=1/seed1"


def test_all_runs_of_a_seed_precede_the_next_seed(plan: Plan) -> None:
    assert order_of(plan) == [(seed, stage) for seed in (0, 1) for stage in "abbbccc"]


def test_runs_that_others_start_from_come_first_within_a_seed(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, [{"name": "x", "variant": "tac"}, *STAGES])
    assert order_of(plan) == [(seed, stage) for seed in (0, 1) for stage in "abbbxccc"]


def order_of(plan: Plan) -> list[tuple[int, str]]:
    """Seeds and stages of all nodes, if one is computed at a time."""
    scheduler = Scheduler(plan, finished=())
    order = []
    while (ready := scheduler.next_ready()) is not None:
        scheduler.start(ready.key)
        scheduler.finish(ready.key)
        order.append((ready.run.seed, ready.stage))
    return order


def test_finished_nodes_are_reused(plan: Plan) -> None:
    keys = [node.key for node in plan.nodes]
    scheduler = Scheduler(plan, finished=keys)
    assert scheduler.complete
    assert scheduler.having(Status.REUSED) == list(plan.nodes)
    scheduler = Scheduler(plan, finished=keys[:2])
    ready = scheduler.next_ready()
    assert ready is not None
    assert ready.stage == "b"


def test_a_failure_skips_exactly_its_dependents(plan: Plan) -> None:
    scheduler = Scheduler(plan, finished=())
    for node in plan.nodes[:2]:
        scheduler.start(node.key)
    skipped = scheduler.fail(plan.nodes[0].key)
    assert {node.run.seed for node in skipped} == {0}
    assert len(skipped) == 6
    scheduler.finish(plan.nodes[1].key)
    while (ready := scheduler.next_ready()) is not None:
        scheduler.start(ready.key)
        scheduler.finish(ready.key)
    assert scheduler.complete
    assert len(scheduler.having(Status.FINISHED)) == 7
    assert len(scheduler.having(Status.SKIPPED)) == 6


@pytest.mark.parametrize("seed", range(5))
def test_every_node_starts_once_and_after_its_input(plan: Plan, seed: int) -> None:
    """Imitates Tune: asks the searcher, finishes or fails running nodes in random order."""
    rng = random.Random(seed)
    scheduler = Scheduler(plan, finished=())
    searcher = DagSearcher(scheduler, lambda node: {"key": node.key})
    running: list[str] = []
    handed_out: list[str] = []
    while True:
        suggestion = searcher.suggest(f"trial{len(handed_out)}")
        if suggestion == Searcher.FINISHED:
            break
        if suggestion is None:
            assert running, "Tune would block for ever"
        else:
            assert isinstance(suggestion, dict)
            running.append(suggestion["key"])
            handed_out.append(suggestion["key"])
        if running and (suggestion is None or rng.random() < 0.5):
            key = running.pop(rng.randrange(len(running)))
            if rng.random() < 0.2:
                scheduler.fail(key)
            else:
                scheduler.finish(key)
    for key in running:
        scheduler.finish(key)
    assert scheduler.complete
    assert len(set(handed_out)) == len(handed_out)
    skipped = {node.key for node in scheduler.having(Status.SKIPPED)}
    assert skipped | set(handed_out) == {node.key for node in plan.nodes}
    for key in handed_out:
        source = scheduler.node(key).input
        if source is not None:
            assert scheduler[source.key] is Status.FINISHED
            assert handed_out.index(source.key) < handed_out.index(key)


def test_an_error_of_the_storage_is_found_behind_one_of_tune() -> None:
    """Tune raises the text of a traceback instead of an error in a callback."""

    def behind(error: Exception) -> BaseException | None:
        try:
            try:
                raise error
            except Exception:
                raise TuneError("Traceback (most recent call last): ...")  # noqa: B904
        except TuneError as found:
            return _file_error(found)

    away = OSError("HTTP status 503")
    assert behind(away) is away
    assert behind(ValueError("a bug")) is None
