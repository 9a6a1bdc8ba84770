"""A search's trials while it goes on, and their order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState

from music_rllib import names
from music_rllib.config.schema import Stage
from music_rllib.config.search.settings import Rung, SearchSettings
from music_rllib.experiment.plan import Run
from music_rllib.search.study import Study
from music_rllib.store.run_record import Report

__all__ = ["Active", "Arm", "Finalist", "Search", "in_words", "ranked", "up_to"]

Array = NDArray[np.float64]


@dataclass
class Active:
    """A trial that this driver judges."""

    trial: FrozenTrial
    values: Mapping[str, Any]
    """With the compared ones."""
    runs: list[Run] = field(default_factory=list)
    """Of the rung that it is on."""
    rung: int = 0


@dataclass
class Finalist:
    """A trial that is run again on fresh seeds."""

    number: int
    values: Mapping[str, Any]
    searched: tuple[float, ...]
    """Its values in the search."""
    runs: list[Run]
    scores: list[Array] | None = None
    """For each objective `[seeds, tasks]` on fresh seeds; None before all are there."""
    failure: str = ""


@dataclass
class Arm:
    """One study: of one compared value, or the only one."""

    values: Mapping[str, Any]
    study: Study
    position: int
    active: dict[int, Active] = field(default_factory=dict)
    finalists: list[Finalist] | None = None
    """None before the study is over."""

    @property
    def over(self) -> bool:
        """Whether every trial has ended, whoever has judged it."""
        return all(trial.state.is_finished() for trial in self.study.trials())


@dataclass
class Search:
    """A searched stage."""

    stage: Stage
    settings: SearchSettings
    arms: list[Arm]
    rungs: tuple[Rung, ...]
    """The last one is the end."""


def up_to(history: Sequence[Report], until: int | None) -> list[Report]:
    """Reports up to the first evaluation from `until` environment steps on."""
    if until is None:
        return list(history)
    found = []
    for report in history:
        found.append(report)
        if report.env_steps >= until and names.EVAL_EPISODES in report.metrics:
            break
    return found


def ranked(settings: SearchSettings, trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """Judged trials, the best first; of several objectives the Pareto front, by the first one."""
    judged = [trial for trial in trials if trial.state is TrialState.COMPLETE and trial.values]
    signs = [1.0 if objective.maximised else -1.0 for objective in settings.objectives]

    def goodness(trial: FrozenTrial) -> tuple[float, ...]:
        return tuple(sign * value for sign, value in zip(signs, trial.values, strict=True))

    if len(signs) > 1:
        judged = [
            trial
            for trial in judged
            if not any(_dominates(goodness(other), goodness(trial)) for other in judged)
        ]
    return sorted(judged, key=lambda trial: (*(-part for part in goodness(trial)), trial.number))


def _dominates(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one != other and all(a >= b for a, b in zip(one, other, strict=True))


def in_words(values: Mapping[str, Any]) -> str:
    """`tac.alpha=0.1 tac.entropic_index=2 `, for the beginning of a line."""
    return "".join(f"{name}={value} " for name, value in values.items())
