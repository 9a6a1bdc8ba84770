"""Error rates and power of the tests behind a verdict, by simulation.

python -m benchmarks.decisions [DRAWS]

Each setting draws paired differences of two conditions. Its rate is the rate of a decision at level
0.05 for one comparison: a *difference* (superior or worse), or *equivalence* within 0.05. The first
procedure is the one of `music_rllib.results.claims`; the others were candidates.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from music_rllib.results import statistics as st
from music_rllib.results.claims import COLLAPSES, adjusted, contrast, verdict_of
from music_rllib.results.statistics import Array

SEEDS = (3, 5, 6, 10, 15, 20, 24, 30)
MARGIN, COLLAPSE, RATE = 0.05, 0.45, 0.1
"""Margin of equivalence; depth of a collapse, and its chance for a seed."""
Draw = Callable[[np.random.Generator, tuple[int, int]], Array]
Test = Callable[[Array], tuple[Array, Array]]
"""Maps differences `[seeds, draws]` to p-values of a difference and of equivalence, `[draws]`."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """Paired differences, and the decision that is counted."""

    name: str
    draw: Draw
    equivalent: bool
    """Whether equivalence is counted; otherwise a difference is."""


def normal(mean: float, spread: float) -> Draw:
    """Normal differences."""
    return lambda rng, shape: rng.normal(mean, spread, shape)


def collapses(mean: float, *, both: bool = False) -> Draw:
    """Differences with this mean, where one side or both collapse in one seed of ten."""

    def draw(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
        lost = (rng.random(shape) < RATE) - ((rng.random(shape) < RATE) * 1.0 if both else RATE)
        return np.asarray(rng.normal(mean, 0.03, shape) - COLLAPSE * lost)

    return draw


def betas(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Rates of equal means, one of which varies far more, over 1,000 episodes."""
    x, y = (rng.binomial(1000, rng.beta(a, a / 9, shape)) / 1000 for a in (9, 90))
    return x - y


def ceiling(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Final rates over 50 episodes at the ceiling; on one side, one seed of ten has half of it."""
    x, y = rng.binomial(50, 0.99, (2, *shape)) / 50
    return np.asarray(np.where(rng.random(shape) < RATE, x - 0.5, x) - y)


SETTINGS = (
    Setting(name="normal, no difference", draw=normal(0, 0.06), equivalent=False),
    Setting(name="normal, at the margin", draw=normal(MARGIN, 0.06), equivalent=True),
    Setting(name="one side collapses, no difference", draw=collapses(0), equivalent=False),
    Setting(name="one side collapses, at the margin", draw=collapses(-MARGIN), equivalent=True),
    Setting(name="both collapse, no difference", draw=collapses(0, both=True), equivalent=False),
    Setting(
        name="both collapse, at the margin", draw=collapses(MARGIN, both=True), equivalent=True
    ),
    Setting(name="Beta(9, 1) and Beta(90, 10)", draw=betas, equivalent=False),
    Setting(name="at the ceiling, one side collapses", draw=ceiling, equivalent=True),
)
"""Settings in which a decision is wrong."""
POWER = (
    Setting(name="power: difference of 0.05", draw=normal(0.05, 0.03), equivalent=False),
    Setting(name="power: difference of 0.1", draw=normal(0.1, 0.06), equivalent=False),
    Setting(name="power: equivalence", draw=normal(0.0, 0.03), equivalent=True),
)


def student(differences: Array) -> tuple[Array, Array]:
    """The procedure of a verdict."""
    found = contrast(differences, np.zeros_like(differences), paired=True, margin=MARGIN)
    assert found.p_equivalent is not None
    return found.p_value, found.p_equivalent


def silent(differences: Array) -> tuple[Array, Array]:
    """The same, but a verdict that states which collapses it does not exclude is not counted."""
    found = contrast(differences, np.zeros_like(differences), paired=True, margin=MARGIN)
    assert found.p_equivalent is not None
    is_said = found.collapses >= COLLAPSES
    return np.where(is_said, 1.0, found.p_value), np.where(is_said, 1.0, found.p_equivalent)


def _weaker(one_sided: Callable[[Array], Array]) -> Test:
    """The weaker of Student's t and another test."""

    def test(differences: Array) -> tuple[Array, Array]:
        p_value, p_equivalent = student(differences)
        sides = [one_sided(sign * differences) for sign in (1, -1)]
        beyond = [one_sided(MARGIN + sign * differences) for sign in (1, -1)]
        other = np.minimum(1, 2 * np.minimum(*sides))
        return np.fmax(p_value, other), np.fmax(p_equivalent, np.maximum(*beyond))

    return test


def sign_flips(differences: Array) -> Array:
    """One-sided permutation test over the signs of the differences, exact up to ten seeds."""
    seeds = len(differences)
    signs = 1.0 - 2 * (
        (np.arange(2**seeds)[:, None] >> np.arange(seeds)) & 1
        if seeds <= 10
        else (np.random.default_rng(1).integers(0, 2, (1000, seeds)))
    )
    return np.asarray(np.mean(signs @ differences >= differences.sum(axis=0) - 1e-12, axis=0))


def johnson(differences: Array) -> Array:
    """Johnson's (1978) t corrected for skewness, one-sided."""
    seeds, mean = len(differences), differences.mean(axis=0)
    spread = differences.std(axis=0, ddof=1)
    third = np.mean((differences - mean) ** 3, axis=0)
    with np.errstate(all="ignore"):
        shifted = mean + third / (6 * seeds * spread**2) + third * mean**2 / (3 * spread**4)
        return np.asarray(stats.t.sf(shifted / spread * np.sqrt(seeds), seeds - 1))


def one_more_collapse(differences: Array) -> tuple[Array, Array]:
    """Student's t with one more seed in which the side that is ahead collapses."""
    median = np.median(differences, axis=0)
    ahead = np.sign(differences.mean(axis=0))
    down, up = (
        student(np.concatenate([differences, (median + sign * COLLAPSE)[None]])) for sign in (-1, 1)
    )
    return np.where(ahead > 0, down[0], up[0]), np.maximum(down[1], up[1])


TESTS: Mapping[str, Test] = {
    "Student's t": student,
    "the same, without a statement on collapses": silent,
    "weaker of t and sign flips": _weaker(sign_flips),
    "weaker of t and Johnson's t": _weaker(johnson),
    "t with one more collapse": one_more_collapse,
}


def rate(setting: Setting, test: Test, seeds: int, draws: int) -> float:
    """Share of draws with the decision that the setting counts."""
    rng = np.random.default_rng(0)
    p_values = test(setting.draw(rng, (seeds, draws)))
    return float(np.mean(p_values[setting.equivalent] < st.SIGNIFICANCE))


def wrong_in_a_family(truths: Array, seeds: int, spread: float, draws: int) -> float:
    """Share of families of comparisons with a wrong verdict; each difference is 0 or the margin."""
    rng, wrong = np.random.default_rng(0), 0
    differences = rng.normal(truths[:, None, None], spread, (len(truths), seeds, draws))
    tested = [student(one) for one in differences]
    for draw in range(draws):
        adjusted_ones = adjusted([(float(p[draw]), float(e[draw])) for p, e in tested])
        means = differences[:, :, draw].mean(axis=1)
        wrong += any(
            verdict_of(float(mean), *p_values)
            in (("superior", "worse") if truth == 0 else ("equivalent", "worse"))
            for mean, p_values, truth in zip(means, adjusted_ones, truths, strict=True)
        )
    return wrong / draws


def coverage(seeds: int, draws: int) -> float:
    """Share of 95% intervals that contain the mean, where one seed of ten collapses."""
    rng = np.random.default_rng(0)
    scores = 0.55 + collapses(0.0)(rng, (seeds, draws))
    found = st.estimate(scores[:, None], episodes=1000)
    return float(np.mean((found.lower <= 0.55) & (found.upper >= 0.55)))


def rows(draws: int) -> Iterator[tuple[str, str, list[float]]]:
    """Setting, procedure, and the rate for each number of `SEEDS`."""
    for setting in (*SETTINGS, *POWER):
        for name, test in TESTS.items():
            yield setting.name, name, [rate(setting, test, seeds, draws) for seeds in SEEDS]
    yield "coverage of a mean, collapses", "interval", [coverage(n, draws) for n in SEEDS]
    for truths in ([0.0] * 3, [0.0, MARGIN], [0.0, 0.0, MARGIN]):
        wrong = [wrong_in_a_family(np.array(truths), n, 0.05, draws) for n in SEEDS]
        yield f"family with differences {truths}", "any wrong verdict", wrong


def main() -> None:
    """Print a Markdown table."""
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    print("| setting | procedure | " + " | ".join(map(str, SEEDS)) + " |")
    print("|---|---|" + "---|" * len(SEEDS))
    for setting, test, found in rows(draws):
        print(f"| {setting} | {test} | {' | '.join(f'{share:.3f}' for share in found)} |")


if __name__ == "__main__":
    main()
