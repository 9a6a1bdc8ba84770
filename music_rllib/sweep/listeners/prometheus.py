"""Gauges of a sweep for Prometheus, exported beside Ray's own by `ray.util.metrics`.

The driver exports them, because a worker's gauges vanish with the worker. Ray forgets a gauge that
is not set again, so each is set regularly. `dashboards/` has the files that scrape and show them.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from music_rllib import names
from music_rllib.config.tac_settings import setting_text
from music_rllib.experiment.plan import Node
from music_rllib.experiment.scheduler import Failure, Listener, Scheduler, Status
from music_rllib.store.files import write_atomically
from music_rllib.store.history import Report, RunResult, last_values
from music_rllib.tracking.sender import Pending

TARGETS = ".prometheus"
"""Folder beside the sweeps' folders, since Prometheus' file_sd needs all files in one. A driver has
a file NAME.HOST-PID.json with the addresses of its Ray's metrics."""
STALE_SECONDS = 3600.0
"""Age of the files of drivers that were killed elsewhere. A driver writes its own each minute."""
SET_SECONDS = 2.0
KEPT = 100
"""Number of ended runs that are still exported, the newest ones, so that the export does not grow
with a sweep of thousands of runs."""
_RUN_TAGS = ("sweep", "stage", "variant", "task", "q", "seed", "run")
_SWEEP_GAUGES = {
    "music_runs": ("sweep", "state"),
    "music_undelivered_records": ("sweep",),
}
"""Gauges of a whole sweep to their tags; all other gauges describe a run."""
_METRICS = {
    "music_success_rate": names.EVAL_SUCCESS,
    "music_success_rate_any_step": names.EVAL_SUCCESS_ANY,
    "music_episode_return": names.EVAL_RETURN,
    "music_mutual_information_bound_nats": names.MI_BOUND,
    "music_env_steps": names.ENV_STEPS,
    "music_grad_updates": names.GRAD_UPDATES,
}
GAUGES = {
    "music_success_rate": "Success rate of a run at the last step of evaluation episodes.",
    "music_success_rate_any_step": "Success rate of a run at any step of evaluation episodes.",
    "music_episode_return": "Mean return of a run in evaluation episodes.",
    "music_mutual_information_bound_nats": "Bound on the mutual information of a run, in nats.",
    "music_env_steps": "Environment steps of a run so far.",
    "music_grad_updates": "Gradient updates of a run so far.",
    "music_runs": "Runs of a sweep by their state.",
    "music_undelivered_records": "Records that MLflow has not received yet.",
}
"""Name of each gauge, without Ray's prefix `ray_`, to its description."""


class PrometheusListener(Listener):
    """Sets every gauge of a sweep every few seconds."""

    def __init__(
        self,
        sweep: str,
        scheduler: Scheduler,
        pending: Callable[[], Pending],
        folder: Path,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Export the gauges of a sweep; the addresses for Prometheus are written beside `folder`.

        `pending` returns the records that MLflow has not received yet, `now` is a clock in seconds.
        """
        self._sweep = sweep
        self._scheduler = scheduler
        self._pending = pending
        own = f"{folder.name}.{socket.gethostname()}-{os.getpid()}.json"
        self._targets, self._addresses = folder.parent / TARGETS / own, b""
        self._next_written = 0.0
        self._now = now
        self._next_set = 0.0
        self._gauges: dict[str, Any] = {}
        self._values: dict[str, tuple[dict[str, str], dict[str, float]]] = {}
        """Node key to tags and values by gauge."""
        self._in_workers: set[str] = set()
        """Keys of nodes whose run a worker has started; other started nodes wait for resources."""
        self._ended: dict[str, None] = {}
        """Keys of ended nodes, in the order of their ends."""

    def started(self, node: Node) -> None:
        self._in_workers.add(node.key)

    def left(self, node: Node, holder: str) -> None:
        self._in_workers.discard(node.key)

    def reported(self, node: Node, reports: list[Report]) -> None:
        self._ended.pop(node.key, None)
        _, values = self._values.setdefault(node.key, (self._tags(node), {}))
        last = last_values(reports)
        values |= {gauge: last[metric] for gauge, metric in _METRICS.items() if metric in last}

    def finished(self, node: Node, result: RunResult) -> None:
        self._end(node)

    def failed(self, node: Node, failure: Failure) -> None:
        self._end(node)

    def paused(self, node: Node) -> None:
        self._in_workers.discard(node.key)
        self._end(node)

    def tick(self) -> None:
        if self._now() < self._next_set:
            return
        self._next_set = self._now() + SET_SECONDS
        # An error of Ray's metrics must not end the sweep.
        with contextlib.suppress(Exception):
            self._set_all()

    def close(self) -> None:
        """Remove the addresses, because the metrics end with Ray."""
        with contextlib.suppress(OSError):
            self._targets.unlink(missing_ok=True)

    def _end(self, node: Node) -> None:
        """Keep the last values of a run that does not train."""
        self._values.setdefault(node.key, (self._tags(node), {}))
        self._ended[node.key] = None
        while len(self._ended) > KEPT:
            oldest = next(iter(self._ended))
            del self._ended[oldest], self._values[oldest]

    def _tags(self, node: Node) -> dict[str, str]:
        return {
            "sweep": self._sweep,
            "stage": node.stage,
            "variant": node.run.variant,
            "task": node.run.task.name,
            "q": setting_text(node.run.tac.entropic_index),
            "seed": str(node.run.seed),
            "run": node.label,
        }

    def _set_all(self) -> None:
        if not self._gauges:
            self._create_gauges()
        if self._now() >= self._next_written:
            write_atomically(self._targets, self._addresses)
            self._next_written = self._now() + STALE_SECONDS / 60
        for tags, values in self._values.values():
            for gauge, value in values.items():
                self._gauges[gauge].set(value, tags=tags)
        tags = {"sweep": self._sweep}
        counts = {status: len(self._scheduler.having(status)) for status in Status}
        started = self._scheduler.having(Status.STARTED)
        queued = sum(node.key not in self._in_workers for node in started)
        counts[Status.STARTED] -= queued
        counts[Status.WAITING] += queued
        for status, count in counts.items():
            self._gauges["music_runs"].set(count, tags=tags | {"state": status.value})
        pending = self._pending()
        self._gauges["music_undelivered_records"].set(pending.records, tags=tags)

    def _create_gauges(self) -> None:
        """Create the gauges in Ray, and find the addresses for Prometheus."""
        import ray
        from ray.util.metrics import Gauge

        self._gauges = {
            name: Gauge(name, description=text, tag_keys=_SWEEP_GAUGES.get(name, _RUN_TAGS))
            for name, text in GAUGES.items()
        }
        nodes = [node for node in ray.nodes() if node["Alive"] and node["MetricsExportPort"]]
        targets = [f"{node['NodeManagerAddress']}:{node['MetricsExportPort']}" for node in nodes]
        # Equal labels: Prometheus scrapes an address once, however many sweeps name it.
        entry = {"labels": {"job": "music_rllib"}, "targets": targets}
        self._targets.parent.mkdir(parents=True, exist_ok=True)
        for file in self._targets.parent.iterdir():  # also of drivers that were killed
            _, here, pid = file.stem.rpartition(f".{socket.gethostname()}-")
            is_dead = here and pid.isdigit() and not psutil.pid_exists(int(pid))
            if is_dead or time.time() - file.stat().st_mtime > STALE_SECONDS:
                file.unlink(missing_ok=True)
        self._addresses = json.dumps([entry], indent=1).encode()
