"""Intrinsic rewards other than MUSIC's: an oracle for each, their scale, exact resume."""

import functools
import importlib
import inspect
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from music_rllib.intrinsic.interface import Batch, IntrinsicReward, Sizes
from music_rllib.intrinsic.make import make_reward
from music_rllib.intrinsic.novelty import E3B
from music_rllib.intrinsic.relabeling import RewardLearner
from music_rllib.intrinsic.settings import BUILT_IN, SETTINGS, IntrinsicSettings
from music_rllib.replay.trajectories import Trajectory
from music_rllib.store.serialization import read_state, write_state

SIZES = Sizes(6, 3, 2, (0, 1, 2), (3, 4, 5))


class Speed(IntrinsicReward):
    """An own reward, named `tests.unit.intrinsic.test_rewards:Speed` in YAML."""

    def __init__(self, sizes: Sizes, *, factor: float = 1.0) -> None:
        super().__init__(sizes)
        self.factor = factor

    def bonus(self, batch: Batch) -> Tensor:
        return self.factor * (batch.followers - batch.states).abs().sum(-1)


class Unusual(IntrinsicReward):
    """Distance to the mean of all trajectories."""

    trajectories = 3

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(sizes)
        self.center = torch.nn.Parameter(torch.zeros(sizes.observation))

    def bonus(self, batch: Batch) -> Tensor:
        return (batch.followers - self.center).abs().sum(-1)

    def loss(self, batch: Batch) -> Tensor:
        assert batch.trajectories is not None
        assert batch.trajectories.shape[::2] == (3, self.sizes.observation)
        return (batch.trajectories - self.center).square().mean()


OWN, OF_TRAJECTORIES = f"{__name__}:Speed", f"{__name__}:Unusual"


def made(name: str, *, frozen: bool = False, seed: int = 0, **settings: Any) -> RewardLearner:
    chosen = IntrinsicSettings(reward=name, settings=settings, frozen=frozen, lr=1e-2)
    return RewardLearner(make_reward(chosen, SIZES, seed), chosen.lr, frozen=frozen)


def batch(rows: int = 64, seed: int = 0, **columns: Any) -> Batch:
    generator = torch.Generator().manual_seed(seed)
    states, followers = torch.randn(2, rows, 6, generator=generator)
    actions = torch.rand(rows, 2, generator=generator) * 2 - 1
    goals, stored = torch.randn(rows, 3, generator=generator), torch.ones(rows)
    return Batch(states, actions, followers, goals, generator, stored)._replace(**columns)


@torch.no_grad()
def bonus(learner: RewardLearner, of: Batch) -> float:
    return float(learner.reward.bonus(of).mean())


def test_rnd_falls_on_repeated_states_only() -> None:
    rnd, seen = made("rnd"), batch()
    new = batch(seed=1, followers=batch(seed=1).followers + 3.0)
    before = bonus(rnd, seen)
    for _ in range(200):
        rnd.learn(seen, 1)
    assert bonus(rnd, seen) < 0.05 * before
    assert bonus(rnd, new) > 10 * bonus(rnd, seen)


def moved(seed: int, *, noise: float = 0.0) -> Batch:
    """Dynamics in which the action moves the first two dimensions."""
    one = batch(256, seed)
    step = torch.nn.functional.pad(one.actions, (0, 4))
    return one._replace(followers=one.states + step + noise * one.followers)


@pytest.mark.parametrize("name", ["icm", "disagreement"])
def test_the_bonus_of_predictable_dynamics_vanishes(name: str) -> None:
    learner = made(name)
    learner.reward.inputs.update(moved(1).states)  # type: ignore[operator,union-attr]
    before = bonus(learner, moved(999))
    for seed in range(400):
        learner.learn(moved(seed), 1)
    assert bonus(learner, moved(999)) < 0.1 * before
    assert bonus(learner, moved(999)._replace(states=moved(999).states * 4)) > 5 * bonus(
        learner, moved(999)
    )


def test_icm_stays_high_for_unpredictable_dynamics() -> None:
    found = {}
    for noise in (0.0, 1.0):
        learner = made("icm")
        for seed in range(150):
            learner.learn(moved(seed, noise=noise), 1)
        found[noise] = bonus(learner, moved(999, noise=noise))
    assert found[1.0] > 5 * found[0.0]


def test_e3b_equals_its_closed_form() -> None:
    e3b = made("e3b", ridge=0.5).reward
    assert isinstance(e3b, E3B)
    frames, actions = torch.randn(9, 6), torch.randn(8, 2)
    found = e3b.of_episode(frames, actions).double()
    features = e3b.encode(frames).detach().double()
    for t in range(8):
        so_far = features[: t + 1]
        inverse = torch.linalg.inv(so_far.T @ so_far + 0.5 * torch.eye(16).double())
        expected = features[t + 1] @ inverse @ features[t + 1]
        assert float(found[t]) == pytest.approx(float(expected), rel=1e-3)
    twice = e3b.of_episode(frames.repeat(2, 1), torch.cat([actions, actions, actions[:1]]))
    assert float(twice[9:].mean()) < 0.6 * float(twice[:8].mean())


def test_e3b_keeps_a_small_ridge_in_a_long_episode_at_rest() -> None:
    torch.manual_seed(0)
    e3b = E3B(Sizes(17, 0, 6), ridge=0.001)
    with torch.no_grad():  # features as large as those of a trained encoder
        for parameter in e3b.encoder[-1].parameters():
            parameter.mul_(8.0)
    frames = torch.randn(17) + 1e-4 * torch.randn(1001, 17)
    frames[980:] += torch.linspace(0, 1, 21)[:, None] * torch.randn(17)
    found = e3b.of_episode(frames, torch.zeros(1000, 6)).double()
    features = e3b.encode(frames).detach().double()
    matrices = torch.einsum("ni,nj->nij", features, features).cumsum(0)[:-1]
    matrices += 0.001 * torch.eye(16).double()
    expected = (features[1:] * torch.linalg.solve(matrices, features[1:])).sum(-1)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0.0)


def test_diayn_separates_two_trivial_skills() -> None:
    diayn = made("diayn", skills=2)
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        goals = torch.randn(64, 3, generator=generator)
        diayn.reward.update_scales(batch(goals=goals))  # type: ignore[operator]
        skill = diayn.reward.skills(goals)  # type: ignore[operator]
        followers = torch.randn(64, 6, generator=generator)
        followers[:, 0] += 8.0 * skill - 4.0
        told = batch(goals=goals, followers=followers)
        diayn.learn(told, 1)
    assert bonus(diayn, told) > 0.85
    assert bonus(diayn, told._replace(followers=followers.flip(0))) < 0.65
    assert bonus(diayn, told._replace(followers=-followers)) < 0.1


def test_discern_recognises_its_goal() -> None:
    discern = made("discern")
    generator = torch.Generator().manual_seed(0)
    for _ in range(300):
        goals = torch.randn(64, 3, generator=generator)
        followers = torch.randn(64, 6, generator=generator)
        followers[:, 3:] = goals + 0.02 * torch.randn(64, 3, generator=generator)
        told = batch(goals=goals, followers=followers)
        discern.learn(told, 1)
    assert bonus(discern, told) > 0.5
    assert bonus(discern, told._replace(goals=goals.roll(1, 0))) < 0.2


def test_displacement_is_of_the_object_and_jitter_earns_nothing() -> None:
    learner, one = made("displacement"), batch()
    arm = one._replace(followers=torch.cat([one.followers[:, :3], one.states[:, 3:]], 1))
    assert bonus(learner, arm) == 0
    rewards, _ = learner.learn(arm._replace(followers=arm.followers + 1e-5), 1)
    assert float(rewards.max()) < -0.98
    distance = (one.followers - one.states)[:, 3:].norm(dim=1)
    torch.testing.assert_close(learner.reward.bonus(one), distance)
    with pytest.raises(ValueError, match="without surrounding_indices"):
        make_reward(IntrinsicSettings(reward="displacement"), Sizes(6, 3, 2), 0)


def test_random_rewards_are_uniform_and_of_no_transition() -> None:
    rewards, _ = made("random").learn(batch(4096), 1)
    assert float(rewards.mean()) == pytest.approx(-0.5, abs=0.03)
    assert float(rewards.std()) == pytest.approx(1 / math.sqrt(12), abs=0.02)


@pytest.mark.parametrize("factor", [1e-6, 1.0, 1e6])
def test_rewards_have_the_same_scale_for_any_unit_of_the_bonus(factor: float) -> None:
    rewards, metrics = made(OWN, factor=factor).learn(batch(256), 2)
    expected, _ = made(OWN).learn(batch(256), 2)
    torch.testing.assert_close(rewards, expected)
    assert rewards.shape == (2, 128)
    assert -0.7 < float(rewards.mean()) < -0.3
    assert metrics["intrinsic/bonus"].shape == (2,)


@pytest.mark.parametrize("name", [*BUILT_IN, OWN])
def test_rewards_resume_exactly_and_are_in_their_range(name: str, tmp_path: Path) -> None:
    unbroken, resumed = made(name), made(name, seed=1)
    for seed in range(3):
        unbroken.learn(batch(seed=seed), 2)
    write_state(tmp_path, unbroken.state())
    resumed.load_state(read_state(tmp_path))
    for seed in range(3, 6):
        rewards, metrics = unbroken.learn(batch(seed=seed), 2)
        theirs, their_metrics = resumed.learn(batch(seed=seed), 2)
        assert torch.equal(rewards, theirs)
        assert all(torch.equal(metrics[key], value) for key, value in their_metrics.items())
        assert ((rewards >= -1.0) & (rewards <= 0.0)).all()
    for key, array in unbroken.weights().items():
        assert (array == resumed.weights()[key]).all(), key


@pytest.mark.parametrize("name", ["rnd", "icm", "diayn"])
def test_frozen_rewards_keep_the_networks_and_the_scale_of_their_source(name: str) -> None:
    source, frozen = made(name), made(name, seed=1, frozen=True)
    source.learn(batch(), 1)
    frozen.load_weights(source.weights())
    first, _ = frozen.learn(batch(seed=1), 1)
    for seed in range(5):
        frozen.learn(batch(seed=seed), 1)
    assert torch.equal(frozen.learn(batch(seed=1), 1)[0], first)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("no_such_module:Mine", {}, r"^intrinsic\.reward must be importable, got 'no_such"),
        (f"{__name__}:batch", {}, "must name a subclass of IntrinsicReward"),
        (f"{__name__}:IntrinsicReward", {}, "must have a method bonus, which .* lacks"),
        (f"{__name__}:Speed", {"facter": 3}, r"^intrinsic\.settings must fit .*Speed: .*facter"),
    ],
)
def test_what_does_not_fit_is_named(name: str, settings: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        made(name, **settings)


@pytest.mark.parametrize(
    ("method", "result", "message"),
    [
        ("bonus", torch.ones(64, 1), r"of shape \(64,\), got one of torch\.float32 and \(64, 1\)"),
        ("bonus", torch.ones(64).bool(), r"tensor of floats .* got one of torch\.bool"),
        ("bonus", np.ones(64), r"^Wrong\.bonus must return a tensor .*, got ndarray"),
        ("loss", 0.5, r"^Wrong\.loss must return a tensor of floats and of shape \(\), got float"),
        ("loss", torch.ones(64), r"got one of torch\.float32 and \(64,\)"),
        ("loss", torch.tensor(1.0), r"^Wrong\.loss must depend on the reward's parameters"),
        ("of_episode", torch.ones(9), r"of shape \(8,\), got one of torch\.float32 and \(9,\)"),
    ],
    ids=str,
)
def test_a_result_that_does_not_fit_is_refused_instead_of_broadcast(
    method: str, result: Any, message: str
) -> None:
    class Wrong(Unusual):
        trajectories = 0

        def loss(self, batch: Batch) -> Tensor:
            return (batch.states - self.center).square().mean()

    setattr(Wrong, method, lambda *_: result)
    learner = RewardLearner(Wrong(SIZES), 1e-3, frozen=False)
    frames = np.zeros((9, 12), np.float32)
    played = Trajectory(frames, frames[:8, :2], frames[:8, 0], terminated=False)

    def use() -> None:
        learner.learn(batch(), 1)
        learner.values_of([played])

    with pytest.raises(ValueError, match=message):
        use()


class InPlace(Speed):
    def bonus(self, batch: Batch) -> Tensor:
        moved = batch.followers
        moved -= batch.states
        return moved.abs().sum(-1)


class InPlaceLoss(Unusual):
    trajectories = 0

    def loss(self, batch: Batch) -> Tensor:
        return (batch.actions.clamp_(0.0).sum() - self.center).square().mean()


class Counting(Speed):
    """Its attribute is in no checkpoint."""

    seen = 0

    def bonus(self, batch: Batch) -> Tensor:
        self.seen += 1
        return super().bonus(batch) / self.seen


class Growing(Speed):
    """Distance to the nearest state of a memory that grows."""

    memory: Tensor

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(sizes)
        self.register_buffer("memory", torch.zeros(1, sizes.observation))

    def bonus(self, batch: Batch) -> Tensor:
        distances = torch.cdist(batch.followers, self.memory)
        self.memory = torch.cat([self.memory, batch.followers])
        return distances.amin(-1)


class NumpyNoise(Speed):
    def bonus(self, batch: Batch) -> Tensor:
        return torch.from_numpy(np.random.default_rng().random(len(batch.states)))


class Dropout(Speed):
    """It draws from PyTorch's own generator, whose state is in checkpoints."""

    def bonus(self, batch: Batch) -> Tensor:
        return torch.nn.functional.dropout(super().bonus(batch), 0.2)


class Drawn(Speed):
    """Its constructor takes random numbers that no seed determines."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(sizes)
        self.factor = float(np.random.default_rng().random())

    scale = 100.0


class OwnOptimizer(Unusual):
    """Trains its parameter itself; the optimizer's momentum is in no checkpoint."""

    trajectories = 0

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(sizes)
        self.optimizer = torch.optim.SGD([self.center], 0.1, momentum=0.9)

    def bonus(self, batch: Batch) -> Tensor:
        with torch.enable_grad():
            (batch.followers - self.center).square().mean().backward()
        self.optimizer.step()
        return super().bonus(batch)

    def loss(self, batch: Batch) -> None:  # type: ignore[override]
        return None


def own(kind: type[IntrinsicReward], *, frozen: bool = False) -> RewardLearner:
    make = functools.partial(kind, SIZES)
    return RewardLearner(make(), 1e-3, frozen=frozen, again=make)


@pytest.mark.parametrize(
    ("kind", "rule"),
    [
        (InPlace, "must not change the followers of its batch in place"),
        (InPlaceLoss, "must not change the actions of its batch in place"),
        (Counting, "keep everything that changes in parameters and buffers"),
        (Growing, "must keep the shapes .* size mismatch for memory"),
        (NumpyNoise, r"take random numbers from batch\.generator"),
        (Drawn, "keep everything"),
        (OwnOptimizer, "keep everything"),
    ],
)
def test_a_reward_that_would_change_data_or_not_resume_is_refused(kind: Any, rule: str) -> None:
    with pytest.raises(ValueError, match=f"^{kind.__name__} .*{rule}"):
        own(kind).learn(batch(128), 2)


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("kind", [Speed, Unusual, Dropout])
def test_the_check_of_a_reward_changes_no_result(kind: Any, frozen: bool) -> None:
    shown: Any = {"trajectories": torch.randn(2 * kind.trajectories, 4, 6)}
    checked, plain = own(kind, frozen=frozen), RewardLearner(kind(SIZES), 1e-3, frozen=frozen)
    torch.manual_seed(3)
    rewards = checked.learn(batch(128, **shown), 2)[0]
    state = torch.get_rng_state()
    torch.manual_seed(3)
    assert torch.equal(plain.learn(batch(128, **shown), 2)[0], rewards)
    assert torch.equal(state, torch.get_rng_state())
    for name, weights in plain.weights().items():
        np.testing.assert_array_equal(weights, checked.weights()[name])


@pytest.mark.parametrize("name", ["alpha", "intrinsic/reward"])
def test_a_metric_must_not_replace_another(name: str) -> None:
    class Wrong(Speed):
        def metrics(self) -> dict[str, float]:
            return {name: 1.0}

    with pytest.raises(ValueError, match=f"must begin with intrinsic/ .*, got '{name}'"):
        RewardLearner(Wrong(SIZES), 1e-3, frozen=False).metrics()


def test_a_class_whose_constructor_does_not_call_its_parents_is_named() -> None:
    class Forgetful(Speed):
        def __init__(self, sizes: Sizes) -> None:
            self.factor = 1.0

    globals()["Forgetful"] = Forgetful
    with pytest.raises(ValueError, match=r"Forgetful must call super\(\).__init__\(sizes\)"):
        made(f"{__name__}:Forgetful")


@pytest.mark.parametrize("number", [-0.5, torch.nan, torch.inf])
def test_a_bonus_that_is_negative_or_not_finite_is_refused(number: float) -> None:
    class Wrong(Speed):
        def bonus(self, batch: Batch) -> Tensor:
            bonus = super().bonus(batch)
            bonus[3] = number
            return bonus

    with pytest.raises(ValueError, match=f"must return finite numbers >= 0, got {number}"):
        RewardLearner(Wrong(SIZES), 1e-3, frozen=False).learn(batch(), 1)


@pytest.mark.parametrize("name", BUILT_IN)
def test_the_checked_settings_are_those_of_the_class(name: str) -> None:
    module, _, cls = BUILT_IN[name].partition(":")
    signature = inspect.signature(getattr(importlib.import_module(module), cls))
    assert tuple(signature.parameters)[1:] == SETTINGS.get(name, ())


def test_a_rewards_networks_take_a_step_in_every_fourth_update() -> None:
    learner = made("rnd")
    learner.learn(batch(90), 9)
    assert {float(each["step"]) for each in learner.state()["adam"].values()} == {3.0}


@pytest.mark.parametrize("name", ["rnd", "icm", "displacement", "diayn"])
def test_measuring_fresh_episodes_changes_nothing(name: str) -> None:
    learner = made(name)
    learner.learn(batch(), 1)
    before = learner.weights()
    learner.observe(batch(seed=1), None)
    for key, array in learner.weights().items():
        np.testing.assert_array_equal(array, before[key])


@pytest.mark.parametrize("name", sorted(set(BUILT_IN) - {"random"}))
def test_a_bonus_that_depends_on_its_minibatch_says_so(name: str) -> None:
    reward = make_reward(IntrinsicSettings(reward=name), SIZES, 0)
    whole = batch()
    names = ("states", "actions", "followers", "goals", "stored")
    part = whole._replace(**{name: getattr(whole, name)[:8] for name in names})
    with torch.no_grad():
        depends = not torch.allclose(reward.bonus(whole)[:8], reward.bonus(part), atol=1e-5)
    assert reward.by_minibatch == depends


def test_rewards_have_the_type_of_the_states() -> None:
    class Double(IntrinsicReward):
        def bonus(self, batch: Batch) -> Tensor:
            return (batch.followers - batch.states).double().abs().sum(-1)

    states = torch.randn(8, 3)
    batch = Batch(states, torch.zeros(8, 2), states + 1, torch.zeros(8, 0), torch.Generator())
    reward, bonus = Double(Sizes(3, 0, 2)).reward(batch, learning=True)
    assert reward.dtype == bonus.dtype == torch.float32


@pytest.mark.parametrize(
    "name", ["intrinsic/error (mean)", "intrinsic//x", "intrinsic/", "intrinsic/" + "x" * 250]
)
def test_names_that_mlflow_refuses(name: str) -> None:
    class Reward:
        def metrics(self) -> dict[str, float]:
            return {name: 1.0}

    learner = RewardLearner.__new__(RewardLearner)
    vars(learner)["reward"] = Reward()
    with pytest.raises(ValueError, match=r"names in Reward\.metrics"):
        learner.metrics()


@pytest.mark.parametrize("found", [None, {"intrinsic/x": "abc"}, {"intrinsic/x": torch.ones(2)}])
def test_metrics_must_be_numbers(found: Any) -> None:
    class Forgot(Speed):
        def metrics(self) -> dict[str, float]:
            return found  # type: ignore[no-any-return]

    with pytest.raises(ValueError, match=r"Forgot\.metrics must return a dictionary of numbers"):
        RewardLearner(Forgot(SIZES), 1e-3, frozen=False).metrics()
