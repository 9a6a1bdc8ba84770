"""Compiled updates have the gradients and the training results of autograd."""

from __future__ import annotations

import functools
import itertools
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numba import njit
from ray.rllib.core import DEFAULT_MODULE_ID
from torch import Tensor

from music_rllib import TACConfig, names
from music_rllib.kernels import blas
from music_rllib.tac.algorithm import TAC
from music_rllib.tac.compiled_update import CompiledUpdate
from music_rllib.tac.learner import TACLearner
from tests.integration.algorithm.test_tac_algorithm import (
    HER,
    MUSIC_R,
    MUSIC_U,
    PER,
    SMALL,
    build,
    fingerprint,
    register_uneven,
)
from tests.integration.algorithm.test_tac_losses import (
    ACTION,
    BATCH,
    OBSERVATION,
    learner,
    minibatch,
)
from tests.unit.intrinsic.test_rewards import OF_TRAJECTORIES

DDPG = {
    "policy": "deterministic",
    "bootstrap": "critics",
    "alpha": 0.0,
    "behaviour": {"kind": "gaussian_noise"},
}
BACKBONES: dict[str, dict[str, Any]] = {
    "TAC": {"bootstrap": "value", "alpha": 0.3},
    "SAC": {"bootstrap": "critics", "alpha": 0.3},
    "DDPG": DDPG,
    "REDQ": {"critics": 4, "target_critics": 2, "policy_critic": "mean"},
    "TQC": {
        "bootstrap": "critics",
        "policy_critic": "mean",
        "critics": 3,
        "quantiles": 5,
        "dropped_quantiles": 2,
    },
}
RAMP = {"schedule": "linear", "start": 1.0, "end": 2.0}
BY_ENTROPY = {"follows": "shannon_entropy", "points": [[1.0, 1.0], [3.0, 2.0]]}
VARIANTS: dict[str, dict[str, Any]] = {
    "tac": HER,
    "music-u": {"music": MUSIC_U},
    "music-r": {"music": MUSIC_R, "entropic_index": 1.5},
    "episodes of unequal lengths": {"task": "Uneven", "music": MUSIC_U},
    "frames shuffled as in 2021": {"music": {**MUSIC_U, "shuffle": "random"}},
    "MINE": {"music": {**MUSIC_U, "bound": "moving_average"}},
    "q measured, alpha scheduled": {"entropic_index": BY_ENTROPY, "alpha": {**RAMP, "start": 0.1}},
    "alpha learned": {"alpha": {"learned": True}, "bootstrap": "critics"},
    "alpha learned for a Shannon entropy": {"alpha": {"learned": True, "target_shannon": -2.0}},
    "alpha learned for a width": {"alpha": {"learned": True, "target_width": 0.1}},
    "ddpg": {
        **DDPG,
        "target_bounds": (-200.0, 0.0),
        "target_update_interval": 2,
        "action_l2": 1.0,
    },
    "per": PER,
    "redq": {
        "bootstrap": "critics",
        "critics": 4,
        "target_critics": 2,
        "policy_critic": "mean",
        "layer_norm": "critics",
        "policy_delay": 3,
    },
    "tqc": {
        "bootstrap": "critics",
        "alpha": {"learned": True},
        "entropic_index": 1.5,
        "policy_critic": "mean",
        "quantiles": 5,
        "dropped_quantiles": 1,
        "policy_delay": 2,
    },
    "bonus": {**HER, "intrinsic.reward": "icm"},
    "bonus on trajectories": {"music": MUSIC_U, "intrinsic.reward": OF_TRAJECTORIES},
    "widths between bounds": {"log_std_form": "tanh", "log_std_bounds": (-5.0, 2.0)},
}
ACTIVE_BOUNDS = {"target_bounds": (-0.5, 0.5), "log_std_bounds": (-0.02, 0.02)}


def both_gradients(
    built: TACLearner, batch: dict[str, Tensor]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Gradients of autograd and of compiled code, by parameter; compares losses and observed."""
    module = built.module[DEFAULT_MODULE_ID].unwrapped()
    trained = {n: p for n, p in module.named_parameters() if p.requires_grad and n != "log_alpha"}
    losses = built._losses_of(module.forward_train(batch)["tac"], batch)
    grads = torch.autograd.grad(losses.total, list(trained.values()))
    direct = CompiledUpdate(module)
    learned = direct.learn(batch, None, 0, built._now.entropic_index, float(built._objective.alpha))
    for expected, found in ((losses.named, learned.losses), (built._observed, learned.observed)):
        assert expected.keys() == found.keys()
        for name, values in expected.items():
            atol = 1e-5 * float(values.detach().abs().max())
            torch.testing.assert_close(found[name][0], values.detach(), rtol=0, atol=atol, msg=name)
    flat = direct.flat
    ours = {name: flat.view(flat.gradients, parameter) for name, parameter in trained.items()}
    return dict(zip(trained, grads, strict=True)), ours


def ready(**settings: Any) -> tuple[TACLearner, dict[str, Tensor]]:
    """A Learner in float64 whose policy differs from its initial one, and a minibatch."""
    built = learner(**settings)
    module = built.module[DEFAULT_MODULE_ID].unwrapped()
    generator = torch.Generator().manual_seed(1)
    if module.settings.normalise_observations:
        module.normaliser.update(torch.randn(50, OBSERVATION, generator=generator) * 3 + 1)
    for parameter in module.policy.parameters():
        parameter.data += 0.2 * torch.randn(parameter.shape, generator=generator)
    batch = minibatch()
    batch["next_noise"] = torch.randn(BATCH, ACTION, generator=generator).double()
    if (some := built._settings.target_critics) is not None:
        batch["target_critics"] = torch.arange(some) + 1
    return built, batch


def check(settings: dict[str, Any], weights: bool = False) -> None:
    built, batch = ready(**settings)
    if weights:
        batch["weights"] = torch.linspace(0.1, 1.0, BATCH).double()
    expected, found = both_gradients(built, batch)
    assert expected.keys() == found.keys()
    for name, gradient in expected.items():
        scale = float(gradient.abs().max())
        assert scale > 0, name
        torch.testing.assert_close(
            found[name].reshape(gradient.shape), gradient, rtol=0, atol=1e-9 * scale, msg=name
        )


@pytest.mark.parametrize("q", [0.1, 0.5, 1.0, 1.0 + 1e-7, 1.5, 2.0, 3.0, 5.0])
@pytest.mark.parametrize("form", ["per_dimension", "joint"])
@pytest.mark.parametrize("backbone", ["TAC", "SAC"])
def test_gradients_equal_autograd_at_every_q(q: float, form: str, backbone: str) -> None:
    check({**BACKBONES[backbone], "entropic_index": q, "entropy_form": form})


@pytest.mark.parametrize("backbone", list(BACKBONES))
@pytest.mark.parametrize(
    "settings",
    [
        {"policy_critic": "first"},
        {"action_l2": 0.7},
        {"target_bounds": (-0.5, 0.5)},
        {"normalise_observations": False},
        {"log_std_form": "tanh", "log_std_bounds": (-2.0, 1.0)},
    ],
    ids=str,
)
def test_gradients_equal_autograd_with_every_setting(
    backbone: str, settings: dict[str, Any]
) -> None:
    check({**BACKBONES[backbone], "entropic_index": 1.5, **settings}, weights=True)


@pytest.mark.parametrize("backbone", ["TAC", "DDPG", "REDQ"])
def test_gradients_equal_autograd_with_layer_norm(backbone: str) -> None:
    check({**BACKBONES[backbone], "layer_norm": "all"})


@pytest.mark.parametrize("alpha", [0.4, {"learned": True}])
def test_gradients_equal_autograd_at_active_bounds(alpha: Any) -> None:
    settings = {"entropic_index": 5.0, "alpha": alpha, **ACTIVE_BOUNDS}
    check(settings)
    built, batch = ready(**settings)
    forward = built.module[DEFAULT_MODULE_ID].unwrapped().forward_train(batch)["tac"]
    assert forward.log_std is not None
    at_bound = forward.log_std.abs() == ACTIVE_BOUNDS["log_std_bounds"][1]
    assert 0 < int(at_bound.sum()) < at_bound.numel(), "some are within their bounds"


@pytest.mark.parametrize("hidden", [(128, 128), (17, 200), (64,)], ids=str)
def test_in_float32_gradients_differ_by_rounding(hidden: tuple[int, ...]) -> None:
    # The first critic, because rounding may decide which one is smaller.
    settings = {"entropic_index": 1.5, "policy_critic": "first", "hidden_sizes": hidden}
    built, batch = ready(**settings)
    exact, _ = both_gradients(built, batch)
    built.module[DEFAULT_MODULE_ID].float()
    _, found = both_gradients(built, {n: values.float() for n, values in batch.items()})
    for name, gradient in exact.items():
        torch.testing.assert_close(
            found[name].reshape(gradient.shape).double(),
            gradient,
            rtol=0,
            atol=3e-6 * float(gradient.abs().max()),
            msg=name,
        )


def test_critics_of_equal_value_share_the_policys_gradient() -> None:
    built, batch = ready(entropic_index=1.5, policy_critic="min")
    module = built.module[DEFAULT_MODULE_ID].unwrapped()
    for parameter in module.critics.parameters():
        parameter.data[1] = parameter.data[0]
    expected, found = both_gradients(built, batch)
    for name, gradient in expected.items():
        atol = 1e-9 * float(gradient.abs().max())
        same = found[name].reshape(gradient.shape)
        torch.testing.assert_close(same, gradient, rtol=0, atol=atol, msg=name)


@pytest.mark.parametrize("backbone", list(BACKBONES))
def test_updates_in_one_call_are_bit_identical_to_single_updates(backbone: str) -> None:
    batches = [ready(**BACKBONES[backbone])[1] for _ in range(5)]
    for k, batch in enumerate(batches):
        batch["rewards"] += k
    together = {name: torch.cat([b[name] for b in batches]) for name in batches[0]}
    together = {n: v.float() if v.is_floating_point() else v for n, v in together.items()}

    def learned(calls: list[int]) -> dict[str, Tensor]:
        delays = {"target_update_interval": 2, "policy_delay": 2}
        settings = {**BACKBONES[backbone], "tau": 0.1, **delays}
        built, _ = ready(**settings)
        module = built.module[DEFAULT_MODULE_ID].unwrapped().float()
        first = {name: p.detach().clone() for name, p in module.named_parameters()}
        direct, done = CompiledUpdate(module), 0
        for updates in calls:
            some = {
                name: values.unflatten(0, (5, -1))[done : done + updates].flatten(0, 1)
                for name, values in together.items()
            }
            found = direct.learn(some, built._adam["networks"], done, 1.5, 0.3)
            assert {loss.shape for loss in found.losses.values()} == {(updates,)}
            done += updates
        after = {name: p.detach().clone() for name, p in module.named_parameters()}
        assert not any(torch.equal(after[name], first[name]) for name in first)
        return after

    expected = learned([1, 1, 1, 1, 1])
    for name, values in learned([5]).items():
        assert torch.equal(values, expected[name]), name
    for name, values in learned([2, 3]).items():
        assert torch.equal(values, expected[name]), name


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("policy_critic", ["min", "first"])
@pytest.mark.parametrize("backbone", list(BACKBONES))
def test_non_finite_values_spread_as_in_autograd(
    backbone: str, policy_critic: str, bad: float
) -> None:
    """One non-finite number in each column of a minibatch, each parameter and target network."""
    settings = {**BACKBONES[backbone], "policy_critic": policy_critic, "entropic_index": 1.5}
    built, batch = ready(**settings, target_bounds=(-0.5, 0.5))
    module = built.module[DEFAULT_MODULE_ID].unwrapped()
    places = {**dict(module.named_parameters()), **batch, "weights": torch.ones(BATCH).double()}
    batch["weights"] = places["weights"]
    for name, tensor in places.items():
        if name == "target_critics":
            continue
        for index in (0, tensor.numel() - 1):
            number = tensor.detach().flatten()[index].clone()
            tensor.detach().view(-1)[index] = bad
            # Autograd multiplies a critic that the policy does not use by 0, which keeps NaN.
            gradients = policy_critic == "min" and np.isnan(bad)
            expected, found = spoilt(built, batch, gradients)
            tensor.detach().view(-1)[index] = number
            assert expected == found, name
    assert not any(sum(part.values()) for part in spoilt(built, batch, True))


def spoilt(
    built: TACLearner, batch: dict[str, Tensor], gradients: bool
) -> tuple[dict[str, int], dict[str, int]]:
    """Counts of non-finite numbers in losses, observed tensors and gradients of both."""
    module = built.module[DEFAULT_MODULE_ID].unwrapped()
    trained = {n: p for n, p in module.named_parameters() if p.requires_grad}
    built._losses, built._observed = {}, {}
    losses = built._losses_of(module.forward_train(batch)["tac"], batch)
    expected = {**built._losses, **built._observed}
    direct = CompiledUpdate(module)
    learned = direct.learn(batch, None, 0, built._now.entropic_index, float(built._objective.alpha))
    found = {**learned.losses, **learned.observed}
    if gradients:
        grads = torch.autograd.grad(losses.total, list(trained.values()))
        expected |= dict(zip(trained, grads, strict=True))
        flat = direct.flat
        found |= {name: flat.view(flat.gradients, p) for name, p in trained.items()}
    count = [{n: int((~v.isfinite()).sum()) for n, v in part.items()} for part in (expected, found)]
    return count[0], count[1]


@njit  # compiled once for all sizes, because that takes seconds
def product(left: Any, right: Any, transposed: tuple[bool, bool], out: Any) -> None:
    blas.multiply(left, transposed[0], right, transposed[1], out)


# The fourth and fifth are the sizes at which BLAS multiplies small matrices without copies.
@pytest.mark.parametrize(
    ("rows", "inner", "columns"),
    [(256, 28, 128), (5, 3, 1), (1, 1, 7), (256, 128, 128), (130, 250, 320), (0, 3, 4)],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_products_equal_numpy_for_every_transposition(
    rows: int, inner: int, columns: int, dtype: Any
) -> None:
    rng = np.random.default_rng(0)
    left, right = rng.normal(size=(rows, inner)), rng.normal(size=(inner, columns))
    for of_left, of_right in itertools.product((False, True), repeat=2):
        out = np.full((rows, columns), np.nan, dtype)
        first = np.ascontiguousarray(left.T if of_left else left, dtype)
        second = np.ascontiguousarray(right.T if of_right else right, dtype)
        for multiply in (product, product.py_func):
            out.fill(np.nan)
            multiply(first, second, (of_left, of_right), out)
            np.testing.assert_allclose(out, left @ right, rtol=1e-4, atol=1e-5)


@pytest.mark.usefixtures("local_ray")
@pytest.mark.parametrize("settings", list(VARIANTS.values()), ids=list(VARIANTS))
def test_compiled_training_equals_autograd_to_rounding(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    register_uneven()
    # Few updates: rounding errors grow, and then counts differ. Short episodes need one more round.
    rounds = 3 if "task" in settings else 2
    found = fingerprint(build(**settings), rounds)
    monkeypatch.setattr(TACLearner, "_needs_autograd", True)
    expected = fingerprint(build(**settings), rounds)
    assert found != expected, "they round differently: else both took the same way"
    for row, same in zip(found, expected, strict=True):
        # Rewards of objects at rest are at the lowest value, up to rounding of the bound: the share
        # of those that are exactly there differed by up to 0.02 (AMD EPYC without AVX-512).
        counted = row.pop(names.MI_REWARD_LOWEST, 0.0)
        assert counted == pytest.approx(same.pop(names.MI_REWARD_LOWEST, 0.0), abs=0.05)
        assert row == pytest.approx(same, rel=1e-3, abs=1e-4)


HOOKS = (
    "compute_losses",
    "compute_loss_for_module",
    "compute_gradients",
    "postprocess_gradients",
    "postprocess_gradients_for_module",
    "apply_gradients",
    "configure_optimizers_for_module",
)


@pytest.mark.parametrize("hook", HOOKS)
def test_overridden_methods_of_a_learner_are_called(hook: str) -> None:
    calls = []

    def own(self: TACLearner, *args: Any, **kwargs: Any) -> Any:
        calls.append(hook)
        return getattr(TACLearner, hook)(self, *args, **kwargs)

    config = TACConfig().environment("FetchReach-v4").training(**SMALL)
    config.reporting(min_sample_timesteps_per_iteration=1)
    config.learners(learner_class=type("Own", (TACLearner,), {hook: own}))
    algo: TAC = config.build_algo()
    for _ in range(3):
        algo.train()
    assert algo.grad_updates == 10
    assert len(calls) == (1 if hook.startswith("configure") else 10)
    assert algo.learner_group._learner._compiled is None


def test_updates_without_own_methods_are_compiled() -> None:
    def compiled_of(algo: TAC) -> CompiledUpdate | None:
        found: CompiledUpdate | None = algo.learner_group._learner._compiled
        return found

    assert compiled_of(build()) is not None
    assert compiled_of(build(grad_clip=1.0)) is None


@pytest.mark.parametrize("settings", [{}, {"grad_clip": 1.0}], ids=["compiled", "autograd"])
def test_updates_compute_without_denormals(settings: dict[str, Any]) -> None:
    """Intel's CPUs are slow with them; the moments of dead units decay to them and stay there."""
    algo = build(**settings)
    while not algo.grad_updates:
        algo.train()
    state = algo.learner_group._learner._adam["networks"].state
    moments = [s[name] for s in state.values() for name in ("exp_avg", "exp_avg_sq")]
    smallest, tiny = torch.finfo(torch.float32).smallest_normal, 1e-40
    for values in moments:
        values[values.abs() < smallest] = tiny
    assert any((values == tiny).any() for values in moments)
    algo.train()
    assert not any(((values != 0) & (values.abs() < smallest)).any() for values in moments)
    assert torch.tensor(smallest) / 2 > 0  # the caller's arithmetic is not changed


@pytest.mark.parametrize("alpha", [0.2, {"learned": True, "lr": 1e-3}])
def test_learning_rates_of_rllibs_schedulers_are_used_and_kept(alpha: Any, tmp_path: Path) -> None:
    config = TACConfig().environment("FetchReach-v4").training(**SMALL, alpha=alpha)
    config.reporting(min_sample_timesteps_per_iteration=1)
    rising = functools.partial(torch.optim.lr_scheduler.LinearLR, start_factor=0.5, total_iters=4)
    config.experimental(_torch_lr_scheduler_classes=[rising])

    def rate(algo: TAC) -> float:
        """The learning rate of all optimizers."""
        adam = algo.learner_group._learner._adam
        (found,) = {one.param_groups[0]["lr"] for one in adam.values()}
        return float(found)

    algo: TAC = config.build_algo()
    assert rate(algo) == 1e-3 / 2
    for _ in range(4):
        algo.train()
    assert rate(algo) == pytest.approx(1e-3 * 3 / 4)
    algo.save_to_path(str(tmp_path))
    resumed: TAC = config.copy(copy_frozen=False).build_algo()
    resumed.restore_from_path(str(tmp_path))
    for one in (algo, resumed):
        one.train()
    assert rate(algo) == rate(resumed) == pytest.approx(1e-3 * 7 / 8)


def read_only(value: Any) -> Any:
    """Nested dictionaries with copies of their arrays, as RLlib receives from other processes."""
    if isinstance(value, dict):
        return {key: read_only(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray):
        value = value.copy()
        value.flags.writeable = False
    return value


def test_the_learner_accepts_read_only_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    """RLlib's arrays from another process are read-only; PyTorch would print a warning."""
    algo = build(music={"estimator": "frozen", "prioritise_replay": True})
    learner_ = algo.learner_group._learner
    update = learner_.update

    def from_afar(*args: Any, training_data: Any, **kwargs: Any) -> Any:
        for columns in training_data.batch.policy_batches.values():
            columns.update({name: read_only(values) for name, values in columns.items()})
        return update(*args, training_data=training_data, **kwargs)

    monkeypatch.setattr(learner_, "update", from_afar)
    episodes = algo.env_runner.sample(random_actions=True)
    for episode in episodes:
        for array in (episode.frames, episode.actions, episode.rewards):
            array.flags.writeable = False
    torch.set_warn_always(True)  # by default PyTorch prints this warning once per process
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*not writable")
        learner_.observe_inputs(episodes[0].frames[:, : learner_._policy_module.input_size])
        learner_.trajectory_priorities(episodes)
        learner_.diagnose(episodes, None)
        learner_.set_state(read_only(learner_.get_state()))
        while not algo.grad_updates:
            algo.train()
    torch.set_warn_always(False)


def test_a_converted_module_keeps_learning() -> None:
    algo = build()
    learner_ = algo.learner_group._learner
    algo.train()
    module = learner_.module[DEFAULT_MODULE_ID].unwrapped()
    module.double()
    module.float()
    before = module.policy[0].weight.detach().clone()
    algo.train()
    assert not torch.equal(module.policy[0].weight, before)


@pytest.mark.parametrize(
    ("vendor", "has_mkl", "expected"),
    [
        ("AuthenticAMD", True, "OpenBLAS"),
        ("GenuineIntel", True, "MKL"),
        ("GenuineIntel", False, "OpenBLAS"),
        ("", False, "OpenBLAS"),
    ],
)
def test_the_blas_library_depends_on_the_cpu_vendor(
    vendor: str, has_mkl: bool, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blas, "_cpu_vendor", lambda: vendor)
    monkeypatch.setattr(blas, "_in_mkl", lambda routine: 1 if has_mkl else None)
    assert blas.library() == expected
