"""Sittings put together: no run twice, none lost, and each with its own numbers."""

from typing import Any

import numpy as np

from music_rllib.reports.data import Points, RunRecord, Sweep, columns
from music_rllib.reports.merge import merged
from music_rllib.tracking import names


def sweep(*runs: tuple[str, str, list[float]], run_id: str = "s") -> Sweep:
    """(node, status, values at steps 0, 1, ...) each."""
    records = [
        RunRecord(
            run_id=f"{run_id}-{node}",
            name=node,
            status=status,
            started=0,
            ended=1,
            params={},
            tags={names.TAG_NODE_KEY: node},
        )
        for node, status, _ in runs
    ]
    points = [
        Points(["m"] * len(values), list(range(len(values))), [0] * len(values), values)
        for _, _, values in runs
    ]
    own: dict[str, Any] = {"name": "n", "status": "FINISHED", "experiment_id": "1", "started": 0}
    return Sweep(
        **own,
        run_id=run_id,
        source="x",
        tags={},
        config=None,
        runs=records,
        history=columns(points),
    )


def told(found: Sweep) -> dict[str, tuple[str, list[float]]]:
    return {
        run.node_key: (run.run_id, list(found.series(i, "m")[1]))
        for i, run in enumerate(found.runs)
    }


def test_runs_of_both_sittings_are_there_once_with_their_own_values() -> None:
    first = sweep(("a", "FINISHED", [1, 2]), ("b", "KILLED", [3]), ("c", "FINISHED", [4]))
    second = sweep(
        ("d", "FINISHED", [5, 6]), ("b", "FINISHED", [3, 7]), ("c", "FAILED", [0]), run_id="t"
    )
    found = merged(first, second)
    assert told(found) == {
        "a": ("s-a", [1, 2]),
        "b": ("t-b", [3, 7]),
        "c": ("s-c", [4]),
        "d": ("t-d", [5, 6]),
    }
    assert found.run_id == "t"


def test_an_unfinished_run_is_the_later_one_and_merging_again_changes_nothing() -> None:
    first, second = sweep(("a", "FAILED", [1])), sweep(("a", "RUNNING", []), run_id="t")
    assert told(merged(first, second)) == {"a": ("t-a", [])}
    whole = sweep(("a", "FINISHED", [1]), ("b", "FINISHED", [2]))
    assert told(merged(whole, whole)) == told(whole)
    empty = sweep()
    assert told(merged(empty, whole)) == told(merged(whole, empty)) == told(whole)
    assert np.all(np.diff(merged(whole, whole).history["m"].run) >= 0)
