"""Environment steps a second of a whole training, against what a user would take instead."""

from __future__ import annotations

import importlib.util
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from benchmarks.measure import Row, ratio_row, told_turns
from music_rllib.tac.precision import has_bf16

__all__ = ["rows"]

GROUP = "whole training"
SECONDS = 12.0
"""Of a turn. The slowest peer does some 70 environment steps in it."""
COMPARED = (
    ("ours", "RLlib SAC", None),
    ("ours", "RLlib SAC, same networks", 5.0),
    ("ours", "SB3 SAC+HER", 1.5),
    ("ours, ratio 0.4", "RLlib SAC, ratio 0.4", None),
    ("ours, ratio 0.4", "RLlib SAC, same networks, ratio 0.4", None),
    ("ours, ratio 0.4", "SB3 SAC+HER, ratio 0.4", None),
    ("ours, bf16", "ours", None),
)


class Peer:
    """A process that trains when it is asked to, and waits otherwise."""

    def __init__(self, name: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.peer", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
        )

    def wait(self) -> None:
        """Until its warm-up is over."""
        self._answer()

    def turn(self) -> float:
        """Environment steps a second."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{SECONDS}\n")
        self._process.stdin.flush()
        answer = self._answer()
        return float(answer["steps"] / answer["seconds"])

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self._process.args!r} ended by itself")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def stop(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.terminate()
        self._process.wait(60)


def rows(repeats: int) -> Iterator[Row]:
    """Speeds at equal networks, batch and replay ratio."""
    pairs = [pair for pair in COMPARED if _available(pair[0]) and _available(pair[1])]
    peers: dict[str, Peer] = {}
    try:
        for name in dict.fromkeys(name for ours, theirs, _ in pairs for name in (ours, theirs)):
            peers[name] = Peer(name)
            peers[name].wait()  # one after the other, on a machine of few cores
        speeds: dict[str, list[float]] = {name: [] for name in peers}
        for _ in told_turns(repeats):
            for name, peer in peers.items():
                speeds[name].append(peer.turn())
    finally:
        for peer in peers.values():
            peer.stop()
    for ours, theirs, target in pairs:
        yield ratio_row(
            GROUP,
            ours,
            statistics.median(speeds[ours]),
            "env steps/s",
            against=f"{theirs} (speed)",
            ratios=[a / b for a, b in zip(speeds[ours], speeds[theirs], strict=True)],
            at_least=target,
        )


def _available(name: str) -> bool:
    if name.startswith("SB3"):
        return importlib.util.find_spec("stable_baselines3") is not None
    return "bf16" not in name or has_bf16()
