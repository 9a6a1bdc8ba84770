"""The points of trials: a function of the settings, the trial's number and earlier results.

Each trial has its own sampler, seeded by the study's seed and the trial's number, with the results
of exactly the trials up to `number - concurrent`. Therefore the points depend neither on the order
in which runs finish, nor on the number of drivers, nor on interruptions. No trial repeats the point
of an earlier one while other points remain: the sampler proposes again, and if it repeats itself,
the trial gets the nearest remaining point.
"""

from __future__ import annotations

import hashlib
import json
import random
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.exceptions import ExperimentalWarning
from optuna.samplers import BaseSampler, CmaEsSampler, NSGAIISampler, RandomSampler, TPESampler
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState, create_trial

from music_rllib.config.problems import same
from music_rllib.config.search import SearchSettings
from music_rllib.config.space import Choice, Dimension, FloatRange, IntRange

VALUES = "values"
"""Attribute of a trial: its point."""
ATTEMPTS = 8
"""Proposals of a sampler for one trial before the nearest remaining point is used."""
DRAWS = 200
"""Random points that are drawn if the space's points cannot be counted."""
DIGITS = 6
"""Significant digits of a proposed number: with more digits, the hash of a point would depend on
the last bit of a machine's logarithm."""

optuna.logging.set_verbosity(optuna.logging.WARNING)


class Proposer:
    """Proposes the points of one study."""

    def __init__(self, settings: SearchSettings, points: Sequence[Mapping[str, Any]] = ()) -> None:
        """Propose `points` first."""
        self._settings = settings
        self._points = list(points)

    def propose(
        self, number: int, ended: Sequence[FrozenTrial], running: Sequence[FrozenTrial]
    ) -> FrozenTrial:
        """A waiting trial at the point of trial `number`.

        Args:
            number: The trial's number, from 0.
            ended: Trials 0 to `number - concurrent`, all of them ended.
            running: The trials between those and `number`, which have points.
        """
        space = self._settings.space
        tried = {_key(space, trial.user_attrs[VALUES]) for trial in (*ended, *running)}
        if self._settings.sampler == "grid":
            points = self._settings.points or []
            # Another, if earlier trials had the keys of the space in another order.
            left = (p for p in (points[number], *points) if _key(space, p) not in tried)
            return trial_at(space, next(left))
        given = self._points[number] if number < len(self._points) else {}
        if given and _key(space, given) in tried:
            given = {}
        study = optuna.create_study(
            directions=directions_of(self._settings), sampler=self._sampler(number)
        )
        study.add_trials(ended)
        for other in running:
            study.add_trial(
                create_trial(
                    state=TrialState.RUNNING,
                    params=dict(other.params),
                    distributions=dict(other.distributions),
                )
            )
        countable = self._settings.points is not None
        for attempt in range(ATTEMPTS if countable else ATTEMPTS + 2 * DRAWS):
            if attempt == ATTEMPTS:
                study.sampler = RandomSampler(seed=self._seed(number) ^ 1)
            if attempt == ATTEMPTS + DRAWS:  # no remaining point has the given values
                given = {}
            values = self._sampled(study, given)
            if _key(space, values) not in tried:
                break
        else:
            values = self._nearest(values, tried, given, self._seed(number)) or values
        system_attrs = dict(study.get_trials(deepcopy=False)[-1].system_attrs)
        system_attrs.pop("fixed_params", None)
        return trial_at(space, values, system_attrs=system_attrs)

    def _sampled(self, study: optuna.Study, given: Mapping[str, Any]) -> dict[str, Any]:
        """A point from the sampler, with the `given` values."""
        if given:
            study.enqueue_trial(_encoded(self._settings.space, given))
        values: dict[str, Any] = {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            trial = study.ask()
            for name, dimension in self._settings.space.items():
                if dimension.applies(values):
                    values[name] = _suggest(trial, name, dimension)
                    if name in given and isinstance(dimension, FloatRange):
                        values[name] = float(given[name])  # as written in the file, not rounded
        return values

    def _nearest(
        self, values: Mapping[str, Any], tried: set[str], given: Mapping[str, Any], seed: int
    ) -> dict[str, Any] | None:
        """The nearest untried point, with the `given` values if such a point remains."""
        space = self._settings.space
        left = [p for p in self._settings.points or () if _key(space, p) not in tried]
        fitting = [p for p in left if all(same(p.get(name), given[name]) for name in given)]
        left = fitting or left
        random.Random(seed).shuffle(left)
        return min(left, key=lambda point: _distance(space, values, point), default=None)

    def _seed(self, number: int) -> int:
        digest = hashlib.sha256(f"{self._settings.seed}/{number}".encode()).digest()
        return int.from_bytes(digest[:4], "big")

    def _sampler(self, number: int) -> BaseSampler:
        settings, seed = self._settings, self._seed(number)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            match settings.sampler:
                case "tpe":
                    return TPESampler(
                        n_startup_trials=settings.startup_trials,
                        # Running trials count as bad, so that their points are not proposed again.
                        constant_liar=True,
                        seed=seed,
                    )
                case "cmaes":
                    return CmaEsSampler(
                        n_startup_trials=settings.startup_trials,
                        popsize=settings.population,
                        consider_pruned_trials=False,
                        warn_independent_sampling=False,
                        seed=seed,
                    )
                case "nsga2":
                    return NSGAIISampler(population_size=settings.population, seed=seed)
        return RandomSampler(seed=seed)


def directions_of(settings: SearchSettings) -> list[StudyDirection]:
    """Optuna's direction of each objective."""
    return [
        StudyDirection.MAXIMIZE if objective.maximised else StudyDirection.MINIMIZE
        for objective in settings.objectives
    ]


def _key(space: Mapping[str, Dimension], values: Mapping[str, Any]) -> str:
    """A text that equal points share, whatever the last bits of their numbers."""
    params = _encoded(space, values)
    numbers = (name for name in values if not isinstance(space[name], Choice))
    return _json(params | {name: f"{values[name]:.12g}" for name in numbers})


def _distance(
    space: Mapping[str, Dimension], one: Mapping[str, Any], other: Mapping[str, Any]
) -> float:
    """Sum over the dimensions: 1 for another choice, a fraction of the range for numbers."""
    total = 0.0
    for name, dimension in space.items():
        if name in one and name in other and not isinstance(dimension, Choice):
            low, high = dimension.bounds
            total += abs(one[name] - other[name]) / (high - low)
        else:
            total += not same(one.get(name), other.get(name))
    return total


def trial_at(
    space: Mapping[str, Dimension],
    values: Mapping[str, Any],
    objective: Sequence[float] | None = None,
    system_attrs: Mapping[str, Any] | None = None,
) -> FrozenTrial:
    """A trial at a point: complete if its `objective` values are given, else waiting."""
    return create_trial(
        state=TrialState.WAITING if objective is None else TrialState.COMPLETE,
        values=objective,
        params=_encoded(space, values),
        distributions={name: _distribution(space[name]) for name in values},
        user_attrs={VALUES: dict(values)},
        system_attrs=dict(system_attrs or {}),
    )


def _distribution(dimension: Dimension) -> BaseDistribution:
    match dimension:
        case FloatRange():
            low, high = dimension.ends()
            return FloatDistribution(low, high, log=dimension.log, step=dimension.step)
        case IntRange():
            low, high = dimension.ends()
            return IntDistribution(low, high, log=dimension.log, step=dimension.step)
        case Choice():
            return CategoricalDistribution([_plain(value) for value in dimension.choice])


def _suggest(trial: optuna.Trial, name: str, dimension: Dimension) -> Any:
    match dimension:
        case FloatRange():
            low, high = dimension.ends()
            value = trial.suggest_float(name, low, high, log=dimension.log, step=dimension.step)
            digits = DIGITS if dimension.step is None else 12
            return min(max(float(f"{value:.{digits}g}"), low), high)
        case IntRange():
            low, high = dimension.ends()
            return trial.suggest_int(name, low, high, log=dimension.log, step=dimension.step)
        case Choice():
            chosen = trial.suggest_categorical(name, [_plain(value) for value in dimension.choice])
            return next(v for v in dimension.choice if _json(_plain(v)) == _json(chosen))


def _plain(value: Any) -> Any:
    """A value as a category of Optuna: a scalar, or JSON text for anything else."""
    return value if value is None or isinstance(value, bool | int | float | str) else _json(value)


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True)


def _encoded(space: Mapping[str, Dimension], values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a point in Optuna."""
    params = dict(values)
    for name, value in values.items():
        if isinstance(dimension := space[name], Choice):
            # The equal value of the choice: Optuna must find 1 in [1.0, 1.5].
            params[name] = _plain(next(v for v in dimension.choice if same(v, value)))
    return params
