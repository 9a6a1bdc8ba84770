"""The dimensions of a search's space: ranges and choices, and where they apply."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self, TypeGuard

from pydantic import BaseModel, ConfigDict, Discriminator, Field, JsonValue, Tag, model_validator

from music_rllib.config.problems import same, shown


class Strict(BaseModel):
    """Nothing unknown, nothing infinite, never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


When = dict[str, JsonValue]


class _Dimension(Strict):
    when: When = Field(default_factory=dict)
    """Only where each of these settings, which stand above this one in the space, has this value,
    or one of a list of values."""

    def applies(self, chosen: Mapping[str, Any]) -> bool:
        """Whether this dimension exists beside the values that are chosen already."""
        return all(
            name in chosen and any(same(chosen[name], value) for value in listed(wanted))
            for name, wanted in self.when.items()
        )


def listed(wanted: JsonValue) -> list[JsonValue]:
    """The values that one setting of `when` may have."""
    return wanted if isinstance(wanted, list) else [wanted]


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _in_steps(low: float, high: float, step: float | None) -> str:
    """`in [1, 2] and whole steps of 0.5 from 1`."""
    steps = "" if step is None else f" and whole steps of {step:g} from {low:g}"
    return f"in [{low:g}, {high:g}]{steps}"


class FloatRange(_Dimension):
    """A real number."""

    bounds: tuple[float, float] = Field(alias="float")
    """Lowest and highest value, both possible."""
    log: bool = False
    """Whether to search in the logarithm."""
    step: float | None = Field(None, gt=0)
    """Only the lowest value and those that are whole steps above it."""

    @model_validator(mode="after")
    def _is_a_range(self) -> Self:
        _check_range(self.bounds, log=self.log, step=self.step)
        return self

    def ends(self) -> tuple[Any, ...]:
        """Values that must be sound for the whole range to be."""
        return self.bounds

    @property
    def reachable(self) -> tuple[float, float]:
        """The ends, the upper one a whole number of steps above the lower."""
        return self.bounds if self.size is None else (self._at(0), self._at(self.size - 1))

    @property
    def size(self) -> int | None:
        """Number of values; None where they can't be counted."""
        low, high = self.bounds
        return None if self.step is None else int(min((high - low) / self.step, 1e18) + 1e-9) + 1

    def _at(self, position: int) -> float:
        return float(f"{self.bounds[0] + position * (self.step or 0.0):.12g}")

    def values(self) -> tuple[Any, ...] | None:
        """All values, for a grid; None where they can't be listed."""
        return None if self.size is None else tuple(self._at(at) for at in range(self.size))

    def contains(self, value: Any) -> bool:
        """Whether it is one of the values, however many there are."""
        low, high = self.reachable
        if not (_is_number(value) and low <= value <= high):
            return False
        steps = 0.0 if self.step is None else (value - low) / self.step
        return abs(steps - round(steps)) < 1e-8  # Optuna's tolerance

    @property
    def rule(self) -> str:
        """What a value must be, in words."""
        return _in_steps(*self.bounds, self.step)


class IntRange(_Dimension):
    """A whole number."""

    bounds: tuple[int, int] = Field(alias="int")
    """Lowest and highest value, both possible."""
    log: bool = False
    """Whether to search in the logarithm."""
    step: int = Field(1, gt=0)
    """Only the lowest value and those that are whole steps above it."""

    @model_validator(mode="after")
    def _is_a_range(self) -> Self:
        _check_range(self.bounds, log=self.log, step=None if self.step == 1 else self.step)
        return self

    def ends(self) -> tuple[Any, ...]:
        """Values that must be sound for the whole range to be."""
        return self.bounds

    @property
    def reachable(self) -> tuple[int, int]:
        """The ends, the upper one a whole number of steps above the lower."""
        low, high = self.bounds
        return low, low + (high - low) // self.step * self.step

    @property
    def size(self) -> int | None:
        """Number of values."""
        return (self.bounds[1] - self.bounds[0]) // self.step + 1

    def values(self) -> tuple[Any, ...] | None:
        """All values, for a grid."""
        return tuple(range(self.bounds[0], self.bounds[1] + 1, self.step))

    def contains(self, value: Any) -> bool:
        """Whether it is one of the values, however many there are."""
        low, high = self.bounds
        return _is_number(value) and low <= value <= high and (value - low) % self.step == 0

    @property
    def rule(self) -> str:
        """What a value must be, in words."""
        return f"a whole number {_in_steps(*self.bounds, None if self.step == 1 else self.step)}"


class Choice(_Dimension):
    """One of some values of any kind: numbers, text, schedules."""

    choice: list[JsonValue] = Field(min_length=1)
    """The values."""

    def ends(self) -> tuple[Any, ...]:
        """Values that must be sound for all of them to be."""
        return tuple(self.choice)

    @property
    def size(self) -> int | None:
        """Number of values."""
        return len(self.choice)

    def values(self) -> tuple[Any, ...] | None:
        """All values, for a grid."""
        return tuple(self.choice)

    def contains(self, value: Any) -> bool:
        """Whether it is one of the values."""
        return any(same(value, one) for one in self.choice)

    @property
    def rule(self) -> str:
        """What a value must be, in words."""
        return f"one of {shown(self.choice)}"


def _kind(value: Any) -> str | None:
    if isinstance(value, _Dimension):
        return {FloatRange: "real", IntRange: "whole", Choice: "options"}[type(value)]
    kinds = {"float": "real", "int": "whole", "choice": "options"}
    found = [kinds[key] for key in value if key in kinds] if isinstance(value, dict) else []
    return found[0] if len(found) == 1 else None


Dimension = Annotated[
    Annotated[FloatRange, Tag("real")]
    | Annotated[IntRange, Tag("whole")]
    | Annotated[Choice, Tag("options")],
    Discriminator(
        _kind,
        custom_error_type="dimension",
        custom_error_message="must have exactly one of float, int and choice",
    ),
]


def _check_range(ends: tuple[float, float], *, log: bool, step: float | None) -> None:
    low, high = ends
    if not low < high:
        raise ValueError(f"must be [lowest, highest], got [{low:g}, {high:g}]")
    if log and low <= 0:
        raise ValueError(
            f"must be above 0 to be searched in the logarithm, got [{low:g}, {high:g}]"
        )
    if log and step is not None:
        raise ValueError(f"step must be left out with log: true, got {step:g}")
    if step is not None and step > high - low:
        raise ValueError(f"must be wider than its step {step:g}, got [{low:g}, {high:g}]")
