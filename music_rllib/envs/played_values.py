"""What the episodes of a probe show about an environment.

Shape legend: n steps of an episode, O observation features, G goal features, N numbers.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from music_rllib.envs.episodes import TOLERANCE
from music_rllib.envs.values import GOAL_KEYS

_LOST = 0.05
"""Share of the range of some numbers from which on their rounding to float32 is reported."""
_STILL = 1e-5
"""Range up to which a number of an observation is constant, as the height of an object at rest."""
FEWEST_EPISODES = 3
"""Number of episodes with different goals that show what an observation contains."""


class Rounding:
    """The range of some numbers [N], and how far float32 is from them."""

    def __init__(self) -> None:
        self._low: Any = np.inf
        self._high: Any = -np.inf
        self._error: Any = 0.0

    def see(self, values: Any) -> None:
        """Take in one more value of each number."""
        exact = np.asarray(values, np.float64)
        self._low, self._high = np.minimum(self._low, exact), np.maximum(self._high, exact)
        self._error = np.maximum(self._error, np.abs(exact - exact.astype(np.float32)))

    def lost(self, still: float = 0.0) -> NDArray[np.intp]:
        """Positions of the numbers of whose range, above `still`, float32 loses over `_LOST`."""
        varied = np.asarray(self._high - self._low)
        return np.flatnonzero((varied > still) & (self._error > _LOST * varied))


class PlayedValues:
    """Collect observations and rewards of episodes, and name what networks can't learn from."""

    def __init__(self, space: gym.Space[Any], observation: int, goal: int) -> None:
        self._space, self._sizes = space, (observation, goal)
        self._types: set[str] = set()
        self._seen = {name: Rounding() for name in GOAL_KEYS[: 2 if goal else 1]}
        """Of the observation and the desired goal, which the networks get."""
        self._reward = Rounding()
        self._holds = np.ones((observation, goal), bool)
        self._goals: list[NDArray[np.float32]] = []
        self._lowest, self._highest = np.inf, -np.inf

    @property
    def rewards_differ(self) -> bool:
        """Whether two different rewards were seen."""
        return self._lowest < self._highest

    def see(self, observation: Any) -> None:
        parts, values = {GOAL_KEYS[0]: self._space}, {GOAL_KEYS[0]: observation}
        if isinstance(self._space, spaces.Dict):
            parts, values = self._space.spaces, observation
        for name in parts.keys() & {*GOAL_KEYS}:
            returned, declared = np.asarray(values[name]).dtype, np.dtype(parts[name].dtype)
            if returned.kind != declared.kind:
                self._types.add(f"{name} has type {returned}, its space declares {declared}")
        for name in self._seen:
            self._seen[name].see(values[name])

    def reward(self, value: Any) -> None:
        """Take in the valid reward of a step."""
        number = float(value)
        self._reward.see([number])
        self._lowest, self._highest = min(self._lowest, number), max(self._highest, number)

    def end(self, frames: NDArray[np.float32]) -> None:
        """Compare observations with goals in the frames [n+1, O+2G] of an episode."""
        observation, goal = self._sizes
        seen, desired, achieved = np.split(frames, [observation, observation + goal], axis=1)
        near = [
            np.isclose(seen[:, :, None], target[:, None, :], rtol=1e-4, atol=1e-6).all(axis=0)
            for target in (desired, desired - achieved, achieved - desired)
        ]
        self._holds &= np.any(near, axis=0)
        self._goals.append(desired[0])

    def problems(self, reward_range: tuple[float, float] | None) -> list[str]:
        """Contradictions to the task, one line each."""
        smallest, largest = reward_range or (-np.inf, np.inf)
        slack = TOLERANCE * max(1.0, *np.abs([self._lowest, self._highest]))
        if smallest - slack <= self._lowest and self._highest <= largest + slack:
            return []
        return [
            f"reward_range must contain every reward, got [{smallest:g}, {largest:g}]: random "
            f"steps have rewards from {self._lowest:g} to {self._highest:g}"
        ]

    def remarks(self, *, hindsight: bool) -> list[str]:
        """Other findings, one line each."""
        lines = [f"{line}; the networks get float32" for line in sorted(self._types)]
        lines += [
            f"{name}[{entry}] changes too little for its size: float32, which the networks "
            "get, does not keep its changes; give it relative to an origin that is near"
            for name, values in self._seen.items()
            for entry in values.lost(_STILL)[:1]
        ]
        if len(self._reward.lost()):
            lines.append(
                "rewards change too little for their size: float32, which the networks get, does "
                "not keep their changes; leave out a constant part"
            )
        goals = np.array(self._goals)
        if hindsight and len(np.unique(goals, axis=0)) >= FEWEST_EPISODES:
            entries = np.argwhere(self._holds & (np.ptp(goals, axis=0) > 0))
            lines += [
                f"observation[{entry}] holds desired_goal[{of}] or its distance from the achieved "
                "goal: hindsight does not replace it there; leave it out of the observation"
                for entry, of in entries[:1]
            ]
        return lines
