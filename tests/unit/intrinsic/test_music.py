"""`shuffle: random`, the original's time shuffle: rows per draw, and the mean reward."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from music_rllib import names
from music_rllib.intrinsic.estimator import MutualInformationEstimator
from music_rllib.intrinsic.music import HELD_OUT_STEPS, Music
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.kernels.adam import FusedAdam
from music_rllib.replay.trajectories import Trajectory


def music(shuffle: str = "random", **settings: Any) -> Music:
    torch.manual_seed(0)
    settings = {"estimator": "trained", "shuffle": shuffle, "reward_scale": 100.0, **settings}
    network = MutualInformationEstimator(range(3), range(3, 6), hidden_size=16)
    return Music(MusicSettings(**settings), network)


def transitions(rows: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    states = torch.randn(rows, 6, generator=generator)
    return states, states + torch.randn(rows, 6, generator=generator)


@pytest.mark.parametrize(("rows", "draws"), [(4096, 16), (256, 1), (32, 1), (300, 2), (1000, 4)])
def test_every_256_rows_draw_their_own_shuffle(rows: int, draws: int) -> None:
    one, updates = music(), 100 if rows > 1000 else 1000
    states, followers = transitions(rows)
    drawn = one.draw(updates, updates * rows, None, torch.Generator().manual_seed(2), first=False)
    assert {len(each) for each in drawn} == {draws}
    swapped, kept = (one.reward(states, followers, (both,)) for both in (True, False))
    assert (kept < -0.999).all()
    assert (swapped > -0.9).float().mean() > 0.3
    means = torch.stack([one.reward(states, followers, each).mean() for each in drawn]).double()
    # Each draw is a swap with probability 1/2: known mean and variance.
    shares = torch.stack([part.sum() for part in (swapped - kept).tensor_split(draws)]) / rows
    deviation = float(0.5 * shares.double().square().sum().sqrt())
    expected = float((swapped + kept).double().mean() / 2)
    assert float(means.mean()) == pytest.approx(expected, abs=4 * deviation / updates**0.5)
    assert float(means.std()) == pytest.approx(deviation, rel=4 / (2 * updates) ** 0.5)
    # Fresh episodes are measured with the mean reward that the critics learn.
    frames = torch.cat([states, followers[-1:]]).numpy()
    fresh = Trajectory(frames, states.numpy(), np.zeros(rows, np.float32), False)
    observed = one.observe([fresh], states, followers, torch.Generator())
    torch.testing.assert_close(observed, (swapped + kept) / 2)


@pytest.mark.parametrize("shuffle", ["random", "independent"])
def test_compiled_rewards_use_the_drawn_shuffles(shuffle: str) -> None:
    one, updates, rows = music(shuffle), 3, 600
    states, followers = transitions(updates * rows)
    trajectories = {"obs": torch.randn(updates * 520, 9, 6)}
    generator = torch.Generator().manual_seed(3)
    drawn = one.draw(updates, updates * rows, trajectories, generator, first=False)
    assert len(set(drawn)) > 1 or shuffle == "independent"
    permutations = trajectories["permutations"].unflatten(0, (updates, -1))
    for of_update in permutations:
        if shuffle == "independent":
            assert len(of_update.unique(dim=0)) > 500
            continue
        assert len(of_update.unique(dim=0)) == 3
        for worker in of_update.tensor_split([174, 347]):
            assert (worker == worker[0]).all()
    shape = (updates, rows, 6)
    adam = FusedAdam(one._network.parameters(), 0.0)
    found, _ = one.learn(states.view(shape), followers.view(shape), drawn, trajectories, adam)
    one._network.compiled = False
    parts = zip(states.view(shape), followers.view(shape), drawn, strict=True)
    expected = torch.stack([one.reward(*part) for part in parts])
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-4)


def test_priorities_of_the_random_shuffle_are_half_of_the_swaps() -> None:
    episodes = [transitions(51)[0] + 0.1 * i for i in range(40)]
    generator = torch.Generator().manual_seed(4)
    settings: dict[str, Any] = {"estimator": "frozen", "prioritise_replay": True}
    whole = music("independent", **settings).priorities(episodes, generator)
    drawn = np.stack([music(**settings).priorities(episodes, generator) for _ in range(50)])
    assert whole.std() > 0
    assert (drawn <= whole + 1e-12).all()
    # Half of the steps count, each at most 2e-4: the deviation of 50 x 40 sums of 50 steps.
    assert drawn.mean() / whole.mean() == pytest.approx(0.5, abs=0.01)


def test_a_priority_is_the_sum_of_the_clipped_bounds_of_its_steps() -> None:
    one = music("independent", estimator="frozen", prioritise_replay=True)
    frames = 5.0 * torch.randn(21, 6, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        bounds = one._network.transition_bounds(frames[:-1], frames[1:], (True,))
    assert bounds.min() < 0
    assert bounds.max() > 1e-3
    (found,) = one.priorities([frames], torch.Generator())
    assert found == pytest.approx(float(bounds.clamp(0.0, 2e-4).sum()))


def test_the_bound_on_new_episodes_is_weighted_by_their_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one = music("independent")
    monkeypatch.setattr(one._network, "bound", lambda *_: torch.tensor([0.1, 0.4]))
    episodes = [
        Trajectory(
            np.zeros((n + 1, 6), np.float32),
            np.zeros((n, 2), np.float32),
            np.zeros(n, np.float32),
            False,
        )
        for n in (30, 1, 10)
    ]
    one._measure_held_out(episodes, torch.Generator())
    assert one.metrics() == {names.HELD_OUT_BOUND: pytest.approx(0.175), HELD_OUT_STEPS: 40}
    assert one.metrics() == {}
