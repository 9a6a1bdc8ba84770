"""The observation normaliser: running moments per feature, merged so that offsets do no harm.

Shape legend: B batch, I input features.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

__all__ = ["RunningNormaliser", "for_another_run", "in_this_form"]

_ROUNDING = float(np.finfo(np.float32).eps) / 2
"""Standard deviation, as a share of the mean, up to which a feature only flickers between two
neighbouring numbers of float32."""
_OLD_ROUNDING = 1e-12
"""Variance, as a share of the squared mean, up to which sums of squares were only rounding."""

Moments = Mapping[str, NDArray[Any]]


class RunningNormaliser(nn.Module):
    """Running mean and standard deviation per feature; clips what it normalises.

    The moments live in float64 buffers, so they are part of the module's state: environment
    runners, checkpoints and handoffs get them with the weights. Each feature has a count of its
    own, since a run that starts from another one begins anew with some (`for_another_run`).
    """

    count: Tensor
    """[I] observations so far."""
    centre: Tensor
    """[I] their mean."""
    squares: Tensor
    """[I] the sum of their squared distances from it: no difference of large sums."""
    mean: Tensor
    inverse_std: Tensor

    def __init__(self, features: int, *, epsilon: float, clip: float) -> None:
        super().__init__()
        self.epsilon, self.clip = epsilon, clip
        for moment in ("count", "centre", "squares"):
            self.register_buffer(moment, torch.zeros(features, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("inverse_std", torch.ones(features))

    def forward(self, values: Tensor) -> Tensor:
        """[..., I] -> [..., I]: (x - mean) / max(std, epsilon), clipped to plus/minus `clip`.

        0 for a feature that has been the same in all observations.
        """
        return ((values - self.mean) * self.inverse_std).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, values: Tensor) -> None:
        """Takes [B, I] more observations, B > 0, into the moments.

        The batch's moments are merged with those so far (Chan et al. 1983, "Algorithms for
        computing the sample variance", (2.1)), each taken from numbers near 0.
        """
        values = values.to(self.centre)
        # From the first row on: of equal numbers the mean is then exactly that number.
        shifted = values - values[0]
        shifted_mean = shifted.mean(0)
        added = values.shape[0]
        total = self.count + added
        distance = values[0] + shifted_mean - self.centre
        self.squares += (shifted - shifted_mean).square().sum(0)
        self.squares += distance.square() * (self.count * added / total)
        self.centre += distance * (added / total)
        self.count.copy_(total)
        std = (self.squares / self.count).sqrt()
        # What was constant so far taught the networks nothing: it becomes 0 whatever it is later.
        # MUSIC-u is trained on goals of 0 and evaluated with real ones, which would otherwise enter
        # as -5 or 5, through weights that were never learned.
        constant = std <= _ROUNDING * self.centre.abs()
        self.mean.copy_(self.centre)
        self.inverse_std.copy_(torch.where(constant, 0.0, 1.0 / std.clamp(min=self.epsilon)))


def for_another_run(moments: Moments) -> dict[str, NDArray[Any]]:
    """The normaliser's arrays that a run starts with which goes on with these networks.

    Features that were constant begin anew: counted in, they would keep the standard deviation of
    what comes small for as long as the source run was. MUSIC-u's goals are zeros, in MUSIC-f they
    vary. Until they do they stay 0, as the networks know them.
    """
    moments = in_this_form(moments)
    varied = moments["inverse_std"] > 0
    fresh = {name: np.where(varied, moments[name], 0.0) for name in ("count", "centre", "squares")}
    return {**moments, **fresh}


def in_this_form(moments: Moments) -> dict[str, NDArray[Any]]:
    """The same moments, also of a handoff of before version 3: one count, sums, sums of squares."""
    if "total_square" not in moments:
        return dict(moments)
    rest = {name: np.asarray(a) for name, a in moments.items() if not name.startswith("total")}
    total = np.asarray(moments["total"], np.float64)
    count = np.broadcast_to(np.asarray(moments["count"], np.float64), total.shape).copy()
    centre = total / np.maximum(count, 1.0)
    variance = np.asarray(moments["total_square"]) / np.maximum(count, 1.0) - centre**2
    squares = np.where(variance <= _OLD_ROUNDING * centre**2, 0.0, variance * count)
    return {**rest, "count": count, "centre": centre, "squares": squares}
