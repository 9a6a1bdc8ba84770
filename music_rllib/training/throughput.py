"""The speed of a run, and its remaining time. Knows no Ray and no screen."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from music_rllib.store.history import Report, last_values


class Throughput:
    """Progress of one run, by its reports."""

    def __init__(self, budget: int, warm_up: int, now: float) -> None:
        """Follow a run that begins now.

        Args:
            budget: Its environment steps.
            warm_up: Of those, the first ones without learning. They are many times faster than the
                others, and so are left out of the estimate.
            now: Seconds on any clock.
        """
        self.budget = budget
        self._warm_up = warm_up
        self.env_steps = 0
        self.metrics: dict[str, float] = {}
        """The last value of each metric."""
        self._recent: deque[Report] = deque(maxlen=6)
        self._updated = now

    def hear(self, reports: Iterable[Report], now: float) -> None:
        """Add new reports."""
        reports = list(reports)
        for report in reports:
            if report.env_steps <= self._warm_up:
                self._recent.clear()
            self._recent.append(report)
            self.env_steps = report.env_steps
        self.metrics |= last_values(reports)
        self._updated = now

    @property
    def steps_per_second(self) -> float | None:
        """Speed over the last few reports; None before the first one after the warm-up."""
        if self.env_steps <= self._warm_up:
            return None
        first, last = self._recent[0], self._recent[-1]
        steps, seconds = last.env_steps - first.env_steps, last.seconds - first.seconds
        if len(self._recent) == 1:  # from the beginning
            steps, seconds = last.env_steps, last.seconds
        return steps / seconds if seconds > 0 else None

    def seconds_left(self, now: float) -> float | None:
        """Estimated remaining time; None where the speed is not known yet."""
        rate = self.steps_per_second
        if rate is None:
            return None
        return max((self.budget - self.env_steps) / rate - (now - self._updated), 0.0)
