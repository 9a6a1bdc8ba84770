"""Schedules of scalar settings (q, alpha, the MI weight) over a run.

A setting is a number (constant), a :class:`Linear` ramp over fractions of the run's budget (the
curriculum of Lee et al. 2019, "TAC with curricula": 10% to 90% of training) or a
:class:`Piecewise` table of environment steps. Each holds its last value to the end of the run. q
and the MI weight can also be :class:`Measured`: a function of the run's success rate or entropy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    JsonValue,
    Tag,
    model_validator,
)

Quantity = Literal["success_rate", "shannon_entropy"]
"""Quantities that a `Measured` setting can follow."""
QUANTITIES = {"success_rate": "success rate", "shannon_entropy": "Shannon entropy"}
"""Name of each quantity in text."""


class StrictModel(BaseModel):
    """Immutable settings without unknown keys, infinities and NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _finite(value: JsonValue) -> JsonValue:
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            _finite(inner)
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"must be a finite number, got {value}")
    return value


Plain = Annotated[JsonValue, AfterValidator(_finite)]
"""A value of the user's own code; the key of a run, which is a hash of JSON, can hold it."""


class Linear(StrictModel):
    """Straight line from `start` to `end` between two fractions of the run's budget."""

    schedule: Literal["linear"] = "linear"
    """The kind of schedule."""
    start: float
    """First value."""
    end: float
    """Last value."""
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


class Piecewise(StrictModel):
    """Values at given environment steps, joined by lines or held until the next one."""

    schedule: Literal["piecewise"] = "piecewise"
    """The kind of schedule."""
    points: tuple[tuple[int, float], ...] = Field(min_length=1)
    """(environment steps, value) pairs; the first pair must be at step 0."""
    interpolation: Literal["linear", "hold"] = "linear"
    """Between two points: a straight line, or the value of the earlier point."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        steps = [step for step, _ in self.points]
        if steps[0] != 0:
            raise ValueError(f"points must begin at env step 0, got {steps[0]}")
        if any(later <= earlier for earlier, later in pairwise(steps)):
            raise ValueError(f"points must have strictly increasing env steps, got {steps}")
        return self


class Measured(StrictModel):
    """Value as a function of a measured quantity of the run: straight lines between points."""

    follows: Quantity
    """Success rate of the run's evaluations, at the last step of an episode; or Shannon entropy of
    the policy over all action dimensions, in nats, averaged over up to 100 updates after each round
    of episodes."""
    points: tuple[tuple[float, float], ...] = Field(min_length=2)
    """(measured, value) pairs, joined by straight lines and held beyond both ends. Until the first
    measurement the success rate counts as the lowest of them and the entropy as the highest."""
    smoothing: float = Field(0.0, ge=0)
    """Environment steps over which measurements are averaged: the mean of a round of episodes keeps
    a share exp(-steps since then/smoothing) of the mean before it. 0: only the last measurement
    counts."""
    monotone: bool = False
    """Whether the highest success rate so far counts, or the lowest entropy so far, after
    smoothing: the value then moves along the points in one direction only."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        measured = [at for at, _ in self.points]
        if any(later <= earlier for earlier, later in pairwise(measured)):
            raise ValueError(f"points must rise strictly in what is measured, got {measured}")
        if self.follows == "success_rate" and not 0 <= measured[0] < measured[-1] <= 1:
            raise ValueError(f"points of a success rate must lie in [0, 1], got {measured}")
        return self


class Follower:
    """The measured quantity that one `Measured` setting follows."""

    def __init__(self, schedule: Measured) -> None:
        self._schedule = schedule
        self._state: dict[str, Any] = {
            "measured": None,
            "mean": None, "env_steps": 0, "sum": 0.0, "count": 0,
            "before": None, "steps_before": 0,
        }  # fmt: skip
        """`measured` is the followed quantity. The smoothed quantity was `mean` after `env_steps`,
        with `count` measurements in that round, and `before` in the round before it."""

    @property
    def measured(self) -> float | None:
        """The quantity, smoothed and monotone as configured; None before any measurement."""
        measured: float | None = self._state["measured"]
        return measured

    def observe(self, quantity: Quantity, measured: float, env_steps: int) -> None:
        """Add a measurement made after `env_steps`, unless it is of another quantity.

        Measurements after the same `env_steps` form a round, whose mean is smoothed.
        """
        schedule, state = self._schedule, self._state
        if quantity != schedule.follows or not math.isfinite(measured):
            return
        if schedule.smoothing > 0:
            measured = self._smoothed(measured, env_steps)
        state |= {"mean": measured, "env_steps": env_steps}
        if schedule.monotone and state["measured"] is not None:
            best = max if schedule.follows == "success_rate" else min
            measured = best(measured, state["measured"])
        state["measured"] = measured

    def _smoothed(self, measured: float, env_steps: int) -> float:
        """The moving average, with a measurement of the current round or of a new round."""
        state = self._state
        if env_steps != state["env_steps"]:
            state |= {"before": state["mean"], "steps_before": state["env_steps"]}
            state |= {"sum": 0.0, "count": 0}
        state |= {"sum": state["sum"] + measured, "count": state["count"] + 1}
        mean: float = state["sum"] / state["count"]
        if state["before"] is None:
            return mean
        kept = math.exp((state["steps_before"] - env_steps) / self._schedule.smoothing)
        return mean + kept * (float(state["before"]) - mean)

    def state(self) -> dict[str, float | None]:
        return dict(self._state)

    def load_state(self, state: Mapping[str, float | None]) -> None:
        self._state = dict(state)


def _kind(value: object) -> str | None:
    """Tag of the member of `Schedule` that `value` should be."""
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
    schedule: AdaptiveSchedule,
    env_steps: int,
    total_env_steps: int,
    measured: float | None = None,
) -> float:
    """The schedule's value after `env_steps` of `total_env_steps` environment steps.

    Args:
        total_env_steps: The run's budget.
        measured: The quantity that a `Measured` follows; None before the first measurement.
    """
    match schedule:
        case Linear():
            fraction = env_steps / max(total_env_steps, 1)
            progress = (fraction - schedule.begin) / (schedule.finish - schedule.begin)
            if progress >= 1.0:  # by the formula below .1 to .9 would end at .8999999999999999
                return schedule.end
            value = schedule.start + (schedule.end - schedule.start) * max(progress, 0.0)
            return _between(value, schedule.start, schedule.end)
        case Piecewise(interpolation="hold"):
            return next(value for step, value in reversed(schedule.points) if step <= env_steps)
        case Piecewise():
            return _interpolated(schedule.points, env_steps)
        case Measured():
            if measured is None:
                measured = schedule.points[0 if schedule.follows == "success_rate" else -1][0]
            return _interpolated(schedule.points, measured)
    return float(schedule)


def _interpolated(points: Sequence[tuple[float, float]], at: float) -> float:
    """The value at `at` on straight lines between `points`, held beyond both ends."""
    before, held = points[0]
    if at <= before:
        return held
    for after, value in points[1:]:
        if at < after:
            between = held + (value - held) * (at - before) / (after - before)
            return _between(between, held, value)
        before, held = after, value
    return held


def _between(value: float, one: float, other: float) -> float:
    """Limit the value to both ends, because rounding can move it beyond them."""
    return min(max(value, min(one, other)), max(one, other))


def extremes(schedule: AdaptiveSchedule) -> tuple[float, float]:
    """Smallest and largest value the schedule ever takes."""
    match schedule:
        case Linear():
            values = [schedule.start, schedule.end]
        case Piecewise() | Measured():
            values = [value for _, value in schedule.points]
        case _:
            values = [float(schedule)]
    return min(values), max(values)


def check_measurable(settings: Mapping[str, object], *, success: bool, entropy: bool) -> None:
    """Reject settings that follow a quantity that the run does not measure.

    Args:
        settings: Dotted name to value.
        success: Whether the task declares success.
        entropy: Whether the policy has an entropy.

    Raises:
        ValueError: Names the setting.
    """
    lacking = {
        "success_rate": None if success else "on a task without success (success_key: null)",
        "shannon_entropy": None if entropy else "for policy: deterministic (it has no entropy)",
    }
    for name, value in settings.items():
        if isinstance(value, Measured) and (reason := lacking[value.follows]):
            raise ValueError(f"{name}.follows must not be {value.follows} {reason}")


def bounded(rule: str, holds: Callable[[float], bool]) -> AfterValidator:
    """A pydantic validator that `holds` for a schedule's smallest and largest value."""

    def check(schedule: AdaptiveSchedule) -> AdaptiveSchedule:
        for value in extremes(schedule):
            if not holds(value):
                raise ValueError(f"must be {rule}, got {value:g}")
        return schedule

    check.__doc__ = f"Rule: {rule}"  # docs/generate_configuration.py shows it
    return AfterValidator(check)
