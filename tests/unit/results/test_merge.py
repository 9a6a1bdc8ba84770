"""Merged exports have each run once, with its own values."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from docs.result_pages.exports import of_plan
from music_rllib import names
from music_rllib.experiment.plan import make_plan
from music_rllib.results.analysis_plan import AnalysisPlan, with_plan
from music_rllib.results.archive import merged
from music_rllib.results.data import Points, RunRecord, Sweep, columns
from music_rllib.version import ALGORITHM_VERSION
from tests.sweep_files import loaded


def sweep(*runs: tuple[str, str, list[float]], run_id: str = "s") -> Sweep:
    """A sweep of runs, each as (node, status, values at steps 0, 1, ...)."""
    records = [
        RunRecord(
            run_id=f"{run_id}-{node}",
            name=node,
            status=status,
            tags={names.TAG_NODE_KEY: node},
        )
        for node, status, _ in runs
    ]
    points = [
        Points(["m"] * len(values), list(range(len(values))), [0] * len(values), values)
        for _, _, values in runs
    ]
    return Sweep(name="n", source=run_id, runs=records, history=columns(points))


def values_of(found: Sweep) -> dict[str, tuple[str, list[float]]]:
    """Run id and values of each node."""
    return {
        run.node_key: (run.run_id, list(found.series(i, "m")[1]))
        for i, run in enumerate(found.runs)
    }


def test_merging_keeps_each_run_once_with_its_values() -> None:
    first = sweep(("a", "FINISHED", [1, 2]), ("b", "KILLED", [3]), ("c", "FINISHED", [4]))
    second = sweep(
        ("d", "FINISHED", [5, 6]), ("b", "FINISHED", [3, 7]), ("c", "FAILED", [0]), run_id="t"
    )
    found = merged(first, second)
    assert values_of(found) == {
        "a": ("s-a", [1, 2]),
        "b": ("t-b", [3, 7]),
        "c": ("s-c", [4]),
        "d": ("t-d", [5, 6]),
    }
    assert found.source == "t"


def test_of_unfinished_runs_the_later_one_is_kept() -> None:
    first, second = sweep(("a", "FAILED", [1])), sweep(("a", "RUNNING", []), run_id="t")
    assert values_of(merged(first, second)) == {"a": ("t-a", [])}
    whole = sweep(("a", "FINISHED", [1]), ("b", "FINISHED", [2]))
    assert values_of(merged(whole, whole)) == values_of(whole)
    empty = sweep()
    assert values_of(merged(empty, whole)) == values_of(merged(whole, empty)) == values_of(whole)
    assert np.all(np.diff(merged(whole, whole).history["m"].run) >= 0)


def test_a_later_plan_for_fewer_seeds_is_not_another_version() -> None:
    """Otherwise its runs would count as trained after a change of the plan."""

    def recorded(at: int, seeds: str) -> Sweep:
        plan = AnalysisPlan(
            question=None,
            hypotheses=("q = 2 worse than q = 1",),
            stage="s",
            metric="auc",
            primary_metric="p",
            margin=0.05,
            seeds=seeds,
            control="c",
            budget={},
            test="t",
        )
        return replace(sweep(), plans=with_plan((), plan, at))

    whole, part, more = recorded(1, "0, 1, 12"), recorded(2, "12, 1"), recorded(3, "0, 1, 2")
    assert merged(whole, part).plans == merged(part, whole).plans == whole.plans
    assert merged(whole, more).plans == (*whole.plans, *more.plans)
    # Additional seeds are a new version.
    early, late = recorded(1, "0, 1"), recorded(2, "0, 1, 2")
    assert merged(early, late).plans == (*early.plans, *late.plans)
    # Fewer seeds in the same storage are a change of the plan.
    changed = replace(whole, plans=(*whole.plans, *recorded(2, "0, 1").plans))
    assert merged(whole, changed).plans == merged(changed, changed).plans == changed.plans


def test_runs_of_a_plan_are_found_in_exports_of_other_sweeps(tmp_path: Path) -> None:
    text = (
        "{name: mine, tasks: [FetchPush], seeds: [0, 1, 2], "
        "stages: [{name: first, variant: tac, grid: {tac.entropic_index: [1.0, 2.0]}}]}"
    )
    plan = make_plan(loaded(tmp_path, text))
    keys = [node.key for node in plan.nodes]
    exports = [
        sweep(("other", "FINISHED", [9]), (keys[4], "FINISHED", [1, 2]), (keys[0], "KILLED", [3])),
        sweep((keys[0], "FINISHED", [4]), (keys[4], "FAILED", [5]), run_id="t"),
    ]
    found = of_plan(plan, exports)
    assert found is not None
    assert values_of(found) == {keys[0]: ("t-" + keys[0], [4]), keys[4]: ("s-" + keys[4], [1, 2])}
    assert [(run.name, run.stage, run.tags[names.TAG_TRIAL]) for run in found.runs] == [
        ("first/FetchPush/tac.entropic_index=1/seed0", "first", "0"),
        ("first/FetchPush/tac.entropic_index=2/seed1", "first", "1"),
    ]
    assert of_plan(plan, [sweep(("other", "FINISHED", [9]))]) is None


def test_runs_of_an_earlier_algorithm_replace_missing_ones(
    tmp_path: Path,
) -> None:
    """A run and the runs that start from it have the same version of the algorithm."""
    config = loaded(
        tmp_path,
        "{name: mine, tasks: [FetchPush], seeds: [0, 1], stages: [{name: u, variant: music-u},"
        " {name: r, variant: music-r, init_from: u}]}",
    )
    plan, earlier = make_plan(config), make_plan(config, algorithm="2")
    now, before = ([node.key for node in one.nodes] for one in (plan, earlier))
    assert not set(now) & set(before)
    exports = [
        sweep(*((key, "FINISHED", [2.0]) for key in before)),
        sweep((now[1], "FINISHED", [3])),
    ]
    found = of_plan(plan, exports, earlier)
    assert found is not None
    # The run that starts from it has the earlier version and did not start from this one.
    assert [run.node_key for run in found.runs] == before
    found = of_plan(plan, [*exports, sweep((now[3], "FINISHED", [4]))], earlier)
    assert found is not None
    assert [run.node_key for run in found.runs] == [before[0], now[1], before[2], now[3]]
    algorithms = [run.tags[names.TAG_ALGORITHM] for run in found.runs]
    assert algorithms == ["2", ALGORITHM_VERSION] * 2
