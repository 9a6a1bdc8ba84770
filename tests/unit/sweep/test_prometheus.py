"""Metrics that a sweep exports for Prometheus; a recorder replaces Ray's gauges."""

import json
import os
import socket
from pathlib import Path
from typing import Any

import pytest
import ray
import ray.util.metrics

from music_rllib import names
from music_rllib.experiment.plan import Plan, make_plan
from music_rllib.experiment.scheduler import Scheduler
from music_rllib.store.history import Report, RunResult
from music_rllib.sweep.listeners import prometheus
from music_rllib.sweep.listeners.prometheus import PrometheusListener
from music_rllib.tracking.sender import Pending
from tests.sweep_files import loaded

KEPT = 3


@pytest.fixture
def exported(monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, float]]:
    """By gauge and run: the value of the last round."""
    found: dict[str, dict[str, float]] = {}

    class Gauge:
        def __init__(self, name: str, **_: Any) -> None:
            self.name = name

        def set(self, value: float, tags: dict[str, str]) -> None:
            if key := tags.get("run") or tags.get("state"):
                found.setdefault(self.name, {})[key] = value

    monkeypatch.setattr(ray.util.metrics, "Gauge", Gauge)
    monkeypatch.setattr(ray, "nodes", list)
    monkeypatch.setattr("music_rllib.sweep.listeners.prometheus.KEPT", KEPT)
    return found


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    document = {
        "name": "s",
        "tasks": ["FetchReach"],
        "seeds": list(range(8)),
        "stages": [{"name": "train", "variant": "tac"}],
    }
    return make_plan(loaded(tmp_path, document))


def nothing() -> Pending:
    return Pending(records=0, error=None)


def report(env_steps: int, success: float) -> Report:
    metrics = {names.ENV_STEPS: float(env_steps), names.EVAL_SUCCESS: success}
    return Report(env_steps=env_steps, seconds=env_steps / 100, timestamp_ms=0, metrics=metrics)


def test_what_is_exported_does_not_grow_with_the_runs_that_ended(
    exported: dict[str, dict[str, float]], plan: Plan, tmp_path: Path
) -> None:
    now = iter(range(0, 1000, 10))
    gauges = PrometheusListener(
        "s", Scheduler(plan, set()), nothing, tmp_path / "s", now=lambda: next(now)
    )
    slow, *others = plan.nodes
    paused = others.pop()
    for node in (slow, paused, *others):
        gauges.reported(node, [report(100, 0.25), report(300, 0.5)])
    gauges.paused(paused)
    gauges.tick()
    gauges.reported(paused, [report(300, 0.5), report(400, 0.75)])  # it continues
    for node in others:
        gauges.finished(node, RunResult(label="", env_steps=300, seconds=3, metrics={}))
    exported.clear()
    gauges.tick()
    kept = [slow, paused, *others[-KEPT:]]
    assert exported["music_success_rate"] == {
        node.label: 0.75 if node is paused else 0.5 for node in kept
    }
    assert exported["music_env_steps"][paused.label] == 400.0


def test_a_run_that_waits_for_cpus_is_not_exported_as_started(
    exported: dict[str, dict[str, float]], plan: Plan, tmp_path: Path
) -> None:
    scheduler = Scheduler(plan, set())
    listener = PrometheusListener("s", scheduler, nothing, tmp_path)
    for node in plan.nodes[:3]:
        scheduler.start(node.key)  # passed to Ray Tune
    listener.started(plan.nodes[0])  # by a worker
    listener.tick()
    runs = exported["music_runs"]
    assert (runs["started"], runs["waiting"]) == (1, 7), "as in `status`"


def test_drivers_of_one_sweep_are_scraped_until_each_ends(
    exported: dict[str, dict[str, float]],
    plan: Plan,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listeners: list[PrometheusListener] = []
    folder = tmp_path / prometheus.TARGETS
    folder.mkdir()
    (folder / "s.elsewhere-1.json").touch()
    os.utime(folder / "s.elsewhere-1.json", (0, 0))
    (folder / f"s.{socket.gethostname()}-{2**22 + 1}.json").touch()  # no process has this pid
    for pid in (os.getpid(), os.getppid()):
        port = len(listeners) + 1
        node = {"Alive": True, "MetricsExportPort": port, "NodeManagerAddress": "host"}
        monkeypatch.setattr(ray, "nodes", lambda node=node: [node])
        monkeypatch.setattr(os, "getpid", lambda pid=pid: pid)
        scheduler = Scheduler(plan, set())
        listeners.append(PrometheusListener("s", scheduler, nothing, tmp_path / "s"))
        listeners[-1].tick()

    def scraped() -> set[str]:
        files = folder.glob("*.json")
        return {target for file in files for target in json.loads(file.read_text())[0]["targets"]}

    assert scraped() == {"host:1", "host:2"}
    listeners[0].close()
    assert scraped() == {"host:2"}
