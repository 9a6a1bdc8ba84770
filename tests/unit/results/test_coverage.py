"""Simulated coverage of the 95% CIs; docs/reports.md lists it."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import coverage as c

FLOOR = 0.93
REPEATS = 4000


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("population", c.POPULATIONS, ids=lambda one: one.name)
@pytest.mark.parametrize("seeds", [3, 4, 5, 10])
def test_coverage_of_a_mean(population: c.Population, seeds: int, rng: np.random.Generator) -> None:
    share, width = c.coverage_of_the_mean([population], seeds, REPEATS, rng)
    assert share >= FLOOR
    if population.episodes is not None:
        # The interval [0, 1] would always cover a rate.
        assert width < {3: 0.8, 4: 0.65, 5: 0.5, 10: 0.35}[seeds]


def test_coverage_of_a_mean_over_tasks_with_one_at_its_ceiling(rng: np.random.Generator) -> None:
    tasks = [c.rates(9, 1, 50), c.rates(3, 3, 50), c.rates(50, 1, 50)]
    for seeds in (3, 5, 10):
        assert c.coverage_of_the_mean(tasks, seeds, REPEATS, rng)[0] >= FLOOR


HIGH, MIDDLE, TOP = c.rates(9, 1, 50), c.rates(5, 5, 50), c.rates(50, 1, 50)


@pytest.mark.parametrize("x, y", [(HIGH, MIDDLE), (TOP, TOP), (c.POPULATIONS[0],) * 2])
@pytest.mark.parametrize("seeds", [3, 5, 10])
def test_coverage_of_a_difference(
    x: c.Population, y: c.Population, seeds: int, rng: np.random.Generator
) -> None:
    assert c.coverage_of_the_gap(x, y, seeds, REPEATS, rng)[0] >= FLOOR


@pytest.mark.parametrize("seeds", [5, 8, 10])
def test_coverage_of_a_censored_median(seeds: int, rng: np.random.Generator) -> None:
    # The coverage with five is 0.9375; 1,000 repeats have a standard error of 0.008.
    assert c.coverage_of_the_median(seeds, 1000, rng) >= FLOOR - 0.016
