"""Minibatches of 256 from replays of 1,000 to 20,000 trajectories."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Row, compared, interleaved, middle, ratio_row
from music_rllib.replay.buffer import TrajectoryReplay
from music_rllib.replay.trajectories import ReplayLayout, Trajectory

__all__ = ["filled_replay", "random_trajectory", "rows"]

GROUP = "replay"
LAYOUT = ReplayLayout(observation=25, action=4, goal=3, horizon=50)
BATCH, CALLS, PER_CALL = 256, 4, 50
Floats = NDArray[np.float32]
FLAT = 1.5  # 20 times the data, from memory instead of the cache
KINDS = ("uniform", "HER", "MUSIC-p")


def random_trajectory(rng: np.random.Generator) -> Trajectory:
    """An episode with the shapes of FetchPush."""
    frames = rng.standard_normal((LAYOUT.horizon + 1, LAYOUT.frame), dtype=np.float32)
    actions = rng.uniform(-1, 1, (LAYOUT.horizon, LAYOUT.action)).astype(np.float32)
    return Trajectory(frames, actions, np.full(LAYOUT.horizon, -1.0, np.float32), False)


def filled_replay(trajectories: int, kind: str = "uniform") -> TrajectoryReplay:
    """A replay with this number of trajectories."""

    def reward(achieved: Floats, desired: Floats) -> Floats:
        far = np.linalg.norm(achieved - desired, axis=-1) > 0.05
        return -np.asarray(far, np.float32)

    rng = np.random.default_rng(0)
    replay = TrajectoryReplay(
        LAYOUT,
        trajectories * LAYOUT.horizon,
        rng,
        goal_reward=reward if kind == "HER" else None,
        hindsight_k=4.0 if kind == "HER" else 0.0,
    )
    some = [random_trajectory(rng) for _ in range(100)]
    for _ in range(trajectories // 100):
        replay.extend(some, rng.uniform(0, 1e-2, 100) if kind == "MUSIC-p" else None)
    return replay


def minibatches(replay: TrajectoryReplay) -> Callable[[], None]:
    """A turn of minibatches, drawn as in training: `PER_CALL` per call."""

    def turn() -> None:
        for _ in range(CALLS):
            replay.sample_transitions(PER_CALL * BATCH)

    return turn


def rows(repeats: int) -> Iterator[Row]:
    """Milliseconds per minibatch: independent of the replay's size, and `-p` close to uniform."""
    sizes = (1_000, 10_000, 20_000)
    turns = {(kind, n): minibatches(filled_replay(n, kind)) for kind in KINDS for n in sizes}
    taken = interleaved({f"{kind} {n}": turn for (kind, n), turn in turns.items()}, repeats)
    for kind, n in turns:
        times = taken[f"{kind} {n}"]
        value, cpu = (seconds / (CALLS * PER_CALL) * 1e3 for seconds in middle(times))
        what = f"{kind}, {n:,} trajectories"
        if kind != "MUSIC-p" and n == min(sizes):  # reference of the other rows
            yield Row(GROUP, what, value, "ms/minibatch", cpu=cpu)
            continue
        if kind == "MUSIC-p":
            against, peer, limit = "uniform", taken[f"uniform {n}"], 2.0
        else:
            against, peer, limit = "1,000 trajectories", taken[f"{kind} 1000"], FLAT
        if kind == "HER" and n == max(sizes):
            yield Row(GROUP, f"{what}: a minibatch", value, "ms", cpu=cpu,
                      target="<= 0.25", met=value <= 0.25)  # fmt: skip
        yield ratio_row(
            GROUP, what, value, "ms/minibatch", cpu=cpu, against=f"{against} (time)",
            **compared(times, peer), at_most=limit,
        )  # fmt: skip
