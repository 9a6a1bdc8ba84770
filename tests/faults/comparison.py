"""Comparison of an interrupted sweep with an uninterrupted one, in the store and in MLflow."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from mlflow import MlflowClient

from music_rllib import names
from music_rllib.store.node_store import NodeStore
from tests.integration.conftest import runs_by_name

Numbers = dict[str, list[tuple[int, dict[str, float]]]]


def nodes(storage: Path) -> Numbers:
    """Node key to its reports: environment steps and metrics, except those of the machine."""
    store = NodeStore(str(storage))
    return {
        folder.name: [
            (report.env_steps, without_machine(report.metrics))
            for report in store.history(folder.name)
        ]
        for folder in sorted((storage / "nodes").iterdir())
        if not folder.name.startswith(".")
    }


def weights(storage: Path) -> dict[str, bytes]:
    """Every file of network weights in a handoff.

    In a bucket, a node's files are in a folder of the attempt that finished it.
    """
    nodes = storage / "nodes"
    paths = sorted(nodes.rglob("*.safetensors"))
    found = {f"{path.relative_to(nodes).parts[0]}/{path.name}": path.read_bytes() for path in paths}
    assert len(found) == len(paths), "an unfinished attempt has left its weights"
    return found


def without_machine(metrics: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in metrics.items() if not name.startswith("system/")}


def logged(tracking_uri: str, experiment: str = "points") -> Numbers:
    """Run name to its metrics in MLflow, by step; fails if a step occurs twice."""
    client = MlflowClient(tracking_uri)
    runs = runs_by_name(client, experiment)
    return {name: _steps(client, run) for name, run in runs.items() if _is_of_a_node(run)}


def _is_of_a_node(run: Any) -> bool:
    return bool(run.data.tags.get(names.TAG_KIND) == names.KIND_RUN)


def _steps(client: MlflowClient, run: Any) -> list[tuple[int, dict[str, float]]]:
    steps: dict[int, dict[str, float]] = {}
    for name in without_machine(run.data.metrics):
        history = client.get_metric_history(run.info.run_id, name)
        twice = [step for step, n in Counter(point.step for point in history).items() if n > 1]
        assert not twice, f"{run.info.run_name}: {name} is there twice at {twice}"
        for point in history:
            steps.setdefault(point.step, {})[name] = point.value
    return sorted(steps.items())


def same(one: Path, other: Path, *, uri: str = "sqlite:///{}/mlflow.db") -> None:
    """Check that both storages have the same numbers, bit for bit."""
    assert nodes(one) == nodes(other)
    assert weights(one) == weights(other)
    assert logged(uri.format(one)) == logged(uri.format(other))
    assert not list((other / "work").iterdir()), "finished runs leave nothing in work/"
    assert not list((other / "nodes").glob(".*")), "killed attempts leave nothing"
