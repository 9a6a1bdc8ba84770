"""`make bench`: what a gradient update costs through RLlib's Learner, against bare torch.

Both run in turn in this process, one thread each; the table shows medians of the turns and the
median of their ratios. `python -m benchmarks.learner --help`.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

from music_rllib._quiet import prepare_environment, quiet_third_parties

prepare_environment()
os.environ.setdefault("OMP_NUM_THREADS", "1")

import ray  # noqa: E402
import torch  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from benchmarks.raw_torch import RawUpdate  # noqa: E402
from music_rllib import TACConfig  # noqa: E402
from music_rllib._allocator import keep_freed_memory  # noqa: E402
from music_rllib.tac.algorithm import TAC  # noqa: E402

UPDATES = 100
VARIANTS: dict[str, dict[str, Any]] = {
    "TAC": {},
    "TAC, HER": {"hindsight_k": 4.0},
    "TAC, HER, frozen estimator": {"hindsight_k": 4.0, "estimator": "frozen"},
    "TAC, HER, trained estimator": {"hindsight_k": 4.0, "estimator": "trained"},
}
TARGET = 1.25


def algorithm(hindsight_k: float = 0.0, estimator: str = "none") -> TAC:
    """TAC on FetchPush, 10,000 random transitions in its replay."""
    config = TACConfig().environment("FetchPush-v4").env_runners(num_envs_per_env_runner=4)
    config.training(entropic_index=1.5, alpha=0.05, random_steps=10_000).debugging(seed=0)
    config.replay(capacity=10_000, hindsight_k=hindsight_k)
    weight = 0.0 if estimator == "none" else 1.0
    config.music(
        agent_indices=range(3),
        surrounding_indices=range(3, 6),
        estimator=estimator,
        mi_reward_weight=weight,
    )
    algo: TAC = config.build_algo()
    while len(algo.replay) < 10_000:
        algo.training_step()
    return algo


def learner_updates(algo: TAC) -> Callable[[], None]:
    """A turn of `UPDATES` updates: sampling and relabelling, and the Learner's call."""

    def turn() -> None:
        algo.learner_group.update(batch=algo.sample_batch(UPDATES), timesteps={})

    return turn


def raw_updates(raw: RawUpdate) -> Callable[[], None]:
    """A turn of `UPDATES` updates in bare torch."""

    def turn() -> None:
        for _ in range(UPDATES):
            raw.step()

    return turn


def seconds(turn: Callable[[], None]) -> float:
    """Wall time of a turn."""
    begin = time.perf_counter()
    turn()
    return time.perf_counter() - begin


def main() -> None:
    """Measures and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=7, help="turns of each (default 7)")
    repeats = parser.parse_args().repeats
    quiet_third_parties()
    ray.init(num_cpus=2, include_dashboard=False, logging_level="error")
    torch.set_num_threads(1)
    keep_freed_memory()  # the raw loop gets it too
    raw = raw_updates(RawUpdate(inputs=28, actions=4, batch=256, q=1.5, alpha=0.05))
    table = Table(title=f"One update, batch 256, 3 x 256 networks ({UPDATES} updates a turn)")
    for column in ("path", "updates/s", "raw torch/s", "ratio", "range of ratios"):
        table.add_column(column, justify="left" if column == "path" else "right")
    for name, settings in VARIANTS.items():
        ours = learner_updates(algorithm(**settings))
        seconds(ours), seconds(raw)  # the first turn allocates
        turns = [(seconds(ours), seconds(raw)) for _ in range(repeats)]
        ratios = sorted(mine / bare for mine, bare in turns)
        table.add_row(
            name,
            f"{UPDATES / statistics.median(t for t, _ in turns):.0f}",
            f"{UPDATES / statistics.median(t for _, t in turns):.0f}",
            f"{statistics.median(ratios):.2f}",
            f"{ratios[0]:.2f} - {ratios[-1]:.2f}",
        )
    console = Console()
    console.print(table)
    load = os.getloadavg()[0]
    console.print(f"Target for plain TAC: at most {TARGET} x raw torch. Load average {load:.1f}.")


if __name__ == "__main__":
    main()
