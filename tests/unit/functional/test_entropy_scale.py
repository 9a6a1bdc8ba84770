"""Alphas that scale with q, compared with derivatives and integrals."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate

from music_rllib.functional.entropy_scale import (
    entropy_pressure,
    largest_entropy,
    matched_alpha,
    normalised_alpha,
)
from tests.unit.functional.entropies import gaussian_entropy, joint_entropy

FORMS = ["per_dimension", "joint"]


def slope(q: float, width: float, actions: int, form: str) -> float:
    """dS_q / d ln sigma of the first dimension, by autograd through the closed forms."""
    log_std = torch.full((actions,), math.log(width), dtype=torch.float64, requires_grad=True)
    each = gaussian_entropy(log_std.exp(), q)
    total = each.sum() if form == "per_dimension" else joint_entropy(each, q)
    (gradient,) = torch.autograd.grad(total, log_std)
    return float(gradient[0])


@given(q=st.floats(0.3, 4.0), width=st.floats(0.02, 1.0), actions=st.integers(1, 4))
@pytest.mark.parametrize("form", FORMS)
def test_the_pressure_is_the_derivative_of_the_entropy(
    form: str, q: float, width: float, actions: int
) -> None:
    expected = slope(q, width, actions, form)
    assert entropy_pressure(q, width, actions, form) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("width", [0.02, 0.1, 0.3])
def test_a_matched_alpha_has_the_pressure_of_q_1(form: str, width: float) -> None:
    expected = 0.05 * slope(1.0, width, 4, form)
    for q in (0.5, 1.0 + 1e-7, 1.25, 1.5, 2.0, 3.0):
        alpha = matched_alpha(0.05, q, width, 4, form)
        assert alpha * slope(q, width, 4, form) == pytest.approx(expected, rel=1e-6)
    assert matched_alpha(0.05, 1.0, width, 4, form) == pytest.approx(0.05)


def test_one_fixed_alpha_weighs_q_2_more_the_narrower_the_policy() -> None:
    at = {width: entropy_pressure(2.0, width) for width in (0.3, 0.1, 0.02)}
    assert at == pytest.approx({0.3: 0.94, 0.1: 2.82, 0.02: 14.1}, rel=0.01)
    assert entropy_pressure(2.0, 0.1, 4, "joint") == pytest.approx(63.0, rel=0.01)


@pytest.mark.parametrize("q", [0.5, 1.0, 1.5, 2.0, 3.0])
def test_the_largest_entropy_is_that_of_the_uniform_density(q: float) -> None:
    def summand(x: float, density: float) -> float:
        ln_q = math.log(density) if q == 1 else (density ** (q - 1) - 1) / (q - 1)
        return -density * ln_q

    one = integrate.quad(lambda x: summand(x, 0.5), -1, 1)[0]
    joint = integrate.dblquad(lambda x, y: summand(x, 0.25), -1, 1, -1, 1)[0]
    assert largest_entropy(q, 3) == pytest.approx(3 * one)
    assert largest_entropy(q, 2, "joint") == pytest.approx(joint)


@pytest.mark.parametrize("q", [0.5, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("actions", [1, 4])
def test_a_normalised_alpha_weighs_the_largest_entropy_as_at_q_1(q: float, actions: int) -> None:
    """docs/comparing_q.md: times 1.18 at q = 1.5 and 1.39 at q = 2."""
    each = (1 - 2 ** (1 - q)) / (q - 1)
    joint = (1 - 2 ** (actions * (1 - q))) / (q - 1)
    for form, largest in (("per_dimension", actions * each), ("joint", joint)):
        expected = 0.3 * actions * math.log(2)
        assert normalised_alpha(0.3, q, actions, form) * largest == pytest.approx(expected)
    assert normalised_alpha(1.0, 1.5) == pytest.approx(1.18, abs=0.005)
    assert normalised_alpha(1.0, 2.0) == pytest.approx(1.39, abs=0.005)
