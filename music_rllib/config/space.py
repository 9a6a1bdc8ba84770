"""The dimensions of a search's space: ranges and choices, and when they apply."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, Self, TypeGuard

from pydantic import Discriminator, Field, JsonValue, Tag, model_validator

from music_rllib.config.problems import same, shown
from music_rllib.schedules import StrictModel


class _Dimension(StrictModel):
    when: dict[str, JsonValue] = Field(default_factory=dict)
    """The dimension exists only where each of these settings, which stand above it in the space,
    has this value, or one of a list of values."""

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


class _Range(_Dimension):
    bounds: tuple[float, float]
    """Lowest and highest value, both possible."""
    log: bool = False
    """Whether to search in the logarithm."""
    step: float | None = Field(None, gt=0)
    """Only the lowest value and those that are whole steps above it are possible."""

    @property
    def _given_step(self) -> float | None:
        """The step; None if it excludes no value."""
        return self.step

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
    @abstractmethod
    def size(self) -> int | None:
        """Number of values; None if they can't be counted."""

    @abstractmethod
    def _at(self, position: int) -> Any:
        """The value at a position in the order of values."""

    def ends(self) -> tuple[Any, ...]:
        """Values that must be valid for the whole range to be."""
        return self.bounds

    @property
    def reachable(self) -> tuple[Any, Any]:
        """The ends, the upper one a whole number of steps above the lower."""
        return self.bounds if self.size is None else (self._at(0), self._at(self.size - 1))

    def values(self) -> tuple[Any, ...] | None:
        """All values, for a grid; None if they can't be counted."""
        return None if self.size is None else tuple(map(self._at, range(self.size)))

    @property
    def rule(self) -> str:
        """The rule of its values in words: `in [1, 2] and whole steps of 0.5 from 1`."""
        (low, high), step = self.bounds, self._given_step
        steps = "" if step is None else f" and whole steps of {step:g} from {low:g}"
        return f"in [{low:g}, {high:g}]{steps}"


class FloatRange(_Range):
    """A real number."""

    bounds: tuple[float, float] = Field(alias="float")

    @property
    def size(self) -> int | None:
        low, high = self.bounds
        return None if self.step is None else int(min((high - low) / self.step, 1e18) + 1e-9) + 1

    def _at(self, position: int) -> float:
        return float(f"{self.bounds[0] + position * (self.step or 0.0):.12g}")

    def contains(self, value: Any) -> bool:
        """Whether it is one of the values, however many there are."""
        low, high = self.reachable
        if not (_is_number(value) and low <= value <= high):
            return False
        steps = 0.0 if self.step is None else (value - low) / self.step
        return bool(abs(steps - round(steps)) < 1e-8)  # Optuna's tolerance


class IntRange(_Range):
    """A whole number."""

    bounds: tuple[int, int] = Field(alias="int")
    step: int = Field(1, gt=0)

    @property
    def _given_step(self) -> float | None:
        return None if self.step == 1 else self.step

    @property
    def size(self) -> int:
        return (self.bounds[1] - self.bounds[0]) // self.step + 1

    def _at(self, position: int) -> int:
        return self.bounds[0] + position * self.step

    def contains(self, value: Any) -> bool:
        """Whether it is one of the values, however many there are."""
        low, high = self.bounds
        return _is_number(value) and low <= value <= high and (value - low) % self.step == 0

    @property
    def rule(self) -> str:
        return f"a whole number {super().rule}"


class Choice(_Dimension):
    """One of some values of any kind: numbers, text, schedules."""

    choice: list[JsonValue] = Field(min_length=1)
    """The values."""

    def ends(self) -> tuple[Any, ...]:
        """Values that must be valid for all of them to be."""
        return tuple(self.choice)

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.choice)

    def values(self) -> tuple[Any, ...]:
        """All values, for a grid."""
        return tuple(self.choice)

    def contains(self, value: Any) -> bool:
        """Whether it is one of the values."""
        return any(same(value, option) for option in self.choice)

    @property
    def rule(self) -> str:
        """The rule of its values in words."""
        return f"one of {shown(self.choice)}"


def _kind(value: Any) -> str | None:
    """Tag of the kind of dimension that a value is meant to be; errors are about that one."""
    if isinstance(value, _Dimension):
        return {FloatRange: "real", IntRange: "whole", Choice: "options"}[type(value)]
    tags = {"float": "real", "int": "whole", "choice": "options"}
    claimed = [tag for key, tag in tags.items() if isinstance(value, dict) and key in value]
    return claimed[0] if len(claimed) == 1 else None


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
