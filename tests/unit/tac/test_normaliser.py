"""The running normalizer, compared with moments in exact arithmetic."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from music_rllib.tac.networks import RunningNormaliser, for_another_run

Numbers = NDArray[Any]


def fed(*parts: Numbers, features: int | None = None) -> RunningNormaliser:
    size = features or parts[0].shape[1]
    normaliser = RunningNormaliser(size, epsilon=0.01, clip=5.0)
    for part in parts:
        normaliser.update(torch.from_numpy(part))
    return normaliser


def arrays(normaliser: RunningNormaliser) -> dict[str, Numbers]:
    return {name: tensor.numpy().copy() for name, tensor in normaliser.state_dict().items()}


def restored(moments: dict[str, Numbers]) -> RunningNormaliser:
    normaliser = RunningNormaliser(len(moments["mean"]), epsilon=0.01, clip=5.0)
    normaliser.load_state_dict({name: torch.as_tensor(a) for name, a in moments.items()})
    return normaliser


def exact_moments(values: Numbers) -> tuple[float, float]:
    numbers = [Fraction(float(value)) for value in values]
    mean = sum(numbers, Fraction(0)) / len(numbers)
    return float(mean), float(sum((x - mean) ** 2 for x in numbers) / len(numbers))


@given(
    offset=st.sampled_from([0.0, 1.3, -1e3, 1e6, -3e7, 1e9]),
    spread=st.floats(1e-6, 1e6),
    sizes=st.lists(st.integers(1, 30), min_size=1, max_size=5),
    seed=st.integers(0, 99),
)
@example(offset=-3e7, spread=0.5, sizes=[5, 9], seed=2)
def test_moments_equal_exact_moments_at_any_offset(
    offset: float, spread: float, sizes: list[int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    parts = [rng.normal(offset, spread, (size, 1)).astype(np.float32) for size in sizes]
    moments = arrays(fed(*parts))
    mean, variance = exact_moments(np.concatenate(parts)[:, 0])
    assert moments["count"] == sum(sizes)
    assert moments["centre"] == pytest.approx(mean, rel=1e-14, abs=1e-12 * spread)
    assert moments["squares"] / sum(sizes) == pytest.approx(variance, rel=1e-8, abs=1e-25)


@pytest.mark.parametrize(("offset", "std"), [(1e6, 0.5), (1e6, 0.1), (-2e5, 0.03), (0.0, 1.0)])
def test_a_feature_far_from_0_is_normalised_like_any_other(offset: float, std: float) -> None:
    data = np.random.default_rng(0).normal(offset, std, (4000, 1)).astype(np.float32)
    got = fed(*np.array_split(data, 9))(torch.from_numpy(data)).numpy()
    # The resolution of float32: at 1e6 its numbers are 1/16 apart.
    exact = (data.astype(np.float64) - data.mean(dtype=np.float64)) / data.std(dtype=np.float64)
    step = float(np.spacing(np.float32(abs(offset)))) / std
    np.testing.assert_allclose(got, np.clip(exact, -5, 5), atol=1e-3 + step)
    assert got.std() == pytest.approx(1.0, abs=0.02)


def test_narrow_features_are_divided_by_epsilon_and_all_are_clipped() -> None:
    data = np.random.default_rng(0).normal([-200.0, 0.5], [30.0, 1e-4], (1000, 2))
    normaliser = fed(*np.array_split(data, 7))
    expected = (data - data.mean(0)) / np.maximum(data.std(0), 0.01)
    got = normaliser(torch.from_numpy(data).float()).numpy()
    np.testing.assert_allclose(got, np.clip(expected, -5, 5), atol=1e-4)
    assert normaliser(torch.tensor([1e9, -1e9])).tolist() == [5.0, -5.0]


@given(
    value=st.floats(-1e9, 1e9, width=32),
    sizes=st.lists(st.integers(1, 999), min_size=1, max_size=6),
)
def test_a_constant_feature_stays_0_until_the_next_update(value: float, sizes: list[int]) -> None:
    normaliser = fed(*(np.full((size, 1), value, np.float32) for size in sizes))
    assert float(normaliser(torch.tensor([value + abs(value) + 1.0]))) == 0.0
    normaliser.update(torch.tensor([[value + abs(value) + 1.0]]))
    assert float(normaliser(torch.tensor([2 * (value + abs(value) + 1.0) - value]))) > 0


def test_adjacent_float32_values_count_as_constant() -> None:
    for value in np.array([1.0, 1.34, 1.99, 1e6], np.float32):
        neighbour = np.nextafter(value, np.float32(np.inf))
        normaliser = fed(np.tile([[value], [neighbour]], (50, 1)))
        assert float(normaliser(torch.tensor([2.0 * value]))) == 0.0


def test_the_normalizer_is_identity_at_first_and_part_of_the_state() -> None:
    fresh = RunningNormaliser(2, epsilon=0.01, clip=5.0)
    torch.testing.assert_close(fresh(torch.tensor([1.0, -2.0])), torch.tensor([1.0, -2.0]))
    fresh.update(torch.randn(10, 2))
    copy = restored(arrays(fresh))
    more = torch.randn(5, 2)
    fresh.update(more)
    copy.update(more)
    for name, array in arrays(fresh).items():
        np.testing.assert_array_equal(arrays(copy)[name], array)


# -- handoff to another run -----------------------------------------------------------------


def of_music_u(rng: np.random.Generator, rows: int, constant: float) -> Numbers:
    return np.stack([rng.normal(2.0, 3.0, rows), np.full(rows, constant)], 1).astype(np.float32)


@pytest.mark.parametrize("constant", [0.0, 1.34, 1e6])
def test_constants_of_the_source_run_are_reset_and_other_moments_kept(
    constant: float,
) -> None:
    rng = np.random.default_rng(0)
    before = [of_music_u(rng, rows, constant) for rows in (51, 20_000)]
    source = fed(*before)
    handed = restored(for_another_run(arrays(source)))
    # Until the first update, outputs are those of the source.
    seen = torch.tensor([[1.0, constant + 0.4]])
    torch.testing.assert_close(handed(seen), source(seen), rtol=0, atol=0)
    goals = rng.normal([2.0, constant - 5], [3.0, 0.15], (204, 2)).astype(np.float32)
    handed.update(torch.from_numpy(goals))
    assert float(handed(torch.from_numpy(goals))[:, 1].std(correction=0)) == pytest.approx(1.0)
    moments = arrays(handed)
    np.testing.assert_array_equal(moments["count"], [20_255, 204])
    mean, variance = exact_moments(np.concatenate([*before, goals])[:, 0])
    assert moments["centre"][0] == pytest.approx(mean)
    assert moments["squares"][0] / 20_255 == pytest.approx(variance)
