"""Two exports of one sweep as one: what several sittings on several machines have computed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from music_rllib.reports.data import Column, Ints, RunRecord, Sweep

__all__ = ["merged"]

FINISHED = "FINISHED"


def merged(earlier: Sweep, later: Sweep) -> Sweep:
    """Every run of either; of a run that both have, the finished one, or else the later one.

    Runs are the same where their node is: the hash of everything that determines their numbers.
    The sweep's own fields are those of `later`.
    """
    of_later = {run.node_key: run for run in later.runs}
    of_earlier = {run.node_key: run for run in earlier.runs}

    def earlier_stays(run: RunRecord) -> bool:
        other = of_later.get(run.node_key)
        return other is None or (run.status == FINISHED and other.status != FINISHED)

    def later_stays(run: RunRecord) -> bool:
        other = of_earlier.get(run.node_key)
        return other is None or not earlier_stays(other)

    first = [i for i, run in enumerate(earlier.runs) if earlier_stays(run)]
    second = [i for i, run in enumerate(later.runs) if later_stays(run)]
    runs = [*(earlier.runs[i] for i in first), *(later.runs[i] for i in second)]
    metrics = sorted(earlier.history.keys() | later.history.keys())
    history = {
        metric: joined
        for metric in metrics
        if len((joined := _joined(earlier, first, later, second, metric)).run)
    }
    return replace(later, runs=runs, history=history)


def _joined(
    earlier: Sweep, first: Sequence[int], later: Sweep, second: Sequence[int], metric: str
) -> Column:
    parts = [
        *_kept(earlier.history.get(metric), first, 0),
        *_kept(later.history.get(metric), second, len(first)),
    ]
    return Column(
        run=_concatenated((part.run for part in parts), np.int64),
        step=_concatenated((part.step for part in parts), np.int64),
        value=_concatenated((part.value for part in parts), np.float64),
        time=_concatenated((part.time for part in parts), np.int64),
    )


def _kept(column: Column | None, runs: Sequence[int], offset: int) -> Iterable[Column]:
    """The values of `runs`, which become the runs from `offset` on."""
    if column is None or not runs:
        return
    wanted: Ints = np.asarray(runs, dtype=np.int64)
    place = np.searchsorted(wanted, column.run)
    chosen = np.flatnonzero(wanted[np.minimum(place, len(wanted) - 1)] == column.run)
    yield Column(
        run=place[chosen] + offset,
        step=column.step[chosen],
        value=column.value[chosen],
        time=column.time[chosen],
    )


def _concatenated(parts: Iterable[np.ndarray], kind: type) -> np.ndarray:
    return np.concatenate([np.empty(0, kind), *parts]).astype(kind)
