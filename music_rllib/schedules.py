"""Schedules of scalar settings (q, alpha, the MI weight) over a run.

A setting is a plain number (constant), a :class:`Linear` ramp over fractions of the run's budget
(the curriculum of Lee et al. 2019, "TAC with curricula": 10 % to 90 % of training) or a
:class:`Piecewise` table of environment steps. All hold their last value for ever. q and the MI
weight may also be :class:`Measured`: a function of the run's success rate or entropy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    model_validator,
)

Quantity = Literal["success_rate", "shannon_entropy"]
"""What a setting may follow."""
QUANTITIES = {"success_rate": "success rate", "shannon_entropy": "Shannon entropy"}
"""In words."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Linear(_Frozen):
    """Straight line from `start` to `end` between two fractions of the run's budget."""

    schedule: Literal["linear"] = "linear"
    """Says which kind of schedule this is."""
    start: float
    """Value at first."""
    end: float
    """Value at last."""
    begin: float = Field(0.1, ge=0.0, le=1.0)
    """Fraction of the budget up to which the value is `start`."""
    finish: float = Field(0.9, ge=0.0, le=1.0)
    """Fraction of the budget from which the value is `end`."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.begin >= self.finish:
            raise ValueError(
                f"begin must be < finish, got begin={self.begin}, finish={self.finish}"
            )
        return self

    def value(self, env_steps: int, total_env_steps: int) -> float:
        fraction = env_steps / max(total_env_steps, 1)
        progress = (fraction - self.begin) / (self.finish - self.begin)
        return self.start + (self.end - self.start) * min(max(progress, 0.0), 1.0)

    def extremes(self) -> tuple[float, float]:
        return min(self.start, self.end), max(self.start, self.end)


class Piecewise(_Frozen):
    """Values at given environment steps, joined by lines or held until the next one."""

    schedule: Literal["piecewise"] = "piecewise"
    """Says which kind of schedule this is."""
    points: tuple[tuple[int, float], ...] = Field(min_length=1)
    """(environment steps, value) pairs; the first one must be at step 0."""
    interpolation: Literal["linear", "hold"] = "linear"
    """Between two points: a straight line, or the earlier value until the later point."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        steps = [step for step, _ in self.points]
        if steps[0] != 0:
            raise ValueError(f"points must begin at env step 0, got {steps[0]}")
        if any(later <= earlier for earlier, later in pairwise(steps)):
            raise ValueError(f"points must have strictly increasing env steps, got {steps}")
        return self

    def value(self, env_steps: int, total_env_steps: int) -> float:
        held_step, held = self.points[0]
        for step, value in self.points[1:]:
            if env_steps < step:
                if self.interpolation == "hold":
                    return held
                return held + (value - held) * (env_steps - held_step) / (step - held_step)
            held_step, held = step, value
        return held

    def extremes(self) -> tuple[float, float]:
        values = [value for _, value in self.points]
        return min(values), max(values)


class Measured(_Frozen):
    """Value that follows what is measured of the run: straight lines between points."""

    follows: Quantity
    """The success rate at the last step, of the run's evaluations; or the policy's Shannon entropy
    over all action dimensions, in nats, a mean over the updates after each round of episodes."""
    points: tuple[tuple[float, float], ...] = Field(min_length=2)
    """(measured, value) pairs, joined by straight lines and held beyond both ends. Before anything
    is measured, the success rate counts as the lowest and the entropy as the highest of them."""
    smoothing: float = Field(0.0, ge=0)
    """Environment steps over which measurements are averaged: of the mean before one, a share of
    exp(-steps since then/smoothing) is kept. 0: only the last measurement counts."""
    monotone: bool = False
    """Only the highest success rate so far counts, or the lowest entropy so far, after smoothing:
    the value goes one way along the points and never back."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        measured = [at for at, _ in self.points]
        if any(later <= earlier for earlier, later in pairwise(measured)):
            raise ValueError(f"points must rise strictly in what is measured, got {measured}")
        if self.follows == "success_rate" and not 0 <= measured[0] < measured[-1] <= 1:
            raise ValueError(f"points of a success rate must lie in [0, 1], got {measured}")
        return self

    @property
    def initial(self) -> float:
        """The measured value that counts before there is one."""
        return self.points[0 if self.follows == "success_rate" else -1][0]

    def value(self, measured: float | None) -> float:
        """The setting where so much is measured; None: nothing yet."""
        at = self.initial if measured is None else measured
        below, held = self.points[0]
        if at <= below:
            return held
        for above, value in self.points[1:]:
            if at < above:
                return held + (value - held) * (at - below) / (above - below)
            below, held = above, value
        return held

    def extremes(self) -> tuple[float, float]:
        values = [value for _, value in self.points]
        return min(values), max(values)


class Follower:
    """What has been measured for one `Measured` setting."""

    def __init__(self, schedule: Measured) -> None:
        self._schedule = schedule
        self._mean: float | None = None
        self._env_steps = 0
        self.measured: float | None = None
        """What the setting follows: smoothed, and monotone where asked; None before the first."""

    def observe(self, quantity: Quantity, measured: float, env_steps: int) -> None:
        """Take a measurement made after `env_steps`; others than the one followed are ignored."""
        schedule = self._schedule
        if quantity != schedule.follows or not math.isfinite(measured):
            return
        if self._mean is not None and schedule.smoothing > 0:
            kept = math.exp((self._env_steps - env_steps) / schedule.smoothing)
            measured += kept * (self._mean - measured)
        self._mean, self._env_steps = measured, env_steps
        if schedule.monotone and self.measured is not None:
            best = max if schedule.follows == "success_rate" else min
            measured = best(measured, self.measured)
        self.measured = measured

    def state(self) -> dict[str, float | None]:
        """All of it, for a checkpoint."""
        return {"mean": self._mean, "env_steps": self._env_steps, "measured": self.measured}

    def load_state(self, state: dict[str, float | None]) -> None:
        """Go on from `state`."""
        self._mean, self.measured = state["mean"], state["measured"]
        self._env_steps = int(state["env_steps"] or 0)


def _kind(value: object) -> str | None:
    """Which member of `Schedule` a value claims to be, so that errors speak of that one only."""
    if isinstance(value, dict):
        return "measured" if "follows" in value else value.get("schedule")
    if isinstance(value, Measured):
        return "measured"
    return value.schedule if isinstance(value, Linear | Piecewise) else "constant"


_Constant = Annotated[Annotated[float, Field(strict=True, allow_inf_nan=False)], Tag("constant")]


def _discriminator(kinds: str) -> Discriminator:
    message = f"must be a number, or have {kinds}"
    return Discriminator(_kind, custom_error_type="schedule", custom_error_message=message)


Schedule = Annotated[
    _Constant | Annotated[Linear, Tag("linear")] | Annotated[Piecewise, Tag("piecewise")],
    _discriminator("'schedule: linear' or 'schedule: piecewise'"),
]
"""A constant, or a schedule over the environment steps."""

AdaptiveSchedule = Annotated[
    _Constant
    | Annotated[Linear, Tag("linear")]
    | Annotated[Piecewise, Tag("piecewise")]
    | Annotated[Measured, Tag("measured")],
    _discriminator("'schedule: linear', 'schedule: piecewise' or 'follows'"),
]
"""A constant, or any of the schedules above."""


def value_at(
    schedule: float | Linear | Piecewise | Measured,
    env_steps: int,
    total_env_steps: int,
    measured: float | None = None,
) -> float:
    """The schedule's value after `env_steps` of `total_env_steps` environment steps.

    Args:
        measured: what a `Measured` follows; None before anything has been measured.
    """
    if isinstance(schedule, Measured):
        return schedule.value(measured)
    if isinstance(schedule, Linear | Piecewise):
        return schedule.value(env_steps, total_env_steps)
    return float(schedule)


def extremes(schedule: float | Linear | Piecewise | Measured) -> tuple[float, float]:
    """Smallest and largest value the schedule ever takes."""
    if isinstance(schedule, Linear | Piecewise | Measured):
        return schedule.extremes()
    return float(schedule), float(schedule)


def check_measurable(settings: Mapping[str, object], *, success: bool, entropy: bool) -> None:
    """Refuse settings that follow what the run does not measure.

    Args:
        settings: dotted name to value.
        success: whether the task declares success.
        entropy: whether the policy has one.

    Raises:
        ValueError: names the setting.
    """
    for name, value in settings.items():
        follows = value.follows if isinstance(value, Measured) else None
        if follows == "success_rate" and not success:
            raise ValueError(
                f"{name}.follows must not be success_rate on a task that declares no success "
                "(success_key: null)"
            )
        if follows == "shannon_entropy" and not entropy:
            raise ValueError(
                f"{name}.follows must not be shannon_entropy for policy: deterministic (it has no "
                "entropy)"
            )


def bounded(rule: str, holds: Callable[[float], bool]) -> AfterValidator:
    """A pydantic validator that asks `holds` of the ends of a schedule's range."""

    def check(
        schedule: float | Linear | Piecewise | Measured,
    ) -> float | Linear | Piecewise | Measured:
        low, high = extremes(schedule)
        for value in (low, high):
            if not holds(value):
                raise ValueError(f"must be {rule}, got {value:g}")
        return schedule

    check.__doc__ = f"Rule: {rule}"  # docs/generate_configuration.py shows it
    return AfterValidator(check)
