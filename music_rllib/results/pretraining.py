"""Steps of a run and of the runs that it starts from, as one curve."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from music_rllib.results.data import Column, History, Sweep, joined


class _Computed(Mapping[str, Column]):
    """Columns computed from those of another history when they are first read."""

    def __init__(self, history: History, of: Callable[[Column], Column]) -> None:
        self._history, self._of = history, of
        self._known: dict[str, Column] = {}

    def __getitem__(self, metric: str) -> Column:
        if metric not in self._known:
            self._known[metric] = self._of(self._history[metric])
        return self._known[metric]

    def __iter__(self) -> Iterator[str]:
        return iter(self._history)

    def __len__(self) -> int:
        return len(self._history)


def with_pretraining(sweep: Sweep) -> Sweep:
    """The sweep with steps that count from the first step of each run's pretraining.

    A run that starts from another run of the sweep has the curves of that run before its own, and
    its budget is the sum of both.
    """
    position = {run.node_key: i for i, run in enumerate(sweep.runs) if run.node_key}
    budgets = [run.budget or sweep.last_step(i) for i, run in enumerate(sweep.runs)]
    chains = [[i] for i in range(len(budgets))]
    for chain in chains:  # each ends with the run, and begins with the one from scratch
        while (source := position.get(sweep.runs[chain[0]].source, -1)) not in (-1, *chain):
            chain.insert(0, source)

    def whole(column: Column, chain: Sequence[int]) -> Column:
        before, parts = 0, []
        for part in chain:
            own = column.of_run(part)
            own = own.select(own.step <= budgets[part])
            parts.append(own._replace(run=0 * own.run + chain[-1], step=own.step + before))
            before += budgets[part]
        curve = joined(parts)
        return curve.select(np.diff(curve.step, append=np.iinfo(np.int64).max) > 0)

    history = _Computed(
        sweep.history, lambda column: joined([whole(column, chain) for chain in chains])
    )
    runs = [
        replace(run, params={**run.params, "env_steps": str(sum(budgets[i] for i in chain))})
        for run, chain in zip(sweep.runs, chains, strict=True)
    ]
    return replace(sweep, runs=runs, history=history)


def counted(sweep: Sweep, kind: str) -> Sweep:
    """The sweep with the environment steps that a measure of this kind counts."""
    return with_pretraining(sweep) if kind == "auc_total" else sweep
