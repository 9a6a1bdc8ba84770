"""Area under a learning curve: the mean of a metric over the budget, a study's primary metric.

It counts how soon and how high alike. Steps to a threshold are biased early where an evaluation is
noisy (an agent at 85 % passes "90 % of 50 episodes" in 22 % of its evaluations), and final values
say nothing where all runs end at the ceiling.
"""

from __future__ import annotations

import numpy as np

from music_rllib.results.statistics import Array

__all__ = ["area_under_curve"]


def area_under_curve(steps: Array, values: Array, horizon: float) -> float:
    """Mean of a learning curve over environment steps 0 to `horizon`, by the trapezoid rule.

    Before the first evaluation the curve has that one's value; a budget of 100 steps that ends
    between two evaluations is cut there.

    Args:
        steps: `[points]` of the evaluations, rising.
        values: `[points]`, finite.
        horizon: environment steps, > 0.

    Returns:
        In the metric's unit; NaN for a run that was not evaluated at `horizon` or later, of which
        the rest of the curve is not known.
    """
    if not len(steps) or steps[-1] < horizon:
        return float("nan")
    inside = steps[(steps > 0) & (steps < horizon)]
    at = np.concatenate([[0.0], inside, [horizon]])
    return float(np.trapezoid(np.interp(at, steps, values), at) / horizon)
