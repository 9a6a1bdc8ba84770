"""The primary metric against α, a line for each q: what a comparison at one α would have found."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from music_rllib.results.claims.study import Mean
from music_rllib.results.conditions import ALPHA, Values
from music_rllib.results.statistics import Array, Estimate


@dataclass(frozen=True, kw_only=True)
class AlphaLine:
    """Conditions on a task that differ in α only, by rising α."""

    task: str
    entropic_index: str
    others: Values
    """Other settings that tell the line from the others."""
    means: tuple[Mean, ...]
    alphas: Array
    """`[points]`."""
    estimate: Estimate
    """`[points]`, of the primary metric over the seeds."""


def alpha_sensitivity(means: Sequence[Mean]) -> list[AlphaLine]:
    """Lines of at least two values of α; a condition whose α is no number is on none."""
    groups: defaultdict[tuple[str, str, Values], list[tuple[float, Mean]]] = defaultdict(list)
    for mean in means:
        others = dict(mean.condition.others)
        try:
            alpha = float(others.pop(ALPHA, ""))
        except ValueError:
            continue
        key = (mean.task, mean.condition.entropic_index, tuple(others.items()))
        groups[key].append((alpha, mean))
    return [_line(*key, points) for key, points in groups.items() if len(points) > 1]


def _line(
    task: str, entropic_index: str, others: Values, points: Sequence[tuple[float, Mean]]
) -> AlphaLine:
    alphas, means = zip(*sorted(points, key=lambda point: point[0]), strict=True)
    value, lower, upper = (
        np.array([float(getattr(mean.estimate, end)) for mean in means])
        for end in ("value", "lower", "upper")
    )
    return AlphaLine(
        task=task,
        entropic_index=entropic_index,
        others=others,
        means=means,
        alphas=np.array(alphas),
        estimate=Estimate(value=value, lower=lower, upper=upper),
    )
