"""Schedules of scalar settings (q, alpha, the MI weight) over the environment steps of a run.

A setting is a plain number (constant), a :class:`Linear` ramp over fractions of the run's budget
(the curriculum of Lee et al. 2019, "TAC with curricula": 10 % to 90 % of training) or a
:class:`Piecewise` table of environment steps. All hold their last value for ever.
"""

from __future__ import annotations

from collections.abc import Callable
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

__all__ = ["Linear", "Piecewise", "Schedule", "bounded", "extremes", "value_at"]


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


def _kind(value: object) -> str | None:
    """Which member of `Schedule` a value claims to be, so that errors speak of that one only."""
    if isinstance(value, dict):
        return value.get("schedule")
    return value.schedule if isinstance(value, Linear | Piecewise) else "constant"


Schedule = Annotated[
    Annotated[Annotated[float, Field(strict=True, allow_inf_nan=False)], Tag("constant")]
    | Annotated[Linear, Tag("linear")]
    | Annotated[Piecewise, Tag("piecewise")],
    Discriminator(
        _kind,
        custom_error_type="schedule",
        custom_error_message="must be a number, or have 'schedule: linear' or "
        "'schedule: piecewise'",
    ),
]
"""A constant, or one of the schedules above."""


def value_at(schedule: float | Linear | Piecewise, env_steps: int, total_env_steps: int) -> float:
    """The schedule's value after `env_steps` of `total_env_steps` environment steps."""
    if isinstance(schedule, Linear | Piecewise):
        return schedule.value(env_steps, total_env_steps)
    return float(schedule)


def extremes(schedule: float | Linear | Piecewise) -> tuple[float, float]:
    """Smallest and largest value the schedule ever takes."""
    if isinstance(schedule, Linear | Piecewise):
        return schedule.extremes()
    return float(schedule), float(schedule)


def bounded(rule: str, holds: Callable[[float], bool]) -> AfterValidator:
    """A pydantic validator that asks `holds` of the ends of a schedule's range."""

    def check(schedule: float | Linear | Piecewise) -> float | Linear | Piecewise:
        low, high = extremes(schedule)
        for value in (low, high):
            if not holds(value):
                raise ValueError(f"must be {rule}, got {value:g}")
        return schedule

    check.__doc__ = f"Rule: {rule}"  # docs/generate_configuration.py shows it
    return AfterValidator(check)
