"""The facts of Tsallis statistics that a correct implementation satisfies."""

import math

import entmax
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, optimize, stats

from music_rllib.functional.distribution import (
    MAX_EXPONENT,
    bound_active,
    ln_q_of_log,
    ln_q_of_policy,
)
from music_rllib.functional.entropy_scale import largest_entropy
from tests.unit.functional.entropies import exp_q, gaussian_entropy, joint_entropy, ln_q

orders = st.floats(0.5, 3.0)
positive = st.floats(1e-3, 1e3)


def f64(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


@given(x=positive, q=orders)
def test_exp_q_undoes_ln_q(x: float, q: float) -> None:
    assert float(exp_q(ln_q(f64(x), q), q)) == pytest.approx(x, rel=1e-6)


@pytest.mark.parametrize("q", [0.1, 0.5, 1.2, 1.5, 2.0, 3.0, 5.0])
def test_gradients_in_float32_are_the_slope_on_both_sides_of_the_bound(q: float) -> None:
    log_x = torch.linspace(-8.0, 8.0, 2001, requires_grad=True)
    ln_q_of_log(log_x, q, max_exponent=MAX_EXPONENT).sum().backward()
    exponent = (q - 1.0) * log_x.detach().double()
    assert log_x.grad is not None
    # The gradient of expm1 is its value + 1, which has the precision of numbers near 1.
    expected = exponent.clamp(max=MAX_EXPONENT).exp()
    torch.testing.assert_close(log_x.grad.double(), expected, rtol=2e-6, atol=2e-7)


@given(y=st.floats(-3, 3), q=orders)
def test_ln_q_undoes_exp_q_exactly_where_its_argument_is_positive(y: float, q: float) -> None:
    margin = 1 + (q - 1) * y
    image = exp_q(f64(y), q)
    if margin > 1e-3:
        assert float(ln_q(image, q)) == pytest.approx(y, rel=1e-6, abs=1e-9)
    elif margin < -1e-3:
        assert float(image) == (0.0 if q > 1 else math.inf)


@given(x=positive, y=positive, q=orders)
def test_pseudo_additivity(x: float, y: float, q: float) -> None:
    a, b = ln_q(f64(x), q), ln_q(f64(y), q)
    together = ln_q(f64(x) * f64(y), q)
    assert float(together) == pytest.approx(float(a + b + (q - 1) * a * b), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("q", [1.0 - 1e-7, 1.0 + 1e-7, 1.0 + 1e-12, 1.0])
def test_float32_stays_exact_next_to_the_shannon_case(q: float) -> None:
    x = torch.tensor([0.01, 0.5, 3.0, 40.0])
    torch.testing.assert_close(ln_q(x, q), torch.log(x), rtol=2e-6, atol=1e-6)


def test_gaussian_entropy_has_its_published_value() -> None:
    assert float(gaussian_entropy(f64(0.3), 1.5)) == pytest.approx(0.116877, abs=1e-6)


@pytest.mark.parametrize("q", [0.5, 0.9, 1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("std", [0.05, 0.3, 1.0])
def test_gaussian_entropy_is_the_integral_of_its_definition(q: float, std: float) -> None:
    density = stats.norm(scale=std)

    def integrand(x: float) -> float:
        return -float(density.pdf(x)) * float(ln_q_of_log(f64(float(density.logpdf(x))), q))

    # 12 standard deviations: at q = 0.5 the integrand falls off as exp(-x^2 / 4).
    numeric, _ = integrate.quad(integrand, -12 * std, 12 * std, limit=200)
    assert float(gaussian_entropy(f64(std), q)) == pytest.approx(numeric, rel=1e-6)


@given(std=st.floats(0.05, 2.0), q=orders)
def test_gaussian_entropy_derivative_in_the_width(std: float, q: float) -> None:
    width = f64(std).requires_grad_()
    gaussian_entropy(width, q).backward()
    expected = (2 * math.pi) ** ((1 - q) / 2) * q**-0.5 * std**-q
    assert width.grad is not None
    assert float(width.grad) == pytest.approx(expected, rel=1e-6)


@given(stds=st.lists(st.floats(0.1, 2.0), min_size=1, max_size=4), q=orders)
def test_joint_entropy_of_independent_gaussians(stds: list[float], q: float) -> None:
    """The product density's S_q in closed form: its power integral is a product."""
    per_dimension = gaussian_entropy(torch.tensor(stds, dtype=torch.float64), q)
    joint = float(joint_entropy(per_dimension, q))
    if abs(q - 1) < 1e-6:
        expected = float(per_dimension.sum())
    else:
        power_integrals = [q**-0.5 * (2 * math.pi * s**2) ** ((1 - q) / 2) for s in stds]
        expected = (1 - math.prod(power_integrals)) / (q - 1)
    assert joint == pytest.approx(expected, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("q", [0.5, 1.0, 1.5, 2.0, 3.0])
def test_no_density_on_the_action_interval_exceeds_the_uniform_one(q: float) -> None:
    grid = np.linspace(-1, 1, 2001)
    for shape in (0.5, 1.0, 2.0, 5.0):
        density = stats.beta(max(shape, 1.0), 2.0, loc=-1, scale=2).pdf(grid)
        density = np.maximum(density, 1e-12)
        integrand = -density * ln_q_of_log(torch.as_tensor(np.log(density)), q).numpy()
        assert integrate.trapezoid(integrand, grid) <= largest_entropy(q) + 1e-6
    assert largest_entropy(1.0) == pytest.approx(math.log(2))


@pytest.mark.parametrize("q", [1.0, 1.3, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("alpha", [0.1, 1.0])
def test_discrete_maximum_is_entmax(q: float, alpha: float) -> None:
    """argmax <x, p> + alpha S_q(p) = entmax_q(x / (q alpha)), found by a numerical optimizer."""
    x = torch.tensor([0.3, 0.1, -0.2, 0.25], dtype=torch.float64)

    def loss(logits: np.ndarray) -> float:
        p = torch.softmax(torch.as_tensor(logits), -1).clamp(min=1e-300)
        entropy = -(p * ln_q(p, q)).sum()
        return -float((x * p).sum() + alpha * entropy)

    best = optimize.minimize(
        loss,
        np.zeros(4),
        method="Nelder-Mead",
        options={"maxiter": 8000, "xatol": 1e-9, "fatol": 1e-13},
    )
    ours = torch.softmax(torch.as_tensor(best.x), -1)
    scaled = x / (q * alpha)
    oracle = scaled.softmax(-1) if q == 1.0 else entmax.entmax_bisect(scaled, alpha=q)
    torch.testing.assert_close(ours, oracle, atol=2e-3, rtol=0)


@pytest.mark.parametrize("q", [1.0, 1.5, 2.0])
def test_tabular_tsallis_mdp_value_is_between_its_bounds(q: float) -> None:
    """V* + alpha/(1-gamma) ln_q(1/|A|) <= V^{pi_q} <= V* (Lee et al. 2019, performance bound)."""
    rng = np.random.default_rng(3)
    states, actions, gamma, alpha = 6, 3, 0.9, 0.2
    transition = rng.dirichlet(np.ones(states), size=(states, actions))
    reward = rng.uniform(0, 1, size=(states, actions))

    def policy_of(action_values: np.ndarray) -> np.ndarray:
        scaled = torch.as_tensor(action_values / (q * alpha))
        pi = scaled.softmax(-1) if q == 1.0 else entmax.entmax_bisect(scaled, alpha=q)
        return pi.numpy()

    soft, best = np.zeros(states), np.zeros(states)
    for _ in range(200):
        q_soft = reward + gamma * transition @ soft
        pi = policy_of(q_soft)
        entropy = -(pi * ln_q(torch.as_tensor(np.maximum(pi, 1e-300)), q).numpy()).sum(-1)
        soft = (pi * q_soft).sum(-1) + alpha * entropy
        best = (reward + gamma * transition @ best).max(-1)
    matrix = np.eye(states) - gamma * np.einsum("sa,sat->st", pi, transition)
    achieved = np.linalg.solve(matrix, (pi * reward).sum(-1))
    slack = alpha / (1 - gamma) * float(ln_q(f64(1 / actions), q))
    assert (achieved <= best + 1e-6).all()
    assert (best + slack <= achieved + 1e-6).all()


@pytest.mark.parametrize("q", [0.1, 0.5, 1.5, 2.0, 5.0])
def test_bounded_ln_q_is_finite_smooth_and_never_loses_its_gradient(q: float) -> None:
    log_p = torch.linspace(-90, 90, 4001, requires_grad=True)
    value = ln_q_of_log(log_p, q, max_exponent=MAX_EXPONENT)
    value.sum().backward()
    assert log_p.grad is not None
    assert torch.isfinite(value).all()
    assert torch.isfinite(log_p.grad).all()
    assert (log_p.grad >= 0).all()
    active = bound_active(log_p.detach(), q)
    assert active.any()
    assert (log_p.grad[active] > 0).all()
    # Exactly ln_q where the bound does not act.
    exact = ln_q_of_log(log_p.detach(), q)
    torch.testing.assert_close(value.detach()[~active], exact[~active])


def test_forms_agree_at_q_1_and_differ_elsewhere() -> None:
    log_density = torch.tensor([[0.3, -1.0], [0.9, 0.2]])
    summed, joint = (ln_q_of_policy(log_density, 1.0, form) for form in ("per_dimension", "joint"))
    torch.testing.assert_close(summed, joint)
    summed, joint = (ln_q_of_policy(log_density, 1.5, form) for form in ("per_dimension", "joint"))
    assert not torch.allclose(summed, joint)


@pytest.mark.parametrize(("q", "width"), [(2.0, 0.0327), (3.0, 0.1143)])
def test_the_joint_form_uses_its_tangent_below_documented_widths(q: float, width: float) -> None:
    """At the mode of four Gaussians: widths that policies have (docs/algorithms.md)."""
    for factor, active in ((1.01, False), (0.99, True)):
        log_density = -math.log(factor * width * math.sqrt(2 * math.pi))
        assert bool(bound_active(torch.tensor(4 * log_density), q)) == active


@pytest.mark.parametrize("q", [0.5, 1.5, 2.0, 3.0])
def test_the_joint_form_is_that_of_the_product_of_densities(q: float) -> None:
    densities = torch.tensor([[0.7, 0.2], [1.3, 0.9]], dtype=torch.float64)
    found = {form: ln_q_of_policy(densities.log(), q, form) for form in ("joint", "per_dimension")}
    order = q - 1
    torch.testing.assert_close(found["joint"], (densities.prod(-1) ** order - 1) / order)
    torch.testing.assert_close(found["per_dimension"], ((densities**order - 1) / order).sum(-1))
