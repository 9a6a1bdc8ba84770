"""The primary metric against α, a line for each q: what a comparison at one α would have found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from music_rllib.results.claims.study import Mean
from music_rllib.results.conditions import Values
from music_rllib.results.statistics import Array, Estimate

ALPHA = "α"


@dataclass(frozen=True, kw_only=True)
class AlphaLine:
    """Conditions on a task that differ in α only, by rising α."""

    task: str
    entropic_index: str
    others: Values
    """What else they have in common that tells them from other lines."""
    means: tuple[Mean, ...]
    alphas: Array
    """`[points]`."""
    estimate: Estimate
    """`[points]`, of the primary metric over the seeds."""


def alpha_sensitivity(means: Sequence[Mean]) -> list[AlphaLine]:
    """Lines of at least two values of α; a condition whose α is no number is on none."""
    groups: dict[tuple[str, str, Values], list[tuple[float, Mean]]] = {}
    for mean in means:
        others = dict(mean.condition.others)
        try:
            alpha = float(others.pop(ALPHA, ""))
        except ValueError:
            continue
        key = (mean.task, mean.condition.entropic_index, tuple(others.items()))
        groups.setdefault(key, []).append((alpha, mean))
    return [_line(*key, points) for key, points in groups.items() if len(points) > 1]


def _line(
    task: str, entropic_index: str, others: Values, points: Sequence[tuple[float, Mean]]
) -> AlphaLine:
    ordered = sorted(points, key=lambda point: point[0])
    found = [mean.estimate for _, mean in ordered]
    return AlphaLine(
        task=task,
        entropic_index=entropic_index,
        others=others,
        means=tuple(mean for _, mean in ordered),
        alphas=np.array([alpha for alpha, _ in ordered]),
        estimate=Estimate(
            value=np.array([float(one.value) for one in found]),
            lower=np.array([float(one.lower) for one in found]),
            upper=np.array([float(one.upper) for one in found]),
        ),
    )
