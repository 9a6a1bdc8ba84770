"""Replay of whole trajectories, sampled as transitions or as trajectories.

It needs the memory of the ring (`music_rllib.replay.ring`). Prioritized replay by TD error adds
8 bytes a row and a tree of 16 to 32 bytes a row.

Shape legend: B transitions, N trajectories, T frames, D observation, G goal, A action.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from music_rllib.replay.ring import TrajectoryRing
from music_rllib.replay.sampling import (
    Places,
    TDPriorities,
    Weights,
    draw_weighted,
    ranges,
    rank_weights,
)
from music_rllib.replay.trajectories import (
    Floats,
    ReplayLayout,
    Rows,
    Trajectory,
    Transitions,
    WholeTrajectories,
    long_enough,
)

GoalReward = Callable[[Floats, Floats], NDArray[Any]]
"""(achieved [B, G], desired [B, G]) -> [B] rewards, without touching a simulator."""
GoalEnd = Callable[[Floats, Floats], NDArray[np.bool_]]
"""(achieved [B, G], desired [B, G]) -> [B] whether a step to these goals ends the episode."""


class TrajectoryReplay(TrajectoryRing):
    """Ring of trajectories with uniform transition sampling, hindsight, and a trajectory view.

    Args:
        layout: sizes of a frame and an action, and the longest episode.
        capacity: largest number of transitions of full episodes, rounded down to whole episodes.
        rng: source of all random numbers of sampling.
        goal_reward: recomputes rewards of relabeled transitions; needed for hindsight.
        goal_end: recomputes where relabeled transitions end. None: the environment does not end
            episodes at a goal, and they end where the played episode does.
        hindsight_k: HER (Andrychowicz et al. 2017): a share k/(1+k) of transitions gets a goal
            that their trajectory achieved.
        hindsight_goals: achieved `future`: later; `final`: at its end; `episode`: after any step.
        n_steps: number of rewards in a transition, fewer at the end of a trajectory.
        gamma: discount factor of the rewards after the first.
        hindsight_episodes: `all`; or `moved`: transitions with such a goal come only from
            trajectories that have moved (Manela & Biess 2021 filter hindsight goals by the same
            idea), at most the share `LARGEST_SHARE` from one of them. If too few have moved, the
            rest comes from all.
        moved_distance: a trajectory has moved if it achieves a goal farther than this from its
            first achieved goal. None: if it achieves a goal that its first state does not reach by
            `goal_reward`, which must be sparse.
        td_exponent: PER (Schaul et al. 2016): draw transitions with probability proportional to
            their absolute TD error to this power. None: uniformly.
        augment: changes drawn transitions in place by symmetries of the task.

    Raises:
        ValueError: one episode does not fit, or hindsight is on without goals.
    """

    def __init__(
        self,
        layout: ReplayLayout,
        capacity: int,
        rng: np.random.Generator,
        *,
        goal_reward: GoalReward | None = None,
        goal_end: GoalEnd | None = None,
        hindsight_k: float = 0.0,
        hindsight_goals: Literal["future", "final", "episode"] = "future",
        n_steps: int = 1,
        gamma: float = 1.0,
        hindsight_episodes: Literal["all", "moved"] = "all",
        moved_distance: float | None = None,
        td_exponent: float | None = None,
        augment: Callable[[np.random.Generator, Transitions], None] | None = None,
    ) -> None:
        super().__init__(layout, capacity)
        if hindsight_k > 0 and (goal_reward is None or layout.goal == 0):
            raise ValueError(
                f"replay.hindsight_k must be 0 without a goal environment, got {hindsight_k:g}"
            )
        self.rng = rng
        self._goal_reward, self._goal_end = goal_reward, goal_end
        self._hindsight_share = hindsight_k / (1.0 + hindsight_k)
        self._goals, self._n_steps, self._gamma = hindsight_goals, n_steps, gamma
        self._augment = augment
        self._only_moved = hindsight_episodes == "moved" and hindsight_k > 0
        self._moved_distance = moved_distance
        self._moved = np.zeros(0, np.bool_)
        self._priorities = np.zeros(0, np.float64)
        self._cumulative_ranks: Weights | None = None
        self._values: Floats | None = None
        """Numbers of each row for an intrinsic reward, from the first `extend` with some."""
        self._td = None if td_exponent is None else TDPriorities(len(self._steps), td_exponent)
        self._refresh()

    def __len__(self) -> int:
        """Number of transitions held."""
        return self._all_places.total

    def extend(
        self, trajectories: Sequence[Trajectory], priorities: NDArray[np.float64] | None = None,
        values: Sequence[Floats] | None = None,
    ) -> None:  # fmt: skip
        """Store finished episodes in place of the oldest ones.

        MUSIC-p gives `priorities` [N] with every call: episodes are drawn by their rank. An
        intrinsic reward by episode gives N arrays of `values` [n], one for each step.

        Raises:
            ValueError: the trajectories held, of a checkpoint, have no priorities or values, or
                priorities are missing.
        """
        if self.trajectories and (priorities is not None) != bool(len(self._priorities)):
            raise ValueError("music.prioritise_replay must be that of the checkpoint")
        if self.trajectories and values is not None and self._values is None:
            raise ValueError(
                "intrinsic.reward must be that of the checkpoint, whose replay lacks its numbers "
                "of each step"
            )
        for i, trajectory in enumerate(trajectories):
            start, steps = self._store(trajectory), len(trajectory)
            if self._only_moved:
                self._moved = np.append(self._moved, self._has_moved(start, steps))
            if self._td is not None:
                self._td.add(start, steps)
            if priorities is not None:
                self._priorities = np.append(self._priorities, priorities[i])
            if values is not None:
                self._row_values()[start : start + steps] = values[i]
        self._refresh()

    def _row_values(self) -> Floats:
        if self._values is None:
            self._values = np.zeros(len(self._steps), np.float32)
        return self._values

    def values_of(self, rows: Rows) -> Floats | None:
        """The values that `extend` got for these rows [B]; None if it got none."""
        return None if self._values is None else self._values[rows]

    def _refresh(self) -> None:
        """Prepare sampling from the trajectories that are held now."""
        if len(self._priorities):
            self._cumulative_ranks = np.cumsum(rank_weights(self._priorities))
        starts, lengths = self._starts, self._lengths
        moved = self._moved if self._only_moved else slice(0)
        whole = long_enough(lengths)
        self._all_places = Places.of(starts, lengths)
        self._moved_places = Places.of(starts[moved], lengths[moved])
        self._whole_places = Places.of(starts[whole], lengths[whole])

    def _drop(self, count: int) -> None:
        if self._td is not None:
            for start, steps in zip(self._starts[:count], self._lengths[:count], strict=True):
                self._td.remove(start, steps)
        super()._drop(count)
        self._priorities = self._priorities[count:]
        self._moved = self._moved[count:]

    def _has_moved(self, start: int, steps: int) -> bool:
        """Whether the episode achieves a goal that its first state does not reach."""
        assert self._goal_reward is not None
        achieved = self._frames[start : start + steps + 1, self.layout.network_input :]
        if self._moved_distance is not None:
            away = np.linalg.norm(achieved - achieved[0], axis=1)
            return bool(away.max() > self._moved_distance)
        at_first = np.broadcast_to(achieved[0], achieved.shape)
        return bool(
            np.any(self._goal_reward(at_first, achieved) < self._goal_reward(achieved, achieved))
        )

    def sample_transitions(self, count: int, *, importance_exponent: float = 0.0) -> Transitions:
        """Draw `count` transitions with replacement, uniformly or by priority.

        `importance_exponent` is PER's beta. Raises ValueError if the replay is empty.
        """
        start, step, length = self._draw(count)
        relabelled = self._hindsight_share > 0
        chosen = np.zeros(0, np.int64)
        if relabelled:
            chosen = np.flatnonzero(self.rng.random(count) < self._hindsight_share)
            moved = self._moved_places
            if moved.total:
                part = chosen[moved.replaced(self.rng, len(chosen), self._hindsight_share)]
                start[part], step[part], length[part] = moved.draw(self.rng, len(part))
        row = start + step
        width, frame = self.layout.network_input, self.layout.frame
        after = self._steps.shape[1]  # where the next row begins
        both = self._read(row, 0, after + frame)
        inputs, next_inputs = both[:, :width].copy(), both[:, after : after + width].copy()
        actions, rewards = both[:, frame : after - 2].copy(), both[:, after - 2].copy()
        discounts = 1.0 - both[:, after - 1]
        if relabelled:
            goals = self._achieved(start[chosen], step[chosen], length[chosen])
            inputs[chosen, self.layout.observation :] = goals
            next_inputs[chosen, self.layout.observation :] = goals
            self._relabel(both, chosen, goals, rewards, discounts)
        weights = None
        if self._td is not None:
            weights = self._td.importance_weights(row, len(self), importance_exponent)
        drawn = Transitions(inputs, actions, rewards, discounts, next_inputs, weights, row)
        for i in range(1, self._n_steps):
            continues = (step + i < length) & (drawn.discounts > 0)
            self._add_step(drawn, i, np.flatnonzero(continues), chosen)
        if self._augment is not None:
            self._augment(self.rng, drawn)
        return drawn

    def _achieved(self, start: Rows, step: Rows, length: Rows) -> Floats:
        """[B, G] goals that the trajectories of B transitions achieved."""
        match self._goals:
            case "future":  # uniform over the later states: step + 1 to the episode's last one
                uniform = self.rng.random(len(start))
                later = step + 1 + (uniform * (length - step)).astype(np.int64)
            case "final":
                later = length
            case "episode":
                later = 1 + (self.rng.random(len(start)) * length).astype(np.int64)
        return self._read(start + later, self.layout.network_input, self.layout.goal)

    def _relabel(
        self, both: Floats, rows: Any, goals: Floats, rewards: Floats, discounts: Floats
    ) -> None:
        """Change rewards and discounts of the stored steps `both[rows]` to new goals [B, G].

        A step that ended the episode for another reason than its goal ends it with any goal.
        """
        assert self._goal_reward is not None
        last, goal = self._steps.shape[1] - 1, self.layout.goal
        achieved = both[rows, -goal:]
        rewards[rows] = self._goal_reward(achieved, goals)
        if self._goal_end is None:
            return
        ended = both[rows, last] > 0
        if ended.any():
            own = both[rows, -2 * goal : -goal]
            ended[ended] = ~self._goal_end(achieved[ended], own[ended])
        ended |= self._goal_end(achieved, goals)
        discounts[rows] = 1.0 - ended.astype(np.float32)

    def _add_step(self, drawn: Transitions, ahead: int, rows: Rows, relabelled: Rows) -> None:
        """Extend the transitions `rows` by the step that is `ahead` of their first one."""
        observation, after = self.layout.observation, self._steps.shape[1]
        both = self._read(drawn.rows[rows] + ahead, 0, after + self.layout.frame)
        rewards, discounts = both[:, after - 2].copy(), 1.0 - both[:, after - 1]
        new = np.isin(rows, relabelled)
        if new.any():
            goals = drawn.inputs[rows[new], observation:]
            self._relabel(both, new, goals, rewards, discounts)
        drawn.rewards[rows] += self._gamma**ahead * rewards
        drawn.discounts[rows] = self._gamma**ahead * discounts
        drawn.next_inputs[rows, :observation] = both[:, after : after + observation]
        # The environment can change its goal during an episode; a new one stays.
        own = both[~new, after + observation : after + self.layout.network_input]
        drawn.next_inputs[rows[~new], observation:] = own

    def update_priorities(self, rows: Rows, errors: Floats) -> None:
        """PER: set the priorities of `rows` [B] by their absolute TD errors [B]."""
        assert self._td is not None
        self._td.update(rows, errors)

    def _draw(self, count: int) -> tuple[Rows, Rows, Rows]:
        """First row and length of the trajectory, and step in it, of `count` transitions."""
        self._check_filled()
        if self._td is not None:
            return self._td.draw(self.rng.random(count))
        if self._cumulative_ranks is not None:
            which = draw_weighted(self._cumulative_ranks, self.rng.random(count))
            length = self._lengths[which]
            return self._starts[which], (self.rng.random(count) * length).astype(np.int64), length
        return self._all_places.draw(self.rng, count)

    def _check_filled(self) -> None:
        if not self.trajectories:
            raise ValueError("cannot sample from an empty replay: collect an episode first")

    def sample_trajectories(self, count: int, width: int | None = None) -> WholeTrajectories:
        """Draw `count` whole trajectories with replacement; the first `width` numbers of frames.

        Each trajectory is drawn in proportion to its steps, so that every state counts the same, as
        for the policy. Trajectories of a single step are drawn only if there are no others. T is
        the length of the longest one held. Raises ValueError if the replay is empty.
        """
        self._check_filled()
        places = self._whole_places
        start, _, length = places.draw(self.rng, count)
        time, width = np.arange(places.longest + 1), width or self.layout.observation
        if places.equal:
            return WholeTrajectories(self._read(start[:, None] + time, 0, width), None)
        rows = start[:, None] + np.minimum(time, length[:, None])
        return WholeTrajectories(self._read(rows, 0, width), time <= length[:, None])

    def index(self) -> dict[str, Any]:
        """The state except `packed`: rows of trajectories, priorities, generator.

        24 bytes a trajectory, with priorities by TD error 8 bytes a transition, and with values of
        an intrinsic reward 4 bytes.
        """
        td = None if self._td is None else self._td.packed(ranges(self._starts, self._lengths))
        values = self.values_of(ranges(self._starts, self._lengths))
        return ({} if values is None else {"values": values}) | {
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
        """Continue exactly from a result of `index`.

        Args:
            index: the result of `index()`.
            parts: number of the first trajectory, and arrays as returned by `packed`. Trajectories
                that are not in the index are ignored.

        Raises:
            ValueError: the replay had other sizes, or trajectories are missing.
        """
        self._terminal[: self._used] = 0.0
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
                f"trajectory {wanted} must be in the checkpoint's files, but is missing"
            )
        self._priorities = np.array(index["priorities"], np.float64)
        self._values = None  # otherwise those of earlier episodes would count as the checkpoint's
        if "values" in index:
            self._row_values()[ranges(self._starts, self._lengths)] = index["values"]
        if self._only_moved:
            episodes = zip(self._starts.tolist(), self._lengths.tolist(), strict=True)
            moved = [self._has_moved(start, steps) for start, steps in episodes]
            self._moved = np.array(moved, np.bool_)
        self._refresh()
        if self._td is not None:
            if index["td"] is None:
                raise ValueError(
                    "replay.priority must be that of the checkpoint, which has no TD errors"
                )
            self._td.load_packed(self._starts, self._lengths, index["td"])
        self._write = int(index["write"])
        self.rng.bit_generator.state = index["rng"]

    def state(self) -> dict[str, Any]:
        """The whole state, as arrays and plain values."""
        first = self.oldest
        return {"index": self.index(), "first": first, "trajectories": self.packed(first)}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue exactly from a result of `state`; ValueError for a replay of other sizes."""
        self.load_packed(state["index"], [(state["first"], state["trajectories"])])
