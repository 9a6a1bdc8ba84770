"""The plan of a sweep: which runs it has, and which nodes compute them, in order.

A *run* is a stage's trial on one task with one seed. A *node* is what computes it: its key is the
hash of everything that determines the result, so runs that are the same computation share a node,
within a sweep and between sweeps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from music_rllib.envs.registry import Task
from music_rllib.experiment.files import content_key
from music_rllib.experiment.model import Checkpoint, Point, Source, Stage, SweepConfig
from music_rllib.experiment.settings import RunSettings
from music_rllib.tac.version import ALGORITHM_VERSION

__all__ = ["Input", "Node", "Plan", "Run", "make_plan", "node_key"]


@dataclass(frozen=True, kw_only=True)
class Input:
    """Where a node gets the modules that its variant wants handed over."""

    key: str
    """A node of the plan, or the node that holds an imported checkpoint."""
    task: Task
    """Task that the modules were trained on."""
    checkpoint: Checkpoint | None = None
    """What to import as `key`; None: it is a node of the plan."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One stage's trial on one task with one seed, as a person asks for it."""

    stage: str
    trial: int
    """Position in the stage: its sources' trials times the points of its grid."""
    values: Mapping[str, Any]
    """What tells the trial from its siblings: dotted setting to value; `pretrain:tac.alpha` is a
    value that it has from its source."""
    task: str
    seed: int
    key: str
    """The node that computes it."""

    @property
    def label(self) -> str:
        """`finetune/FetchPush/tac.alpha=0.1,tac.entropic_index=1.5/seed0`, unique in a sweep."""
        values = ",".join(f"{name}={short(value)}" for name, value in self.values.items())
        return "/".join(filter(None, (self.stage, self.task, values, f"seed{self.seed}")))


@dataclass(frozen=True, kw_only=True)
class Node:
    """One computation."""

    key: str
    run: RunSettings
    input: Input | None
    stage: str
    """Of the first run that wants it, as are `trial` and `label`."""
    trial: int
    label: str


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All that a sweep asks for."""

    name: str
    runs: tuple[Run, ...]
    nodes: tuple[Node, ...]
    """In an order in which every node comes after its input."""

    @property
    def env_steps(self) -> int:
        """Environment steps of training, over all nodes."""
        return sum(node.run.env_steps for node in self.nodes)

    @property
    def imports(self) -> tuple[Input, ...]:
        """Checkpoints from outside that nodes start from, each once."""
        inputs = {node.input.key: node.input for node in self.nodes if node.input}
        return tuple(source for source in inputs.values() if source.checkpoint)


def short(value: Any) -> str:
    """A grid value in a few characters."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{short(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "x".join(short(inner) for inner in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def node_key(run: RunSettings, source: str | None) -> str:
    """Key of the node that computes `run` from the weights of node `source`.

    Depends on all that determines the numbers and on nothing else: not on names, on where things
    are stored, on MLflow or on resources. The same on every machine.
    """
    settings = run.model_dump(mode="json") | {"task": run.task.identity()}
    return content_key({"run": settings, "source": source, "algorithm": ALGORITHM_VERSION})


def make_plan(config: SweepConfig) -> Plan:
    """Lay out a valid sweep."""
    planner = _Planner(config)
    for stage in config.stages:
        planner.add(stage)
    return Plan(name=config.name, runs=tuple(planner.runs), nodes=tuple(planner.nodes.values()))


class _Planner:
    def __init__(self, config: SweepConfig) -> None:
        self._seeds = config.seeds
        self.runs: list[Run] = []
        self.nodes: dict[str, Node] = {}
        self._by_cell: dict[tuple[str, int, str, int], Run] = {}

    def add(self, stage: Stage) -> None:
        """Plan a stage whose source, if it is a stage, is planned already."""
        trial = 0
        for source_trial in self._source_trials(stage.source):
            for point in stage.points:
                for task in stage.tasks:
                    for seed in self._seeds:
                        self._add_run(stage, trial, source_trial, point, task, seed)
                trial += 1

    def _source_trials(self, source: Source | None) -> list[int]:
        """Each trial of a source stage gives one to every point: two grids multiply."""
        if source is None or source.stage is None:
            return [0]
        return sorted({run.trial for run in self.runs if run.stage == source.stage})

    def _add_run(
        self, stage: Stage, trial: int, source_trial: int, point: Point, task: Task, seed: int
    ) -> None:
        settings = point.runs[task.name].model_copy(update={"seed": seed})
        node_input, values = self._input(stage.source, source_trial, task, seed)
        key = node_key(settings, node_input.key if node_input else None)
        run = Run(
            stage=stage.name,
            trial=trial,
            values={**values, **point.values},
            task=task.name,
            seed=seed,
            key=key,
        )
        self.runs.append(run)
        self._by_cell[stage.name, trial, task.name, seed] = run
        node = Node(
            key=key,
            run=settings,
            input=node_input,
            stage=stage.name,
            trial=trial,
            label=run.label,
        )
        self.nodes.setdefault(key, node)

    def _input(
        self, source: Source | None, source_trial: int, task: Task, seed: int
    ) -> tuple[Input | None, dict[str, Any]]:
        """What a run starts from, and what its source's trial was told apart by."""
        if source is None:
            return None, {}
        task = source.task or task
        if source.checkpoint is not None:
            key = f"handoff-{source.checkpoint.manifest.content_hash}"
            return Input(key=key, task=task, checkpoint=source.checkpoint), {}
        run = self._by_cell[str(source.stage), source_trial, task.name, seed]
        values = {
            name if ":" in name else f"{run.stage}:{name}": value
            for name, value in run.values.items()
        }
        return Input(key=run.key, task=task), values
