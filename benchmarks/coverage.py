"""Coverage of 95% intervals from few seeds, by simulation.

python -m benchmarks.coverage [REPEATS]

Seeds are drawn from a population with a known mean. A rate is measured over 20 or 50 evaluation
episodes, which adds their noise. `music_rllib.results` computes the intervals of all repeats in one
call, as if they were independent points of a curve.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from music_rllib.results import statistics as st
from music_rllib.results.statistics import Array

SEEDS = (2, 3, 4, 5, 10, 20)


@dataclass(frozen=True, kw_only=True)
class Population:
    """Distribution of the seeds."""

    name: str
    draw: Callable[[np.random.Generator, tuple[int, ...]], Array]
    mean: float
    episodes: int | None = None
    """Number of evaluation episodes; None: not a rate."""


def rates(a: float, b: float, episodes: int) -> Population:
    """Success rates of Beta(a, b) distributed seeds, each measured over this number of episodes."""
    return Population(
        name=f"rate, Beta({a:g}, {b:g}), {episodes} episodes",
        draw=lambda rng, shape: rng.binomial(episodes, rng.beta(a, b, shape)) / episodes,
        mean=a / (a + b),
        episodes=episodes,
    )


POPULATIONS = (
    Population(name="return, normal", draw=lambda rng, shape: rng.normal(size=shape), mean=0.0),
    rates(5, 5, 50),
    rates(3, 1, 50),
    rates(9, 1, 50),
    rates(9, 1, 20),
    rates(20, 2, 50),
    rates(50, 1, 50),
    rates(200, 1, 50),
    rates(1, 9, 50),
)
"""Normal and bounded populations; the closer to a bound, the more skewed."""
BEYOND = (
    Population(name="return, uniform", draw=lambda rng, shape: rng.uniform(-1, 1, shape), mean=0.0),
    Population(
        name="return, exponential", draw=lambda rng, shape: -rng.exponential(size=shape), mean=-1.0
    ),
    rates(20, 0.5, 50),
    rates(2, 0.2, 50),
)
"""Returns far from normal, and rates with a few seeds far below the rest: a sample of three seeds
without any of these cannot reveal them."""


def coverage_of_the_mean(
    populations: Sequence[Population], seeds: int, repeats: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Share of intervals that contain the mean over the populations, and their median width.

    Each population is a task. Either all of them are rates, or none is.
    """
    scores = np.stack([one.draw(rng, (seeds, repeats)) for one in populations], axis=1)
    found = st.estimate(scores, populations[0].episodes)
    return _held(found, float(np.mean([one.mean for one in populations])))


def coverage_of_the_gap(
    x: Population, y: Population, seeds: int, repeats: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Coverage and median width for the difference between two conditions."""
    a, b = (st.estimate(one.draw(rng, (seeds, 1, repeats)), one.episodes) for one in (x, y))
    return _held(st.difference(a, b), x.mean - y.mean)


def _held(found: st.Estimate, truth: float) -> tuple[float, float]:
    held = (found.lower <= truth + 1e-12) & (truth - 1e-12 <= found.upper)
    return float(np.mean(held)), float(np.median(found.upper - found.lower))


def coverage_of_the_median(seeds: int, repeats: int, rng: np.random.Generator) -> float:
    """Coverage for the median of the steps to a threshold: lognormal, censored at a budget."""
    held, budget = 0, 1.5
    for _ in range(repeats):
        steps = rng.lognormal(size=seeds)
        median = st.censored_median(np.minimum(steps, budget), steps <= budget)
        lower, upper = median.lower, median.upper
        held += bool(lower <= 1 <= upper)
    return held / repeats


def rows(repeats: int) -> Iterator[tuple[str, list[float]]]:
    """Name of a quantity, and its coverage for each number of `SEEDS`; NaN: no interval."""
    rng = np.random.default_rng(0)
    for one in (*POPULATIONS, *BEYOND):
        yield (
            f"mean: {one.name}",
            [coverage_of_the_mean([one], seeds, repeats, rng)[0] for seeds in SEEDS],
        )
    tasks = [rates(9, 1, 50), rates(3, 3, 50), rates(50, 1, 50)]
    yield (
        "mean over three tasks: rates, Beta(9, 1), Beta(3, 3), Beta(50, 1)",
        [coverage_of_the_mean(tasks, seeds, repeats, rng)[0] for seeds in SEEDS],
    )
    normal = POPULATIONS[0]
    above = Population(
        name="return, normal and higher",
        draw=lambda rng, shape: rng.normal(1.0, 0.5, shape),
        mean=1.0,
    )
    for x, y in ((above, normal), (rates(9, 1, 50), rates(5, 5, 50)), (rates(50, 1, 50),) * 2):
        shares = [coverage_of_the_gap(x, y, seeds, repeats, rng)[0] for seeds in SEEDS]
        yield f"difference: {x.name} against {y.name}", shares
    yield (
        "median of steps to a threshold",
        [
            coverage_of_the_median(seeds, repeats // 4, rng) if seeds >= 5 else np.nan
            for seeds in SEEDS
        ],
    )


def main() -> None:
    """Print a Markdown table."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    print("| interval of | " + " | ".join(f"{seeds} seeds" for seeds in SEEDS) + " |")
    print("|---|" + "---|" * len(SEEDS))
    for name, found in rows(repeats):
        cells = ["none" if np.isnan(share) else f"{share:.3f}" for share in found]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
