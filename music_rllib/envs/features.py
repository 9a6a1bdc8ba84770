"""What the entries of a task's observations, goals and actions mean: its split and its symmetries.

Shape legend: B transitions.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from music_rllib.limits import MOST_INDICES
from music_rllib.schedules import StrictModel

if TYPE_CHECKING:
    from music_rllib.replay.trajectories import ReplayLayout, Transitions

_RANGE = re.compile(r"(\d{1,5}):(\d{1,5})")


def _expand_range(value: Any) -> Any:
    """Turn `"3:6"` into (3, 4, 5) and a list into a tuple; return other values unchanged."""
    if not isinstance(value, str):
        return tuple(value) if isinstance(value, list) else value
    bounds = _RANGE.fullmatch(value.strip())
    if bounds is None or int(bounds[1]) > int(bounds[2]):
        raise ValueError(f"must be a list of indices or a range such as 0:3, got {value[:40]!r}")
    return tuple(range(int(bounds[1]), int(bounds[2])))


Index = Annotated[int, Field(ge=0)]
Indices = Annotated[
    tuple[Index, ...],
    Field(max_length=MOST_INDICES),
    BeforeValidator(_expand_range, json_schema_input_type=tuple[int, ...] | str),
]
"""Positions in the observation vector: a list, or a half-open range `a:b` as in Python."""


def beyond_observation(
    agent_indices: Sequence[int], surrounding_indices: Sequence[int], size: int
) -> list[str]:
    """Explain why a split does not fit an observation of this size; empty if it does."""
    parts = (("agent_indices", agent_indices), ("surrounding_indices", surrounding_indices))
    return [
        f"{name} must be < {size}, the size of the observation, got {max(indices)}"
        for name, indices in parts
        if indices and max(indices) >= size
    ]


def check_split(agent_indices: Sequence[int], surrounding_indices: Sequence[int]) -> None:
    """Raise ValueError unless a split has both parts or neither, and repeats no index."""
    if bool(agent_indices) != bool(surrounding_indices):
        missing = "surrounding_indices" if agent_indices else "agent_indices"
        raise ValueError(f"{missing} must be given too: a split needs both parts")
    parts = (("agent_indices", agent_indices), ("surrounding_indices", surrounding_indices))
    for name, indices in parts:
        if len(set(indices)) < len(indices):
            raise ValueError(f"{name} must not repeat an index, got {list(indices)}")
    shared = sorted(set(agent_indices) & set(surrounding_indices))
    if shared:
        raise ValueError(f"agent and surrounding indices must not overlap, both have {shared}")


# Symmetries ---------------------------------------------------------------------------------------

Symmetry = Literal["mirror", "translate"]


class _Entries(StrictModel):
    positions: Indices = ()
    """Entries of the observation that are positions in one direction, such as every y."""
    goal: Indices = ()
    """Entries of the goal that are positions in this direction."""


class Mirror(_Entries):
    """A reflection at a plane across one direction."""

    plane: float = 0.0
    """Place of the mirror: a position y becomes 2 * plane - y."""
    signs: Indices = ()
    """Entries of the observation that change their sign: velocities and relative positions in this
    direction, angles and angular velocities about the other two directions."""
    action: Indices = ()
    """Entries of the action that change their sign."""
    swap: tuple[tuple[Index, Index], ...] = ()
    """Pairs of entries of the observation that change places, such as two fingers."""

    @model_validator(mode="after")
    def _is_a_reflection(self) -> Self:
        used = [*self.positions, *self.signs, *(entry for pair in self.swap for entry in pair)]
        for name, entries in (
            ("positions, signs and swap", used), ("goal", self.goal), ("action", self.action)
        ):  # fmt: skip
            if twice := sorted({entry for entry in entries if list(entries).count(entry) > 1}):
                raise ValueError(f"{name} must have each entry once, {twice[0]} is there twice")
        return self


class Translation(_Entries):
    """Moving everything by one random distance in one direction."""

    distance: float = Field(gt=0)
    """Largest distance."""


class Symmetries(StrictModel):
    """Changes that turn possible transitions of a task into possible ones with the same reward.

    Everything with a place changes together: the agent, its surroundings and the goal.
    """

    mirror: Mirror | None = None
    """The environment is its own mirror image."""
    translate: tuple[Translation, ...] = ()
    """The environment is the same at another place."""

    @property
    def kinds(self) -> tuple[Symmetry, ...]:
        """Those that are given."""
        every: tuple[Symmetry, ...] = ("mirror", "translate")
        return tuple(kind for kind in every if getattr(self, kind))


class Augmentation:
    """Applies symmetries of a task to transitions.

    Sources: reflections, Lin et al. 2020, "Invariant Transform Experience Replay"; translations,
    Corrado and Hanna 2024, "Understanding when Dynamics-Invariant Data Augmentations Benefit
    Model-Free Reinforcement Learning Updates".

    Args:
        symmetries: those of the task.
        used: the kinds to apply.
        layout: sizes of observations, goals and actions.
        goals: whether goals have a place; False if they are all 0.

    Raises:
        ValueError: the task lacks one, or an entry is beyond the observation, goal or action.
    """

    def __init__(
        self, symmetries: Symmetries, used: Collection[Symmetry], layout: ReplayLayout,
        *, goals: bool = True,
    ) -> None:  # fmt: skip
        if missing := set(used) - set(symmetries.kinds):
            raise ValueError(f"the task must have the symmetry {missing.pop()} to use it")
        self._layout, self._goals = layout, goals
        self._mirrors, mirror = "mirror" in used, symmetries.mirror or Mirror()
        places = self._places("mirror", mirror)
        self._order = np.arange(layout.network_input)
        self._sign = np.ones(layout.network_input, np.float32)
        self._offset = np.zeros(layout.network_input, np.float32)
        self._offset[places] = 2.0 * mirror.plane
        signs = self._within("mirror.signs", mirror.signs, layout.observation)
        self._sign[[*places, *signs]] = -1.0
        for pair in mirror.swap:
            first, second = self._within("mirror.swap", pair, layout.observation)
            self._order[[first, second]] = second, first
        self._action = np.ones(layout.action, np.float32)
        self._action[self._within("mirror.action", mirror.action, layout.action)] = -1.0
        self._moves = [
            (self._places(f"translate[{i}]", move), move.distance)
            for i, move in enumerate(symmetries.translate if "translate" in used else ())
        ]

    def _within(self, name: str, entries: Sequence[int], size: int) -> list[int]:
        if entries and max(entries) >= size:
            raise ValueError(f"symmetries.{name} must be < {size}, got {max(entries)}")
        return list(entries)

    def _places(self, name: str, part: Mirror | Translation) -> list[int]:
        """Network inputs that are positions."""
        layout = self._layout
        own = self._within(f"{name}.positions", part.positions, layout.observation)
        goals = self._within(f"{name}.goal", part.goal, layout.goal)
        return own + [layout.observation + entry for entry in goals if self._goals]

    def __call__(self, rng: np.random.Generator, drawn: Transitions) -> None:
        """Mirror half of B transitions and translate all of them, in place."""
        if self._mirrors:
            rows = np.flatnonzero(rng.random(len(drawn.rewards)) < 0.5)
            for inputs in (drawn.inputs, drawn.next_inputs):
                inputs[rows] = inputs[rows][:, self._order] * self._sign + self._offset
            drawn.actions[rows] *= self._action
        for places, distance in self._moves:
            moved = rng.uniform(-distance, distance, (len(drawn.rewards), 1))
            for inputs in (drawn.inputs, drawn.next_inputs):
                inputs[:, places] += moved.astype(np.float32)
