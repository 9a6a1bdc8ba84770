"""Records an episode while it is played, and checks every number of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from music_rllib.envs.numbers import LARGEST, are_usable, check_numbers
from music_rllib.replay.trajectories import ReplayLayout, Trajectory

Floats = NDArray[np.float32]
_PARTS = ("observation", "desired_goal", "achieved_goal")


@dataclass(frozen=True)
class Episode(Trajectory):
    """A finished episode, and whether each of its steps was a success."""

    successes: NDArray[np.bool_] | None
    """[n]; None where the environment does not define success."""

    def env_steps(self) -> int:
        return len(self)

    def agent_steps(self) -> int:
        return len(self)


class Recording:
    """An episode that is being played.

    Args:
        layout: sizes of its arrays.
        zero_goal: whether desired goals are replaced by zeros.
        name: name of environment and episode, for messages.
    """

    def __init__(self, layout: ReplayLayout, *, zero_goal: bool, name: str) -> None:
        self._layout, self._zero_goal, self._name = layout, zero_goal, name
        self._frames = np.zeros((layout.horizon + 1, layout.frame), np.float32)
        self._actions = np.zeros((layout.horizon, layout.action), np.float32)
        self._rewards = np.zeros(layout.horizon, np.float32)
        self._successes: list[bool] = []
        self.steps = 0

    @property
    def place(self) -> str:
        """Name of the episode and its current step, for messages."""
        return f"{self._name}, step {self.steps}"

    def see(self, observation: Any) -> None:
        """Records the next observation; raises BadNumberError for a bad number."""
        frame, layout = self._frames[self.steps], self._layout
        if layout.goal == 0:
            frame[:] = observation
        else:
            frame[: layout.observation] = observation["observation"]
            if not self._zero_goal:
                frame[layout.observation : layout.network_input] = observation["desired_goal"]
            frame[layout.network_input :] = observation["achieved_goal"]
        if not are_usable(frame):
            given = {"observation": observation} if layout.goal == 0 else observation
            check_numbers([(name, given[name]) for name in _PARTS if name in given], self.place)

    @property
    def network_input(self) -> Floats:
        """[I] the policy's input at the current step."""
        return self._frames[self.steps, : self._layout.network_input]

    def step(self, action: Floats, reward: float, success: float | None, observation: Any) -> None:
        """Records a step; raises BadNumberError for a bad number."""
        self._actions[self.steps] = action
        self._rewards[self.steps] = reward
        self.steps += 1
        if not abs(reward) <= LARGEST:
            check_numbers([("reward", reward)], self.place)
        if success is not None:
            if success != success:  # NaN, which bool() takes for true
                check_numbers([("success", success)], self.place)
            self._successes.append(bool(success))
        self.see(observation)

    def finish(self, *, terminated: bool) -> Episode:
        """The finished episode."""
        n = self.steps
        return Episode(
            self._frames[: n + 1],
            self._actions[:n],
            self._rewards[:n],
            terminated,
            np.array(self._successes) if self._successes else None,
        )
