"""The replay, compared with a plain list of episodes."""

import dataclasses
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from music_rllib.replay.buffer import TrajectoryReplay
from music_rllib.replay.sampling import SumTree, draw_weighted, rank_weights
from music_rllib.replay.trajectories import (
    ReplayLayout,
    Trajectory,
    Transitions,
    WholeTrajectories,
)

LAYOUT = ReplayLayout(observation=3, action=2, goal=1, horizon=5)


def episode(number: int, steps: int, *, terminated: bool = False) -> Trajectory:
    """An episode whose numbers identify it and its step: observation = (number, step, 0)."""
    frames = np.zeros((steps + 1, LAYOUT.frame), np.float32)
    frames[:, 0] = number
    frames[:, 1] = np.arange(steps + 1)
    frames[:, 3] = -1.0  # desired
    frames[:, 4] = 100 * number + np.arange(steps + 1)  # achieved
    actions = np.stack([np.full(steps, number), np.arange(steps)], 1).astype(np.float32)
    return Trajectory(frames, actions, np.full(steps, -1.0, np.float32), terminated)


def matches(achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    return np.where(achieved[:, 0] == desired[:, 0], 0.0, -1.0)


def replay(capacity: int, **settings: Any) -> TrajectoryReplay:
    return TrajectoryReplay(
        LAYOUT, capacity, np.random.default_rng(0), goal_reward=matches, **settings
    )


@given(lengths=st.lists(st.integers(1, 5), min_size=1, max_size=40))
@settings(deadline=None)
def test_the_ring_keeps_the_newest_whole_episodes_of_any_length(lengths: list[int]) -> None:
    buffer, model = replay(12), deque[tuple[int, int]]()
    for number, steps in enumerate(lengths):
        buffer.extend([episode(number, steps, terminated=steps < 5)])
        model.append((number, steps))
        held = list(model)[-buffer.trajectories :]
        assert len(buffer) == sum(steps for _, steps in held)
        batch = buffer.sample_transitions(200)
        seen = set(zip(batch.actions[:, 0], batch.actions[:, 1], strict=True))
        assert seen <= {(n, t) for n, length in held for t in range(length)}
        # A transition is one step of one episode, and its flags are that step's.
        np.testing.assert_array_equal(batch.inputs[:, :2], batch.actions)
        np.testing.assert_array_equal(batch.next_inputs[:, 0], batch.actions[:, 0])
        np.testing.assert_array_equal(batch.next_inputs[:, 1], batch.actions[:, 1] + 1)
        last = {n: length - 1 for n, length in held if length < 5}
        ends = [last.get(int(n)) == t for n, t in batch.actions]
        np.testing.assert_array_equal(batch.discounts == 0, ends)
    assert buffer.trajectories >= 1
    if all(steps == 5 for steps in lengths):
        assert buffer.trajectories == min(len(lengths), 12 // 5)


def test_transitions_are_drawn_uniformly_over_unequal_episodes() -> None:
    buffer = replay(100)
    buffer.extend([episode(0, 5), episode(1, 1), episode(2, 2)])
    batch = buffer.sample_transitions(80_000)
    counts = np.unique(batch.actions, axis=0, return_counts=True)[1]
    assert len(counts) == 8
    # 10,000 expected each, standard deviation 94.
    assert (abs(counts - 10_000) < 5 * 94).all()


def test_hindsight_takes_goals_achieved_later_and_recomputes_rewards() -> None:
    buffer = replay(100, hindsight_k=4.0)
    buffer.extend([episode(n, 5) for n in range(4)])
    batch = buffer.sample_transitions(20_000)
    goal, step, number = batch.inputs[:, 3], batch.inputs[:, 1], batch.inputs[:, 0]
    relabelled = goal >= 0
    assert relabelled.mean() == pytest.approx(0.8, abs=0.02)
    later = goal[relabelled] - 100 * number[relabelled]
    assert (later > step[relabelled]).all()
    assert (later <= 5).all()
    np.testing.assert_array_equal(batch.next_inputs[:, 3], goal)
    reached = later == step[relabelled] + 1
    np.testing.assert_array_equal(batch.rewards[relabelled], np.where(reached, 0.0, -1.0))
    assert (batch.rewards[~relabelled] == -1.0).all()
    # `future` is uniform over later states: from step 0, over five of them.
    first = later[step[relabelled] == 0]
    assert np.bincount(first.astype(int), minlength=6)[1:].min() > 0.17 * len(first)
    # Sampling never writes into the store.
    assert (buffer.packed(buffer.oldest)["frames"][:, 3] == -1.0).all()


@pytest.mark.parametrize(
    ("goals", "first"), [("final", lambda step, n: n), ("episode", lambda step, n: 1)]
)
def test_hindsight_of_the_final_state_and_of_the_whole_episode(
    goals: str, first: Callable[[int, int], int]
) -> None:
    buffer = replay(100, hindsight_k=1e9, hindsight_goals=goals)
    buffer.extend([episode(0, 5), episode(1, 3)])
    batch = buffer.sample_transitions(4_000)
    seen: dict[tuple[int, int], set[int]] = {}
    for (number, step, _), goal in zip(batch.inputs[:, :3], batch.inputs[:, 3], strict=True):
        seen.setdefault((int(number), int(step)), set()).add(int(goal - 100 * number))
    for (number, step), reached in seen.items():
        length = (5, 3)[number]
        assert reached == set(range(first(step, length), length + 1))


@pytest.mark.parametrize("n_steps", [2, 3, 9])
@pytest.mark.parametrize("goals", ["future", "final", "episode"])
def test_n_steps_add_the_rewards_of_the_relabeled_goal_up_to_the_end(
    n_steps: int, goals: str
) -> None:
    """Every drawn transition is computed again, step by step, from the episode."""
    gamma = 0.5
    buffer = replay(100, hindsight_k=1.0, hindsight_goals=goals, n_steps=n_steps, gamma=gamma)
    lengths, ends = (5, 3, 1, 4), (False, True, True, False)
    played = [episode(n, steps, terminated=end) for n, (steps, end) in
              enumerate(zip(lengths, ends, strict=True))]  # fmt: skip
    for each in played:
        each.rewards[:] = -np.arange(2, 2 + len(each))  # not those of `matches`
    buffer.extend(played)
    batch = buffer.sample_transitions(2_000)
    for row in range(2_000):
        number, step = (int(value) for value in batch.inputs[row, :2])
        goal, source = batch.inputs[row, 3], played[number]
        last = min(step + n_steps, lengths[number])
        total = 0.0
        for t in range(step, last):
            recomputed = 0.0 if source.frames[t + 1, 4] == goal else -1.0
            total += gamma ** (t - step) * (source.rewards[t] if goal == -1.0 else recomputed)
        ended = ends[number] and last == lengths[number]
        assert batch.rewards[row] == pytest.approx(total)
        assert batch.discounts[row] == (0.0 if ended else gamma ** (last - step - 1))
        np.testing.assert_array_equal(batch.next_inputs[row], [number, last, 0, goal])
        np.testing.assert_array_equal(batch.actions[row], [number, step])


def test_n_steps_end_with_the_goal_of_their_last_state() -> None:
    """Of an environment whose desired goal changes during an episode."""
    buffer = replay(100, n_steps=3, gamma=0.5)
    moving = episode(0, 5)
    moving.frames[:, 3] = 200 + np.arange(6)
    buffer.extend([moving])
    batch = buffer.sample_transitions(200)
    for transition, following in zip(batch.inputs, batch.next_inputs, strict=True):
        assert transition[3] == 200 + transition[1]
        assert following[1] == min(transition[1] + 3, 5)
        assert following[3] == 200 + following[1]


@pytest.mark.parametrize("n_steps", [1, 3])
def test_relabeled_transitions_end_where_their_new_goal_is_reached(n_steps: int) -> None:
    """Episodes that end at their goal, at another state (a fall), or by their length."""
    gamma, lengths, ends = 0.5, (3, 4, 5), (True, True, False)
    played = [episode(n, s, terminated=end) for n, (s, end) in
              enumerate(zip(lengths, ends, strict=True))]  # fmt: skip
    played[0].frames[:, 3] = played[0].frames[-1, 4]
    played[0].rewards[-1] = 0.0
    buffer = replay(
        100, hindsight_k=4.0, hindsight_goals="episode", n_steps=n_steps, gamma=gamma,
        goal_end=lambda achieved, desired: matches(achieved, desired) == 0,
    )  # fmt: skip
    buffer.extend(played)
    batch = buffer.sample_transitions(2_000)
    for row in range(2_000):
        number, step = (int(value) for value in batch.inputs[row, :2])
        goal, achieved = batch.inputs[row, 3], played[number].frames[1:, 4]
        ended = achieved == goal
        ended[-1] |= number == 1  # a fall ends an episode with any goal
        after = next(
            (t for t in range(step, lengths[number]) if ended[t] or t == step + n_steps - 1),
            lengths[number] - 1,
        )
        rewards = [-(gamma ** (t - step)) * (achieved[t] != goal) for t in range(step, after + 1)]
        assert batch.rewards[row] == pytest.approx(sum(rewards))
        assert batch.discounts[row] == (0.0 if ended[after] else gamma ** (after - step))
        np.testing.assert_array_equal(batch.next_inputs[row], [number, after + 1, 0, goal])


def resting(number: int, steps: int) -> Trajectory:
    """An episode whose achieved goal never changes."""
    played = episode(number, steps)
    frames = played.frames.copy()
    frames[:, 4] = frames[0, 4]
    return dataclasses.replace(played, frames=frames)


def moving_replay(**settings: Any) -> TrajectoryReplay:
    return replay(1100, hindsight_k=4.0, hindsight_episodes="moved", **settings)


def test_hindsight_of_moved_episodes_excludes_episodes_at_rest() -> None:
    buffer = moving_replay()
    buffer.extend([resting(n, 5) for n in range(3)])
    # Nothing has moved yet: hindsight uses all episodes.
    assert (buffer.sample_transitions(1_000).inputs[:, 3] >= 0).mean() > 0.7
    buffer.extend([episode(n, 5 if n % 2 else 3) for n in range(3, 15)])
    restored = moving_replay()
    restored.load_state(buffer.state())
    for ring in (buffer, restored):
        batch = ring.sample_transitions(20_000)
        goal, number, step = batch.inputs[:, 3], batch.inputs[:, 0], batch.inputs[:, 1]
        relabelled = goal >= 0
        assert relabelled.mean() == pytest.approx(0.8, abs=0.02)
        assert set(number[relabelled]) == set(range(3, 15))
        # Relabeled ones are uniform over the 48 transitions of these episodes, the others over all.
        assert (number[relabelled] % 2 == 1).mean() == pytest.approx(30 / 48, abs=0.02)
        assert set(number[~relabelled]) == set(range(15))
        later = goal[relabelled] - 100 * number[relabelled]
        assert (later > step[relabelled]).all()
        reached = later == step[relabelled] + 1
        np.testing.assert_array_equal(batch.rewards[relabelled], np.where(reached, 0.0, -1.0))


@pytest.mark.parametrize(
    ("moved", "others", "share"),
    [
        # Plus its share as one of all episodes; without the limit it would be 0.8.
        ([5], 200, 0.4),
        # With unequal lengths the limit is for the longest; all transitions are equally likely.
        ([5, 1, 1], 200, 0.4),
        # With two or more of one length the limit has no effect.
        ([5, 5, 5], 100, 0.8 / 3),
        ([5] * 10, 100, 0.08),
    ],
)
def test_no_moved_episode_fills_more_than_two_fifths_of_a_minibatch(
    moved: list[int], others: int, share: float
) -> None:
    buffer, again = moving_replay(), moving_replay()
    buffer.extend([resting(n, 5) for n in range(others)])
    buffer.extend([episode(others + n, steps) for n, steps in enumerate(moved)])
    again.load_state(buffer.state())
    batch, repeated = buffer.sample_transitions(40_000), again.sample_transitions(40_000)
    np.testing.assert_array_equal(batch.inputs, repeated.inputs)
    of_first = (batch.inputs[:, 0] == others).mean()
    assert share - 0.01 < of_first < share + 5 / (5 * others) + 0.01
    assert (batch.inputs[:, 3] >= 0).mean() == pytest.approx(0.8, abs=0.01)
    counts = np.bincount(batch.inputs[:, 0].astype(int))[others:]
    np.testing.assert_allclose(counts / counts[0], np.array(moved) / moved[0], atol=0.15)


def dense(achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    away: np.ndarray = np.abs(achieved[:, 0] - desired[:, 0])
    return -away


@pytest.mark.parametrize("jitter", [1e-6, 0.049])
def test_jitter_within_moved_distance_does_not_count_as_moved(jitter: float) -> None:
    def shaken(number: int, by: float) -> Trajectory:
        played = resting(number, 5)
        frames = played.frames.copy()
        frames[:, 4] = 1.3
        frames[3, 4] += by
        return dataclasses.replace(played, frames=frames)

    buffer = TrajectoryReplay(
        LAYOUT,
        500,
        np.random.default_rng(0),
        goal_reward=dense,
        hindsight_k=4.0,
        hindsight_episodes="moved",
        moved_distance=0.05,
    )
    buffer.extend(
        [shaken(n, jitter) for n in range(50)] + [shaken(50 + n, -0.06) for n in range(9)]
    )
    batch = buffer.sample_transitions(5_000)
    assert batch.inputs[batch.inputs[:, 3] >= 0, 0].min() == 50


def test_drawn_transitions_are_augmented_with_their_final_goals() -> None:
    def add_one(rng: np.random.Generator, drawn: Transitions) -> None:
        for inputs in (drawn.inputs, drawn.next_inputs):
            inputs += 1.0

    options: dict[str, Any] = {"goal_reward": dense, "hindsight_k": 4.0, "n_steps": 3}
    plain, augmented = (
        TrajectoryReplay(LAYOUT, 500, np.random.default_rng(0), augment=augment, **options)
        for augment in (None, add_one)
    )
    for buffer in (plain, augmented):
        buffer.extend([resting(number, 5) for number in range(9)])
    before, after = plain.sample_transitions(500), augmented.sample_transitions(500)
    np.testing.assert_array_equal(after.inputs, before.inputs + 1.0)
    np.testing.assert_array_equal(after.next_inputs, before.next_inputs + 1.0)
    np.testing.assert_array_equal(after.rewards, before.rewards)


def test_trajectories_of_one_length_are_drawn_whole_without_padding() -> None:
    buffer = replay(100)
    buffer.extend([episode(n, 5) for n in range(3)])
    whole = buffer.sample_trajectories(6_000)
    assert whole.inside is None
    assert whole.observations.shape == (6_000, 6, 3)
    assert (whole.observations[:, :, 1] == np.arange(6)).all()
    counts = np.bincount(whole.observations[:, 0, 0].astype(int))
    np.testing.assert_allclose(counts, 2_000, atol=5 * 37)
    assert buffer.sample_trajectories(9, width=2).observations.shape == (9, 6, 2)


def test_trajectories_are_drawn_whole_in_proportion_to_their_steps() -> None:
    buffer = replay(1_000)
    # Mostly short ones, some of a single step, and the longest right at the ring's end.
    lengths = [2] * 40 + [1] * 7 + [4] * 5 + [5]
    buffer.extend([episode(n, steps) for n, steps in enumerate(lengths)])
    whole = buffer.sample_trajectories(10_500)
    assert whole.inside is not None
    number = whole.observations[:, 0, 0].astype(int)
    steps = np.array(lengths)[number]
    assert (whole.observations[:, :, 0] == number[:, None]).all()
    np.testing.assert_array_equal(whole.inside, np.arange(6) <= steps[:, None])
    expected = np.minimum(np.arange(6), steps[:, None])
    np.testing.assert_array_equal(whole.observations[:, :, 1], expected)
    counts = np.bincount(number, minlength=len(lengths))
    # 105 transitions of trajectories with two steps or more, a hundred draws for each.
    np.testing.assert_allclose(counts, np.where(np.array(lengths) > 1, lengths, 0) * 100, atol=100)
    assert counts[40:47].max() == 0


def test_single_step_trajectories_are_drawn_only_without_others() -> None:
    buffer = replay(100)
    buffer.extend([episode(n, 1) for n in range(3)])
    assert buffer.sample_trajectories(9).observations.shape == (9, 2, 3)
    buffer.extend([episode(3, 3)])
    assert set(buffer.sample_trajectories(9).observations[:, 0, 0]) == {3.0}


@given(st.lists(st.integers(1, 6), min_size=1, max_size=6))
def test_trajectories_are_padded_with_their_last_frame(counts: list[int]) -> None:
    rng = np.random.default_rng(0)
    frames = [rng.normal(size=(count, 2)).astype(np.float32) for count in counts]
    whole = WholeTrajectories.of(frames)
    inside = np.ones((len(counts), counts[0]), bool) if whole.inside is None else whole.inside
    assert (whole.inside is None) == (len(set(counts)) == 1)
    for one, row, held in zip(frames, whole.observations, inside, strict=True):
        np.testing.assert_array_equal(row[held], one)
        assert (row[~held] == one[-1]).all()


@given(
    lengths=st.lists(st.integers(1, 5), min_size=1, max_size=12),
    choice=st.sampled_from(["all", "moved"]),
)
@settings(deadline=None, max_examples=40)
def test_a_restored_replay_draws_the_same_transitions(lengths: list[int], choice: str) -> None:
    original, restored = (replay(12, hindsight_k=4.0, hindsight_episodes=choice) for _ in range(2))
    made = [(resting if n % 2 else episode)(n, steps) for n, steps in enumerate(lengths)]
    original.extend(made)
    original.sample_transitions(7)
    state = original.state()
    restored.extend([dataclasses.replace(episode(n, 4), terminated=True) for n in range(3)])
    restored.load_state(state)
    for name, value in restored.state().items():
        np.testing.assert_equal(value, state[name])
    for buffer in (original, restored):
        buffer.extend([episode(50, 4)])
    ours, theirs = original.sample_transitions(64), restored.sample_transitions(64)
    for field in ("inputs", "actions", "rewards", "discounts", "next_inputs"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))


def test_memory_is_as_documented() -> None:
    layout = ReplayLayout(observation=25, action=4, goal=3, horizon=50)
    buffer = TrajectoryReplay(layout, 1_000_000, np.random.default_rng(0))
    assert buffer.nbytes == pytest.approx(151e6, rel=0.005)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: replay(4), "capacity must hold an episode of 5 steps, got 4"),
        (lambda: replay(10).sample_transitions(1), "empty replay"),
        (lambda: replay(10).sample_trajectories(1), "empty replay"),
        (lambda: replay(10).extend([episode(0, 6)]), "1 to 5 steps, got 6"),
        (
            lambda: TrajectoryReplay(LAYOUT, 10, np.random.default_rng(0), hindsight_k=4),
            "hindsight_k must be 0",
        ),
    ],
)
def test_bad_use_is_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


# -- by priority --------------------------------------------------------------------------------


@given(
    size=st.integers(1, 70),
    writes=st.lists(st.tuples(st.integers(0, 69), st.floats(0, 10)), min_size=1, max_size=60),
)
def test_tree_holds_the_weights_and_draws_in_proportion(
    size: int, writes: list[tuple[int, float]]
) -> None:
    tree, weights = SumTree(size), np.zeros(size)
    for start in range(0, len(writes), 5):
        part = [(index % size, weight) for index, weight in writes[start : start + 5]]
        indices, values = (np.array(column) for column in zip(*part, strict=True))
        tree.set(indices, values)
        weights[indices] = values
    np.testing.assert_allclose(tree[np.arange(size)], weights)
    assert tree.total == pytest.approx(weights.sum())
    if weights.sum() > 1e-6:
        uniform = (np.arange(2000) + 0.5) / 2000
        drawn = np.bincount(tree.draw(uniform), minlength=size)
        # Evenly spread uniform numbers: every count equals its expectation up to rounding.
        assert (abs(drawn - 2000 * weights / weights.sum()) < 2).all()
        assert not drawn[weights == 0].any()
    copy = SumTree(size)
    copy.set(np.arange(size), tree[np.arange(size)])
    assert copy.total == tree.total


def test_dense_ranks_exclude_the_least_and_share_ties() -> None:
    np.testing.assert_array_equal(rank_weights(np.array([0.3, 0.1, 0.3, 0.7])), [1, 0, 1, 2])
    np.testing.assert_array_equal(rank_weights(np.array([0.2, 0.2])), [1, 1])


def test_an_index_without_weight_is_never_drawn_not_even_by_rounding() -> None:
    cumulative = np.cumsum([0.0, 1.0, 0.0, 0.7, 0.0])
    uniform = np.array([0.0, 0.3, 1.0 / 1.7, np.nextafter(1.0, 0.0), 1.0])
    assert draw_weighted(cumulative, uniform).tolist() == [1, 1, 3, 3, 3]


def test_music_p_draws_episodes_by_the_rank_of_their_priority() -> None:
    replay = TrajectoryReplay(LAYOUT, 20, np.random.default_rng(0))
    replay.extend([episode(n, 5) for n in range(4)], np.array([0.4, 0.1, 0.9, 0.4]))
    drawn = replay.sample_transitions(60_000).actions
    share = np.bincount(drawn[:, 0].astype(int), minlength=4) / 60_000
    np.testing.assert_allclose(share, [0.25, 0.0, 0.5, 0.25], atol=0.01)
    steps = np.bincount(drawn[:, 1].astype(int)) / 60_000
    np.testing.assert_allclose(steps, 0.2, atol=0.01)
    # The oldest episode is dropped, with its rank.
    replay.extend([episode(4, 5)], np.array([0.2]))
    drawn = replay.sample_transitions(60_000).actions[:, 0].astype(int)
    share = np.bincount(drawn, minlength=5) / 60_000
    np.testing.assert_allclose(share, [0, 0, 3 / 6, 2 / 6, 1 / 6], atol=0.01)


def test_per_draws_by_td_error_and_weights_undo_it() -> None:
    replay = TrajectoryReplay(LAYOUT, 20, np.random.default_rng(0), td_exponent=0.5)
    replay.extend([episode(0, 5), episode(1, 3)])
    first = replay.sample_transitions(8_000)
    assert first.rows is not None
    assert first.weights is not None
    np.testing.assert_allclose(np.bincount(first.rows)[first.rows], 1000, rtol=0.15)
    rows = np.unique(first.rows)
    errors = np.array([0, 1, 4, 9, 16, 25, 36, 49], np.float32)
    replay.update_priorities(rows, errors)
    batch = replay.sample_transitions(56_000, importance_exponent=1.0)
    assert batch.rows is not None
    assert batch.weights is not None
    drawn = np.array([(batch.rows == row).sum() for row in rows])
    np.testing.assert_allclose(drawn, 2000 * np.sqrt(errors), rtol=0.1, atol=20)
    # Weighted by beta = 1, every transition with a positive error counts the same.
    counted = np.array([batch.weights[batch.rows == row].sum() for row in rows[1:]])
    np.testing.assert_allclose(counted / counted.mean(), 1.0, rtol=0.1)
    assert batch.weights.max() == 1.0


def test_per_forgets_overwritten_rows_and_keeps_hindsight_inside_its_episode() -> None:
    replay = TrajectoryReplay(
        LAYOUT, 10, np.random.default_rng(0), goal_reward=matches, hindsight_k=4, td_exponent=0.6
    )
    for number, steps in enumerate([5, 2, 4, 3, 5, 1, 1, 5]):
        replay.extend([episode(number, steps)])
        batch = replay.sample_transitions(500)
        held = set(batch.actions[:, 0].astype(int))
        assert max(held) == number
        assert len(held) <= replay.trajectories
        np.testing.assert_array_equal(batch.next_inputs[:, 1], batch.actions[:, 1] + 1)
        goal = batch.inputs[:, 3]
        later = goal[goal >= 0] - 100 * batch.actions[goal >= 0, 0]
        assert (later > batch.actions[goal >= 0, 1]).all()
    assert batch.rows is not None
    replay.update_priorities(batch.rows, np.ones(500, np.float32))
    restored = TrajectoryReplay(
        LAYOUT, 10, np.random.default_rng(1), goal_reward=matches, hindsight_k=4, td_exponent=0.6
    )
    restored.extend([episode(number, 4) for number in range(2)])
    restored.load_state(replay.state())
    np.testing.assert_array_equal(
        replay.sample_transitions(50).inputs, restored.sample_transitions(50).inputs
    )


def per() -> TrajectoryReplay:
    return TrajectoryReplay(LAYOUT, 20, np.random.default_rng(0), td_exponent=0.5)


def test_new_transitions_are_drawn_with_the_largest_priority_so_far() -> None:
    """Of all errors, not of the last ones; also after a checkpoint (Schaul et al. 2016, alg. 1)."""
    replay = per()
    replay.extend([episode(0, 5)])
    rows = np.unique(replay.sample_transitions(1000).rows)
    replay.update_priorities(rows, np.array([100, 1, 1, 1, 1], np.float32))
    replay.update_priorities(rows[1:], np.full(4, 1, np.float32))
    restored = per()
    restored.load_state(replay.state())
    for each in (replay, restored):
        each.extend([episode(1, 5)])
        drawn = each.sample_transitions(20_000).actions
        share = np.mean(drawn[:, 0] == 1)
        assert share == pytest.approx(50 / (50 + 10 + 4), abs=0.02)


def test_a_transition_without_an_error_can_still_be_drawn() -> None:
    """Its priority is (1e-6)^0.5 = 1e-3."""
    replay = per()
    replay.extend([episode(0, 5)])
    rows = np.unique(replay.sample_transitions(1000).rows)
    replay.update_priorities(rows, np.array([0, 1e-4, 1e-4, 1e-4, 1e-4], np.float32))
    share = np.mean(replay.sample_transitions(40_000).rows == rows[0])
    one, other = 1e-6**0.5, (1e-4 + 1e-6) ** 0.5
    assert share == pytest.approx(one / (one + 4 * other), rel=0.1)


@pytest.mark.parametrize("beta", [0.0, 0.4, 1.0])
def test_importance_weights_have_the_exponent_that_is_asked_for(beta: float) -> None:
    replay = per()
    replay.extend([episode(0, 5)])
    rows = np.unique(replay.sample_transitions(1000).rows)
    errors = np.array([1, 4, 9, 16, 25], np.float32)
    replay.update_priorities(rows, errors)
    batch = replay.sample_transitions(2000, importance_exponent=beta)
    probability = np.sqrt(errors) / np.sqrt(errors).sum()
    expected = dict(zip(rows, (probability / probability.min()) ** -beta, strict=True))
    assert batch.weights is not None
    np.testing.assert_allclose(batch.weights, [expected[row] for row in batch.rows], rtol=1e-5)


def test_values_of_an_episode_stay_with_its_steps_and_are_restored() -> None:
    def numbers(number: int, steps: int) -> np.ndarray:
        return (10 * number + np.arange(steps)).astype(np.float32)

    replay, restored = (TrajectoryReplay(LAYOUT, 10, np.random.default_rng(0)) for _ in range(2))
    assert replay.values_of(np.zeros(1, np.int64)) is None
    for number, steps in enumerate((5, 2, 4, 3, 1)):  # beyond the ring's end
        replay.extend([episode(number, steps)], values=[numbers(number, steps)])
    restored.load_state(replay.state())
    for each in (replay, restored):
        batch = each.sample_transitions(200)
        np.testing.assert_array_equal(
            each.values_of(batch.rows), 10 * batch.actions[:, 0] + batch.actions[:, 1]
        )


def test_values_of_other_episodes_do_not_survive_a_checkpoint_without_values() -> None:
    without, used = replay(20), replay(20)
    without.extend([episode(0, 3)])
    used.extend([episode(0, 3)], values=[np.full(3, 7.0, np.float32)])
    used.load_state(without.state())
    assert used.values_of(np.arange(3)) is None
    with pytest.raises(ValueError, match="reward must be that of the checkpoint"):
        used.extend([episode(1, 1)], values=[np.ones(1, np.float32)])
