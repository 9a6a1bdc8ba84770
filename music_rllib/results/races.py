"""Which of two groups of runs gets to a success rate sooner, with its evidence.

Final success says nothing of that where all end alike. A run that has used up its budget without
getting there is later than every one that has got there, and as late as another that has not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from music_rllib.results import statistics as st
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import SIGNIFICANCE, Array, Estimate
from music_rllib.results.time_to_threshold import first_passage
from music_rllib.tracking import names

__all__ = ["Race", "races"]


@dataclass(frozen=True, kw_only=True)
class Race:
    """Whether runs of one group get to a success rate before those of another."""

    task: str
    threshold: float
    first: str
    second: str
    runs: tuple[int, int]
    """How many of either group are compared."""
    estimate: Estimate
    """Probability that a run of `first` is there before one of `second`, ties half."""
    p_value: float
    """Of the permutation test, adjusted for the task's other pairs at this threshold (Holm)."""

    @property
    def decided(self) -> bool:
        """Whether so large a difference seldom comes by chance."""
        return self.p_value < SIGNIFICANCE


def races(
    sweep: Sweep,
    task: str,
    groups: Mapping[str, Sequence[int]],
    threshold: float,
    rng: np.random.Generator,
) -> tuple[Race, ...]:
    """Every pair of groups once, a later group against an earlier one.

    Args:
        sweep: the runs.
        task: whose runs are compared.
        groups: name to positions in `sweep.runs`.
        threshold: success rate at the last step of evaluation episodes.
        rng: for bootstrap and permutations.
    """
    found = {name: _earliness(sweep, task, runs, threshold) for name, runs in groups.items()}
    there = [name for name in groups if len(found[name])]
    pairs = [(second, first) for first, second in combinations(there, 2)]
    p_values = st.holm([st.improvement_p_value(found[a], found[b], rng) for a, b in pairs])
    return tuple(
        Race(
            task=task,
            threshold=threshold,
            first=a,
            second=b,
            runs=(len(found[a]), len(found[b])),
            estimate=st.probability_of_improvement(found[a], found[b], rng),
            p_value=p_value,
        )
        for (a, b), p_value in zip(pairs, p_values, strict=True)
    )


def _earliness(sweep: Sweep, task: str, runs: Sequence[int], threshold: float) -> Array:
    """`[R, 1]` minus the steps to the threshold, minus infinity for runs that ended below it.

    A run that is not finished and not there yet could still be the sooner one: it is left out.
    """
    earliness = []
    for run in runs:
        steps, values = sweep.series(run, names.EVAL_SUCCESS)
        passage = first_passage(steps.astype(float), values, threshold)
        if sweep.runs[run].task != task or passage is None:
            continue
        if passage[1]:
            earliness.append(-passage[0])
        elif sweep.runs[run].status == "FINISHED":
            earliness.append(-np.inf)
    return np.array(earliness, dtype=float).reshape(-1, 1)
