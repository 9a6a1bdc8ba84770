"""Updates without autograd against autograd's: the same gradients, and the same training."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from ray.rllib.core import DEFAULT_MODULE_ID
from torch import Tensor

from music_rllib.tac.algorithm import TAC
from music_rllib.tac.kernels import products
from music_rllib.tac.kernels.products import Blas, OneDnn, Products
from music_rllib.tac.kernels.update import DirectUpdate
from music_rllib.tac.learner import TACLearner
from tests.integration.test_captured_updates import VARIANTS
from tests.integration.test_tac_algorithm import build, fingerprint, register_uneven
from tests.integration.test_tac_losses import ACTION, BATCH, OBSERVATION, learner, minibatch

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
}
ACTIVE_BOUNDS = {"target_bounds": (-0.5, 0.5), "log_std_bounds": (-0.02, 0.02)}


def both_gradients(
    built: TACLearner, batch: dict[str, Tensor], by: Products
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Autograd's and ours, by the parameters' names, log alpha left out."""
    module = built.module[DEFAULT_MODULE_ID].unwrapped()
    trained = {n: p for n, p in module.named_parameters() if p.requires_grad and n != "log_alpha"}
    total = built._losses_of(module.forward_train(batch)["tac"], batch).total
    grads = torch.autograd.grad(total, list(trained.values()))
    direct = DirectUpdate(module, by)
    forward = direct.forward(batch)
    loss = built._losses_of(forward, batch)
    direct.backward(
        forward,
        batch,
        target=loss.target,
        value_target=loss.value_target,
        entropic_index=built._now.entropic_index,
        alpha=built._objective.alpha,
    )
    ours = {name: direct.flat.gradient(parameter) for name, parameter in trained.items()}
    return dict(zip(trained, grads, strict=True)), ours


def ready(**settings: Any) -> tuple[TACLearner, dict[str, Tensor]]:
    """A Learner in float64 whose policy is no longer the first one, and a minibatch."""
    built = learner(**settings)
    module = built.module[DEFAULT_MODULE_ID].unwrapped()
    generator = torch.Generator().manual_seed(1)
    if module.settings.normalise_observations:
        module.normaliser.update(torch.randn(50, OBSERVATION, generator=generator) * 3 + 1)
    for parameter in module.policy.parameters():
        parameter.data += 0.2 * torch.randn(parameter.shape, generator=generator)
    batch = minibatch()
    batch["next_noise"] = torch.randn(BATCH, ACTION, generator=generator).double()
    return built, batch


def check(settings: dict[str, Any], weights: bool = False) -> None:
    built, batch = ready(**settings)
    if weights:
        batch["weights"] = torch.linspace(0.1, 1.0, BATCH).double()
    expected, found = both_gradients(built, batch, Blas())
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
def test_gradients_are_autograds_at_every_q(q: float, form: str, backbone: str) -> None:
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
def test_gradients_are_autograds_with_every_setting(
    backbone: str, settings: dict[str, Any]
) -> None:
    check({**BACKBONES[backbone], "entropic_index": 1.5, **settings}, weights=True)


@pytest.mark.parametrize("alpha", [0.4, {"learned": True}])
def test_gradients_are_autograds_where_bounds_are_active(alpha: Any) -> None:
    settings = {"entropic_index": 5.0, "alpha": alpha, **ACTIVE_BOUNDS}
    check(settings)
    built, batch = ready(**settings)
    forward = built.module[DEFAULT_MODULE_ID].unwrapped().forward_train(batch)["tac"]
    assert forward.log_std is not None
    at_bound = forward.log_std.abs() == ACTIVE_BOUNDS["log_std_bounds"][1]
    assert 0 < int(at_bound.sum()) < at_bound.numel(), "some are within their bounds"


@pytest.mark.parametrize("by", [Blas(), OneDnn()], ids=["BLAS", "oneDNN"])
@pytest.mark.parametrize("hidden", [(128, 128), (17, 200), (64,)], ids=str)
def test_in_float32_gradients_differ_by_rounding_whatever_multiplies(
    by: Products, hidden: tuple[int, ...]
) -> None:
    if isinstance(by, OneDnn) and products._linear_pointwise is None:
        pytest.skip("this build of PyTorch has no oneDNN")
    # The first critic: which one is the smaller may hang on rounding.
    settings = {"entropic_index": 1.5, "policy_critic": "first", "hidden_sizes": hidden}
    built, batch = ready(**settings)
    exact, _ = both_gradients(built, batch, Blas())
    built.module[DEFAULT_MODULE_ID].float()
    _, found = both_gradients(built, {n: values.float() for n, values in batch.items()}, by)
    for name, gradient in exact.items():
        torch.testing.assert_close(
            found[name].reshape(gradient.shape).double(),
            gradient,
            rtol=0,
            atol=3e-6 * float(gradient.abs().max()),
            msg=name,
        )


@pytest.mark.usefixtures("local_ray")
@pytest.mark.parametrize("settings", list(VARIANTS.values()), ids=list(VARIANTS))
def test_a_training_has_autograds_numbers_to_rounding(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    register_uneven()
    # Few updates: what is counted jumps where rounding has grown. Short episodes need a round more.
    rounds = 3 if "task" in settings else 2
    found = fingerprint(build(**settings), rounds)
    monkeypatch.setattr(TACLearner, "_is_standard", False)
    expected = fingerprint(build(**settings), rounds)
    assert found != expected, "they round differently: else both took the same way"
    for row, same in zip(found, expected, strict=True):
        assert row == pytest.approx(same, rel=1e-3, abs=1e-4)


class OwnLoss(TACLearner):
    def compute_loss_for_module(self, **kwargs: Any) -> Tensor:
        return super().compute_loss_for_module(**kwargs)


def test_what_is_not_standard_is_left_to_autograd() -> None:
    def direct_of(algo: TAC) -> DirectUpdate | None:
        found: DirectUpdate | None = algo.learner_group._learner._direct
        return found

    assert direct_of(build()) is not None
    assert direct_of(build(grad_clip=1.0)) is None
    config = build().config.copy(copy_frozen=False).learners(learner_class=OwnLoss)
    own: TAC = config.build_algo()
    assert direct_of(own) is None
    own.train()


def test_a_converted_module_is_taken_over_anew() -> None:
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
    ("vendor", "family", "flags", "expected"),
    [
        ("AuthenticAMD", 26, {"avx2", "avx512f"}, OneDnn),
        ("AuthenticAMD", 26, {"avx2"}, Blas),
        ("AuthenticAMD", 25, {"avx2", "avx512f"}, Blas),
        ("GenuineIntel", 6, {"avx2", "avx512f"}, Blas),
        ("", 0, set(), Blas),
    ],
)
def test_the_library_follows_from_the_machines_description(
    vendor: str, family: int, flags: set[str], expected: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(products, "cpu_vendor", lambda: vendor)
    monkeypatch.setattr(products, "cpu_family", lambda: family)
    monkeypatch.setattr(products, "cpu_flags", lambda: frozenset(flags))
    products.products.cache_clear()
    try:
        assert type(products.products()) is expected
    finally:
        monkeypatch.undo()
        products.products.cache_clear()
