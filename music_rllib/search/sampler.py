"""Which point comes next: a function of the settings, the trial's number and earlier results.

Each trial has a sampler of its own, seeded by the study's seed and the trial's number, which sees
the results of exactly the trials up to `number - concurrent`. So it doesn't matter in which order
runs finish, how many drivers there are, or whether the study was interrupted: the points are the
same.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
from optuna.trial import FrozenTrial, TrialState, create_trial

from music_rllib.config.problems import same
from music_rllib.config.search.settings import SearchSettings
from music_rllib.config.search.space import Choice, Dimension, FloatRange, IntRange

__all__ = ["Proposal", "Proposer", "as_proposal", "decoded", "seed_of"]

DIGITS = 6
"""Significant digits of a proposed number: more would make a point's hash depend on the last bit of
a machine's logarithm."""

optuna.logging.set_verbosity(optuna.logging.WARNING)


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """A trial's point."""

    values: Mapping[str, Any]
    """Dotted setting to value."""
    params: Mapping[str, Any]
    """The same as Optuna keeps it: mappings and lists as JSON text."""
    distributions: Mapping[str, BaseDistribution]
    system_attrs: Mapping[str, Any] = field(default_factory=dict)
    """What the sampler wants to find again."""


def seed_of(seed: int, number: int) -> int:
    """The seed of trial `number`'s sampler."""
    digest = hashlib.sha256(f"{seed}/{number}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


class Proposer:
    """Proposes the points of one study."""

    def __init__(
        self,
        settings: SearchSettings,
        points: Sequence[Mapping[str, Any]] = (),
        prior: Sequence[FrozenTrial] = (),
    ) -> None:
        """Propose `points` first, and learn from the finished trials `prior` of an older study."""
        self._settings = settings
        self._points = list(points)
        self._prior = list(prior)
        self._grid = settings.grid() if settings.sampler == "grid" else []

    def propose(
        self, number: int, judged: Sequence[FrozenTrial], running: Sequence[FrozenTrial]
    ) -> Proposal:
        """The point of trial `number`.

        Args:
            number: The trial's number, from 0.
            judged: Trials 0 to `number - concurrent`, all of them ended.
            running: The trials after those and before `number`, whose points are known.
        """
        if self._grid:
            return as_proposal(self._settings.space, self._grid[number])
        study = optuna.create_study(
            directions=[
                "maximize" if o.maximised else "minimize" for o in self._settings.objectives
            ],
            sampler=self._sampler(number),
        )
        study.add_trials([*self._prior, *judged])
        for other in running:
            study.add_trial(
                create_trial(
                    state=TrialState.RUNNING,
                    params=dict(other.params),
                    distributions=dict(other.distributions),
                )
            )
        given = self._points[number] if number < len(self._points) else {}
        if given:
            study.enqueue_trial(_encoded(self._settings.space, given))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            trial = study.ask()
            values: dict[str, Any] = {}
            for name, dimension in self._settings.space.items():
                if dimension.applies(values):
                    values[name] = _suggest(trial, name, dimension)
                    if name in given and isinstance(dimension, FloatRange):
                        values[name] = float(given[name])  # not rounded: a person wrote it
        proposal = as_proposal(self._settings.space, values)
        kept = {
            key: value
            for key, value in study.get_trials(deepcopy=False)[-1].system_attrs.items()
            if key != "fixed_params"
        }
        return Proposal(
            values=proposal.values,
            params=proposal.params,
            distributions=proposal.distributions,
            system_attrs=kept,
        )

    def _sampler(self, number: int) -> BaseSampler:
        settings = self._settings
        seed = seed_of(settings.seed, number)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            match settings.sampler:
                case "tpe":
                    return TPESampler(
                        n_startup_trials=settings.startup_trials,
                        # Points that are being judged count as bad, so that no two are the same.
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


def as_proposal(space: Mapping[str, Dimension], values: Mapping[str, Any]) -> Proposal:
    """A given point as a proposal."""
    return Proposal(
        values=dict(values),
        params=_encoded(space, values),
        distributions={name: _distribution(space[name]) for name in values},
    )


def _distribution(dimension: Dimension) -> BaseDistribution:
    match dimension:
        case FloatRange():
            low, high = dimension.reachable
            return FloatDistribution(low, high, log=dimension.log, step=dimension.step)
        case IntRange():
            low, high = dimension.reachable
            return IntDistribution(low, high, log=dimension.log, step=dimension.step)
        case Choice():
            return CategoricalDistribution([_plain(value) for value in dimension.choice])


def _suggest(trial: optuna.Trial, name: str, dimension: Dimension) -> Any:
    match dimension:
        case FloatRange():
            low, high = dimension.reachable
            value = trial.suggest_float(name, low, high, log=dimension.log, step=dimension.step)
            digits = DIGITS if dimension.step is None else 12
            return min(max(float(f"{value:.{digits}g}"), low), high)
        case IntRange():
            low, high = dimension.reachable
            return trial.suggest_int(name, low, high, log=dimension.log, step=dimension.step)
        case Choice():
            chosen = trial.suggest_categorical(name, [_plain(value) for value in dimension.choice])
            return decoded(dimension, chosen)


def _plain(value: Any) -> Any:
    """As Optuna's categories are: scalars as they are, anything else as JSON text."""
    return value if value is None or isinstance(value, bool | int | float | str) else _json(value)


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True)


def _encoded(space: Mapping[str, Dimension], values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _param(space[name], value) for name, value in values.items()}


def _param(dimension: Dimension, value: Any) -> Any:
    if isinstance(dimension, Choice):
        # As the choice spells it: Optuna must find 1 among [1.0, 1.5].
        return _plain(next(one for one in dimension.choice if same(one, value)))
    return value


def decoded(dimension: Dimension, param: Any) -> Any:
    """The value behind one of Optuna's params."""
    if isinstance(dimension, Choice):
        return next(value for value in dimension.choice if _json(_plain(value)) == _json(param))
    return param
