"""The score of each seed, by which conditions are compared.

The default score is the area under the learning curve: the mean of a metric over the budget. It
weighs speed and final performance equally. Steps to a threshold are biased early by noisy
evaluations (an agent at 85% passes "90% of 50 episodes" in 22% of its evaluations), and final
values do not differ once all runs are at the ceiling.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from music_rllib import names
from music_rllib.results.conditions import Condition
from music_rllib.results.data import Column, Sweep, joined
from music_rllib.results.statistics import Array


@dataclass(frozen=True, kw_only=True)
class Measure:
    """The number by which a run is compared."""

    kind: str
    """`auc`: the mean of `metric` over the budget, the area under its curve. `auc_total`: the same
    with the steps of pretraining (`with_pretraining`). `final`: its last value."""
    metric: str
    horizon: float
    """Environment steps of the area: the smallest budget of the compared runs. NaN for several
    tasks with different horizons."""
    maximised: bool = True
    worst: float = np.nan
    until: Mapping[str, float] = field(default_factory=dict)
    """By stage: environment steps at which its final values are read, if runs have more than
    planned; infinite: their last. NaN for several tasks with different steps."""

    @property
    def is_rate(self) -> bool:
        """Whether it is a share of episodes, between 0 and 1."""
        return self.metric in names.EVAL_RATES

    @property
    def kind_in_words(self) -> str:
        """`area under the curve`, or `final value`."""
        return "final value" if self.kind == "final" else "area under the curve"

    @property
    def words(self) -> str:
        """`mean success over 100,000 steps`."""
        word = names.word_of(self.metric)
        if self.kind == "final":
            steps = {*self.until.values()}
            (only,) = steps if len(steps) == 1 else (np.nan,)
            at = f" at {only:,.0f} steps" if np.isfinite(only) else " at the planned steps"
            return f"final {word}{at * bool(steps)}"
        budget = "the budget" if np.isnan(self.horizon) else f"{self.horizon:,.0f} steps"
        return f"mean {word} over {budget}" + ", pretraining included" * (self.kind == "auc_total")


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of one condition on one task."""

    by_seed: Mapping[str, float]
    """Scores of the finished runs, and the worst score for each failed run."""
    episodes: float
    """Mean number of evaluation episodes behind a score; infinite if unknown."""
    noise: float
    """Mean variance of a rate's score from its evaluation episodes alone; 0 if unknown."""
    failed: int
    runs: int
    unfinished: int
    """Number of runs that are neither finished nor failed."""

    @property
    def finished(self) -> int:
        return len(self.by_seed) - self.failed


def measure_on(
    sweep: Sweep,
    task: str,
    runs: Iterable[int],
    kind: str,
    metric: str | None = None,
    *,
    maximised: bool = True,
    horizon: float = np.inf,
    until: Mapping[str, float] | None = None,
) -> Measure:
    """The measure by which runs on a task are compared.

    A failed run has the worst score: 0 for a rate, the lowest possible return if the reward's range
    is known, else the worst score of the runs of the compared stages.

    Args:
        runs: Positions of all runs that are compared.
        kind: As in `Measure`, like `maximised`.
        metric: None: the task's primary one.
        horizon: Largest number of environment steps.
        until: As in `Measure`.
    """
    own = [run for run in runs if sweep.runs[run].task == task]
    measure = Measure(
        kind=kind,
        metric=metric or sweep.primary_metric(task),
        horizon=min(horizon, sweep.least_budget(task, own)),
        maximised=maximised,
        until=until or {},
    )
    if not any(has_failed(sweep, run, measure.metric) for run in own):
        return measure
    # The whole stage, so that a failed run has one score in all comparisons of a report.
    stages = {sweep.runs[run].stage for run in own}
    peers = [i for i, run in enumerate(sweep.runs) if run.task == task and run.stage in stages]
    return replace(measure, worst=_worst(sweep, peers, measure))


def has_failed(sweep: Sweep, run: int, metric: str | None = None) -> bool:
    """Whether a run ended with an error, or diverged to a score that is not a number.

    The metric of the score is `metric`, or the primary one.
    """
    record = sweep.runs[run]
    values = sweep.column(run, metric or sweep.primary_metric(record.task)).value
    diverged = record.is_finished and len(values) > 0 and not np.isfinite(values[-1])
    return record.status == "FAILED" or diverged


def _worst(sweep: Sweep, runs: Sequence[int], measure: Measure) -> float:
    if measure.is_rate:
        return 0.0 if measure.maximised else 1.0
    params = sweep.runs[runs[0]].params
    if measure.metric == names.EVAL_RETURN and measure.maximised:
        with suppress(KeyError, ValueError):
            low = float(params["task.reward_range"].strip("[]").split(",")[0])
            return min(low, low * int(params["task.horizon"]))
    scores = [_score(sweep, run, measure) for run in runs]
    known = [score for score in scores if np.isfinite(score)]
    worst = min if measure.maximised else max
    return worst(known, default=np.nan)


def _score(sweep: Sweep, run: int, measure: Measure) -> float:
    """The score of a run; NaN if it is unfinished or was not evaluated up to the horizon."""
    if not sweep.runs[run].is_finished or has_failed(sweep, run, measure.metric):
        return np.nan
    steps, values = sweep.finite(run, measure.metric)
    if measure.kind != "final" and measure.horizon > 0:
        return area_under_curve(steps, values, measure.horizon)
    until = measure.until.get(sweep.runs[run].stage, np.inf)
    return float(values[_end(steps, until)]) if len(values) else np.nan


def _end(steps: Array, until: float) -> int:
    """Position of the final value: the first evaluation at `until` or later, or the last one."""
    return min(int(np.searchsorted(steps, until)), len(steps) - 1)


def scores_of(sweep: Sweep, condition: Condition, task: str, measure: Measure) -> Scores:
    """The scores of a condition's runs on a task.

    A failed run has the worst score: without it, a condition would look better the more of its runs
    fail. An unfinished run has no score.
    """
    runs = [run for run in condition.runs if sweep.runs[run].task == task]
    failed = {run for run in runs if has_failed(sweep, run, measure.metric)}
    scores = {run: measure.worst if run in failed else _score(sweep, run, measure) for run in runs}
    known = {run: score for run, score in scores.items() if np.isfinite(score)}
    evaluated = [_evaluations(sweep, run, measure) for run in known if run not in failed]
    noise = [_noise(*one) for one in evaluated if np.isfinite(one[1])] if measure.is_rate else []
    return Scores(
        by_seed={sweep.runs[run].seed: score for run, score in known.items()},
        episodes=float(np.mean([e * len(rates) for rates, e in evaluated]))
        if evaluated
        else np.inf,
        noise=float(np.mean(noise)) if noise else 0.0,
        failed=len(failed & known.keys()),
        runs=len(runs),
        unfinished=sum(not sweep.runs[run].is_finished for run in runs if run not in failed),
    )


def _evaluations(sweep: Sweep, run: int, measure: Measure) -> tuple[Array, float]:
    """The values behind a run's score, and the episodes of each; infinite if unknown."""
    steps, values = sweep.finite(run, measure.metric)
    whole = measure.kind != "final" and measure.horizon > 0
    episodes = sweep.final(run, names.EVAL_EPISODES)
    end = _end(steps, measure.until.get(sweep.runs[run].stage, np.inf))
    used = values[steps <= max(measure.horizon, steps[0])] if whole else values[end : end + 1]
    return used, np.inf if episodes is None else episodes


def _noise(rates: Array, episodes: float) -> float:
    """Variance of a mean of rates from their episodes alone.

    Half an episode is added to both outcomes: a rate of 0 or 1 is not certain.
    """
    rates = (rates * episodes + 0.5) / (episodes + 1)
    return float(np.mean(rates * (1 - rates))) / max(episodes * len(rates), 1)


def area_under_curve(steps: Array, values: Array, horizon: float) -> float:
    """Mean of a learning curve over environment steps 0 to `horizon`, by the trapezoid rule.

    Before the first evaluation the curve has its value. A horizon between two evaluations cuts the
    line between them.

    Args:
        steps: `[points]` of the evaluations, increasing.
        values: `[points]`, finite.
        horizon: Environment steps, > 0.

    Returns:
        The mean in the metric's unit; NaN without an evaluation at `horizon` or later.
    """
    if not len(steps) or steps[-1] < horizon:
        return np.nan
    inside = steps[(steps > 0) & (steps < horizon)]
    at = np.concatenate([[0.0], inside, [horizon]])
    return float(np.trapezoid(np.interp(at, steps, values), at) / horizon)


def first_result(sweep: Sweep, runs: Iterable[int]) -> float:
    """Time of the earliest last evaluation of a finished run, in ms since the epoch.

    It is infinite before any run has finished. A run that another sweep trained counts at the time
    of its training. So does a run of an earlier plan with other `env_steps`.
    """
    ends = []
    for run in runs:
        record = sweep.runs[run]
        times = sweep.column(run, sweep.primary_metric(record.task)).time
        if record.is_finished and len(times):
            ends.append(float(times[-1]))
        with suppress(ValueError):
            ends.append(float(record.tags.get(names.TAG_EARLIER_RESULT, "")))
    return min(ends, default=np.inf)


def with_pretraining(sweep: Sweep) -> Sweep:
    """The sweep with steps that count from the first step of each run's pretraining.

    A run that starts from another run of the sweep has the curves of that run before its own, and
    its budget is the sum of both. Of a run on another task only the steps count: its values are not
    those of the task.
    """
    position = {run.node_key: i for i, run in enumerate(sweep.runs) if run.node_key}
    budgets = [run.budget or sweep.last_step(i) for i, run in enumerate(sweep.runs)]
    chains = [[i] for i in range(len(budgets))]
    for chain in chains:  # each ends with the run, and begins with the one from scratch
        while (source := position.get(sweep.runs[chain[0]].source, -1)) not in (-1, *chain):
            chain.insert(0, source)

    def whole(metric: str, chain: Sequence[int]) -> Column:
        column, before, parts = sweep.history[metric], 0, []
        for part in chain:
            own = column.of_run(part)
            if part != chain[-1]:  # the last evaluation of a run can be after its budget
                same_task = sweep.runs[part].task == sweep.runs[chain[-1]].task
                own = own.select((own.step <= budgets[part]) & same_task)
            parts.append(own._replace(run=0 * own.run + chain[-1], step=own.step + before))
            before += budgets[part]
        curve = joined(parts)
        return curve.select(np.diff(curve.step, append=np.iinfo(np.int64).max) > 0)

    def of_all(metric: str) -> Column:
        return joined([whole(metric, chain) for chain in chains])

    runs = [
        replace(run, params={**run.params, "env_steps": str(sum(budgets[i] for i in chain))})
        for run, chain in zip(sweep.runs, chains, strict=True)
    ]
    return replace(sweep, runs=runs, history=_WhenRead(sweep.history, of_all))


class _WhenRead(Mapping[str, Column]):
    """The columns of these metrics, each computed when it is first read: most are not."""

    def __init__(self, metrics: Collection[str], column: Callable[[str], Column]) -> None:
        self._metrics, self._column = metrics, cache(column)

    def __getitem__(self, metric: str) -> Column:
        if metric not in self._metrics:
            raise KeyError(metric)
        return self._column(metric)

    def __iter__(self) -> Iterator[str]:
        return iter(self._metrics)

    def __len__(self) -> int:
        return len(self._metrics)


def counted(sweep: Sweep, kind: str) -> Sweep:
    """The sweep with the environment steps that a measure of this kind counts."""
    return with_pretraining(sweep) if kind == "auc_total" else sweep
