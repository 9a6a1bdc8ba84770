"""Seeds of resets, action bounds, and numbers that cannot be learned from."""

from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box
from hypothesis import given
from hypothesis import strategies as st

from music_rllib.envs.make import reset_seed
from music_rllib.envs.values import (
    LARGEST,
    are_usable,
    check_action_space,
    check_numbers,
    to_bounds,
)


def test_reset_seeds_fill_the_declared_range_and_rarely_repeat() -> None:
    seeds = {reset_seed(np.random.SeedSequence((0, number))) for number in range(2000)}
    assert max(seeds) < 2**31
    assert min(seeds) >= 0
    assert len(seeds) == 2000
    declared = {reset_seed(np.random.SeedSequence(number), (10, 19)) for number in range(200)}
    assert declared == set(range(10, 20))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_actions_fill_bounds_whose_difference_overflows_their_type(dtype: Any) -> None:
    largest = min(float(np.finfo(dtype).max), 1e15)
    space = check_action_space(Box(-largest, largest, (2,), dtype))
    actions = np.linspace(-1, 1, 9, dtype=np.float32)[:, None].repeat(2, axis=1)
    scaled = to_bounds(actions, space)
    assert scaled.dtype == dtype
    np.testing.assert_allclose(scaled / largest, actions, atol=1e-3)
    assert all(space.contains(action) for action in scaled)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_within_ordinary_bounds_keep_their_bits(dtype: Any) -> None:
    """Golden results and finished runs depend on this formula."""
    low, high = np.array([-1.0, -3.0], dtype), np.array([1.0, 0.1], dtype)
    actions = np.random.default_rng(0).uniform(-1, 1, (500, 2)).astype(np.float32)
    formula = np.clip(low + (actions + 1.0) * 0.5 * (high - low), low, high).astype(dtype)
    np.testing.assert_array_equal(to_bounds(actions, Box(low, high, dtype=dtype)), formula)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_placeholder_bounds_are_refused(dtype: Any) -> None:
    largest = np.finfo(dtype).max
    with pytest.raises(ValueError, match=r"bounds must be within \+-1e\+15, got Box"):
        check_action_space(Box(-1, np.array([largest, 1], dtype), (2,), dtype))


BAD = st.sampled_from([np.nan, np.inf, -np.inf, 1e30, -1e30, 2 * LARGEST])


@given(values=st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=80), bad=BAD, data=st.data())
def test_one_bad_number_among_any_others_is_found_and_named(
    values: list[float], bad: float, data: st.DataObject
) -> None:
    assert are_usable(np.array(values, np.float32))
    check_numbers("observation", values)
    place = data.draw(st.integers(0, len(values) - 1))
    values[place] = bad
    assert not are_usable(np.array(values, np.float32))
    with pytest.raises(ValueError, match="every number must be finite") as caught:
        check_numbers("observation", values)
    assert str(caught.value).startswith(f"observation[{place}] is {bad:g}, every number")
