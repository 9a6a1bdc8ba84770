"""One training step (sampling, relabeling, update) against matrix products, bare torch and JAX."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from benchmarks.measure import Row, Taken, compared, interleaved, middle, on_one_core, ratio_row
from benchmarks.raw_torch import RawUpdate
from benchmarks.runs import fill
from music_rllib import TACConfig
from music_rllib.kernels.blas import multiply
from music_rllib.kernels.compiling import compiled
from music_rllib.tac.algorithm import TAC
from music_rllib.tac.minibatches import batch_of

__all__ = ["rows"]

GROUP = "training step"
UPDATES = 50
ROUNDS = 3
"""Factor on `repeats`: a turn takes only 0.3 s, and memory bandwidth varies over minutes."""
BATCH, INPUTS, ACTIONS = 256, 28, 4
HER: dict[str, Any] = {"hindsight_k": 4.0}
SMALL: dict[str, Any] = HER | {"hidden_sizes": (128,) * 3}
VARIANTS: dict[str, dict[str, Any]] = {
    "TAC": {},
    "TAC, HER": HER,
    "TAC, HER, 1,000,000 transitions": HER | {"transitions": 10**6},
    "TAC, HER, by autograd": HER | {"direct": False},
    "TAC, HER, 3 x 128": SMALL,
    "TAC, HER, 3 x 128, by autograd": SMALL | {"direct": False},
    "TAC, HER, 3 x 128, frozen estimator": SMALL | {"estimator": "frozen"},
    "TAC, HER, 3 x 128, trained estimator": SMALL | {"estimator": "trained"},
}
BOUNDS = {
    f"TAC, HER, estimator, {bound}": HER | {"estimator": "trained", "bound": bound}
    for bound in ("capped", "moving_average", "nwj", "smile", "infonce")
}
VARIANTS |= BOUNDS
AVERAGED: dict[str, Any] = SMALL | {"bootstrap": "critics", "policy_critic": "mean"}
DROPPED = {"critics": 5, "quantiles": 25, "dropped_quantiles": 2}
CRITICS: dict[str, dict[str, Any]] = {
    "layer norm in the critics": SMALL | {"layer_norm": "critics"},
    "layer norm everywhere": SMALL | {"layer_norm": "all"},
    "REDQ's 10 critics": AVERAGED | {"critics": 10, "target_critics": 2},
    "TQC's 5 critics": AVERAGED | DROPPED,
    "REDQ's 10 critics, policy delayed by 20": AVERAGED
    | {"critics": 10, "target_critics": 2, "policy_delay": 20},
}
"""Variants of 3 x 128 with other critics, compared with their own matrix products."""
VARIANTS |= {f"TAC, HER, 3 x 128, {name}": settings for name, settings in CRITICS.items()}
PEERS: dict[str, tuple[str, float | None]] = {
    "TAC": ("raw torch", 1.0),
    "TAC, HER": ("raw torch", 1.0),
    "TAC, HER, 1,000,000 transitions": ("TAC, HER", 1.05),
    "TAC, HER, by autograd": ("TAC, HER", None),
    "TAC, HER, 3 x 128, by autograd": ("TAC, HER, 3 x 128", None),
    "TAC, HER, 3 x 128, frozen estimator": ("TAC, HER, 3 x 128", 1.03),
    "TAC, HER, 3 x 128, trained estimator": ("TAC, HER, 3 x 128", 1.15),
}
PEERS |= dict.fromkeys(BOUNDS, ("TAC, HER", 1.4))
"""Reference of a variant's time, and the target."""
SIZES = {"TAC, HER": 256, "TAC, HER, 3 x 128": 128}
"""Variants that are compared with JAX and matrix products, and the width of their layers."""
OF_PRODUCTS = {128: 1.5, 256: 1.35}
"""Target of their time as a multiple of the time of their matrix products, by width."""


def algorithm(
    hindsight_k: float = 0.0,
    estimator: str = "none",
    bound: str = "capped",
    transitions: int = 10_000,
    direct: bool = True,
    gpus: float = 0.0,
    played: int = 10_000,
    **training: Any,
) -> TAC:
    """TAC on FetchPush with `played` transitions of random actions; the rest is random data."""
    config = TACConfig().environment("FetchPush-v4").env_runners(num_envs_per_env_runner=4)
    config.training(entropic_index=1.5, alpha=0.05, random_steps=10_000, **training)
    config.replay(capacity=transitions, hindsight_k=hindsight_k).debugging(seed=0)
    config.learners(num_gpus_per_learner=gpus)
    weight = 0.0 if estimator == "none" else 1.0
    config.music(
        agent_indices=range(3),
        surrounding_indices=range(3, 6),
        estimator=estimator,
        bound=bound,
        mi_reward_weight=weight,
    )
    algo: TAC = config.build_algo()
    if not direct:
        algo.learner_group._learner._compiled = None
    while len(algo.replay) < played:
        algo.training_step()
    fill(algo.replay, transitions)
    return algo


def updates(algo: TAC, count: int = UPDATES) -> Callable[[], None]:
    """A turn of `count` updates: sampling, relabeling, and the Learner's call."""

    def turn() -> None:
        drawn = algo.replay.sample_transitions(count * algo.config.settings.tac.batch_size)
        batch = batch_of(drawn, algo._sample_trajectories(count))
        algo.learner_group.update(batch=batch, timesteps={})

    return turn


def raw_updates() -> Callable[[], None]:
    """A turn of `UPDATES` updates in bare torch."""
    raw = RawUpdate(INPUTS, ACTIONS, BATCH, q=1.5, alpha=0.05)

    def turn() -> None:
        for _ in range(UPDATES):
            raw.step()

    return turn


Turn = Callable[[], None]


def floors(width: int) -> dict[str, Turn]:
    """Turns of matrix products with the FLOPs of `UPDATES` updates, by library and rows."""
    libraries: dict[str, Callable[[torch.Tensor, torch.Tensor, torch.Tensor], Any]] = {
        "torch.mm": lambda left, right, out: torch.mm(left, right, out=out),
        "OpenBLAS": lambda left, right, out: np.matmul(left.numpy(), right.numpy(), out.numpy()),
        "compiled updates'": lambda left, right, out: _ours(
            left.numpy(), right.numpy(), out.numpy()
        ),
    }
    if torch.backends.mkldnn.is_available():
        onednn = torch.ops.mkldnn._linear_pointwise.default
        libraries["oneDNN"] = lambda left, right, out: onednn(left, right, None, "none", [], "")
    whole = UPDATES * flops(INPUTS, ACTIONS, (width,) * 3, BATCH)
    return {
        f"{name}, {rows} x {width} x {width}": _products(product, rows, width, whole)
        for name, product in libraries.items()
        for rows in (BATCH, 2 * BATCH)
    }


@compiled
def _ours(left: Any, right: Any, out: Any) -> None:
    multiply(left, False, right, False, out)


def _products(product: Callable[..., Any], rows: int, width: int, whole: int) -> Turn:
    left, right, out = (
        torch.randn(rows, width),
        torch.randn(width, width),
        torch.empty(rows, width),
    )

    def turn() -> None:
        for _ in range(round(whole / (2 * rows * width * width))):
            product(left, right, out)

    return turn


def flops(
    inputs: int, actions: int, hidden: Sequence[int], batch: int, *, bootstrap: str = "value",
    critics: int = 2, target_critics: int | None = None, quantiles: int = 0,
    policy_critic: str = "min", policy_delay: int = 1,
) -> int:  # fmt: skip
    """Multiplications and additions of all matrix products of one update.

    An action of the policy has a gradient only through its smallest critic, unless the critics'
    mean is used.
    """

    def layers(first: int, last: int) -> list[int]:
        return [a * b for a, b in pairwise([first, *hidden, last])]

    def cost(sizes: list[int], passes: str) -> int:
        whole, upper = sum(sizes), sum(sizes[1:])
        return sum({"forward": whole, "weights": whole, "inputs": whole, "hidden": upper}[p]
                   for p in passes.split())  # fmt: skip

    trained = "forward weights hidden"
    of_policy, of_value = layers(inputs, 2 * actions), layers(inputs, 1)
    critic = layers(inputs + actions, quantiles or 1)
    policy = cost(of_policy, "forward") + cost(of_policy, "weights hidden") / policy_delay
    asked: float = critics * cost(critic, "forward")
    improved = (critics if policy_critic == "mean" else 1) * cost(critic, "inputs") / policy_delay
    if bootstrap == "value":
        following = cost(of_value, trained) + cost(of_value, "forward")
    else:
        following = (target_critics or critics) * cost(critic, "forward")
        following += cost(of_policy, "forward")
        asked /= policy_delay
    trained_critics = critics * cost(critic, trained)
    return round(2 * batch * (policy + following + trained_critics + asked + improved))


def rows(repeats: int) -> Iterator[Row]:
    """Rows against bare torch, a JAX jit and the fastest matrix products, all in one run."""
    with on_one_core():  # before threads are created, which would not inherit it
        taken = interleaved(_turns(), ROUNDS * repeats)
    for name in SIZES:
        yield from _against_the_best(name, taken)
    for name, settings in CRITICS.items():
        yield _against_own_products(f"TAC, HER, 3 x 128, {name}", settings, taken)
    for name, (peer, limit) in PEERS.items():
        yield _row(name, taken, peer, f"{peer} (time)", at_most=limit)


def _turns() -> dict[str, Turn]:
    turns = {name: updates(algorithm(**settings)) for name, settings in VARIANTS.items()}
    turns["raw torch"] = raw_updates()
    for width in SIZES.values():
        turns |= floors(width)
        if importlib.util.find_spec("jax") is not None:
            turns[f"JAX {width}"] = _by_jax(width)
    return turns


def _against_the_best(name: str, taken: dict[str, list[Taken]]) -> Iterator[Row]:
    width = SIZES[name]
    if f"JAX {width}" in taken:
        yield _row(name, taken, f"JAX {width}", "a JAX jit of the update alone (time)", at_most=1.1)
    floor = _floor(width, taken)
    limit = OF_PRODUCTS[width]
    yield _row(name, taken, floor, f"its products at their best, {floor} (time)", at_most=limit)


def _against_own_products(
    name: str, settings: dict[str, Any], taken: dict[str, list[Taken]]
) -> Row:
    """A row against the matrix products of its networks at the highest rate found."""
    sizes = (INPUTS, ACTIONS, (128,) * 3, BATCH)
    of_networks = {k: v for k, v in settings.items() if k in (flops.__kwdefaults__ or {})}
    share = flops(*sizes, **of_networks) / flops(*sizes)
    floor = _floor(128, taken)
    products = [Taken(turn.wall * share, turn.cpu * share) for turn in taken[floor]]
    return _row(
        name, taken | {"products": products}, "products", f"its own products, {floor} (time)",
        at_most=OF_PRODUCTS[128],
    )  # fmt: skip


def _floor(width: int, taken: dict[str, list[Taken]]) -> str:
    """The fastest matrix products of a width."""
    floors_of_it = [one for one in taken if one.endswith(f"{width} x {width}")]
    return min(floors_of_it, key=lambda one: middle(taken[one]).cpu)


def _row(
    name: str, taken: dict[str, list[Taken]], peer: str, against: str, *, at_most: float | None
) -> Row:
    rate, cpu = _rates(taken[name])
    return ratio_row(
        GROUP, name, rate, "updates/s", cpu=cpu,
        against=against, at_most=at_most, **compared(taken[name], taken[peer]),
    )  # fmt: skip


def _rates(taken: list[Taken]) -> tuple[float, float]:
    """Updates per second, and per CPU second."""
    wall, cpu = middle(taken)
    return UPDATES / wall, UPDATES / cpu


def _by_jax(width: int) -> Turn:
    from benchmarks.jax_update import jax_updates

    return jax_updates(INPUTS, ACTIONS, (width,) * 3, BATCH, UPDATES, q=1.5, alpha=0.05)
