"""How fast a run goes, and how long it still takes. Knows no Ray and no screen."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from music_rllib.store.run_record import Report, last_values

__all__ = ["Throughput"]


class Throughput:
    """What is known of one running run."""

    def __init__(self, budget: int, warm_up: int, now: float) -> None:
        """A run of `budget` env steps, of which it doesn't learn in the first `warm_up`.

        Those are many times faster than the others, and say nothing about how long it takes.
        `now` is when it began, in seconds on any clock.
        """
        self.budget = budget
        self._warm_up = warm_up
        self.env_steps = 0
        self.metrics: dict[str, float] = {}
        """The last value of each metric."""
        self._recent: deque[Report] = deque(maxlen=6)
        self._heard = now

    def hear(self, reports: Iterable[Report], now: float) -> None:
        """Take up new reports."""
        reports = list(reports)
        for report in reports:
            if report.env_steps <= self._warm_up:
                self._recent.clear()
            self._recent.append(report)
            self.env_steps = report.env_steps
        self.metrics |= last_values(reports)
        self._heard = now

    @property
    def steps_per_second(self) -> float | None:
        """Over the last few reports; None before the first one after the warm-up."""
        if self.env_steps <= self._warm_up:
            return None
        first, last = self._recent[0], self._recent[-1]
        steps, seconds = last.env_steps - first.env_steps, last.seconds - first.seconds
        if len(self._recent) == 1:  # from the beginning
            steps, seconds = last.env_steps, last.seconds
        return steps / seconds if seconds > 0 else None

    def seconds_left(self, now: float) -> float | None:
        """Estimated; None before the first report."""
        rate = self.steps_per_second
        if rate is None:
            return None
        return max((self.budget - self.env_steps) / rate - (now - self._heard), 0.0)
