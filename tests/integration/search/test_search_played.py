"""Searches: the points of trials, early stopping, resumption, and several drivers.

A formula replaces the training of runs; the studies' database and the node store are real.
"""

from __future__ import annotations

import functools
import json
import math
import os
import random
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from optuna.exceptions import StorageInternalError
from optuna.trial import TrialState

from music_rllib import names
from music_rllib.config.load import load_config
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.search import FINAL_SEED
from music_rllib.config.tac_settings import LearnedAlpha
from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.open_sweep import OpenSweep, decide, found_runs, remove_runs
from music_rllib.experiment.plan import Node
from music_rllib.experiment.record import changes_since, keep_record
from music_rllib.experiment.scheduler import Status
from music_rllib.program import main
from music_rllib.results.analysis import stage_scopes
from music_rllib.results.conditions import find_stages
from music_rllib.results.read import read_sweep, searches_of
from music_rllib.search import study as study_module
from music_rllib.search.outcome import outcome
from music_rllib.sweep import driver as driver_module
from music_rllib.sweep.listeners.state_file import StateFile
from tests.played_search import SPACE, Document, Driver, document, points, searched, success
from tests.processes import fresh
from tests.sweep_files import loaded


@pytest.fixture
def tmp_path(tmp_path: Path) -> Iterator[Path]:
    """In memory where possible: a study is written in hundreds of small transactions."""
    memory = Path("/dev/shm")
    if not memory.is_dir():
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        yield Path(folder)


# --- scoring -----------------------------------------------------------------------------------


def test_the_objective_is_the_aggregate_of_the_trials_runs(tmp_path: Path) -> None:
    driver = searched(tmp_path)
    trials = driver.trials()
    assert [trial["state"] for trial in trials] == ["judged"] * 6
    runs = [run for run in driver.sweep.plan.runs if run.part]
    assert len(runs) == 18
    for trial in trials:
        mine = [run for run in runs if run.part == f"trial{trial['number']}"]
        assert {run.seed for run in mine} == {0, 1, 2}
        results = [driver.sweep.store.result(run.key) for run in mine]
        values = sorted(result.metrics[names.EVAL_SUCCESS] for result in results if result)
        # Three values: a quarter of them is less than one, so none is excluded.
        assert trial["objective"] == [pytest.approx(sum(values) / 3, abs=1e-12)]
        assert driver.sweep.plan.node(mine[0].key).run.tac.alpha == trial["values"]["tac.alpha"]
    best = max(trials, key=lambda trial: float(trial["objective"][0]))
    assert driver.outcome()["arms"][0]["best"] == best["number"]


def test_the_event_of_its_last_run_scores_a_trial(tmp_path: Path) -> None:
    driver = Driver(tmp_path, document({"trials": 1}, seeds=[0]))
    driver.play(stop_after=2)  # the pretraining and the run; no further run is proposed
    assert [trial["state"] for trial in driver.trials()] == ["judged"]


def test_trials_whose_source_fails_end_and_a_later_driver_reports_them(tmp_path: Path) -> None:
    """The failure of one seed ends a trial; its other seeds are pruned before they fail."""
    content = document({"trials": 2})
    driver = Driver(tmp_path, content)
    driver.play(fails=lambda node: node.stage == "pretrain")
    assert [(trial["state"], trial["lost"]) for trial in driver.trials()] == [("failed", True)] * 2
    driver.controller.stop()
    again = Driver(tmp_path, content)
    again.play()
    assert [trial["lost"] for trial in again.trials()] == [True] * 2
    assert not again.sweep.scheduler.having(Status.FAILED, Status.SKIPPED)


def test_searches_that_share_runs_both_end(tmp_path: Path) -> None:
    """One search may wait for runs that the other one has stopped early."""
    values = (1.5, 1.25, 1.75, 2.0, 2.5, 2.25)
    search = {
        "space": SPACE,
        "trials": 6,
        "startup_trials": 6,
        "final": None,
        "points_to_evaluate": [{"tac.entropic_index": q, "tac.alpha": 0.05} for q in values],
        "pruning": {"rungs": [{"env_steps": 2000}], "warm_up": 2, "keep": 0.5},
    }
    stages = [
        {"name": "a", "variant": "tac", "search": search},
        {"name": "b", "variant": "tac", "search": search | {"seed": 1}},
    ]
    driver = Driver(tmp_path, document({}, stages=stages))
    driver.play(slots=12)
    for found in outcome(driver.controller):
        assert {trial["state"] for trial in found["arms"][0]["trials"]} == {"judged", "pruned"}


def test_a_trial_that_another_driver_has_ended_is_left_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = document({"storage": f"sqlite:///{tmp_path}/x.db", "study": "q"}, seeds=[0])
    one, other = (Driver(tmp_path, shared | {"name": name}) for name in ("a", "b"))
    mine, theirs = (driver.controller.searches[0].studies[0] for driver in (one, other))
    theirs.trials()  # their state before the first one ends
    first = mine.claim()
    assert first is not None
    mine.end(first, TrialState.COMPLETE, [0.5], "")
    assert theirs.claim() is None
    theirs.refresh()
    second = theirs.claim()
    assert second is not None
    theirs.trials()
    monkeypatch.setattr(study_module, "LEASE_SECONDS", 0.0)
    mine.release_the_dead()
    taken = mine.claim()
    assert taken is not None
    assert taken.number == second.number
    mine.end(taken, TrialState.COMPLETE, [0.5], "")
    other.controller.stop()
    states = [trial.state for trial in mine.as_optuna().trials[:2]]
    assert states == [TrialState.COMPLETE] * 2


def test_changed_settings_of_a_search_are_listed_with_their_lost_runs(
    tmp_path: Path,
) -> None:
    content = document({"trials": 2}, seeds=[0])
    first = Driver(tmp_path, content)
    keep_record(first.sweep)
    first.play()
    keep_record(first.sweep)
    content["stages"][1]["search"]["trials"] = 3
    assert changes_since(Driver(tmp_path, content).sweep) is None
    content["stages"][1]["tac"] = {"lr": 0.0003}
    found = changes_since(Driver(tmp_path, content).sweep)
    assert found is not None
    assert found.differences == ("tac.lr: 0.001 -> 0.0003 (2 runs)",)
    assert len(found.lost) == 2
    del content["stages"][1]["tac"]
    content["stages"][0]["tac"] = {"lr": 0.0003}
    found = changes_since(Driver(tmp_path, content).sweep)
    assert found is not None
    assert len(found.lost) == 3


def test_a_run_without_the_metric_fails_its_trial_and_nothing_else(tmp_path: Path) -> None:
    def formula(run: RunSettings, share: float) -> float:
        return math.nan if run.tac.entropic_index == 2.5 else success(run, share)

    space = {"tac.entropic_index": {"choice": [1.0, 2.5]}}
    driver = Driver(tmp_path, document({"space": space, "sampler": "grid"}), formula)
    driver.play()
    good, bad = driver.trials()
    assert good["state"] == "judged"
    assert bad["state"] == "failed"
    assert "evaluation/success_rate is not a finite number" in bad["reason"]


# --- proposing ----------------------------------------------------------------------------------

SEARCHES: list[Document] = [
    {"sampler": "tpe", "trials": 10},
    {"sampler": "cmaes", "trials": 12, "population": 4},
    {
        "sampler": "nsga2",
        "population": 4,
        "trials": 10,
        "objective": [{}, {"read": "steps_to", "threshold": 0.5}],
    },
    {
        "pruning": {"rungs": [{"seeds": 1, "env_steps": 2000}, {"seeds": 2}], "warm_up": 2},
        "trials": 10,
        "concurrent": 3,
    },
]


@pytest.mark.parametrize("search", SEARCHES, ids=lambda search: json.dumps(search)[:40])
def test_a_resumed_study_equals_the_uninterrupted_one(search: Document, tmp_path: Path) -> None:
    for folder in ("whole", "broken"):
        (tmp_path / folder).mkdir()
    whole = searched(tmp_path / "whole", search)
    for attempt in range(40):
        # A killed driver leaves its trials unchanged.
        driver = Driver(tmp_path / "broken", document(search), seed=attempt + 1)
        driver.play(stop_after=9)
        if driver.controller.over:
            break
    assert driver.controller.over
    assert attempt > 1
    assert driver.trials() == whole.trials()


def test_points_do_not_depend_on_the_order_in_which_runs_end(tmp_path: Path) -> None:
    found = []
    for seed in range(3):
        folder = tmp_path / str(seed)
        folder.mkdir()
        driver = Driver(folder, document({"trials": 6, "concurrent": 3}), seed=seed)
        driver.play(slots=1 + 2 * seed)
        found.append(driver.trials())
    assert found[0] == found[1] == found[2]


def test_tpe_learns(tmp_path: Path) -> None:
    trials = searched(tmp_path, {"trials": 20, "startup_trials": 6}).trials()
    values = [trial["objective"][0] for trial in trials]
    assert np.mean(values[12:]) > np.mean(values[:6]) + 0.05


def test_given_points_come_first(tmp_path: Path) -> None:
    given = [{"tac.entropic_index": 1.25, "tac.alpha": 0.123456789}, {"tac.entropic_index": 2.0}]
    trials = searched(tmp_path, {"points_to_evaluate": given}).trials()
    assert trials[0]["values"] == given[0]
    assert trials[1]["values"]["tac.entropic_index"] == 2.0


def test_a_grid_tries_every_point_that_exists(tmp_path: Path) -> None:
    space = {
        "tac.bootstrap": {"choice": ["value", "critics"]},
        "tac.policy_critic": {"choice": ["first", "min"], "when": {"tac.bootstrap": "critics"}},
        "tac.batch_size": {"int": [64, 128], "step": 64},
    }
    driver = searched(tmp_path, {"space": space, "sampler": "grid", "trials": None})
    found = points(driver.trials())
    assert len(found) == 2 * (1 + 2)
    assert found[0] == {"tac.bootstrap": "value", "tac.batch_size": 64}
    assert all(("tac.policy_critic" in p) == (p["tac.bootstrap"] == "critics") for p in found)


def test_conditional_settings_and_choices_of_any_kind(tmp_path: Path) -> None:
    space = {
        "tac.alpha": {"choice": [0.1, {"learned": True, "initial": 0.3}]},
        "tac.bootstrap": {"choice": ["value", "critics"]},
        "tac.policy_critic": {"choice": ["first", "min"], "when": {"tac.bootstrap": ["critics"]}},
    }

    def formula(run: RunSettings, share: float) -> float:
        return share * (0.5 if run.tac.bootstrap == "critics" else 0.4)

    driver = Driver(tmp_path, document({"space": space, "trials": 12}), formula)
    driver.play()
    found = points(driver.trials())
    assert {type(point["tac.alpha"]) for point in found} == {float, dict}
    assert any("tac.policy_critic" in point for point in found)
    assert all(("tac.policy_critic" in p) == (p["tac.bootstrap"] == "critics") for p in found)


def test_several_objectives_have_a_pareto_front(tmp_path: Path) -> None:
    objectives = [{}, {"read": "steps_to", "threshold": 0.5}]
    driver = searched(tmp_path, {"objective": objectives, "trials": 8})
    (arm,) = driver.outcome()["arms"]
    worth = {t["number"]: (t["objective"][0], -t["objective"][1]) for t in arm["trials"]}

    def beaten(one: tuple[float, float]) -> bool:
        return any(o != one and o[0] >= one[0] and o[1] >= one[1] for o in worth.values())

    assert set(arm["front"]) == {number for number, one in worth.items() if not beaten(one)}
    assert arm["front"][0] == arm["best"]


# --- stopping early ----------------------------------------------------------------------------


def test_a_trial_is_stopped_early_for_a_reason_and_costs_less(tmp_path: Path) -> None:
    pruning = {"rungs": [{"seeds": 1, "env_steps": 2000}, {"seeds": 2}], "warm_up": 3, "keep": 0.3}
    driver = searched(tmp_path, {"pruning": pruning, "trials": 14})
    trials = driver.trials()
    stopped = [trial for trial in trials if trial["state"] == "pruned"]
    assert stopped
    assert not any(trial["number"] < 3 for trial in stopped)
    for trial in stopped:
        assert "is not among the best" in trial["reason"]
        assert "interval" in trial["reason"]
        runs = [run for run in driver.sweep.plan.runs if run.part == f"trial{trial['number']}"]
        assert len(runs) < 3
    assert driver.pruned
    assert set(driver.pruned.values()) <= {trial["reason"] for trial in stopped}
    best = max((t for t in trials if t["objective"]), key=lambda trial: trial["objective"])
    assert best["number"] == driver.outcome()["arms"][0]["best"]


# --- the final ranking -------------------------------------------------------------------------


def test_the_ranking_is_of_fresh_seeds(tmp_path: Path) -> None:
    def lucky(run: RunSettings, share: float) -> float:
        """The trial that is good on the seeds of the search only."""
        q = float(run.tac.entropic_index)  # type: ignore[arg-type]
        if q == 2.5 and run.seed < FINAL_SEED:
            return 0.99 * share
        return share * (0.6 - 0.1 * abs(q - 1.5)) + 0.01 * (run.seed % 3)

    space = {"tac.entropic_index": {"float": [1.0, 2.5], "step": 0.5}}
    final = {"trials": 2, "seeds": 4, "env_steps": 6000}
    driver = Driver(tmp_path, document({"space": space, "sampler": "grid", "final": final}), lucky)
    driver.play()
    found = driver.outcome()
    assert found["complete"]
    assert found["arms"][0]["best"] == 3, "the lucky one was the best in the search"
    first, second = found["ranking"]
    assert (first["values"]["tac.entropic_index"], second["values"]["tac.entropic_index"]) == (
        1.5,
        2.5,
    )
    assert second["selection_bias"][0] > 0.4
    assert abs(first["selection_bias"][0]) < 0.02
    assert first["interval"][0][0] <= first["fresh"][0] <= first["interval"][0][1]
    assert second["best_is_better_with"] == 1.0
    runs = [run for run in driver.sweep.plan.runs if run.part.startswith("final")]
    assert {run.seed for run in runs} == {FINAL_SEED + n for n in range(4)}
    budgets = {
        run.part[:5]: driver.sweep.plan.node(run.key).run.env_steps
        for run in driver.sweep.plan.runs
    }
    assert budgets == {"": 4000, "trial": 4000, "final": 6000}
    pretrained = {run.seed for run in driver.sweep.plan.runs if run.stage == "pretrain"}
    assert pretrained == {0, 1, 2} | {run.seed for run in runs}, "one for each seed, shared"


def test_baselines_are_ranked_with_the_best(tmp_path: Path) -> None:
    points = [
        {"tac.entropic_index": 2.5, "tac.alpha": 0.5},
        {"tac.entropic_index": 1.0, "tac.alpha": 0.05},
    ]
    final = {"trials": 1, "seeds": 2, "baselines": True}
    search = {"trials": 5, "points_to_evaluate": points, "final": final}
    driver = searched(tmp_path, search)
    found = driver.outcome()
    trials = found["arms"][0]["trials"]
    assert [trial["values"] for trial in trials[:2]] == points
    ranked = {entry["trial"] for entry in found["ranking"]}
    assert ranked == {0, 1, found["arms"][0]["best"]}
    runs = [run for run in driver.sweep.plan.runs if run.part.startswith("final")]
    assert len(runs) == 2 * len(ranked)
    # Also off the Pareto front of several objectives.
    objectives = [{}, {"read": "steps_to", "threshold": 0.5}]
    several = searched(tmp_path / "several", search | {"objective": objectives})
    assert {0, 1} <= {entry["trial"] for entry in several.outcome()["ranking"]}


def test_importance_names_the_settings_that_matter(tmp_path: Path) -> None:
    def formula(run: RunSettings, share: float) -> float:
        return share * float(run.tac.entropic_index) / 3  # type: ignore[arg-type]

    driver = Driver(tmp_path, document({"trials": 12, "sampler": "random"}), formula)
    driver.play()
    (arm,) = driver.outcome()["arms"]
    assert next(iter(arm["importance"])) == "tac.entropic_index"
    assert sum(arm["importance"].values()) == pytest.approx(1.0)


def chain(search: Document, steps: int = 4000, **init_from: Any) -> Document:
    """Three stages, of which the last one is searched."""
    first, last = document(search)["stages"]
    middle = {"name": "middle", "variant": "music-r", "init_from": "pretrain"}
    source = {"init_from": {"stage": "middle", **init_from}}
    stages = [first | {"env_steps": steps}, middle, last | {"variant": "music-f"} | source]
    return document(search, stages=stages, tasks=["FetchPush", "FetchPickAndPlace"])


def test_a_search_at_the_end_of_a_chain_has_fresh_seeds(tmp_path: Path) -> None:
    final = {"trials": 2, "final": {"trials": 1, "seeds": 2}}
    driver = Driver(tmp_path, chain(final))
    driver.play()
    assert driver.controller.over
    (best,) = driver.outcome()["ranking"]
    assert len(best["scores"][0]) == 2
    labels = [node.label for node in driver.sweep.plan.nodes if node.stage == "pretrain"]
    assert len(labels) == 2 * (3 + 2)


def test_another_source_is_another_study(tmp_path: Path) -> None:
    """Otherwise its trials would keep the values of the old networks."""
    contents = [
        chain({"trials": 2}),
        chain({"trials": 2}, steps=5000),
        chain({"trials": 2}, task="FetchPush"),
        chain({"trials": 2}, task="FetchPickAndPlace"),
    ]
    found = set()
    for content in contents:
        driver = Driver(tmp_path, content)
        driver.play()
        found.add(driver.outcome()["arms"][0]["study"])
    assert len(found) == 4


def recorded(folder: Path, content: Document) -> Driver:
    """The sweep as a later driver finds it, with the files of a driver that has ended."""
    driver = Driver(folder, content)
    driver.controller.propose()
    keep_record(driver.sweep)
    with StateFile(driver.sweep) as state_file:
        state_file.searches = lambda: outcome(driver.controller, thorough=False)
        state_file.end("stopped")
    if driver.controller.over:
        driver.sweep.location.keep(
            sweep_files.SEARCH, sweep_files.as_json(outcome(driver.controller))
        )
    return driver


def answered(capsys: pytest.CaptureFixture[str], *arguments: str) -> Document:
    capsys.readouterr()
    code = main([*arguments, "--json"])
    output, errors = capsys.readouterr()
    assert code == 0, errors
    found: Document = json.loads(output)
    return found


def test_deleted_results_of_a_finished_search_are_trained_again(tmp_path: Path) -> None:
    """With `--retrain`, and with them the runs that start from them."""
    content = document({"trials": 2, "final": {"trials": 1, "seeds": 2}})
    first = Driver(tmp_path, content)
    first.play()
    keep_record(first.sweep)

    def retrained(name: str, stop_after: int | None = None) -> set[str]:
        said: list[str] = []

        def remove(sweep: OpenSweep) -> OpenSweep:
            runs = found_runs(sweep)
            again, _ = decide(sweep, runs, [name], all_changed=False, keep=True)
            changed = remove_runs(sweep, again, said.append)
            keep_record(changed)
            return changed

        driver = Driver(tmp_path, content, change=remove)
        driver.play(stop_after=stop_after)
        if stop_after is not None:  # another driver continues
            other = Driver(tmp_path, content)
            other.play()
            driver.computed += other.computed
        assert driver.trials() == first.trials()
        assert driver.controller.over
        computed = {key.partition("/")[0] for key in driver.computed}
        assert len(computed) == len(driver.computed) == len(said)
        return {driver.sweep.plan.node(key).label for key in computed}

    trials = [node for node in first.sweep.plan.nodes if node.part == "trial0"]
    assert len(retrained(trials[0].label)) == 1
    of_seed = retrained("pretrain/FetchPush/seed0", stop_after=1)
    assert len(of_seed) == 1 + 2
    assert len(retrained("pretrain")) == 3 + 2 + 2 * 3 + 2
    later = Driver(tmp_path, content, change=lambda sweep: remove_runs(sweep, [], print))
    assert later.sweep.finished == {node.key for node in later.sweep.plan.nodes}
    later.play()
    assert later.computed == []


LOWEST: Document = {
    "space": {"tac.entropic_index": {"choice": [1.0, 1.5, 2.0, 2.5]}},
    "sampler": "grid",
    "trials": None,
    "concurrent": 4,
    "objective": {"direction": "minimize"},
}


def test_best_and_status_rank_as_the_search_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a final ranking, with a minimized objective, and with an unfinished trial."""

    def formula(run: RunSettings, share: float) -> float:
        lucky = run.tac.entropic_index == 2.5
        return 0.01 if lucky else 0.2 * float(run.tac.entropic_index) + 0.01 * run.seed  # type: ignore[arg-type]

    driver = Driver(tmp_path, document(LOWEST), formula)
    driver.play(stop_after=3 + 3 * 3 + 1, slots=1)
    (begun,) = [trial for trial in driver.trials() if trial["state"] != "judged"]
    assert begun["values"] == {"tac.entropic_index": 2.5}
    assert any(
        run.key in driver.sweep.finished
        for run in driver.sweep.plan.runs
        if run.part == f"trial{begun['number']}"
    ), "one seed of it is finished"
    recorded(tmp_path, document(LOWEST))
    place = str(tmp_path / "results/s")
    best = answered(capsys, "status", place)["best"]
    assert best["values"] == {"tac.entropic_index": 1.0}
    assert (best["direction"], best["runs"]) == ("minimize", 3)
    assert best["value"] == pytest.approx(0.21)
    chosen = answered(capsys, "best", place, "--output", str(tmp_path / "out"))
    assert chosen["values"] == {"tac.entropic_index": 1.0}
    said = "finetune q = 1: iqm of evaluation/success_rate (minimize) 0.21"
    assert chosen["why"].startswith(said)
    compared = answered(capsys, "compare", place)
    assert compared["direction"] == "minimize"


def test_the_best_is_the_first_on_fresh_seeds_once_the_ranking_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def formula(run: RunSettings, share: float) -> float:
        q = float(run.tac.entropic_index)  # type: ignore[arg-type]
        return 0.3 - 0.1 * q if run.seed < FINAL_SEED else 0.1 * q

    search = LOWEST | {"final": {"trials": 2, "seeds": 2}}
    driver = Driver(tmp_path, document(search), formula)
    driver.play()
    recorded(tmp_path, document(search))
    place = str(tmp_path / "results/s")
    best = answered(capsys, "status", place)["best"]
    chosen = answered(capsys, "best", place, "--output", str(tmp_path / "out"))
    # 2.5 was the lowest in the search; of the two ranked trials, 2.0 is lower on fresh seeds.
    for found in (best, chosen):
        assert found["values"] == {"tac.entropic_index": 2.0}
        assert found["on_fresh_seeds"]
        assert found["value"] == pytest.approx(0.2)


# --- comparisons, extensions, warm starts ------------------------------------------------


def test_compare_gives_every_value_the_same_budget_and_seeds(tmp_path: Path) -> None:
    search = {
        "mode": "compare",
        "compare": {"tac.entropic_index": [1.0, 1.5, 2.0]},
        "space": {"tac.alpha": {"float": [0.005, 0.5], "log": True}},
        "trials": 4,
        "final": {"trials": 1, "seeds": 3},
    }
    driver = searched(tmp_path, search)
    found = driver.outcome()
    assert [arm["values"] for arm in found["arms"]] == [
        {"tac.entropic_index": q} for q in (1.0, 1.5, 2.0)
    ]
    for arm in found["arms"]:
        assert [trial["state"] for trial in arm["trials"]] == ["judged"] * 4
    # The same seed of the sampler: all start with the same point.
    first = {arm["trials"][0]["values"]["tac.alpha"] for arm in found["arms"]}
    assert len(first) == 1
    by_q: dict[float, set[int]] = {}
    for run in driver.sweep.plan.runs:
        if run.part.startswith("trial"):
            by_q.setdefault(run.values["tac.entropic_index"], set()).add(run.seed)
    assert by_q == {1.0: {0, 1, 2}, 1.5: {0, 1, 2}, 2.0: {0, 1, 2}}
    assert found["ranking"][0]["values"]["tac.entropic_index"] == 1.5
    assert len(found["ranking"]) == 3


def test_more_seeds_only_train_the_new_ones(tmp_path: Path) -> None:
    before = searched(tmp_path)
    after = searched(tmp_path, seeds=[0, 1, 2, 3, 4])
    assert points(after.trials()) == points(before.trials())
    assert len(after.computed) == 6 * 2 + 2, "of each trial two runs, and what they start from"
    assert all(len(trial["scores"][0]) == 5 for trial in after.trials())


def test_a_study_of_a_wider_space_evaluates_the_earlier_points(tmp_path: Path) -> None:
    before = searched(tmp_path, {"trials": 4})
    wider = SPACE | {"tac.alpha": {"float": [0.001, 0.9], "log": True}}
    after = searched(tmp_path, {"trials": 6, "space": wider})
    assert points(after.trials())[:4] == points(before.trials())
    assert len(after.computed) == 2 * 3


def test_a_choice_that_becomes_a_range_keeps_its_numbers(tmp_path: Path) -> None:
    def formula(run: RunSettings, share: float) -> float:
        return share * (0.3 if isinstance(run.tac.alpha, LearnedAlpha) else 0.5)

    choice = {"choice": [0.1, 0.2, {"learned": True, "initial": 0.3}]}
    search = {"space": {"tac.alpha": choice}, "sampler": "grid"}
    before = Driver(tmp_path, document(search), formula)
    before.play()
    assert [trial["state"] for trial in before.trials()] == ["judged"] * 3
    space = {"tac.alpha": {"float": [0.05, 0.5]}}
    after = searched(tmp_path, {"space": space, "trials": 3})
    assert points(after.trials())[:2] == [{"tac.alpha": 0.1}, {"tac.alpha": 0.2}]


def test_settings_of_the_pretraining_can_be_searched_and_are_shared(tmp_path: Path) -> None:
    space = {
        "pretrain:music.lr": {"choice": [0.001, 0.01]},
        "tac.alpha": {"choice": [0.05, 0.1, 0.2]},
    }
    driver = searched(tmp_path, {"space": space, "sampler": "grid", "trials": None})
    nodes = [node for node in driver.sweep.plan.nodes if node.stage == "pretrain"]
    assert len(nodes) == 2 * 3, "one for each of its settings and seed"
    assert {node.run.music.lr for node in nodes} == {0.001, 0.01}
    assert len([run for run in driver.sweep.plan.runs if run.part]) == 6 * 3


def play_in_turns(*drivers: Driver) -> None:
    """Wait until the search is over for all drivers."""
    for _ in range(200):
        for driver in drivers:
            try:
                driver.play(stop_after=len(driver.computed) + 2)
            except AssertionError:
                continue  # it waits for trials of the other one
        if all(driver.controller.over for driver in drivers):
            return
    raise AssertionError("it does not end")


def parts_computed(driver: Driver) -> set[str]:
    nodes = (driver.sweep.plan.node(piece.partition("/")[0]) for piece in driver.computed)
    return {node.part for node in nodes if node.part}


def test_two_sweeps_that_share_a_study_list_all_trials(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = f"sqlite:///{tmp_path}/shared.db"
    search = {"storage": database, "study": "together", "trials": 8, "concurrent": 3}
    drivers = [Driver(tmp_path, document(search, name=name)) for name in ("one", "other")]
    for driver in drivers:
        keep_record(driver.sweep)
    play_in_turns(*drivers)
    for driver in drivers:
        driver.controller.stop()
        assert parts_computed(driver)
        with StateFile(driver.sweep) as state_file:
            state_file.searches = functools.partial(outcome, driver.controller, thorough=False)
            state_file.end("finished")
        place = str(driver.sweep.folder)
        state = answered(capsys, "status", place)
        assert state["stages"][1]["trials"] == 8
        (scope,) = stage_scopes(sweep := read_sweep(place).sweep, find_stages(sweep)[-1])
        assert sum(final.runs for final in scope.finals) == 8 * 3
        trials = json.loads((driver.sweep.folder / "plan.json").read_text())["trials"]
        assert len(trials) == len({json.dumps(trial) for trial in trials})


def test_two_drivers_share_a_study(tmp_path: Path) -> None:
    database = f"sqlite:///{tmp_path}/shared.db"
    search = {"storage": database, "study": "together", "trials": 10, "concurrent": 3}
    for folder in ("one", "other", "alone"):
        (tmp_path / folder).mkdir()
    one = Driver(tmp_path / "one", document(search))
    other = Driver(tmp_path / "other", document(search), seed=1)
    play_in_turns(one, other)
    assert one.trials() == other.trials()
    assert [trial["state"] for trial in one.trials()] == ["judged"] * 10
    by_trial = [parts_computed(driver) for driver in (one, other)]
    everything = {f"trial{number}" for number in range(10)}
    assert by_trial[0] | by_trial[1] == everything
    assert not by_trial[0] & by_trial[1]
    assert all(by_trial)
    for driver in (one, other):
        assert {run.part for run in driver.sweep.plan.runs if run.part} == everything
    alone = searched(tmp_path / "alone", search | {"storage": None})
    assert alone.trials() == one.trials()


@pytest.mark.parametrize("study", ["of the sweep", "of each driver"])
def test_two_drivers_of_one_sweep_share_its_runs(
    study: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drivers on two machines with a bucket have separate studies with the same trials."""
    search = {"trials": 5, "concurrent": 2, "final": {"trials": 1, "seeds": 2}}
    alone = searched(tmp_path / "alone", search, seeds=[0, 1])
    drivers = []
    for seed in (0, 1):
        if study == "of each driver":
            monkeypatch.setenv(names.VARIABLE_STUDIES, str(tmp_path / f"{seed}"))
        content = document(search, seeds=[0, 1])
        drivers.append(Driver(tmp_path / "shared", content, seed=seed, leases=True))
    play_in_turns(*drivers)
    one, other = drivers
    assert one.trials() == other.trials() == alone.trials()
    assert sorted(one.computed + other.computed) == sorted(alone.computed), "each run once"
    assert one.computed
    assert other.computed
    assert one.sweep.finished == other.sweep.finished == alone.sweep.finished


def test_a_dead_drivers_trials_are_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = {"storage": f"sqlite:///{tmp_path}/shared.db", "study": "together"}
    dead = Driver(tmp_path, document(search))
    dead.play(stop_after=4)
    study = dead.controller.searches[0].studies[0]
    held = [trial.number for trial in study.trials() if trial.state.name == "RUNNING"]
    assert held
    driver = Driver(tmp_path, document(search))
    mine = driver.controller.searches[0].studies[0]
    mine.release_the_dead()
    assert [t.number for t in mine.trials() if t.state.name == "RUNNING"] == held, "it is alive"
    # It is dead, and a fast clock has dated its heartbeat ahead.
    name, ahead = f"driver:{study._me}", time.time() + 3600
    mine._storage.set_study_user_attr(mine._id, name, ahead)
    mine.release_the_dead()
    assert [t.number for t in mine.trials() if t.state.name == "RUNNING"] == held, "it may be alive"
    monkeypatch.setattr(study_module, "LEASE_SECONDS", 0.0)
    mine.release_the_dead()
    driver.play()
    assert [trial["state"] for trial in driver.trials()] == ["judged"] * 6


def test_a_driver_whose_trials_were_taken_over_changes_nothing(tmp_path: Path) -> None:
    search = {"storage": f"sqlite:///{tmp_path}/shared.db", "study": "together"}
    for folder in ("silent", "other"):
        (tmp_path / folder).mkdir()
    silent = Driver(tmp_path / "silent", document(search))
    silent.play(stop_after=5)
    other = Driver(tmp_path / "other", document(search))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_module, "LEASE_SECONDS", 0.0)
        other.controller.searches[0].studies[0].release_the_dead()
    other.play()
    before = other.trials()
    silent.play()
    assert silent.trials() == before == other.trials()


class Flaky:
    """A database that fails in one of ten calls."""

    def __init__(self, storage: Any, seed: int) -> None:
        self._storage, self._rng = storage, random.Random(seed)
        self.down = 0

    def __getattr__(self, name: str) -> Any:
        if self._rng.random() < 0.1:
            self.down += 1
            raise StorageInternalError("the server closed the connection")
        return getattr(self._storage, name)


def test_a_database_that_fails_now_and_then_changes_nothing(tmp_path: Path) -> None:
    for folder in ("whole", "flaky"):
        (tmp_path / folder).mkdir()
    whole = searched(tmp_path / "whole")
    driver = Driver(tmp_path / "flaky", document({}))
    study = driver.controller.searches[0].studies[0]
    sound, flaky = study._storage, Flaky(study._storage, 1)
    study._storage = flaky  # type: ignore[assignment]
    while not driver.controller.over:
        try:
            driver.play(stop_after=len(driver.computed) + 1)
        except (AssertionError, StorageInternalError):
            continue  # it only waits
    assert flaky.down > 10
    study._storage = sound
    assert driver.trials() == whole.trials()


def test_the_cost_of_a_trial_does_not_grow_with_their_number(tmp_path: Path) -> None:
    driver = Driver(tmp_path, document({"trials": 40, "sampler": "random"}, seeds=[0]))
    process = psutil.Process()
    seconds, memory = [], []
    for until in (11, 21, 31, 41):  # one is the pretraining
        before = time.process_time()
        driver.play(stop_after=until)
        seconds.append(time.process_time() - before)
        memory.append(process.memory_info().rss)
    driver.play()
    assert [trial["state"] for trial in driver.trials()] == ["judged"] * 40
    assert seconds[3] < 3 * seconds[0], seconds
    assert memory[3] - memory[0] < 20 * 2**20, memory


# --- the same everywhere -----------------------------------------------------------------------


def test_the_same_file_gives_the_same_points_on_another_machine(tmp_path: Path) -> None:
    """Numbers have six digits: the last bits of a machine's logarithm do not matter."""
    driver = Driver(tmp_path, document({}))
    driver.play()
    assert points(driver.trials()) == FIRST_POINTS
    (tmp_path / "random").mkdir()
    by_chance = points(searched(tmp_path / "random", {"sampler": "random"}).trials())
    assert by_chance[:3] == FIRST_POINTS[:3]
    assert not any(point in FIRST_POINTS for point in by_chance[3:]), "those are TPE's"


def test_more_seeds_keep_all_points_if_some_are_given_in_part(tmp_path: Path) -> None:
    def formula(run: RunSettings, share: float) -> float:
        """The seeds prefer different values of q."""
        q, seed = float(run.tac.entropic_index), run.seed  # type: ignore[arg-type]
        return round(0.8 * share - 0.3 * abs(q - (1.0, 2.5)[seed]) * (1 + 2 * seed), 6)

    given = [{"tac.entropic_index": 1.0}, {"tac.entropic_index": 2.0}]
    search = {"points_to_evaluate": given, "trials": 8}
    before = Driver(tmp_path, document(search, seeds=[0]), formula)
    before.play()
    after = Driver(tmp_path, document(search, seeds=[0, 1]), formula)
    after.play()
    assert points(after.trials()) == points(before.trials())
    assert len(after.computed) == 1 + 8, "only the new seed"


def test_node_keys_are_the_same_in_another_process(tmp_path: Path) -> None:
    driver = Driver(tmp_path, document({"trials": 2}))
    driver.play()
    code = (
        "import json, sys; from pathlib import Path\n"
        "from tests.played_search import Driver, document\n"
        "driver = Driver(Path(sys.argv[1]), document({'trials': 2})); driver.play()\n"
        "print(json.dumps([[run.label, run.key] for run in driver.sweep.plan.runs]))"
    )
    (tmp_path / "there").mkdir()
    elsewhere = os.environ | {"PYTHONHASHSEED": "12345", "LC_ALL": "C", "TZ": "Asia/Tokyo"}
    found = fresh("-c", code, tmp_path / "there", env=elsewhere, cwd=Path(__file__).parents[3])
    here = {run.label: run.key for run in driver.sweep.plan.runs}
    assert dict(json.loads(found.stdout.splitlines()[-1])) == here


FIRST_POINTS: list[Mapping[str, Any]] = [
    {"tac.entropic_index": 2.5, "tac.alpha": 0.135116},
    {"tac.entropic_index": 1.5, "tac.alpha": 0.146438},
    {"tac.entropic_index": 1.0, "tac.alpha": 0.338515},
    # From here on TPE uses the results of two trials.
    {"tac.entropic_index": 2.0, "tac.alpha": 0.00672013},
    {"tac.entropic_index": 1.25, "tac.alpha": 0.0335914},
    {"tac.entropic_index": 1.75, "tac.alpha": 0.419184},
]


def test_a_password_in_the_url_is_refused(tmp_path: Path) -> None:
    search = {"storage": "postgresql://me:hidden@127.0.0.1:9/studies"}
    with pytest.raises(RuntimeError, match="must not hold a password") as error:
        Driver(tmp_path, document(search))
    assert "hidden" not in str(error.value)


def test_a_database_that_does_not_answer_is_refused(tmp_path: Path) -> None:
    search = {"storage": "postgresql://me@127.0.0.1:9/studies"}
    with pytest.raises(RuntimeError, match=r"search.storage must be a database that can be used"):
        Driver(tmp_path, document(search))


# --- retraining ----------------------------------------------------------------------------------


class KilledError(BaseException):
    """Ends a driver at once, as `kill -9` does."""


def killed(*_: Any) -> None:
    raise KilledError


def one_trial(folder: Path) -> tuple[Document, Driver, Node]:
    """A recorded search with one trial, whose run has ended."""
    content = document({"trials": 1}, seeds=[0])
    first = Driver(folder, content)
    first.play()
    keep_record(first.sweep)
    first.controller.stop()
    (node,) = (node for node in first.sweep.plan.nodes if node.part)
    return content, first, node


def test_a_run_to_retrain_is_recorded_before_it_is_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, first, node = one_trial(tmp_path)
    config = load_config(tmp_path / "sweep.yaml", storage=str(tmp_path / "results"))
    with monkeypatch.context() as patch:
        patch.setattr(driver_module, "_check", killed)
        with pytest.raises(KilledError):
            driver_module.run(config, retrain=[node.label])
    assert not first.sweep.store.is_finished(node.key)
    again = Driver(tmp_path, content)
    again.play()
    assert again.computed == [f"{node.key}/None"]


def test_nothing_is_deleted_if_the_study_cannot_be_opened(tmp_path: Path) -> None:
    _, first, node = one_trial(tmp_path)
    (tmp_path / "results" / "s" / "study.db").write_bytes(b"x" * 4096)
    config = load_config(tmp_path / "sweep.yaml", storage=str(tmp_path / "results"))
    with pytest.raises(BadInputError, match=r"search\.storage must be a database"):
        driver_module.run(config, retrain=[node.label])
    assert first.sweep.store.is_finished(node.key)


def test_trials_of_another_sweep_that_start_from_a_retrained_run_are_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, first, node = one_trial(tmp_path)
    plain = document({}, name="plain", seeds=[0])
    plain["stages"] = plain["stages"][:1]
    config = loaded(tmp_path, plain, storage=str(tmp_path / "results"))
    with monkeypatch.context() as patch:
        patch.setattr(driver_module, "_check", killed)
        with pytest.raises(KilledError):
            driver_module.run(config, retrain=["pretrain"])
    again = Driver(tmp_path, content)
    again.play()
    assert len(again.computed) == 2
    assert first.sweep.store.is_finished(node.key)


def test_an_extended_search_that_was_killed_before_its_record_shows_its_new_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for trials in (2, 3):
        driver = Driver(tmp_path, document({"trials": trials}, seeds=[0]))
        keep_record(driver.sweep)
        driver.play()
        found = functools.partial(outcome, driver.controller, thorough=False)
        with StateFile(driver.sweep) as state:
            monkeypatch.setattr(state, "searches", found)
            state.tick()
            state._update()
            state._write()
        if trials == 2:
            driver.sweep.location.keep(sweep_files.SEARCH, sweep_files.as_json(found()))
        driver.controller.stop()
    (shown,) = searches_of(driver.sweep.location, driver.sweep.config)
    assert len(shown["arms"][0]["trials"]) == 3


def test_a_grid_whose_keys_change_places_tries_every_point(tmp_path: Path) -> None:
    space = {"tac.alpha": {"choice": [0.1, 0.2]}, "tac.entropic_index": {"choice": [1.0, 2.0]}}
    grid = {"sampler": "grid", "space": space}
    searched(tmp_path, {**grid, "trials": 2}, seeds=[0])
    grid["space"] = dict(reversed(space.items()))
    after = searched(tmp_path, {**grid, "trials": 4}, seeds=[0])
    assert len({json.dumps(point, sort_keys=True) for point in points(after.trials())}) == 4


def test_points_of_a_study_outlive_one_that_was_stopped_at_once(tmp_path: Path) -> None:
    before = searched(tmp_path, {"trials": 4}, seeds=[0])
    for lowest in (0.001, 0.002):
        space = SPACE | {"tac.alpha": {"float": [lowest, 0.9], "log": True}}
        driver = Driver(tmp_path, document({"trials": 6, "space": space}, seeds=[0]))
    driver.play()
    assert points(driver.trials())[:4] == points(before.trials())
    assert len(driver.computed) == 2


def test_best_exports_a_trial_that_equals_a_run_of_an_earlier_stage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    search = {
        "space": {"tac.entropic_index": {"choice": [1.0, 1.5]}},
        "sampler": "grid",
        "final": None,
    }
    stages = [
        {"name": "coarse", "variant": "tac", "grid": {"tac.entropic_index": [1.5]}},
        {"name": "tuned", "variant": "tac", "search": search},
    ]
    content = document({}, seeds=[0, 1], stages=stages)
    Driver(tmp_path, content).play()
    recorded(tmp_path, content)
    place, out = str(tmp_path / "results/s"), str(tmp_path / "out")
    chosen = answered(capsys, "best", place, "--stage", "tuned", "--output", out)
    assert chosen["values"] == {"tac.entropic_index": 1.5}
    assert [policy["task"] for policy in chosen["policies"]] == ["FetchPush"]


def test_steps_to_come_are_without_sources_that_the_search_has_asked_for(tmp_path: Path) -> None:
    space = {"tac.alpha": {"choice": [0.05, 0.1]}, "pretrain:music.lr": {"choice": [0.001, 0.01]}}
    content = document(
        {"space": space, "sampler": "grid", "trials": None, "concurrent": 4}, seeds=[0]
    )
    content["stages"][0]["env_steps"] = 50_000
    Driver(tmp_path, content).play(stop_after=5, slots=1)
    recorded(tmp_path, content)
    state = json.loads((tmp_path / "results/s/state.json").read_text())
    assert state["env_steps"] == {"done": 112_000, "left": 4_000, "to_come": 0}


def test_a_failed_trial_pretrains_nothing_more(tmp_path: Path) -> None:
    space = {"pretrain:tac.alpha": {"choice": [0.1, 0.2]}}
    search = {"space": space, "sampler": "grid", "trials": None, "concurrent": 1}
    driver = Driver(tmp_path, document(search), lambda run, share: share)
    first = {"pretrain/FetchPush/tac.alpha=0.1/seed0"}
    driver.play(slots=1, fails=lambda node: node.label in first)
    assert [trial["state"] for trial in driver.trials()] == ["failed", "judged"]
    computed = [driver.sweep.plan.node(one.partition("/")[0]) for one in driver.computed]
    assert {node.run.tac.alpha for node in computed if node.stage == "pretrain"} == {0.2}
