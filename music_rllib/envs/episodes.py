"""Record episodes while they are played, and check every number and reward of them.

Shape legend: n steps of an episode, G goal features, B rows of a batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from music_rllib.envs.values import (
    GOAL_KEYS,
    LARGEST,
    BadNumberError,
    are_usable,
    check_numbers,
    flag_of,
    number_of,
    shown,
    success_of,
    vector,
)
from music_rllib.replay.buffer import GoalEnd, GoalReward
from music_rllib.replay.trajectories import ReplayLayout, Trajectory

Floats = NDArray[np.float32]
Goals = NDArray[np.floating[Any]]

TOLERANCE = 1e-5
"""Difference of two rewards that counts as rounding, relative to the range of the rewards."""
_NEIGHBORS = 64
"""Number of goals tried around those of a step, which may have been rounded."""
_ROWS, _MOST_ROUNDED = 4096, 0.005
"""Number of goals tried for the effect of rounding, and the accepted share of changed rewards."""

END_AT_GOAL = (
    "step() terminates episodes; if it does so at the goal, hindsight needs compute_terminated("
    "achieved_goal, desired_goal, info), or relabeled transitions do not end at their new goal"
)
EARLY_END = (
    "step() terminates episodes, and intrinsic rewards lie in [-1, 0]: a policy earns more of them "
    "by ending an episode early. If the end is a failure, use an environment that continues (often "
    "env_kwargs: {terminate_when_unhealthy: false})"
)
"""Remarks about environments whose episodes terminate."""


@dataclass(frozen=True)
class Episode(Trajectory):
    """A finished episode, and whether each of its steps was a success."""

    successes: NDArray[np.bool_] | None
    """[n]; None if the environment does not define success."""

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
        goal_reward: the function that hindsight uses; the rewards of the episode must equal its
            values. None without hindsight.
        goal_end: the function that hindsight uses; the episode must terminate where it is True.
    """

    def __init__(
        self,
        layout: ReplayLayout,
        *,
        name: str,
        zero_goal: bool = False,
        success: tuple[str | None, bool | None] = (None, None),
        goal_reward: GoalReward | None = None,
        goal_end: GoalEnd | None = None,
    ) -> None:
        self._layout, self._zero_goal, self._name = layout, zero_goal, name
        self._success, self._goal_reward, self._goal_end = success, goal_reward, goal_end
        self._frames = np.zeros((layout.horizon + 1, layout.frame), np.float32)
        self._actions = np.zeros((layout.horizon, layout.action), np.float32)
        self._rewards = np.zeros(layout.horizon, np.float32)
        self._successes: list[bool | None] = []
        self.steps = 0

    @property
    def place(self) -> str:
        """Name of the episode and its current step, for messages."""
        return f"{self._name}, step {self.steps}"

    @property
    def network_input(self) -> Floats:
        """[I] the policy's input at the current step."""
        return self._frames[self.steps, : self._layout.network_input]

    def see(self, observation: Any) -> None:
        """Record the observation of a reset; raises BadNumberError for a bad one."""
        try:
            self._see(observation)
        except ValueError as error:
            raise BadNumberError.at(self.place, error) from None

    def step(self, action: Floats, reward: Any, info: Mapping[str, Any], observation: Any) -> None:
        """Record a step; raises BadNumberError for a bad value."""
        self._actions[self.steps] = action
        self.steps += 1
        try:
            number = number_of(reward, "reward")
            if not abs(number) <= LARGEST:
                check_numbers("reward", number)
            success = success_of(info, *self._success)
            self._see(observation)
        except ValueError as error:
            raise BadNumberError.at(self.place, error) from None
        self._rewards[self.steps - 1] = number
        self._successes.append(success)

    def ends(self, terminated: Any, truncated: Any) -> tuple[bool, bool]:
        """The flags of the last step as bools; raises BadNumberError for other values."""
        try:
            return flag_of(terminated, "terminated"), flag_of(truncated, "truncated")
        except ValueError as error:
            raise BadNumberError.at(self.place, error) from None

    def _see(self, observation: Any) -> None:
        frame, layout = self._frames[self.steps], self._layout
        if layout.goal == 0:
            given = {"observation": observation}
            frame[:] = vector(observation, "observation", layout.observation)
        else:
            given = observation
            try:
                seen, desired, achieved = (observation[name] for name in GOAL_KEYS)
            except (KeyError, TypeError, IndexError):
                rule = f"observation must be a dictionary with {', '.join(GOAL_KEYS)}"
                raise ValueError(f"{rule}, got {shown(observation)}") from None
            frame[: layout.observation] = vector(seen, "observation", layout.observation)
            desired = vector(desired, "desired_goal", layout.goal)
            if not self._zero_goal:
                frame[layout.observation : layout.network_input] = desired
            frame[layout.network_input :] = vector(achieved, "achieved_goal", layout.goal)
        if not are_usable(frame):
            for name in GOAL_KEYS:
                if name in given:
                    check_numbers(name, given[name])

    def finish(self, *, terminated: bool) -> Episode:
        """The finished episode; raises BadNumberError if hindsight computes other steps."""
        n = self.steps
        episode = Episode(
            self._frames[: n + 1],
            self._actions[:n],
            self._rewards[:n],
            terminated,
            self._flags(),
        )
        if self._goal_reward is not None and not self._zero_goal:
            self._check_hindsight(self._goal_reward, episode)
        return episode

    def _flags(self) -> NDArray[np.bool_] | None:
        """[n] successes; None if no step reported one. A step without a report is none."""
        if all(each is None for each in self._successes):
            return None
        return np.array([each is True for each in self._successes])

    def _check_hindsight(self, reward: GoalReward, episode: Episode) -> None:
        goals = episode.frames[:, self._layout.observation :]
        if found := first_mismatch(reward, goals, episode.rewards):
            step, given, computed = found
            problem = (
                "compute_reward is not the whole reward of a step: a step returned reward "
                f"{given:g}, compute_reward gives {computed:g}"
            )
        elif ended := self._end_not_played(goals, episode.terminated):
            step, problem = ended, "episodes continue where compute_terminated is True"
        else:
            return
        rule = f"replay.hindsight_k must be 0 if {problem}"
        raise BadNumberError.at(f"{self._name}, step {step}", rule)

    def _end_not_played(self, goals: NDArray[np.float32], terminated: bool) -> int | None:
        """The first step whose goals end an episode that did not terminate there."""
        if self._goal_end is None:
            return None
        desired, achieved = np.split(goals[1:], 2, axis=1)
        computed = self._goal_end(achieved, desired)
        if not computed.any():
            return None
        ends = np.zeros(len(computed), np.float32)
        # An episode may terminate for another reason than its goal.
        ends[-1] = terminated and computed[-1]
        found = first_mismatch(self._goal_end, goals, ends)
        return None if found is None else found[0]


# -- rewards of goals -------------------------------------------------------------------------


def first_mismatch(
    reward: GoalReward, goals: NDArray[np.float32], given: NDArray[np.float32]
) -> tuple[int, float, float] | None:
    """Find the first step whose reward differs from the reward of its goals.

    A reward may belong to the desired goal before or after its step. It may also differ as much as
    rewards of goals that round to the same float32, for example at a threshold.

    Args:
        goals: [n+1, 2G] desired and achieved goals of an episode.
        given: [n] rewards of its steps.

    Returns:
        The number of the step, counted from 1, its reward, and the reward of its goals; or None.
    """
    desired, achieved = np.split(goals.astype(np.float64), 2, axis=1)
    achieved = achieved[1:]
    computed = _rewards(reward, achieved, desired[1:])
    # An episode may have one value of a sparse reward only; reached goals have the other one.
    values = np.concatenate([computed, _rewards(reward, achieved, achieved)])
    tolerance = TOLERANCE * np.maximum(np.ptp(values), np.abs(given))
    for i in np.flatnonzero(~(np.abs(given - computed) <= tolerance)):
        near = [_range_near(reward, achieved[i], desired[j]) for j in (i + 1, i)]
        if not any(low - tolerance[i] <= given[i] <= high + tolerance[i] for low, high in near):
            return int(i) + 1, float(given[i]) + 0.0, float(computed[i]) + 0.0
    return None


def _rewards(reward: GoalReward, achieved: Goals, desired: Goals) -> NDArray[np.float64]:
    return np.asarray(reward(achieved, desired), np.float64).reshape(len(achieved))


def _range_near(reward: GoalReward, achieved: Goals, desired: Goals) -> tuple[float, float]:
    """Smallest and largest reward of goals that round to approximately the given ones [G]."""
    grain = 2.0 * np.spacing(np.maximum(np.abs(achieved), np.abs(desired)).astype(np.float32))
    signs = np.random.default_rng(0).choice([-1.0, 0.0, 1.0], (2, _NEIGHBORS, len(achieved)))
    signs[:, 0] = 0.0
    rewards = _rewards(reward, achieved + grain * signs[0], desired + grain * signs[1])
    return float(rewards.min()), float(rewards.max())


def lost_by_rounding(reward: GoalReward, achieved: Goals, distance: float) -> str | None:
    """Explain why goals around `achieved` [G] can't be kept in float32; None if they can.

    Goals far from the origin, such as UTM coordinates, lose the digits on which rewards depend.

    Args:
        achieved: an achieved goal as the environment returns it.
        distance: typical distance of achieved and desired goals.
    """
    around = np.broadcast_to(achieved.astype(np.float64), (_ROWS, len(achieved)))
    desired = around + distance * random_offsets(_ROWS, len(achieved), 1e-3, 2.0)
    exact, reached = _rewards(reward, around, desired), _rewards(reward, around, around)
    kept = _rewards(reward, around.astype(np.float32), desired.astype(np.float32))
    changed = np.abs(exact - kept) > 0.05 * np.abs(exact - reached) + 1e-6 * np.ptp(exact)
    if changed.mean() <= _MOST_ROUNDED:
        return None
    entry = int(np.argmax(np.abs(achieved)))
    value = float(achieved[entry])
    return (
        f"achieved_goal[{entry}] is {value:.10g}, which float32 keeps to "
        f"{float(np.spacing(np.float32(abs(value)))):.2g} only, and that changes "
        f"{changed.mean():.0%} of the rewards: give goals relative to an origin that is near them"
    )


def random_offsets(rows: int, size: int, nearest: float, farthest: float) -> NDArray[np.float64]:
    """[rows, size] random offsets of increasing length, in random subsets of the entries."""
    rng = np.random.default_rng(0)
    lengths = np.geomspace(nearest, farthest, rows)[:, None]
    offsets = lengths * rng.standard_normal((rows, size))
    return np.asarray(offsets * rng.integers(0, 2, (rows, size)))
