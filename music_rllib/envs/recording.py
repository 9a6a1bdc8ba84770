"""Records an episode while it is played, and checks every number of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from music_rllib.envs.goal_rewards import first_unlike
from music_rllib.envs.numbers import (
    LARGEST,
    BadNumberError,
    are_usable,
    check_numbers,
    number_of,
    shown,
    success_of,
    vector,
)
from music_rllib.replay.buffer import GoalReward
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
        success: key of `info` that reports success, and the value of a step without it.
        goal_reward: the rewards that hindsight computes, which the given ones must equal; None
            without hindsight.
    """

    def __init__(
        self,
        layout: ReplayLayout,
        *,
        name: str,
        zero_goal: bool = False,
        success: tuple[str | None, bool | None] = (None, None),
        goal_reward: GoalReward | None = None,
    ) -> None:
        self._layout, self._zero_goal, self._name = layout, zero_goal, name
        self._success, self._goal_reward = success, goal_reward
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
        """Records the next observation; raises BadNumberError for a bad one."""
        try:
            self._see(observation)
        except ValueError as error:
            raise BadNumberError.at(self.place, error) from None

    def _see(self, observation: Any) -> None:
        frame, layout = self._frames[self.steps], self._layout
        if layout.goal == 0:
            frame[:] = vector(observation, "observation", layout.observation)
        else:
            try:
                seen, desired, achieved = (observation[name] for name in _PARTS)
            except (KeyError, TypeError, IndexError):
                rule = f"observation must be a dictionary with {', '.join(_PARTS)}"
                raise ValueError(f"{rule}, got {shown(observation)}") from None
            frame[: layout.observation] = vector(seen, "observation", layout.observation)
            desired = vector(desired, "desired_goal", layout.goal)
            if not self._zero_goal:
                frame[layout.observation : layout.network_input] = desired
            frame[layout.network_input :] = vector(achieved, "achieved_goal", layout.goal)
        if not are_usable(frame):
            given = {"observation": observation} if layout.goal == 0 else observation
            check_numbers([(name, given[name]) for name in _PARTS if name in given], self.place)

    @property
    def network_input(self) -> Floats:
        """[I] the policy's input at the current step."""
        return self._frames[self.steps, : self._layout.network_input]

    def step(self, action: Floats, reward: Any, info: Mapping[str, Any], observation: Any) -> None:
        """Records a step; raises BadNumberError for a bad value."""
        try:
            number = number_of(reward, "reward")
            success = success_of(info, *self._success)
        except ValueError as error:
            raise BadNumberError.at(f"{self._name}, step {self.steps + 1}", error) from None
        self._actions[self.steps] = action
        self._rewards[self.steps] = number
        self.steps += 1
        if not abs(number) <= LARGEST:
            check_numbers([("reward", number)], self.place)
        if success is not None:
            self._successes.append(success)
        self.see(observation)

    def finish(self, *, terminated: bool) -> Episode:
        """The finished episode; raises BadNumberError where hindsight has other rewards."""
        n = self.steps
        episode = Episode(
            self._frames[: n + 1],
            self._actions[:n],
            self._rewards[:n],
            terminated,
            np.array(self._successes) if self._successes else None,
        )
        if self._goal_reward is not None and not self._zero_goal:
            goals = episode.frames[:, self._layout.observation :]
            unlike = first_unlike(self._goal_reward, goals, episode.rewards)
            if unlike is not None:
                raise BadNumberError.at(
                    f"{self._name}, step {unlike.step}",
                    "replay.hindsight_k must be 0 where compute_reward is not the whole reward of "
                    f"a step: {unlike.problem}",
                )
        return episode
