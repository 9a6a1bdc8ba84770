"""The pressure of one alpha on policies of different q, and alphas that make it equal.

S_q has a different scale at each q: with one fixed alpha, the pressure on a policy of standard
deviation 0.1 is 2.8 times as large at q = 2 as at q = 1, and 14 times as large at 0.02. Comparing
values of q at one alpha therefore also compares widths of policies.

A: action dimensions; `form` is that of `ln_q_of_policy`.
"""

from __future__ import annotations

import math

_SHANNON = 1e-9
"""|q - 1| below which S_q is Shannon's entropy."""


def entropy_pressure(
    q: float, width: float, actions: int = 1, form: str = "per_dimension"
) -> float:
    """dS_q / d ln sigma of one action dimension of a Gaussian policy of standard deviation `width`.

    Per dimension it is G = q^(-1/2) (sqrt(2 pi) sigma)^(1-q), the integral of p^q; for the joint
    entropy (1 - G^A)/(q-1) it is G^A; for Shannon's entropy it is 1 at every width. This is the
    Gaussian before tanh, which changes little at widths below 0.3.
    """
    log_integral = -0.5 * math.log(q) + (1.0 - q) * math.log(math.sqrt(2.0 * math.pi) * width)
    return math.exp(log_integral * (actions if form == "joint" else 1))


def matched_alpha(
    alpha: float, q: float, width: float, actions: int = 1, form: str = "per_dimension"
) -> float:
    """The alpha at which q has the pressure at `width` that `alpha` has at q = 1."""
    return alpha / entropy_pressure(q, width, actions, form)


def largest_entropy(q: float, actions: int = 1, form: str = "per_dimension") -> float:
    """S_q of the uniform density on [-1, 1]^A, the largest of all policies there.

    Per dimension A (1 - 2^(1-q))/(q-1), joint (1 - 2^(A (1-q)))/(q-1); A ln 2 at q = 1.
    """
    copies, dimensions = (1, actions) if form == "joint" else (actions, 1)
    order, log_volume = q - 1.0, dimensions * math.log(2.0)
    if abs(order) < _SHANNON:
        return copies * log_volume
    return -copies * math.expm1(-order * log_volume) / order


def normalised_alpha(
    alpha: float, q: float, actions: int = 1, form: str = "per_dimension"
) -> float:
    """The alpha that weighs S_q as a share of its largest value, relative to q = 1."""
    return alpha * largest_entropy(1.0, actions, form) / largest_entropy(q, actions, form)
