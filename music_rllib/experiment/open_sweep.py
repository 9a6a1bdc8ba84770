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
from music_rllib.experiment.earlier import earlier_runs
from music_rllib.experiment.environments import Environments
from music_rllib.experiment.plan import Plan
from music_rllib.experiment.scheduler import DONE, Scheduler
from music_rllib.experiment.sweep_files import CONFIG, IN_STORAGE, PLAN, as_json, keep, read
from music_rllib.labels import ShortLabels
from music_rllib.redaction import redact, redact_yaml, without_secrets
from music_rllib.store.history import RunResult
from music_rllib.store.node_store import NodeStore, damage_in_words
from music_rllib.store.storage import DamagedError, StorageError, database_url


@dataclass(frozen=True, kw_only=True)
class OpenSweep:
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
    earlier: list[dict[str, Any]] = field(default_factory=list)
    """Runs of earlier versions of the plan, as `plan.json` has them."""

    @property
    def finished(self) -> set[str]:
        """Keys of the nodes that have a result."""
        return {node.key for node in self.scheduler.having(*DONE)}

    def results(self) -> dict[str, RunResult]:
        """Results of the finished nodes, by key."""
        results = zip(self.finished, self.store.map(self.store.result, self.finished), strict=True)
        return {key: result for key, result in results if result is not None}


def open_sweep(
    config: SweepConfig,
    plan: Plan,
    storage: str,
    folder: Path,
    *,
    environments: Mapping[str, Fingerprint] | None = None,
    lenient: bool = False,
) -> OpenSweep:
    """Open the storage, and find the runs in it that are finished and undamaged.

    Damaged ones are refused, or where `lenient` they wait for `remove_damaged`.

    Raises:
        StorageError: The storage can't be reached, or finished runs in it are damaged.
    """
    store = NodeStore(storage)
    labels = _labels(config, plan, storage)
    published = store.finished(labels)
    damaged = store.damage(key for key in labels if key in published)
    if damaged and not lenient:
        raise DamagedError(damage_in_words({labels[key]: why for key, why in damaged.items()}))
    finished = published & {node.key for node in plan.nodes}
    return OpenSweep(
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


def remove_damaged(sweep: OpenSweep, say: Callable[[str], None]) -> None:
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


def plan_document(sweep: OpenSweep) -> dict[str, Any]:
    """The content of `plan.json`: all nodes, those of searches as far as they are chosen.

    And the nodes of earlier plans that this one does not have.
    """
    keys = {node.key for node in sweep.plan.nodes}
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
        "algorithm": sweep.plan.algorithm,
        "nodes": nodes,
        "trials": sweep.plan.trials,
        "environments": {task: dict(found) for task, found in sweep.environments.now.items()},
        "earlier": [one for one in sweep.earlier if one["key"] not in keys],
    }


def keep_record(sweep: OpenSweep) -> None:
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
    configuration = as_json(_configuration(sweep.config))
    recorded = _recorded_plan(sweep, configuration)
    with contextlib.suppress(StorageError):  # a damaged record is replaced
        sweep.earlier[:] = (
            recorded["earlier"] if recorded else earlier_runs(sweep.plan, sweep.storage)
        )
    keep(sweep, CONFIG, configuration)
    keeps_trials = recorded is not None and sweep.plan.searched and not sweep.plan.trials
    if not keeps_trials:  # else the record has more runs than the plan has yet
        keep(sweep, PLAN, as_json(plan_document(sweep)))


def _recorded_plan(sweep: OpenSweep, configuration: str) -> dict[str, Any] | None:
    """The content of `plan.json` if the plan has not changed since; else None."""
    with contextlib.suppress(StorageError):
        plan: dict[str, Any] | None = read(sweep.storage, f"{sweep.config.name}/{PLAN}")
        same = read(sweep.storage, f"{sweep.config.name}/{CONFIG}") == json.loads(configuration)
        if same and plan and plan.get("algorithm") == sweep.plan.algorithm and "earlier" in plan:
            return plan
    return None


def _configuration(config: SweepConfig) -> dict[str, Any]:
    """The whole configuration without secrets, in words that mean the same elsewhere."""
    document: dict[str, Any] = json.loads(as_json(without_secrets(config.document)))
    if uri := (document.get("mlflow") or {}).get("tracking_uri"):
        document["mlflow"]["tracking_uri"] = database_url(uri)
    for stage, resolved in zip(document["stages"], config.stages, strict=True):
        if resolved.source and resolved.source.checkpoint:
            stage["init_from"]["checkpoint"] = f"{IN_STORAGE}{resolved.source.checkpoint.key}"
    return document
