"""A cheap environment: a point that pushes another point to a goal."""

from __future__ import annotations

import ctypes
import os
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Array = NDArray[np.float32]


class GripperError(Exception):
    """An environment with two arguments, so it can be neither copied nor pickled."""

    def __init__(self, what: str, said: str) -> None:
        super().__init__(f"{what}\n{said}")


class Point(gym.Env[dict[str, Array], Array]):
    """Observation: agent (2) and object (2), which moves with the agent's actions.

    Args:
        fail_at: step, counted over all episodes, at which it raises an error.
        nan_at: step, counted likewise, at which the object's position becomes NaN.
    """

    def __init__(self, fail_at: int | None = None, nan_at: int | None = None) -> None:
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.Box(-2, 2, (4,), np.float32),
                "achieved_goal": spaces.Box(-2, 2, (2,), np.float32),
                "desired_goal": spaces.Box(-2, 2, (2,), np.float32),
            }
        )
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self._state = np.zeros(4, np.float32)
        self._goal = np.zeros(2, np.float32)
        self._fail_at, self._nan_at = fail_at, nan_at
        self._steps = 0

    def compute_reward(self, achieved: Array, desired: Array, info: Any) -> Array:
        distance = np.linalg.norm(achieved - desired, axis=-1)
        return -np.asarray(distance > 0.3, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        super().reset(seed=seed)
        self._state = self.np_random.uniform(-1, 1, 4).astype(np.float32)
        self._goal = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self._observation(), {}

    def step(self, action: Array) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        self._steps += 1
        if self._steps == self._fail_at:
            said = os.environ.get("POINT_SAYS", "look at the second screw")
            raise GripperError("the gripper fell off", said)
        moved = self._state + np.concatenate([0.1 * action, 0.05 * action])
        self._state = np.clip(moved, -2, 2).astype(np.float32)
        if self._steps == self._nan_at:
            self._state[2:] = np.nan
        observation = self._observation()
        reward = float(self.compute_reward(observation["achieved_goal"], self._goal, {}))
        return observation, reward, False, False, {"is_success": float(reward == 0)}

    def _observation(self) -> dict[str, Array]:
        return {
            "observation": self._state.copy(),
            "achieved_goal": self._state[2:].copy(),
            "desired_goal": self._goal.copy(),
        }


class Hanging(Point):
    """Never return from a step.

    Args:
        at: number of the step, counted over all episodes.
        locked: whether it holds Python's lock meanwhile, as a simulator in C may.
    """

    def __init__(self, at: int = 50, locked: bool = False) -> None:
        super().__init__()
        self._at, self._locked = at, locked

    def step(self, action: Array) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        if self._steps + 1 == self._at:
            self.hang()
        return super().step(action)

    def hang(self) -> None:
        sleep = ctypes.PyDLL(None).sleep if self._locked else time.sleep
        sleep(3600)


class Paced(Point):
    """Step slowly until the file `fast` exists, so that a run can be interrupted.

    Args:
        fast: path of the file.
        after: number of steps before the slow ones.
        seconds: duration of a slow step.
    """

    def __init__(self, fast: str, after: int = 0, seconds: float = 0.01) -> None:
        super().__init__()
        self._fast, self._after, self._seconds = Path(fast), after, seconds

    def step(self, action: Array) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        if self._steps >= self._after and not self._fast.exists():
            time.sleep(self._seconds)
        return super().step(action)


class Meeting(Paced):
    """Write the node's name to `folder`, and wait until another node has done so.

    Args:
        folder: shared folder.
        fast: path of the file until which steps are slow.
    """

    def __init__(self, folder: str, fast: str) -> None:
        import ray

        super().__init__(fast, seconds=0.02)
        if not ray.is_initialized():
            return  # in the driver
        Path(folder, ray.get_runtime_context().get_node_id()).touch()
        for _ in range(1500):
            if len(list(Path(folder).iterdir())) > 1:
                return
            time.sleep(0.1)
        raise RuntimeError("no run on another node has come")


class HandOver(Point):
    """Render in an unusual size, and check actions against bounds that float32 can't represent."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__()
        self.action_space = spaces.Box(-0.1, 0.1, (2,), np.float64)
        self.render_mode = render_mode

    def step(self, action: Array) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), f"{action} is out of bounds"
        return super().step(action)

    def render(self) -> Any:
        return np.zeros((16, 24, 3), np.uint8)


gym.register("Point-v0", "point_env:Point", max_episode_steps=20)
gym.register("Hanging-v0", entry_point="point_env:Hanging", max_episode_steps=20)
gym.register("Meeting-v0", entry_point="point_env:Meeting", max_episode_steps=20)
gym.register("HandOver-v0", entry_point="point_env:HandOver", max_episode_steps=20)
gym.register("Paced-v0", entry_point="point_env:Paced", max_episode_steps=20)
