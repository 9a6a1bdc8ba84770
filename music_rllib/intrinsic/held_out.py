"""The estimator's bound on fresh trajectories, collected until it is reported."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from music_rllib.functional.mutual_information import time_permutations
from music_rllib.replay.trajectories import Trajectory, WholeTrajectories, long_enough

__all__ = ["HeldOutBound"]


class HeldOutBound:
    """Mean bound of all trajectories that have come since it was taken, by their steps."""

    def __init__(self) -> None:
        self._sum = self._steps = 0.0

    @torch.no_grad()
    def add(
        self,
        episodes: Sequence[Trajectory],
        bound: Callable[[Tensor, Tensor, Tensor | None], Tensor],
        generator: torch.Generator,
    ) -> None:
        """Measures trajectories that nothing has learned from yet.

        Args:
            episodes: fresh ones.
            bound: the estimator's (`EstimatorModule.bound`).
            generator: of the time shuffles; what is measured goes to its device.
        """
        lengths = np.array([len(episode) for episode in episodes])
        chosen = np.flatnonzero(long_enough(lengths)).tolist()
        whole = WholeTrajectories.of([episodes[i].frames for i in chosen])
        device = generator.device
        observations = torch.as_tensor(whole.observations, device=device)
        inside = None if whole.inside is None else torch.as_tensor(whole.inside, device=device)
        count, frames = observations.shape[:2]
        permutations = time_permutations(count, frames, generator, inside=inside)
        bounds = bound(observations, permutations, inside).cpu().numpy()
        self._sum += float(bounds @ lengths[chosen])
        self._steps += float(lengths[chosen].sum())

    def take(self) -> tuple[float, float] | None:
        """The mean, in nats, and the steps behind it; None where there are none. Begins anew."""
        taken = (self._sum / self._steps, self._steps) if self._steps else None
        self._sum = self._steps = 0.0
        return taken

    def state(self) -> list[float]:
        """What `load_state` goes on from."""
        return [self._sum, self._steps]

    def load_state(self, state: Sequence[float]) -> None:
        """Takes over what `state` gave."""
        self._sum, self._steps = state
