"""The bound on mutual information: known values, invariances, the two-frame reward."""

import copy
import math

import pytest
import torch
from torch import Tensor

from benchmarks.gaussians import capped_optimum, trained_bound, true_information
from music_rllib.functional.mutual_information import (
    donsker_varadhan,
    other_bound,
    shuffle_time,
    time_permutations,
)
from music_rllib.intrinsic.estimator import MutualInformationEstimator, intrinsic_reward
from music_rllib.kernels.adam import FusedAdam
from music_rllib.kernels.mutual_information import Data


def make_estimator(
    agent_size: int, surrounding_size: int, hidden_size: int = 128
) -> MutualInformationEstimator:
    """An estimator for observations of the agent's state followed by the surrounding state."""
    total = agent_size + surrounding_size
    return MutualInformationEstimator(range(agent_size), range(agent_size, total), hidden_size)


def beside(x: Tensor, y: Tensor) -> Tensor:
    return torch.cat([x, y], -1)


def transition_bounds(
    estimator: MutualInformationEstimator, x: Tensor, y: Tensor, *, swapped: bool = True
) -> Tensor:
    frames = beside(x, y)
    return estimator.transition_bounds(frames[:, 0], frames[:, 1], (swapped,))


def test_the_bound_approaches_the_limit_of_the_cap_and_never_exceeds_the_truth() -> None:
    truth = true_information(0.9, 1)
    bound = trained_bound(0.9, 1, seed=0, steps=200)
    # 0.01: the sampling error of 160,000 held-out pairs, three standard deviations.
    assert 0.9 * capped_optimum(0.9, 1) < bound < min(truth, 2.0) + 0.01


@pytest.mark.parametrize("bound", ["moving_average", "nwj", "smile", "infonce"])
def test_bounds_without_a_cap_approach_the_truth(bound: str) -> None:
    truth = true_information(0.9, 1)
    steps, share = (50, 0.7) if bound == "infonce" else (100, 0.93)  # with 9 pairs in place of all
    found = trained_bound(0.9, 1, seed=0, steps=steps, bound=bound)
    assert share * truth < found < truth + 0.02


def test_bounds_without_a_cap_equal_their_formulas() -> None:
    joint, marginals = torch.randn(3, 7).double(), torch.randn(2, 3, 7).double()
    exp = marginals[0].exp()
    expected = {
        "moving_average": joint.mean(1) - exp.mean(1).log(),
        "nwj": joint.mean(1) - exp.mean(1) / math.e,
        "smile": joint.mean(1) - exp.clamp(math.exp(-5), math.exp(5)).mean(1).log(),
        "infonce": (joint - ((joint.exp() + marginals.exp().sum(0)) / 3).log()).mean(1),
    }
    padding = torch.full((3, 4), 9.0).double()
    inside = torch.arange(11).expand(3, 11) < 7
    for kind, values in expected.items():
        torch.testing.assert_close(other_bound(kind, joint, marginals), values)
        padded = torch.cat([joint, padding], 1), torch.cat([marginals, padding.expand(2, 3, 4)], 2)
        torch.testing.assert_close(other_bound(kind, *padded, inside), values)


@pytest.mark.parametrize("bound", ["moving_average", "nwj", "smile", "infonce"])
@pytest.mark.parametrize("statistic", [0.0, 8.0])
def test_transitions_at_rest_earn_the_smallest_reward_with_every_bound(
    bound: str, statistic: float
) -> None:
    estimator = MutualInformationEstimator(range(3), range(3, 6), bound=bound)
    torch.nn.init.constant_(estimator.output.bias, statistic)
    x, y = torch.randn(10, 2, 3), torch.randn(10, 1, 3).expand(10, 2, 3)
    with torch.no_grad():
        assert (transition_bounds(estimator, x, y) <= 1e-6).all()


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
    estimator = make_estimator(3, 3)
    x, y = torch.randn(100, 2, 3), torch.randn(100, 2, 3)
    assert (transition_bounds(estimator, x, y, swapped=False) <= 1e-6).all()
    assert (transition_bounds(estimator, x, y) > 0).any()


def test_transition_bound_equals_its_formula() -> None:
    torch.manual_seed(1)
    estimator = make_estimator(3, 2)
    x, y = torch.randn(5, 2, 3), torch.randn(5, 2, 2)
    joint = (estimator(x[:, 0], y[:, 0]) + estimator(x[:, 1], y[:, 1])) / 2
    crossed = (estimator(x[:, 0], y[:, 1]).exp() + estimator(x[:, 1], y[:, 0]).exp()) / 2
    torch.testing.assert_close(transition_bounds(estimator, x, y), joint - crossed.log())


def trained_by(
    estimator: MutualInformationEstimator, pairs: Data, trajectories: Data, lr: float = 0.0
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Bounds of both after one update, and the gradients of the negative mean bound."""
    found, means = estimator.learn(pairs, trajectories, FusedAdam(estimator.parameters(), lr), 1)
    flat = estimator._flat
    assert flat is not None
    gradients = [flat.view(flat.gradients, p).clone() for p in estimator.parameters()]
    return found, means, gradients


def test_compiled_bound_and_gradients_equal_autograd() -> None:
    generator = torch.Generator().manual_seed(2)
    estimator = make_estimator(3, 2, hidden_size=20)
    x, y = (torch.randn(4, 11, n, generator=generator) for n in (3, 2))
    permutations = time_permutations(4, 11, generator)

    def statistics(agent: Tensor, surrounding: Tensor) -> Tensor:
        hidden = torch.relu(estimator.agent(agent) + estimator.surrounding(surrounding))
        return torch.tanh(estimator.output(hidden)).squeeze(-1)

    shuffled = shuffle_time(y, permutations)
    expected = donsker_varadhan(statistics(x, y), statistics(x, shuffled))
    gradients = torch.autograd.grad(-expected.mean(), list(estimator.parameters()))
    torch.testing.assert_close(estimator.bound(beside(x, y), permutations), expected)
    with torch.no_grad():
        torch.testing.assert_close(estimator.bound(beside(x, y), permutations), expected)
    data = estimator.data(beside(x, y), permutations, None)
    found, means, ours = trained_by(estimator, data, data)
    torch.testing.assert_close(found, expected.detach())
    torch.testing.assert_close(means, expected.detach().mean()[None])
    for one, other in zip(ours, gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("frames", [11, 2])
@pytest.mark.parametrize("bound", ["moving_average", "nwj", "smile", "infonce"])
def test_compiled_losses_without_a_cap_equal_autograd(bound: str, frames: int) -> None:
    torch.manual_seed(0)
    estimator = MutualInformationEstimator(range(3), range(3, 5), hidden_size=20, bound=bound)
    torch.nn.init.constant_(estimator.output.bias, 5.0)  # where `smile` clips some of them
    generator = torch.Generator().manual_seed(1)
    inside = torch.arange(frames) < torch.tensor([[frames], [2], [min(7, frames)], [frames]])
    observations = 3.0 * torch.randn(4, frames, 5, generator=generator)
    permutations = time_permutations(4, frames, generator, inside=inside)
    expected = estimator.bound(observations, permutations, inside).detach()
    before = copy.deepcopy(estimator.state_dict())
    loss, mean = estimator.loss(observations, permutations, inside)
    gradients = torch.autograd.grad(loss, list(estimator.parameters()))
    average = copy.deepcopy(estimator.state_dict().get("log_average"))
    estimator.load_state_dict(before)
    with torch.no_grad():
        found = estimator.bound(observations, permutations, inside)
    torch.testing.assert_close(found, expected)
    pairs = observations[:, :2]
    swaps = time_permutations(4, 2, generator)
    of_pairs, means, ours = trained_by(
        estimator,
        estimator.data(pairs, swaps, None),
        estimator.data(observations, permutations, inside),
    )
    torch.testing.assert_close(of_pairs, estimator.bound(pairs, swaps, of_pairs=True).detach())
    torch.testing.assert_close(means, mean[None])
    for one, other in zip(ours, gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    if average is not None:
        torch.testing.assert_close(estimator.log_average, average)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_non_finite_values_spread_as_in_autograd(bad: float) -> None:
    estimator = make_estimator(2, 2, hidden_size=8)
    frames = torch.randn(4, 6, 4, generator=torch.Generator().manual_seed(0))
    permutations = time_permutations(4, 6, torch.Generator().manual_seed(1))
    parameters = list(estimator.parameters())
    for tensor in (frames, *parameters):
        number = tensor.detach().flatten()[-1].clone()
        tensor.detach().view(-1)[-1] = bad
        bound = estimator.bound(frames, permutations)
        expected = torch.autograd.grad(-bound.mean(), parameters)
        data = estimator.data(frames, permutations, None)
        bounds, _, found = trained_by(estimator, data, data)
        tensor.detach().view(-1)[-1] = number
        assert torch.equal(bounds.isfinite(), bound.isfinite())
        if math.isnan(bad):
            for one, other in zip(found, expected, strict=True):
                assert torch.equal(one.isfinite(), other.isfinite())


def test_compiled_estimator_updates_equal_adam() -> None:
    torch.manual_seed(0)
    ours = make_estimator(2, 2, hidden_size=32)
    theirs = copy.deepcopy(ours)
    adam = torch.optim.Adam(theirs.parameters(), 1e-2)
    x, y = correlated(200)
    generator = torch.Generator().manual_seed(1)
    shuffles = torch.cat([time_permutations(8, 200, generator) for _ in range(5)])
    found, means = ours.learn(
        ours.data(beside(x, y).repeat(5, 1, 1), shuffles, None),
        ours.data(beside(x, y).repeat(5, 1, 1), shuffles, None),
        FusedAdam(ours.parameters(), 1e-2),
        5,
    )
    for k, permutations in enumerate(shuffles.unflatten(0, (5, 8))):
        bound = theirs.bound(beside(x, y), permutations)
        torch.testing.assert_close(found.view(5, 8)[k], bound.detach(), rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(means[k], bound.detach().mean(), rtol=1e-3, atol=1e-5)
        adam.zero_grad()
        (-bound.mean()).backward()
        adam.step()
    for one, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_resting_surroundings_earn_the_smallest_reward() -> None:
    estimator = make_estimator(3, 3)
    x = torch.randn(10, 2, 3)
    y = torch.randn(10, 1, 3).expand(10, 2, 3)
    reward = intrinsic_reward(transition_bounds(estimator, x, y), 5000.0)
    # For an object at rest, swapping its frames changes nothing: bound <= 0, reward -1.
    torch.testing.assert_close(reward, torch.full((10,), -1.0), atol=5000 * 1e-6, rtol=0)


def test_reward_is_the_clipped_scaled_bound() -> None:
    bound = torch.tensor([-1.0, 0.0, 1e-4, 1.0])
    expected = torch.tensor([-1.0, -1.0, -0.5, 0.0])
    torch.testing.assert_close(intrinsic_reward(bound, 5000.0), expected)


def correlated(rows: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    x, noise = torch.randn(2, 8, rows, 2, generator=generator)
    return x, 0.9 * x + (1 - 0.9**2) ** 0.5 * noise


@pytest.mark.parametrize(("offset", "spread"), [(1e6, 0.5), (0.0, 1e4)])
def test_inputs_far_from_0_reach_the_same_bound(offset: float, spread: float) -> None:
    def bound(x: Tensor, y: Tensor, *, adapts: bool) -> float:
        torch.manual_seed(0)
        estimator = make_estimator(2, 2, hidden_size=32)
        if adapts:
            estimator.adapt_to(beside(x, y))
        adam = torch.optim.Adam(estimator.parameters(), 1e-2)
        generator = torch.Generator().manual_seed(1)
        for _ in range(100):
            value = estimator.bound(beside(x, y), time_permutations(8, 200, generator)).mean()
            adam.zero_grad()
            (-value).backward()
            adam.step()
        return float(value.detach())

    x, y = correlated(200)
    usual = bound(x, y, adapts=True)
    assert usual > 0.5
    far = (offset + spread * x, y - offset)
    assert bound(*far, adapts=True) == pytest.approx(usual, rel=0.15)
    if offset:
        assert bound(*far, adapts=False) == pytest.approx(0, abs=1e-12), "what this is for"


def test_inputs_near_0_are_raw_and_scaling_is_part_of_the_state() -> None:
    x, y = correlated(20)
    estimator, copy = make_estimator(2, 2), make_estimator(2, 2)
    before = estimator(x + 1.3, y)
    estimator.adapt_to(beside(x + 1.3, y))
    assert torch.equal(estimator(x + 1.3, y), before)
    estimator.adapt_to(beside(x + 1e6, y))
    copy.load_state_dict(estimator.state_dict())
    assert torch.equal(copy(x + 1e6, y), estimator(x + 1e6, y))
    assert not torch.equal(copy(x + 1e6, y), before)


def test_every_trajectory_has_its_own_permutation_unless_shared() -> None:
    generator = torch.Generator().manual_seed(0)
    own = time_permutations(6, 20, generator)
    assert (own.sort(-1).values == torch.arange(20)).all()
    assert not (own == own[0]).all()
    shared = time_permutations(6, 20, generator, draws=1)
    assert (shared == shared[0]).all()


COUNTS = torch.tensor([11, 2, 7, 3])
INSIDE = torch.arange(11) < COUNTS.unsqueeze(1)


@pytest.mark.parametrize("draws", [None, 1])
def test_padding_is_never_shuffled_into_a_trajectory(draws: int | None) -> None:
    generator = torch.Generator().manual_seed(0)
    times = [time_permutations(4, 11, generator, draws=draws, inside=INSIDE) for _ in range(500)]
    for drawn in times:
        assert (drawn.sort(-1).values == torch.arange(11)).all()
        for row, count in zip(drawn, COUNTS.tolist(), strict=True):
            assert (row[:count] < count).all()
    # All frames of a trajectory are equally likely: 71 of 500 expected, deviation 8.
    first = torch.stack(times)[:, 2, 0].bincount(minlength=7)
    assert ((first - 500 / 7).abs() < 5 * 8).all()


def test_bounds_of_padded_trajectories_equal_bounds_of_each_alone() -> None:
    generator = torch.Generator().manual_seed(2)
    estimator = make_estimator(3, 2, hidden_size=20)
    x, y = (torch.randn(4, 11, n, generator=generator) for n in (3, 2))
    permutations = time_permutations(4, 11, generator, inside=INSIDE)
    together = estimator.bound(beside(x, y), permutations, INSIDE)
    with torch.no_grad():
        torch.testing.assert_close(estimator.bound(beside(x, y), permutations, INSIDE), together)
    data = estimator.data(beside(x, y), permutations, INSIDE)
    alone = torch.stack(
        [
            estimator.bound(beside(x, y)[i : i + 1, :n], permutations[i : i + 1, :n])[0]
            for i, n in enumerate(COUNTS.tolist())
        ]
    )
    torch.testing.assert_close(together, alone)
    parameters = list(estimator.parameters())
    expected = torch.autograd.grad(-alone.mean(), parameters)
    for one, other in zip(trained_by(estimator, data, data)[2], expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    everything = torch.ones(4, 11, dtype=torch.bool)
    whole = time_permutations(4, 11, generator)
    torch.testing.assert_close(
        estimator.bound(beside(x, y), whole, everything), estimator.bound(beside(x, y), whole)
    )
