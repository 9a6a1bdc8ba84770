"""A score for each seed: what the runs of a condition are compared by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from music_rllib import names
from music_rllib.results.claims.area import area_under_curve
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Sweep

__all__ = ["Measure", "Scores", "ended_first", "measure_on", "scores_of"]

FINISHED = "FINISHED"


@dataclass(frozen=True, kw_only=True)
class Measure:
    """What counts of a run."""

    kind: str
    """`auc`: the area under the curve of `metric` over the budget, its mean; `final`: its last
    value."""
    metric: str
    horizon: float
    """Environment steps of the area: the smallest budget of what is compared; NaN for tasks
    together, each of which has its own."""
    maximised: bool = True

    @property
    def is_rate(self) -> bool:
        """Whether it is a share of episodes, within 0 and 1."""
        return self.metric in names.EVAL_RATES

    @property
    def words(self) -> str:
        """`mean success over 100,000 steps`."""
        word = names.word_of(self.metric)
        if self.kind == "final":
            return f"final {word}"
        budget = "the budget" if np.isnan(self.horizon) else f"{self.horizon:,.0f} steps"
        return f"mean {word} over {budget}"


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Of one condition on one task."""

    by_seed: Mapping[str, float]
    """Of the runs that have finished."""
    episodes: float
    """Evaluation episodes behind each, mean of the runs; infinite where they are not known."""


def measure_on(
    sweep: Sweep, task: str, runs: Sequence[int], kind: str, metric: str | None = None
) -> Measure:
    """What the runs on a task are compared by, over a budget that each of them has."""
    metric = metric or sweep.primary_metric(task)
    budgets = [
        float(sweep.runs[run].budget or sweep.last_step(run))
        for run in runs
        if sweep.runs[run].task == task
    ]
    return Measure(kind=kind, metric=metric, horizon=min(budgets, default=0.0))


def scores_of(sweep: Sweep, condition: Condition, task: str, measure: Measure) -> Scores:
    """The scores of a condition's finished runs on a task; an unfinished run has none.

    What a run would have come to is not known before its end, even where its curve is there as far
    as another's: those that fail early are not like the others.
    """
    by_seed, episodes = {}, []
    for run in condition.runs:
        record = sweep.runs[run]
        if record.task != task or record.status != FINISHED:
            continue
        steps, values = sweep.finite(run, measure.metric)
        score, evaluations = values[-1] if len(values) else np.nan, 1
        if measure.kind == "auc" and measure.horizon > 0:
            score = area_under_curve(steps, values, measure.horizon)
            evaluations = int(np.sum(steps <= measure.horizon))
        if not np.isnan(score):
            by_seed[record.seed] = float(score)
            found = sweep.final(run, names.EVAL_EPISODES)
            episodes.append(np.inf if found is None else found * evaluations)
    return Scores(by_seed=by_seed, episodes=float(np.mean(episodes)) if episodes else np.inf)


def ended_first(sweep: Sweep, runs: Sequence[int]) -> float:
    """When the first of the finished runs had its last evaluation, ms since the epoch.

    Infinite before any has finished. A run that was taken over from another sweep counts when that
    one computed it.
    """
    ends = []
    for run in runs:
        record = sweep.runs[run]
        column = sweep.history.get(sweep.primary_metric(record.task))
        if record.status == FINISHED and column is not None:
            begin, end = np.searchsorted(column.run, [run, run + 1])
            if end > begin:
                ends.append(float(column.time[end - 1]))
    return min(ends, default=np.inf)
