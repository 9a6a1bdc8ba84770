"""Progress of a running sweep: its driver's `state.json`, its speed and the time left."""

from __future__ import annotations

import shlex
from collections import deque
from functools import cached_property
from typing import Any

from music_rllib import names
from music_rllib.experiment import sweep_files
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.labels import ShortLabels
from music_rllib.redaction import redact
from music_rllib.store.storage import StorageError

WINDOW = 120.0
"""Seconds over which the speed is measured."""
SHOWN = 50
"""Largest number of running runs, and of failed ones, on the page."""


class Progress:
    """Reads a sweep's `state.json` for the page."""

    def __init__(self, found: SweepLocation) -> None:
        self._found = found
        self._seen: deque[tuple[float, int]] = deque()

    def read(self) -> dict[str, Any]:
        """State, steps, speed, stages, running and failed runs of the sweep.

        Raises:
            StorageError: `state.json` is damaged or not reachable.
        """
        state = self._found.read(sweep_files.STATE)
        if state is None:
            return {"sweep": self._found.name, "state": "not started"}
        driver, steps = state["driver"], state["env_steps"]
        to_come = steps["to_come"]
        left = steps["left"] + to_come
        running = sweep_files.is_alive(state)
        outcome = driver["outcome"]
        speed = self._speed(driver["heartbeat"], steps["done"]) if running else None
        return {
            "sweep": self._found.name,
            "state": "interrupted" if outcome == "running" and not running else outcome,
            "since": driver["started"],
            "ended": None if running else driver["ended"],
            "command": self._command(outcome, running=running),
            "done": steps["done"],
            "left": left,
            "at_most": to_come > 0,
            "speed": speed,
            "seconds_left": left / speed if speed else None,
            "stages": [{"name": one["name"], "runs": one["runs"]} for one in state["stages"]],
            "running": [
                {
                    "run": self._short(one["run"]),
                    "done": one["env_steps"],
                    "budget": one["budget"],
                    "metric": names.word_of(one["metric"]),
                    "value": one["value"],
                }
                for one in state["running"][:SHOWN]
                if running
            ],
            "failures": [
                {"run": self._short(one["run"]), "cause": one["cause"]}
                for one in state["failures"][-SHOWN:]
            ],
        }

    def is_running(self) -> bool:
        """Whether the sweep's driver is alive; False if its state cannot be read."""
        try:
            return bool(self.read()["state"] == "running")
        except StorageError:
            return False

    def _command(self, outcome: str, *, running: bool) -> str | None:
        """The command that stops a running sweep or resumes a stopped one, without secrets."""
        if outcome == "finished":
            return None
        name, storage = self._found.name, redact(self._found.storage)
        verb = "stop" if running else "resume"
        return shlex.join(["music-rllib", verb, name, "--storage", storage])

    @cached_property
    def _short(self) -> ShortLabels:
        config = self._found.read(sweep_files.CONFIG) or {"tasks": [], "stages": []}
        tasks = {*config["tasks"]}.union(*(stage.get("tasks") or () for stage in config["stages"]))
        return ShortLabels((stage["name"] for stage in config["stages"]), tasks)

    def _speed(self, now: float, done: int) -> float | None:
        """Environment steps per second of all runs; None before two states that differ."""
        seen = self._seen
        if seen and (now < seen[-1][0] or done < seen[-1][1]):
            seen.clear()  # another driver has taken over
        if not seen or now > seen[-1][0]:
            seen.append((now, done))
        while len(seen) > 2 and now - seen[0][0] > WINDOW:
            seen.popleft()
        (begin, before), (end, after) = seen[0], seen[-1]
        return (after - before) / (end - begin) if after > before else None
