"""Turns taken one after the other in one run, and the rows of the table that come of them."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

__all__ = ["Row", "interleaved", "ratio_row", "seconds", "start_ray", "told_turns"]

Turns = dict[str, list[float]]


@dataclass(frozen=True)
class Row:
    """One line of the benchmark's table."""

    group: str
    what: str
    value: float
    """Median over the turns."""
    unit: str
    against: str = ""
    """What `ratio` compares with; empty for a row that stands by itself."""
    ratio: float | None = None
    """Median over the turns of ours to theirs: of times (smaller is better) or speeds (larger)."""
    low: float | None = None
    high: float | None = None
    """The smallest and the largest ratio of a turn."""
    target: str = ""
    met: bool | None = None
    """Whether the target is met; None where there is none."""


def start_ray(cpus: int, address: str = "local") -> None:
    """A quiet Ray of this process's own, not one that happens to run; or the one at `address`."""
    import ray

    quiet: dict[str, Any] = {"logging_level": "error", "log_to_driver": False}
    if address == "local":
        quiet |= {"num_cpus": cpus, "include_dashboard": False}
    ray.init(address, **quiet)


def seconds(turn: Callable[[], object]) -> float:
    """Wall time of a turn."""
    begin = time.perf_counter()
    turn()
    return time.perf_counter() - begin


def interleaved(turns: Mapping[str, Callable[[], object]], repeats: int) -> Turns:
    """Wall times of all turns, in rounds: what disturbs the machine disturbs each alike."""
    for turn in turns.values():
        turn()  # the first one allocates
    taken: Turns = {name: [] for name in turns}
    for _ in range(repeats):
        for name, turn in turns.items():
            taken[name].append(seconds(turn))
    return taken


def told_turns(repeats: int) -> Iterator[int]:
    """The turns' numbers; says which one begins, where a turn takes a minute and more."""
    for turn in range(repeats):
        print(f"  turn {turn + 1} of {repeats}", file=sys.stderr, flush=True)
        yield turn


def ratio_row(
    group: str,
    what: str,
    value: float,
    unit: str,
    *,
    against: str,
    ratios: Sequence[float],
    at_most: float | None = None,
    at_least: float | None = None,
) -> Row:
    """A row of ratios, one a turn, and a target for their median."""
    middle = statistics.median(ratios)
    target, met = "", None
    if at_most is not None:
        target, met = f"<= {at_most:g}", middle <= at_most
    elif at_least is not None:
        target, met = f">= {at_least:g}", middle >= at_least
    return Row(group, what, value, unit, against, middle, min(ratios), max(ratios), target, met)
