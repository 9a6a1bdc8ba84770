"""A planned sweep with its storage open: its finished runs, and the record of its plan."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from music_rllib.config.schema import SweepConfig
from music_rllib.envs.fingerprint import Fingerprint
from music_rllib.experiment.continuation import continuation_key
from music_rllib.experiment.environments import Environments
from music_rllib.experiment.plan import Plan
from music_rllib.experiment.scheduler import DONE, Scheduler
from music_rllib.experiment.sweep_files import CONFIG, IN_STORAGE, PLAN, as_json, keep, read
from music_rllib.labels import ShortLabels
from music_rllib.redaction import redact, redact_yaml, without_secrets
from music_rllib.store.node_store import NodeStore, damage_in_words
from music_rllib.store.object_folder import DamagedError, StorageError
from music_rllib.store.paths import database_url
from music_rllib.store.run_record import RunResult


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """A planned sweep, its storage open."""

    config: SweepConfig
    plan: Plan
    storage: str
    """Absolute folder, or URI."""
    store: NodeStore
    folder: Path
    """Folder of the sweep's own files, on this machine."""
    scheduler: Scheduler
    environments: Environments = field(default_factory=Environments)
    """Environments of its tasks as they are now, if the sweep is to be run."""
    damaged: Mapping[str, str] = field(default_factory=dict)
    """Finished nodes to be trained again, by key, and what is wrong with them."""

    @property
    def finished(self) -> set[str]:
        """Keys of the nodes that have a result."""
        return {node.key for node in self.scheduler.having(*DONE)}

    def results(self) -> dict[str, RunResult]:
        """Results of the finished nodes, by key."""
        results = {key: self.store.result(key) for key in self.finished}
        return {key: result for key, result in results.items() if result is not None}


def open_sweep(
    config: SweepConfig,
    plan: Plan,
    storage: str,
    folder: Path,
    *,
    environments: Mapping[str, Fingerprint] | None = None,
    lenient: bool = False,
) -> Sweep:
    """Open the storage, and find the runs in it that are finished and undamaged.

    Damaged ones are refused, or where `lenient` they wait for `remove_damaged`.

    Raises:
        StorageError: The storage can't be reached, or finished runs in it are damaged.
    """
    store = NodeStore(storage)
    labels = _labels(config, plan, storage)
    damaged = store.damage(key for key in labels if store.is_finished(key))
    if damaged and not lenient:
        raise DamagedError(damage_in_words({labels[key]: why for key, why in damaged.items()}))
    finished = {node.key for node in plan.nodes if store.is_finished(node.key)}
    return Sweep(
        config=config,
        plan=plan,
        storage=storage,
        store=store,
        folder=folder,
        scheduler=Scheduler(plan, finished - damaged.keys()),
        environments=Environments.of(environments, storage) if environments else Environments(),
        damaged={
            key: f"{labels[key]}: damaged, is trained again: {damaged[key]}" for key in damaged
        },
    )


def remove_damaged(sweep: Sweep, say: Callable[[str], None]) -> None:
    """Delete the damaged nodes, and say which; the caller must hold the sweep's lock."""
    for key, text in sweep.damaged.items():
        sweep.store.remove(key)
        say(text)


def _labels(config: SweepConfig, plan: Plan, storage: str) -> dict[str, str]:
    """Labels of all nodes that the sweep may reuse, by key; also those of earlier trials."""
    labels = {
        source.key: f"handoff {source.checkpoint.folder}"
        for source in plan.imports
        if source.checkpoint
    }
    short = ShortLabels.of(node.label for node in plan.nodes)
    labels |= {node.key: short(node.label) for node in plan.nodes}
    if plan.searched:
        with contextlib.suppress(StorageError):  # the sweep writes it anew
            earlier = read(storage, f"{config.name}/{PLAN}") or {"nodes": []}
            labels = {node["key"]: node["label"] for node in earlier["nodes"]} | labels
    return labels


def plan_document(sweep: Sweep) -> dict[str, Any]:
    """The content of `plan.json`: all nodes, those of searches as far as they are chosen."""
    nodes = [
        {
            "key": node.key,
            "label": node.label,
            "input": node.source_key,
            "env_steps": node.run.env_steps,
            "continuation": continuation_key(node.run, node.source_key),
        }
        for node in sweep.plan.nodes
    ]
    return {
        "storage": redact(sweep.storage),
        "nodes": nodes,
        "trials": sweep.plan.trials,
        "environments": {task: dict(found) for task, found in sweep.environments.now.items()},
    }


def keep_record(sweep: Sweep) -> None:
    """Write the configuration and the plan into the sweep's folder.

    Raises:
        StorageError: The folder can't be written.
    """
    # A sweep that is continued from its storage has no file: the one that it began with stays.
    if sweep.config.path.is_file() or not (sweep.folder / "sweep.yaml").is_file():
        # As YAML of their own, whose values end where their lines do.
        given = [redact_yaml(one.replace("=", ": ", 1)) for one in sweep.config.arguments]
        arguments = [f"# {one.replace(': ', '=', 1)}  (command line)\n" for one in given]
        keep(sweep, "sweep.yaml", "".join(arguments) + redact_yaml(sweep.config.text))
    keep(sweep, CONFIG, as_json(_configuration(sweep.config)))
    keep(sweep, PLAN, as_json(plan_document(sweep)))


def _configuration(config: SweepConfig) -> dict[str, Any]:
    """The whole configuration without secrets, in words that mean the same elsewhere."""
    document: dict[str, Any] = json.loads(as_json(without_secrets(config.document)))
    if uri := (document.get("mlflow") or {}).get("tracking_uri"):
        document["mlflow"]["tracking_uri"] = database_url(uri)
    for stage, resolved in zip(document["stages"], config.stages, strict=True):
        if resolved.source and resolved.source.checkpoint:
            stage["init_from"]["checkpoint"] = f"{IN_STORAGE}{resolved.source.checkpoint.key}"
    return document
