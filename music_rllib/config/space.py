"""The dimensions of a search's space: ranges and choices, and when they apply."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import Discriminator, Field, JsonValue, Tag, model_validator

from music_rllib.config.problems import same, shown
from music_rllib.schedules import StrictModel


class _Dimension(StrictModel):
    when: dict[str, JsonValue] = Field(default_factory=dict)
    """Restricts the dimension to points where each of these settings, which must be above it in the
    space, has this value or one of a list of values."""

    def applies(self, chosen: Mapping[str, Any]) -> bool:
        """Whether this dimension exists at a point with the `chosen` values."""
        return all(
            name in chosen and any(same(chosen[name], value) for value in listed(wanted))
            for name, wanted in self.when.items()
        )


def listed(wanted: JsonValue) -> list[JsonValue]:
    """The allowed values of a setting in `when`."""
    return wanted if isinstance(wanted, list) else [wanted]


class _Range(_Dimension):
    bounds: tuple[float, float]
    """Lowest and highest value, both possible."""
    log: bool = False
    """Whether to search in the logarithm."""
    step: float | None = Field(None, gt=0)
    """Restricts values to the lowest one plus whole multiples of the step."""

    @property
    def _given_step(self) -> float | None:
        """The step; None if it excludes no value."""
        return None if isinstance(self, IntRange) and self.step == 1 else self.step

    @model_validator(mode="after")
    def _is_a_range(self) -> Self:
        (low, high), step = self.bounds, self._given_step
        if not low < high:
            raise ValueError(f"must be [lowest, highest], got [{low:g}, {high:g}]")
        if self.log and low <= 0:
            raise ValueError(
                f"must be above 0 to be searched in the logarithm, got [{low:g}, {high:g}]"
            )
        if self.log and step is not None:
            raise ValueError(f"step must be left out with log: true, got {step:g}")
        if step is not None and step > high - low:
            raise ValueError(f"must be wider than its step {step:g}, got [{low:g}, {high:g}]")
        return self

    @property
    def size(self) -> int | None:
        """Number of values; None for a continuous range."""
        low, high = self.bounds
        return None if self.step is None else int(min((high - low) / self.step, 1e18) + 1e-9) + 1

    def _at(self, position: int) -> float:
        """The value at a position in the order of values."""
        value = self.bounds[0] + position * (self.step or 0)
        return value if isinstance(self, IntRange) else float(f"{value:.12g}")

    def ends(self) -> tuple[Any, Any]:
        """Both ends, a whole number of steps apart; if they are valid, the range is valid."""
        return self.bounds if self.size is None else (self._at(0), self._at(self.size - 1))

    def values(self) -> tuple[Any, ...] | None:
        """All values, for a grid; None for a continuous range."""
        return None if self.size is None else tuple(map(self._at, range(self.size)))

    def contains(self, value: Any) -> bool:
        """Whether `value` is one of the values."""
        low, high = self.ends()
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and low <= value <= high):
            return False
        steps = 0.0 if self.step is None else (value - low) / self.step
        return bool(abs(steps - round(steps)) < 1e-8)  # Optuna's tolerance

    @property
    def rule(self) -> str:
        """The rule of its values: `in [1, 2] and whole steps of 0.5 from 1`."""
        (low, high), step = self.bounds, self._given_step
        number = "a whole number " if isinstance(self, IntRange) else ""
        steps = "" if step is None else f" and whole steps of {step:g} from {low:g}"
        return f"{number}in [{low:g}, {high:g}]{steps}"


class FloatRange(_Range):
    """A real number."""

    bounds: tuple[float, float] = Field(alias="float")

    def inside(self) -> float | None:
        """A value between the ends, which a setting of whole numbers refuses; None without one."""
        if self.size is not None:
            return self._at(1) if self.size > 2 else None
        low, high = self.bounds
        return float(f"{low + (high - low) / math.pi:.12g}")


class IntRange(_Range):
    """A whole number."""

    bounds: tuple[int, int] = Field(alias="int")
    step: int = Field(1, gt=0)


class Choice(_Dimension):
    """One of some values of any type: numbers, text, schedules."""

    choice: list[JsonValue] = Field(min_length=1)
    """The values."""

    def ends(self) -> tuple[Any, ...]:
        return tuple(self.choice)

    @property
    def size(self) -> int:
        return len(self.choice)

    def values(self) -> tuple[Any, ...]:
        return tuple(self.choice)

    def contains(self, value: Any) -> bool:
        """Whether `value` is one of the values."""
        return any(same(value, option) for option in self.choice)

    @property
    def rule(self) -> str:
        return f"one of {shown(self.choice)}"


_KINDS = {"float": FloatRange, "int": IntRange, "choice": Choice}


def _tag(value: Any) -> str | None:
    """Tag of the member of `Dimension` that `value` should be."""
    if not isinstance(value, dict):
        return type(value).__name__
    tags = [kind.__name__ for key, kind in _KINDS.items() if key in value]
    return tags[0] if len(tags) == 1 else None


Dimension = Annotated[
    Annotated[FloatRange, Tag("FloatRange")]
    | Annotated[IntRange, Tag("IntRange")]
    | Annotated[Choice, Tag("Choice")],
    Discriminator(
        _tag,
        custom_error_type="dimension",
        custom_error_message="must have exactly one of float, int and choice, like "
        "{float: [0.01, 1], log: true}",
    ),
]
