"""One training step (sampling, relabelling, update) against bare torch and the matrix products."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import torch

from benchmarks.measure import Row, interleaved, ratio_row
from benchmarks.raw_torch import HIDDEN, RawUpdate
from benchmarks.runs import fill
from music_rllib import TACConfig
from music_rllib.tac.algorithm import TAC
from music_rllib.tac.kernels.products import has_onednn, onednn_product
from music_rllib.tac.precision import cpu_flags, has_bf16

__all__ = ["rows"]

GROUP = "training step"
UPDATES = 50
ROUNDS = 3
"""Of `repeats`: a turn takes a third of a second, and the machine's memory has slower minutes."""
BATCH, INPUTS, ACTIONS = 256, 28, 4
VARIANTS: dict[str, dict[str, Any]] = {
    "TAC": {},
    "TAC, HER": {"hindsight_k": 4.0},
    "TAC, HER, 1,000,000 transitions": {"hindsight_k": 4.0, "transitions": 10**6},
    "TAC, HER, frozen estimator": {"hindsight_k": 4.0, "estimator": "frozen"},
    "TAC, HER, trained estimator": {"hindsight_k": 4.0, "estimator": "trained"},
    "TAC, HER, by autograd": {"hindsight_k": 4.0, "direct": False},
    "TAC, HER, 3 x 128": {"hindsight_k": 4.0, "hidden_sizes": (128,) * 3},
    "TAC, HER, 3 x 128, by autograd": {
        "hindsight_k": 4.0,
        "hidden_sizes": (128,) * 3,
        "direct": False,
    },
}

PEERS: dict[str, tuple[str, str, float | None]] = {
    "TAC, HER, 1,000,000 transitions": ("10,000 transitions", "TAC, HER", 1.05),
    "TAC, HER, trained estimator": ("TAC, HER", "TAC, HER", 1.35),
    "TAC, HER, by autograd": ("TAC, HER", "TAC, HER", None),
    "TAC, HER, 3 x 128": ("by autograd", "TAC, HER, 3 x 128, by autograd", 0.8),
    "TAC, HER, 3 x 128, by autograd": ("raw torch with 3 x 256", "raw", None),
}
"""What a variant is compared with in place of raw torch, what that is called, and the target."""


def algorithm(
    hindsight_k: float = 0.0,
    estimator: str = "none",
    transitions: int = 10_000,
    gpus: int = 0,
    graphs: bool = True,
    direct: bool = True,
    **training: Any,
) -> TAC:
    """TAC on FetchPush, 10,000 transitions of random actions in its replay, or more, made up."""
    config = TACConfig().environment("FetchPush-v4").env_runners(num_envs_per_env_runner=4)
    config.training(entropic_index=1.5, alpha=0.05, random_steps=10_000, **training)
    config.replay(capacity=transitions, hindsight_k=hindsight_k).debugging(seed=0)
    weight = 0.0 if estimator == "none" else 1.0
    config.music(
        agent_indices=range(3),
        surrounding_indices=range(3, 6),
        estimator=estimator,
        mi_reward_weight=weight,
    )
    config.learners(num_gpus_per_learner=gpus)
    algo: TAC = config.build_algo()
    if not graphs:
        algo.learner_group._learner._captured = None
    if not direct:
        algo.learner_group._learner._direct = None
    while len(algo.replay) < 10_000:
        algo.training_step()
    fill(algo.replay, transitions)
    return algo


def updates(algo: TAC) -> Callable[[], None]:
    """A turn of `UPDATES` updates: sampling and relabelling, and the Learner's call."""

    def turn() -> None:
        algo.learner_group.update(batch=algo.sample_batch(UPDATES), timesteps={})

    return turn


def raw_updates(*, bf16: bool = False) -> Callable[[], None]:
    """A turn of `UPDATES` updates in bare torch."""
    raw = RawUpdate(INPUTS, ACTIONS, BATCH, q=1.5, alpha=0.05, bf16=bf16)

    def turn() -> None:
        for _ in range(UPDATES):
            raw.step()

    return turn


Turn = Callable[[], None]


def products(multiply: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> Turn:
    """A turn of matrix products with the FLOPs of `UPDATES` updates, at the networks' size."""
    width = HIDDEN[0]
    left, right = torch.randn(BATCH, width), torch.randn(width, width)
    count = round(UPDATES * flops(INPUTS, ACTIONS, HIDDEN, BATCH) / (2 * BATCH * width * width))

    def turn() -> None:
        for _ in range(count):
            multiply(left, right)

    return turn


def flops(inputs: int, actions: int, hidden: Sequence[int], batch: int) -> int:
    """Multiplications and additions of all matrix products in one update."""

    def layers(first: int, last: int) -> list[int]:
        return [a * b for a, b in pairwise([first, *hidden, last])]

    def cost(sizes: list[int], passes: str) -> int:
        whole, upper = sum(sizes), sum(sizes[1:])
        return sum({"forward": whole, "weights": whole, "inputs": whole, "hidden": upper}[p]
                   for p in passes.split())  # fmt: skip

    trained = "forward weights hidden"
    policy = cost(layers(inputs, 2 * actions), trained)
    value = cost(layers(inputs, 1), trained) + cost(layers(inputs, 1), "forward")
    critic = layers(inputs + actions, 1)
    critics = 2 * cost(critic, trained) + 2 * cost(critic, "forward inputs")
    return 2 * batch * (policy + value + critics)


def rows(repeats: int) -> Iterator[Row]:
    """Against bare torch in the same run, and both against the matrix products.

    Those are at the best rate there is here, `torch.matmul`'s or oneDNN's.
    """
    ours = {name: updates(algorithm(**settings)) for name, settings in VARIANTS.items()}
    floors = {"torch.matmul": products(torch.matmul)}
    if has_onednn():
        floors["oneDNN"] = products(onednn_product)
    turns = {"raw": raw_updates(), **floors, **ours}
    if has_bf16():
        turns["raw, bf16"] = raw_updates(bf16=True)
        turns["TAC, HER, bf16"] = updates(algorithm(hindsight_k=4.0, precision="bf16"))
    taken = interleaved(turns, ROUNDS * repeats)
    floor = min(floors, key=lambda name: statistics.median(taken[name]))
    for name in ("raw", "TAC, HER"):
        ratios = [a / b for a, b in zip(taken[name], taken[floor], strict=True)]
        yield ratio_row(
            GROUP, name, UPDATES / statistics.median(taken[name]), "updates/s",
            against=f"its products by {floor} (time)", ratios=ratios, at_most=1.5,
        )  # fmt: skip
    for name, times in taken.items():
        if name == "raw" or name in floors:
            continue
        rate = UPDATES / statistics.median(times)
        if "bf16" in name:
            name = name.replace(", bf16", "") + ", bf16"
            without = name.removesuffix(", bf16")
            ratios = [a / b for a, b in zip(taken[without], times, strict=True)]
            yield ratio_row(
                GROUP, name, rate, "updates/s", against="float32 (speed)", ratios=ratios,
                at_least=1.5 if "amx_bf16" in cpu_flags() else None,
            )  # fmt: skip
            continue
        against, peer, limit = PEERS.get(name, ("raw torch", "raw", 1.12))
        ratios = [a / b for a, b in zip(times, taken[peer], strict=True)]
        yield ratio_row(
            GROUP, name, rate, "updates/s", against=f"{against} (time)", ratios=ratios,
            at_most=limit,
        )  # fmt: skip
    if torch.cuda.is_available():
        yield from on_gpu(repeats)


def on_gpu(repeats: int) -> Iterator[Row]:
    """Updates a second with the Learner on the GPU, captured as a CUDA graph and not."""
    for batch in (256, 4096):
        turns = {
            "captured": updates(algorithm(hindsight_k=4.0, batch_size=batch, gpus=1)),
            "launched": updates(algorithm(hindsight_k=4.0, batch_size=batch, gpus=1, graphs=False)),
        }
        taken = interleaved({name: _waited_for(turn) for name, turn in turns.items()}, repeats)
        ratios = [a / b for a, b in zip(taken["launched"], taken["captured"], strict=True)]
        rate = UPDATES / statistics.median(taken["captured"])
        yield ratio_row(
            GROUP, f"TAC, HER, GPU, batch {batch}", rate, "updates/s",
            against="launched from Python (speed)", ratios=ratios,
        )  # fmt: skip
        share = 100 * (1 - 1 / statistics.median(ratios))
        yield Row(GROUP, f"time that launching takes, batch {batch}", share, "%")


def _waited_for(turn: Callable[[], None]) -> Callable[[], None]:
    def whole() -> None:
        turn()
        torch.cuda.synchronize()

    return whole
