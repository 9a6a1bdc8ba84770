"""Replay of whole trajectories, seen as transitions or as trajectories.

Its memory is that of the ring (`music_rllib.replay.ring`); prioritised replay by TD error adds
8 bytes a row and a tree of 16 to 32.

Shape legend: B transitions, N trajectories, T frames, D observation, G goal, A action.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from music_rllib.replay.priorities import TDPriorities, WeightedDraws, ranges, rank_weights
from music_rllib.replay.ring import TrajectoryRing
from music_rllib.replay.sampling import Places
from music_rllib.replay.trajectories import (
    Floats,
    ReplayLayout,
    Rows,
    Trajectory,
    Transitions,
    WholeTrajectories,
    long_enough,
)

__all__ = ["GoalReward", "TrajectoryReplay"]

GoalReward = Callable[[Floats, Floats], NDArray[Any]]
"""(achieved [B, G], desired [B, G]) -> [B] rewards, without touching a simulator."""


class TrajectoryReplay(TrajectoryRing):
    """Ring of trajectories with uniform transition sampling, hindsight, and a trajectory view.

    Args:
        layout: sizes of a frame and an action, and the longest episode.
        capacity: transitions of full episodes held at most, rounded down to whole episodes.
        rng: all sampling is drawn from it.
        goal_reward: recomputes rewards of relabelled transitions; needed for hindsight.
        hindsight_k: HER `future` (Andrychowicz et al. 2017): a share k/(1+k) of transitions gets
            a goal that their trajectory achieved later on.
        hindsight_episodes: `all`; or `moved`: transitions with such a goal come only from
            trajectories that have moved (Manela & Biess 2021 filter hindsight goals by the same
            thought), but from none of them more than `MOST_OF_ONE_EPISODE`: where they are too
            few for that, the rest comes from all.
        moved_distance: a trajectory has moved where it achieves a goal farther than this from
            the one it begins with. None: one that its first state does not reach by
            `goal_reward`, which must be sparse then.
        td_exponent: PER (Schaul et al. 2016): draw transitions with probability proportional to
            their absolute TD error to this power. None: uniformly.

    Raises:
        ValueError: no room for one episode, or hindsight without goals.
    """

    def __init__(
        self,
        layout: ReplayLayout,
        capacity: int,
        rng: np.random.Generator,
        *,
        goal_reward: GoalReward | None = None,
        hindsight_k: float = 0.0,
        hindsight_episodes: Literal["all", "moved"] = "all",
        moved_distance: float | None = None,
        td_exponent: float | None = None,
    ) -> None:
        super().__init__(layout, capacity)
        if hindsight_k > 0 and (goal_reward is None or layout.goal == 0):
            raise ValueError(
                f"replay.hindsight_k must be 0 without a goal environment, got {hindsight_k:g}"
            )
        self.rng = rng
        self._goal_reward = goal_reward
        self._hindsight_share = hindsight_k / (1.0 + hindsight_k)
        self._only_moved = hindsight_episodes == "moved" and hindsight_k > 0
        self._moved_distance = moved_distance
        self._moved = np.zeros(0, np.bool_)
        self._places: tuple[Places, Places] | None = None
        self._whole: Places | None = None
        self._priorities = np.zeros(0, np.float64)
        self._by_rank: WeightedDraws | None = None
        self._td = None if td_exponent is None else TDPriorities(len(self._steps), td_exponent)

    def __len__(self) -> int:
        """Transitions held."""
        return self._all_and_moved()[0].total

    # -- storing --------------------------------------------------------------------------

    def extend(
        self, trajectories: Sequence[Trajectory], priorities: NDArray[np.float64] | None = None
    ) -> None:
        """Stores finished episodes in place of the oldest ones.

        Args:
            priorities: [N] MUSIC-p: episodes are drawn by the rank of these. Given always or never.
        """
        for i, trajectory in enumerate(trajectories):
            self._add(trajectory)
            if priorities is not None:
                self._priorities = np.append(self._priorities, priorities[i])
        if priorities is not None:
            self._rank()

    def _rank(self) -> None:
        if len(self._priorities):
            self._by_rank = WeightedDraws(rank_weights(self._priorities))

    def _add(self, trajectory: Trajectory) -> None:
        start, steps = self._store(trajectory), len(trajectory)
        if self._only_moved:
            self._moved = np.append(self._moved, self._has_moved(start, steps))
        if self._td is not None:
            self._td.add(start, steps)
        self._places = self._whole = None

    def _drop(self, count: int) -> None:
        if self._td is not None:
            for start, steps in zip(self._starts[:count], self._lengths[:count], strict=True):
                self._td.remove(start, steps)
        super()._drop(count)
        self._priorities = self._priorities[count:]
        self._moved = self._moved[count:]

    def _has_moved(self, start: int, steps: int) -> bool:
        """Whether a goal achieved later is not reached by the state that the episode begins in."""
        assert self._goal_reward is not None
        achieved = self._frames[start : start + steps + 1, self.layout.network_input :]
        if self._moved_distance is not None:
            away = np.linalg.norm(achieved - achieved[0], axis=1)
            return bool(away.max() > self._moved_distance)
        at_first = np.broadcast_to(achieved[0], achieved.shape)
        return bool(
            np.any(self._goal_reward(at_first, achieved) < self._goal_reward(achieved, achieved))
        )

    def _find_moved(self) -> None:
        """After loading: what storing would have found out."""
        if self._only_moved:
            places = zip(self._starts.tolist(), self._lengths.tolist(), strict=True)
            moved = [self._has_moved(start, steps) for start, steps in places]
            self._moved = np.array(moved, np.bool_)
        self._places = self._whole = None

    def _all_and_moved(self) -> tuple[Places, Places]:
        """Kept between minibatches: to find them anew takes time that grows with the replay."""
        if self._places is None:
            moved = self._moved if self._only_moved else slice(0)
            self._places = (
                Places.of(self._starts, self._lengths),
                Places.of(self._starts[moved], self._lengths[moved]),
            )
        return self._places

    # -- the view of TAC: transitions -----------------------------------------------------

    def sample_transitions(self, count: int, *, importance_exponent: float = 0.0) -> Transitions:
        """`count` transitions with replacement: uniform over all, or by priority where set.

        Args:
            importance_exponent: PER's beta, for the importance weights.

        Raises:
            ValueError: the replay is empty.
        """
        start, step, length = self._draw(count)
        relabelled = self._hindsight_share > 0
        if relabelled:
            chosen = np.flatnonzero(self.rng.random(count) < self._hindsight_share)
            _, moved = self._all_and_moved()
            if moved.total:
                part = chosen[moved.few_of_one(self.rng, len(chosen), self._hindsight_share)]
                start[part], step[part], length[part] = moved.draw(self.rng, len(part))
        row = start + step
        width, frame = self.layout.network_input, self.layout.frame
        after = self._steps.shape[1]
        both = self._read(row, 0, after + frame)
        inputs, next_inputs = both[:, :width].copy(), both[:, after : after + width].copy()
        actions, rewards = both[:, frame : after - 2].copy(), both[:, after - 2].copy()
        if relabelled:
            later = self._later_step(step[chosen], length[chosen])
            goals = self._read(start[chosen] + later, width, self.layout.goal)
            inputs[chosen, self.layout.observation :] = goals
            next_inputs[chosen, self.layout.observation :] = goals
            assert self._goal_reward is not None
            rewards[chosen] = self._goal_reward(both[chosen, after + width :], goals)
        weights = None
        if self._td is not None:
            weights = self._td.importance_weights(row, len(self), importance_exponent)
        discounts = 1.0 - both[:, after - 1]
        return Transitions(inputs, actions, rewards, discounts, next_inputs, weights, row)

    def update_priorities(self, rows: Rows, errors: Floats) -> None:
        """PER: takes over the absolute TD errors [B] of transitions drawn from `rows` [B]."""
        assert self._td is not None
        self._td.update(rows, errors)

    def _draw(self, count: int) -> tuple[Rows, Rows, Rows]:
        """First frame, step and length of their trajectory, of `count` transitions; [B] each."""
        self._check_filled()
        if self._td is not None:
            return self._td.draw(self.rng.random(count))
        if self._by_rank is not None:
            which = self._by_rank.draw(self.rng.random(count))
            length = self._lengths[which]
            return self._starts[which], (self.rng.random(count) * length).astype(np.int64), length
        return self._all_and_moved()[0].draw(self.rng, count)

    def _check_filled(self) -> None:
        if not self.trajectories:
            raise ValueError("cannot sample from an empty replay: collect an episode first")

    def _later_step(self, step: NDArray[np.int64], length: NDArray[np.int64]) -> NDArray[np.int64]:
        """Uniform over the states that follow: step + 1 to the episode's last one."""
        return step + 1 + (self.rng.random(len(step)) * (length - step)).astype(np.int64)

    # -- the view of MUSIC: trajectories --------------------------------------------------

    def sample_trajectories(self, count: int) -> WholeTrajectories:
        """Observations of `count` whole trajectories, drawn with replacement.

        Each in proportion to its steps, so that every state counts the same, as for the policy.
        Those of a single step only where there are no others. T is the longest one held.

        Raises:
            ValueError: the replay is empty.
        """
        places = self._long_enough()
        start, _, length = places.draw(self.rng, count)
        time = np.arange(places.longest + 1)
        if places.equal:
            return WholeTrajectories(
                self._read(start[:, None] + time, 0, self.layout.observation), None
            )
        rows = start[:, None] + np.minimum(time, length[:, None])
        observations = self._read(rows, 0, self.layout.observation)
        return WholeTrajectories(observations, time <= length[:, None])

    def _long_enough(self) -> Places:
        """Kept between minibatches, as `_all_and_moved`."""
        if self._whole is None:
            self._check_filled()
            chosen = long_enough(self._lengths)
            self._whole = Places.of(self._starts[chosen], self._lengths[chosen])
        return self._whole

    # -- checkpoints ----------------------------------------------------------------------

    def index(self) -> dict[str, Any]:
        """Everything that `packed` lacks: places of trajectories, priorities, random generator.

        Small: 24 bytes a trajectory, and with priorities by TD error 8 a transition.
        """
        td = None if self._td is None else self._td.packed(ranges(self._starts, self._lengths))
        return {
            "starts": self._starts.copy(),
            "lengths": self._lengths.copy(),
            "priorities": self._priorities.copy(),
            "td": td,
            "write": self._write,
            "trajectories_added": self.trajectories_added,
            "rng": self.rng.bit_generator.state,
        }

    def load_packed(
        self, index: dict[str, Any], parts: Iterable[tuple[int, Mapping[str, NDArray[Any]]]]
    ) -> None:
        """Continues exactly where `index` was taken. Only for a replay that is still empty.

        Args:
            index: what `index()` gave.
            parts: number of the first trajectory, and arrays as `packed` gives them; what they
                have beyond the index is left out.

        Raises:
            ValueError: they come from a replay of other sizes, or do not make up all of it.
        """
        self._starts = np.array(index["starts"], np.int64)
        self._lengths = np.array(index["lengths"], np.int64)
        self.trajectories_added = int(index["trajectories_added"])
        self._used = int((self._starts + self._lengths).max(initial=-1)) + 1
        if self._used > len(self._frames):
            raise ValueError(
                f"the replay holds {len(self._frames)} frames, the checkpoint has {self._used}"
            )
        wanted = self.oldest
        for first, arrays in parts:
            if first > wanted:
                break
            wanted = max(wanted, self._place(first, arrays))
        if wanted < self.trajectories_added:
            raise ValueError(
                f"trajectory {wanted} must be in the checkpoint's files, as those before it"
            )
        self._priorities = np.array(index["priorities"], np.float64)
        self._rank()
        self._find_moved()
        if self._td is not None:
            self._td.load_packed(self._starts, self._lengths, index["td"])
        self._write = int(index["write"])
        self.rng.bit_generator.state = index["rng"]

    def state(self) -> dict[str, Any]:
        """Everything that sampling and storing depend on, as arrays and plain values."""
        used = self._used
        return {
            "frames": self._frames[:used].copy(),
            "actions": self._actions[:used].copy(),
            "rewards": self._rewards[:used].copy(),
            "terminal": self._terminal[:used] > 0,
            "starts": self._starts.copy(),
            "lengths": self._lengths.copy(),
            "priorities": self._priorities.copy(),
            "td": None if self._td is None else self._td.state(),
            "write": self._write,
            "trajectories_added": self.trajectories_added,
            "rng": self.rng.bit_generator.state,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continues exactly where `state()` was taken.

        Raises:
            ValueError: the state comes from a replay of other sizes.
        """
        frames = np.asarray(state["frames"])
        if frames.shape[1] != self.layout.frame or len(frames) > len(self._frames):
            raise ValueError(
                f"the replay holds {len(self._frames)} frames of {self.layout.frame} numbers, "
                f"the checkpoint has {frames.shape[0]} of {frames.shape[1]}"
            )
        self._used = used = len(frames)
        self._frames[:used] = frames
        self._actions[:used] = state["actions"]
        self._rewards[:used] = state["rewards"]
        self._terminal[:used] = state["terminal"]
        self._starts = np.array(state["starts"], np.int64)
        self._lengths = np.array(state["lengths"], np.int64)
        self._priorities = np.array(state["priorities"], np.float64)
        self._rank()
        self._find_moved()
        if self._td is not None:
            self._td.load_state(state["td"])
        self._write = int(state["write"])
        self.trajectories_added = int(state["trajectories_added"])
        self.rng.bit_generator.state = state["rng"]
