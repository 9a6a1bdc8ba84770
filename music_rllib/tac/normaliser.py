"""The observation normaliser: running moments per feature, exact also for large offsets.

Shape legend: B batch, I input features.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

_ROUNDING = float(np.finfo(np.float32).eps) / 2
"""Standard deviation, as a share of the mean, up to which a feature counts as constant: it only
alternates between two neighbouring numbers of float32."""

Moments = Mapping[str, NDArray[Any]]


class RunningNormaliser(nn.Module):
    """Running mean and standard deviation per feature; its outputs are clipped.

    The moments are float64 buffers and so part of the module's state: environment runners,
    checkpoints and handoffs get them with the weights. Each feature has its own count, since a run
    that starts from another one resets the counts of some (`for_another_run`).
    """

    count: Tensor
    """[I] number of observations."""
    centre: Tensor
    """[I] their mean."""
    squares: Tensor
    """[I] the sum of their squared distances from the mean."""
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

        0 for a feature that was the same in all observations.
        """
        return ((values - self.mean) * self.inverse_std).clamp(-self.clip, self.clip)

    def in_numpy(self) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
        """`forward` by the moments as they are now."""
        mean, inverse_std = self.mean.numpy(), self.inverse_std.numpy()

        def forward(values: NDArray[np.float32]) -> NDArray[np.float32]:
            normalised = (values - mean) * inverse_std
            clipped: NDArray[np.float32] = np.clip(normalised, -self.clip, self.clip)
            return clipped

        return forward

    @torch.no_grad()
    def update(self, values: Tensor) -> None:
        """Adds [B, I] observations, B > 0, to the moments.

        The batch's moments are merged with the previous ones (Chan et al. 1983, "Algorithms for
        computing the sample variance", (2.1)), each computed from numbers near 0.
        """
        values = values.to(self.centre)
        # Relative to the first row: the mean of equal numbers is then exactly that number.
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
        # The networks have learned nothing about a constant feature, so it stays 0 even when its
        # value changes. MUSIC-u is trained on goals of 0 and evaluated with real ones, which would
        # otherwise enter as -5 or 5, through untrained weights.
        constant = std <= _ROUNDING * self.centre.abs()
        self.mean.copy_(self.centre)
        self.inverse_std.copy_(torch.where(constant, 0.0, 1.0 / std.clamp(min=self.epsilon)))


def for_another_run(moments: Moments) -> dict[str, NDArray[Any]]:
    """The initial moments of a run that starts from the networks of another run.

    Features that were constant are reset: their count would keep the standard deviation small for
    as long as the source run was. MUSIC-u's goals are zeros; in MUSIC-f they vary. Until they do,
    they stay 0.
    """
    varied = moments["inverse_std"] > 0
    fresh = {name: np.where(varied, moments[name], 0.0) for name in ("count", "centre", "squares")}
    return {**moments, **fresh}
