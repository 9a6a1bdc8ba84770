"""PointCarry: a point picks up an object by touching it and carries it to a goal.

The environment needs no simulator and is learned in a few thousand steps, so it shows in seconds
what MUSIC does: MUSIC-u learns without any reward to fetch and move the object.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

_START_DISTANCE = 0.4
_REACH = 0.2
"""Distance at which the point picks up the object, and at which the object has reached the goal."""
_STEP = 0.1
_PIXELS = 128


def _box(size: int) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (size,), np.float32)


class PointCarry(gym.Env[dict[str, NDArray[np.float32]], NDArray[np.float32]]):
    """A point in the square [-1, 1]^2; observation: position of the point (2), of the object (2).

    An action in [-1, 1]^2 moves the point by at most 0.1 per axis. The object starts 0.4 from the
    point in a random direction. From the first step within 0.2 of it, the point carries it. The
    reward is 0 while the object is within 0.2 of the goal, otherwise -1.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        self.observation_space = spaces.Dict(
            {"observation": _box(4), "achieved_goal": _box(2), "desired_goal": _box(2)}
        )
        self.action_space = _box(2)
        self.render_mode = render_mode
        self._point = self._object = self.goal = np.zeros(2)
        self._carries = False

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Rewards `[B]` of achieved and desired goals `[B, 2]`, or one reward of two `[2]`."""
        distance = np.linalg.norm(np.asarray(achieved_goal) - desired_goal, axis=-1)
        return -(distance > _REACH).astype(np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        super().reset(seed=seed)
        angle = self.np_random.uniform(-np.pi, np.pi)
        self._point, self._carries = np.zeros(2), False
        self._object = _START_DISTANCE * np.array([np.cos(angle), np.sin(angle)])
        self.goal = self._object
        while np.linalg.norm(self.goal - self._object) < 2 * _REACH:
            self.goal = self.np_random.uniform(-0.7, 0.7, 2)
        return self._observation(), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        self._point = np.clip(self._point + _STEP * np.clip(action, -1.0, 1.0), -1.0, 1.0)
        self._carries |= bool(np.linalg.norm(self._object - self._point) < _REACH)
        if self._carries:
            self._object = self._point
        observation = self._observation()
        goals = observation["achieved_goal"], observation["desired_goal"]
        reward = float(self.compute_reward(*goals, {}))
        return observation, reward, False, False, {"is_success": reward == 0.0}

    def render(self) -> Any:
        """Image `[128, 128, 3]` of the goal (green), the object (orange) and the point (blue)."""
        rows, columns = np.mgrid[1 : -1 : _PIXELS * 1j, -1 : 1 : _PIXELS * 1j]
        image = np.full((_PIXELS, _PIXELS, 3), 255, np.uint8)
        discs = (
            (self.goal, _REACH, (170, 220, 170)),
            (self._object, 0.1, (230, 140, 40)),
            (self._point, 0.05, (40, 90, 200)),
        )
        for (x, y), radius, color in discs:
            image[np.hypot(columns - x, rows - y) < radius] = color
        return image

    def _observation(self) -> dict[str, NDArray[np.float32]]:
        return {
            "observation": np.concatenate([self._point, self._object]).astype(np.float32),
            "achieved_goal": self._object.astype(np.float32),
            "desired_goal": self.goal.astype(np.float32),
        }


gym.register("PointCarry-v0", f"{__name__}:PointCarry", max_episode_steps=50)
