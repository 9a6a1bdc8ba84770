"""Mutual-information oracles of algorithms: known values, invariances, the two-frame reward."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from benchmarks.gaussians import capped_optimum, trained_bound, true_information
from music_rllib.estimator.network import MutualInformationEstimator, intrinsic_reward
from music_rllib.mutual_information import donsker_varadhan, shuffle_time, time_permutations


@pytest.mark.parametrize("rho, dims", [(0.5, 1), (0.9, 1), (0.5, 3)])
def test_bound_approaches_what_the_cap_allows_and_never_exceeds_the_truth(
    rho: float, dims: int
) -> None:
    truth = true_information(rho, dims)
    bound = trained_bound(rho, dims, seed=0)
    # 0.01: the sampling error of 160,000 held-out pairs, three standard deviations.
    assert 0.9 * capped_optimum(rho, dims) < bound < min(truth, 2.0) + 0.01


def test_bound_of_independent_inputs_is_zero() -> None:
    assert abs(trained_bound(0.0, 2, seed=0, steps=200)) < 0.01


def test_bound_ignores_a_constant_added_to_the_statistic() -> None:
    joint, marginals = torch.randn(3, 7), torch.randn(3, 7)
    shifted = donsker_varadhan(joint + 2.5, marginals + 2.5)
    torch.testing.assert_close(shifted, donsker_varadhan(joint, marginals))


def test_bound_is_capped_by_tanh() -> None:
    joint, marginals = torch.ones(1, 50), -torch.ones(1, 50)
    assert float(donsker_varadhan(joint, marginals)) == pytest.approx(2.0)


def test_identity_on_two_frames_is_never_positive() -> None:
    torch.manual_seed(0)
    estimator = MutualInformationEstimator(3, 3)
    x, y = torch.randn(100, 2, 3), torch.randn(100, 2, 3)
    assert (estimator.transition_bound(x, y, swapped=False) <= 1e-6).all()
    assert (estimator.transition_bound(x, y) > 0).any()


def test_transition_bound_is_the_bound_written_out() -> None:
    torch.manual_seed(1)
    estimator = MutualInformationEstimator(3, 2)
    x, y = torch.randn(5, 2, 3), torch.randn(5, 2, 2)
    joint = (estimator(x[:, 0], y[:, 0]) + estimator(x[:, 1], y[:, 1])) / 2
    crossed = (estimator(x[:, 0], y[:, 1]).exp() + estimator(x[:, 1], y[:, 0]).exp()) / 2
    torch.testing.assert_close(estimator.transition_bound(x, y), joint - crossed.log())


def test_bound_and_gradients_are_those_of_layer_by_layer() -> None:
    generator = torch.Generator().manual_seed(2)
    estimator = MutualInformationEstimator(3, 2, hidden_size=20).double()
    x, y = (torch.randn(4, 11, n, generator=generator).double() for n in (3, 2))
    permutations = time_permutations(4, 11, generator)

    def statistics(agent: Tensor, surrounding: Tensor) -> Tensor:
        hidden = torch.relu(estimator.agent(agent) + estimator.surrounding(surrounding))
        return torch.tanh(estimator.output(hidden)).squeeze(-1)

    def layer_by_layer(agent: Tensor, surrounding: Tensor) -> Tensor:
        shuffled = shuffle_time(surrounding, permutations)
        return donsker_varadhan(statistics(agent, surrounding), statistics(agent, shuffled))

    def with_gradients(bound: Callable[[Tensor, Tensor], Tensor]) -> list[Tensor]:
        halves = [half.clone().requires_grad_() for half in (x, y)]
        values = bound(*halves)
        wanted = [*halves, *estimator.parameters()]
        return [values, *torch.autograd.grad(values.square().sum(), wanted)]

    ours = with_gradients(lambda a, s: estimator.bound(a, s, permutations))
    for one, other in zip(ours, with_gradients(layer_by_layer), strict=True):
        torch.testing.assert_close(one, other)


def test_resting_surroundings_earn_the_smallest_reward() -> None:
    estimator = MutualInformationEstimator(3, 3)
    x = torch.randn(10, 2, 3)
    y = torch.randn(10, 1, 3).expand(10, 2, 3)
    reward = intrinsic_reward(estimator.transition_bound(x, y), 5000.0)
    # An object at rest makes swapping its frames change nothing: bound <= 0, reward -1.
    torch.testing.assert_close(reward, torch.full((10,), -1.0), atol=5000 * 1e-6, rtol=0)


def test_reward_is_the_clipped_scaled_bound() -> None:
    bound = torch.tensor([-1.0, 0.0, 1e-4, 1.0])
    expected = torch.tensor([-1.0, -1.0, -0.5, 0.0])
    torch.testing.assert_close(intrinsic_reward(bound, 5000.0), expected)


def test_every_trajectory_has_its_own_permutation_unless_shared() -> None:
    generator = torch.Generator().manual_seed(0)
    own = time_permutations(6, 20, generator)
    assert (own.sort(-1).values == torch.arange(20)).all()
    assert not (own == own[0]).all()
    shared = time_permutations(6, 20, generator, shared=True)
    assert (shared == shared[0]).all()


def test_shuffle_moves_whole_frames() -> None:
    values = torch.arange(24.0).reshape(2, 4, 3)
    permutation = torch.tensor([[3, 2, 1, 0], [0, 1, 2, 3]])
    shuffled = shuffle_time(values, permutation)
    assert torch.equal(shuffled[0], values[0].flip(0))
    assert torch.equal(shuffled[1], values[1])
