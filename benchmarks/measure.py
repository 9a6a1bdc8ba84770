"""Programs measured in turn in one run, and rows of the table computed from their times."""

from __future__ import annotations

import contextlib
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

__all__ = [
    "Row",
    "Taken",
    "compared",
    "interleaved",
    "middle",
    "ratio_row",
    "start_ray",
    "taken_by",
    "told_turns",
]


class Taken(NamedTuple):
    """Seconds of a turn."""

    wall: float
    cpu: float
    """CPU time of the process and its ended children, over all threads."""


Turns = dict[str, list[Taken]]


@dataclass(frozen=True)
class Row:
    """One line of the benchmark's table."""

    group: str
    what: str
    value: float
    """Median over the turns."""
    unit: str
    against: str = ""
    """The program that `ratio` compares with; empty if there is none."""
    ratio: float | None = None
    """Median over the turns of ours divided by theirs: times (smaller is better) or speeds."""
    low: float | None = None
    high: float | None = None
    """The smallest and the largest ratio of a turn."""
    cpu: float | None = None
    """`value` by CPU time, if measured: wall time is unreliable on a shared machine."""
    cpu_ratio: float | None = None
    cpu_low: float | None = None
    cpu_high: float | None = None
    target: str = ""
    met: bool | None = None
    """Whether the target is met, by wall and by CPU time; None without a target."""


def start_ray(cpus: int, address: str = "local") -> None:
    """Connect to a new local Ray with little output, or to the one at `address`."""
    import ray

    quiet: dict[str, Any] = {"logging_level": "error", "log_to_driver": False}
    if address == "local":
        quiet |= {"num_cpus": cpus, "include_dashboard": False}
    ray.init(address, **quiet)


def taken_by(turn: Callable[[], object]) -> Taken:
    """Time of a turn of this process."""
    wall, cpu = time.perf_counter(), _cpu_seconds()
    turn()
    return Taken(time.perf_counter() - wall, _cpu_seconds() - cpu)


def _cpu_seconds() -> float:
    used = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def interleaved(turns: Mapping[str, Callable[[], object]], repeats: int) -> Turns:
    """Times of all turns, in rounds, so that a disturbance affects all programs alike."""
    for turn in turns.values():
        turn()  # the first one allocates
    taken: Turns = {name: [] for name in turns}
    for _ in range(repeats):
        for name, turn in turns.items():
            taken[name].append(taken_by(turn))
    return taken


@contextlib.contextmanager
def on_one_core() -> Iterator[None]:
    """Run this process on one core, including XLA's threads."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def told_turns(repeats: int) -> Iterator[int]:
    """Numbers of the turns; prints each, for turns that take a minute or more."""
    for turn in range(repeats):
        print(f"  turn {turn + 1} of {repeats}", file=sys.stderr, flush=True)
        yield turn


def middle(taken: Sequence[Taken]) -> Taken:
    """Medians of wall and of CPU time."""
    return Taken(*map(statistics.median, zip(*taken, strict=True)))


def compared(over: Sequence[Taken], under: Sequence[Taken], factor: float = 1.0) -> dict[str, Any]:
    """Ratios of two programs' turns, by wall and CPU time, as arguments of `ratio_row`."""
    pairs = list(zip(over, under, strict=True))
    return {
        "ratios": [factor * a.wall / b.wall for a, b in pairs],
        "cpu_ratios": [factor * a.cpu / b.cpu for a, b in pairs],
    }


def ratio_row(
    group: str,
    what: str,
    value: float,
    unit: str,
    *,
    against: str,
    ratios: Sequence[float],
    cpu: float | None = None,
    cpu_ratios: Sequence[float] = (),
    at_most: float | None = None,
    at_least: float | None = None,
) -> Row:
    """A row for ratios of turns, with a target for their median, by wall and by CPU time."""
    medians = [statistics.median(measured) for measured in (ratios, cpu_ratios) if measured]
    target, met = "", None
    if at_most is not None:
        target, met = f"<= {at_most:g}", max(medians) <= at_most
    elif at_least is not None:
        target, met = f">= {at_least:g}", min(medians) >= at_least
    return Row(
        group, what, value, unit, against, *_spread(ratios), cpu, *_spread(cpu_ratios), target, met
    )


def _spread(ratios: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Median, smallest and largest."""
    if not ratios:
        return None, None, None
    return statistics.median(ratios), min(ratios), max(ratios)
