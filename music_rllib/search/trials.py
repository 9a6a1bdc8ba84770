"""The state of a sweep's searches: their studies, trials and finalists."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState

from music_rllib import names
from music_rllib.config.schema import Stage
from music_rllib.config.search import Rung, SearchSettings
from music_rllib.experiment.plan import Run
from music_rllib.search.study import Study
from music_rllib.search.study_record import VALUES
from music_rllib.store.history import Report

Array = NDArray[np.float64]


@dataclass
class Active:
    """A trial that this driver runs."""

    trial: FrozenTrial
    runs: list[Run] = field(default_factory=list)
    """The runs up to its rung."""
    rung: int = 0


@dataclass
class Finalist:
    """A trial that is run again on fresh seeds."""

    number: int
    values: Mapping[str, Any]
    """Its point, with the compared values."""
    searched: tuple[float, ...]
    """Its objective values in the search."""
    runs: list[Run]
    scores: list[Array] | None = None
    """For each objective `[seeds, tasks]` on fresh seeds; None before all runs are there."""
    failure: str = ""

    @property
    def over(self) -> bool:
        """Whether it has its scores, or can't have them."""
        return self.scores is not None or bool(self.failure)


@dataclass
class Search:
    """A searched stage."""

    stage: Stage
    settings: SearchSettings
    rungs: tuple[Rung, ...]
    """The last one is the end of a trial."""
    arms: list[Arm] = field(default_factory=list)

    @property
    def over(self) -> bool:
        """Whether its ranking is complete, or can't be."""
        return all(
            arm.finalists is not None and all(finalist.over for finalist in arm.finalists)
            for arm in self.arms
        )


@dataclass
class Arm:
    """One study of a search: that of one compared value, or the only one."""

    search: Search = field(repr=False)
    values: Mapping[str, Any]
    """The compared values."""
    study: Study
    position: int
    active: dict[int, Active] = field(default_factory=dict)
    """Trial number to trial."""
    finalists: list[Finalist] | None = None
    """None before the study has ended."""

    @property
    def label(self) -> str:
        """`finetune tac.alpha=0.1`, for messages."""
        stage = self.search.stage.name
        return " ".join((stage, *(f"{name}={value}" for name, value in self.values.items())))

    @property
    def ended(self) -> bool:
        """Whether every trial has ended, in whichever driver."""
        return all(trial.state.is_finished() for trial in self.study.trials())

    def point(self, trial: FrozenTrial) -> dict[str, Any]:
        """A trial's point, with the compared values."""
        return {**self.values, **trial.user_attrs[VALUES]}


def up_to(history: Sequence[Report], until: int | None) -> list[Report]:
    """Reports up to the first evaluation from environment step `until` on."""
    if until is None:
        return list(history)
    ends = (
        count
        for count, report in enumerate(history, 1)
        if report.env_steps >= until and names.EVAL_EPISODES in report.metrics
    )
    return list(history[: next(ends, None)])


def ranked(settings: SearchSettings, trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """Completed trials, the best first; for several objectives the Pareto front, by the first."""
    complete = [trial for trial in trials if trial.state is TrialState.COMPLETE and trial.values]
    signs = [1.0 if objective.maximised else -1.0 for objective in settings.objectives]

    def goodness(trial: FrozenTrial) -> tuple[float, ...]:
        return tuple(sign * value for sign, value in zip(signs, trial.values, strict=True))

    if len(signs) > 1:
        complete = [
            trial
            for trial in complete
            if not any(_dominates(goodness(other), goodness(trial)) for other in complete)
        ]
    return sorted(complete, key=lambda trial: (*(-part for part in goodness(trial)), trial.number))


def _dominates(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one != other and all(a >= b for a, b in zip(one, other, strict=True))
