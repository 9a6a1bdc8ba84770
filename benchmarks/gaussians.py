"""The estimator on Gaussians of known mutual information: `python -m benchmarks.gaussians`.

Trains it on pairs (x, y) of n dimensions with correlation rho in each, and compares its bound on
held-out pairs with the true value and with the best that a statistic within [-1, 1] can reach.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from music_rllib.functional.mutual_information import time_permutations
from music_rllib.intrinsic.estimator import MutualInformationEstimator

HELD_OUT = (8, 20_000)
"""Trajectories and frames for the evaluation of a trained estimator."""


def true_information(rho: float, dims: int) -> float:
    """I(X; Y) in nats."""
    return 0.5 * dims * math.log(1 / (1 - rho**2))


def correlated(
    rho: float, dims: int, trajectories: int, frames: int, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Pairs x, y [N, T, n] of standard normals with correlation rho in each dimension."""
    x = torch.randn(trajectories, frames, dims, generator=generator)
    noise = torch.randn(trajectories, frames, dims, generator=generator)
    return x, rho * x + math.sqrt(1 - rho**2) * noise


def capped_optimum(rho: float, dims: int) -> float:
    """The largest bound that any statistic within [-1, 1] reaches, by Monte Carlo.

    Without the cap the best statistic is the log density ratio (and the bound the true value);
    with it, the ratio shifted and clipped to [-1, 1].
    """
    rng = np.random.default_rng(0)
    x, noise, independent = rng.standard_normal((3, 400_000, dims))
    cov = 1 - rho**2

    def log_ratio(y: np.ndarray) -> np.ndarray:
        exponent = (y**2 + x**2 - (y - rho * x) ** 2 / cov - x**2) / 2
        ratio: np.ndarray = (exponent - 0.5 * math.log(cov)).sum(-1)
        return ratio

    joint, marginal = log_ratio(rho * x + math.sqrt(cov) * noise), log_ratio(independent)

    def bound(shift: float) -> float:
        t_joint = np.clip(joint + shift, -1, 1)
        return float(t_joint.mean() - np.log(np.exp(np.clip(marginal + shift, -1, 1)).mean()))

    return max(bound(shift) for shift in np.linspace(-2, 2, 41))


def trained_bound(
    rho: float, dims: int, seed: int, steps: int = 500, bound: str = "capped"
) -> float:
    """Bound on held-out samples of an estimator trained on correlated Gaussians."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    estimator = MutualInformationEstimator(range(dims), range(dims, 2 * dims), bound=bound)
    optimizer = torch.optim.Adam(estimator.parameters(), lr=1e-2)
    decay = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, steps)
    for _ in range(steps):
        x, y = correlated(rho, dims, 1, 1024, generator)
        loss, _ = estimator.loss(torch.cat([x, y], -1), time_permutations(1, 1024, generator))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        decay.step()
    x, y = correlated(rho, dims, *HELD_OUT, generator)
    with torch.no_grad():
        return float(
            estimator.bound(torch.cat([x, y], -1), time_permutations(*HELD_OUT, generator)).mean()
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--bound", default="capped", help="music.bound (default capped)")
    parser.add_argument("--seeds", type=int, default=3, help="estimators per row (default 3)")
    arguments = parser.parse_args()
    seeds = range(arguments.seeds)
    torch.set_num_threads(1)
    table = Table(title="Bound on held-out pairs, nats")
    for column in ("rho", "n", "true", "best within [-1, 1]", "reached (each seed)"):
        table.add_column(column, justify="right")
    for rho in (0.0, 0.5, 0.9):
        for dims in (1, 2, 3):
            bounds = [trained_bound(rho, dims, seed, bound=arguments.bound) for seed in seeds]
            table.add_row(
                f"{rho:g}",
                str(dims),
                f"{true_information(rho, dims):.3f}",
                f"{capped_optimum(rho, dims):.3f}",
                ", ".join(f"{bound:.3f}" for bound in bounds),
            )
    Console().print(table)


if __name__ == "__main__":
    main()
