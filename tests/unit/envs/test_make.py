"""Seeds of resets, and actions within an environment's bounds."""

from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box

from music_rllib.envs.make import reset_seed
from music_rllib.envs.values import check_action_space, to_bounds


def test_reset_seeds_fit_into_a_signed_integer_and_rarely_repeat() -> None:
    seeds = {reset_seed(np.random.SeedSequence((0, number))) for number in range(2000)}
    assert max(seeds) < 2**31
    assert min(seeds) >= 0
    assert len(seeds) == 2000


def test_reset_seeds_fill_the_declared_range() -> None:
    seeds = {reset_seed(np.random.SeedSequence(number), (10, 19)) for number in range(200)}
    assert seeds == set(range(10, 20))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_actions_fill_bounds_whose_range_their_type_does_not_hold(dtype: Any) -> None:
    largest = min(float(np.finfo(dtype).max), 1e15)
    space = check_action_space(Box(-largest, largest, (2,), dtype))
    actions = np.linspace(-1, 1, 9, dtype=np.float32)[:, None].repeat(2, axis=1)
    scaled = to_bounds(actions, space)
    assert scaled.dtype == dtype
    np.testing.assert_allclose(scaled / largest, actions, atol=1e-3)
    assert all(space.contains(action) for action in scaled)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_within_ordinary_bounds_keep_their_bits(dtype: Any) -> None:
    """Golden results and finished runs rest on this formula."""
    low, high = np.array([-1.0, -3.0], dtype), np.array([1.0, 0.1], dtype)
    actions = np.random.default_rng(0).uniform(-1, 1, (500, 2)).astype(np.float32)
    formula = np.clip(low + (actions + 1.0) * 0.5 * (high - low), low, high).astype(dtype)
    np.testing.assert_array_equal(to_bounds(actions, Box(low, high, dtype=dtype)), formula)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bounds_that_stand_for_none_are_refused(dtype: Any) -> None:
    largest = np.finfo(dtype).max
    with pytest.raises(ValueError, match=r"bounds must be within \+-1e\+15, got Box"):
        check_action_space(Box(-1, np.array([largest, 1], dtype), (2,), dtype))
