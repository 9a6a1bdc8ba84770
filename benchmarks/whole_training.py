"""Environment steps per second of a whole training, compared with other libraries."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import psutil

from benchmarks.measure import Row, Taken, compared, middle, ratio_row, told_turns

__all__ = ["is_installed", "rows"]

GROUP = "whole training"
SECONDS = 10.0
"""Seconds of a turn. The slowest program makes about 60 environment steps in it."""
OTHERS: dict[str, str] = {
    "RLlib SAC": "ray",
    "RLlib SAC, same networks": "ray",
    "SB3 SAC+HER": "stable_baselines3",
    "SBX SAC+HER": "sbx",
    "SB3 TQC+HER": "sb3_contrib",
    "SBX TQC+HER": "sbx",
}
"""Programs to compare with, and the package that each needs."""
SETTINGS: dict[tuple[str, int, float], dict[str, float | None]] = {
    ("ours", 128, 0.4): {"RLlib SAC, same networks": 15.0, "SB3 SAC+HER": 2.5, "SBX SAC+HER": 1.3},
    ("ours, TQC", 128, 0.4): {"SB3 TQC+HER": 2.5, "SBX TQC+HER": 1.3},
    ("ours", 128, 1.0): {"SB3 SAC+HER": None, "SBX SAC+HER": None},
    ("ours", 256, 0.4): {"RLlib SAC, same networks": None, "SB3 SAC+HER": 1.7, "SBX SAC+HER": None},
    ("ours", 256, 1.0): {
        "RLlib SAC": None, "RLlib SAC, same networks": 5.0, "SB3 SAC+HER": 1.7, "SBX SAC+HER": None,
    },
}  # fmt: skip
"""Our program, width of the three layers and replay ratio (`small` first), and the targets."""


class Peer:
    """A process that trains when it is asked to, and waits otherwise."""

    def __init__(self, name: str, width: int, ratio: float) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.peer", name, str(width), str(ratio)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
        )

    def wait(self) -> None:
        """Wait until its warm-up is over."""
        self._answer()

    def turn(self) -> Taken:
        """Seconds per environment step; the CPU time includes Ray's processes."""
        assert self._process.stdin is not None
        before = self._cpu_seconds()
        self._process.stdin.write(f"{SECONDS}\n")
        self._process.stdin.flush()
        answer = self._answer()
        used = self._cpu_seconds() - before
        return Taken(answer["seconds"] / answer["steps"], used / answer["steps"])

    def _cpu_seconds(self) -> float:
        own = psutil.Process(self._process.pid)
        used = 0.0
        for process in (own, *own.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess):
                used += sum(process.cpu_times()[:2])
        return used

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self._process.args!r} ended by itself")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def stop(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.terminate()
        self._process.wait(60)


def rows(repeats: int) -> Iterator[Row]:
    """Speeds at equal networks, batch and replay ratio; programs of a setting take turns."""
    for (ours, width, ratio), targets in SETTINGS.items():
        names = [ours, *(name for name in targets if is_installed(OTHERS[name]))]
        what = f"3 x {width}, replay ratio {ratio:g}{ours.removeprefix('ours')}"
        print(f"  {what}: {', '.join(names)}", file=sys.stderr, flush=True)
        taken = _in_turns(names, width, ratio, repeats)
        for name in names[1:]:
            yield _row(what, taken[ours], taken[name], f"{name} (speed)", targets[name])


def _in_turns(names: list[str], width: int, ratio: float, repeats: int) -> dict[str, list[Taken]]:
    peers: dict[str, Peer] = {}
    try:
        for name in names:
            peers[name] = Peer(name, width, ratio)
            peers[name].wait()  # one after the other, on a machine of few cores
        taken: dict[str, list[Taken]] = {name: [] for name in names}
        for _ in told_turns(repeats):
            for name, peer in peers.items():
                taken[name].append(peer.turn())
    finally:
        for peer in peers.values():
            peer.stop()
    return taken


def _row(
    what: str, ours: list[Taken], theirs: list[Taken], against: str, target: float | None
) -> Row:
    wall, cpu = middle(ours)
    return ratio_row(
        GROUP, what, 1.0 / wall, "env steps/s", cpu=1.0 / cpu, against=against, at_least=target,
        **compared(theirs, ours),
    )  # fmt: skip


def is_installed(package: str) -> bool:
    """Whether the program's package is installed."""
    return importlib.util.find_spec(package) is not None
