"""The plan of a sweep: which runs it has, and which nodes compute them, in order.

A *run* is a stage's trial on one task with one seed. A *node* is what computes it: its key is the
hash of everything that determines the result, so runs that are the same computation share a node,
within a sweep and between sweeps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Checkpoint, Point, Source, Stage, SweepConfig
from music_rllib.config.search.check import of_stage, stages_in
from music_rllib.envs.tasks import Task
from music_rllib.store.files import content_key
from music_rllib.version import ALGORITHM_VERSION

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
    part: str = ""
    """Of a searched stage: `trial7`, or `final7` on fresh seeds."""

    @property
    def label(self) -> str:
        """`finetune/FetchPush/tac.alpha=0.1,tac.entropic_index=1.5/seed0`, unique in a sweep."""
        values = ",".join(f"{name}={short(value)}" for name, value in self.values.items())
        parts = (self.stage, self.task, self.part, values, f"seed{self.seed}")
        return "/".join(filter(None, parts))


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
    part: str = ""
    values: Mapping[str, Any] = field(default_factory=dict, compare=False)
    """As those of the run."""

    @property
    def source_key(self) -> str | None:
        """Of the node whose networks it starts from."""
        return self.input.key if self.input else None


class Plan:
    """All that a sweep asks for; searched stages get their runs as their trials are chosen."""

    def __init__(
        self, name: str, seeds: Sequence[int] = (), *, algorithm: str | None = None
    ) -> None:
        """An empty plan of a sweep with these seeds, under this or an `algorithm` of its own."""
        self.name = name
        self.seeds = tuple(seeds)
        self.algorithm = algorithm or ALGORITHM_VERSION
        self.runs: list[Run] = []
        self.trials: list[dict[str, Any]] = []
        """What `add_trial` was called with, each once, as plain data."""
        self._asked: set[str] = set()
        self._known: set[tuple[str, str]] = set()
        self._nodes: dict[str, Node] = {}
        self._by_cell: dict[tuple[str, int, str, int], Run] = {}
        self._stages: dict[str, Stage] = {}

    @property
    def nodes(self) -> Sequence[Node]:
        """In an order in which every node comes after its input."""
        return list(self._nodes.values())

    @property
    def searched(self) -> tuple[Stage, ...]:
        """Stages whose trials are searched for."""
        return tuple(stage for stage in self._stages.values() if stage.search is not None)

    @property
    def env_steps(self) -> int:
        """Environment steps of training, over all nodes."""
        return sum(node.run.env_steps for node in self.nodes)

    @property
    def imports(self) -> tuple[Input, ...]:
        """Checkpoints from outside that nodes start from, each once."""
        inputs = {node.input.key: node.input for node in self.nodes if node.input}
        return tuple(source for source in inputs.values() if source.checkpoint)

    def add_stage(self, stage: Stage, *, alone: bool = True) -> None:
        """Plan a stage whose source, if it is a stage, is planned already.

        Args:
            stage: One without a search has its runs planned, another one is only made known.
            alone: Whether it has runs of its own, and not only those that trials start from.
        """
        self._stages[stage.name] = stage
        if stage.search is not None or not alone:
            return
        trial = 0
        for source_trial in self._source_trials(stage.source):
            for point in stage.points:
                for task in stage.tasks:
                    for seed in self.seeds:
                        self._add_run(stage, trial, source_trial, point, task, seed)
                trial += 1

    def add_trial(
        self, stage: str, trial: int, values: Mapping[str, Any], seeds: Sequence[int], part: str
    ) -> list[Run]:
        """Plan a trial of a searched stage, with what it starts from; what is there stays.

        Args:
            stage: The stage's name.
            trial: The trial's number.
            values: Dotted settings; those of its source as `STAGE:setting`.
            seeds: To run it with.
            part: What the trial is called in labels.

        Returns:
            Its runs, those with the same seed together.

        Raises:
            ConfigError: The values make no sound settings.
        """
        searched = self._stages[stage]
        point = searched.resolve(_own(values))
        final = searched.search.final if searched.search else None
        budget = {}
        if final is not None and final.env_steps is not None and part.startswith("final"):
            budget = {"env_steps": final.env_steps}
        runs = []
        for seed in seeds:
            for task in searched.tasks:
                node_input = self._trial_input(searched.source, values, task, seed)
                settings = point.runs[task.name].model_copy(update={"seed": seed, **budget})
                run = Run(
                    stage=stage,
                    trial=trial,
                    values=dict(values),
                    task=task.name,
                    seed=seed,
                    key=self._key(settings, node_input),
                    part=part,
                )
                self._add(run, settings, node_input)
                runs.append(run)
        asked = {
            "stage": stage,
            "trial": trial,
            "values": dict(values),
            "seeds": list(seeds),
            "part": part,
        }
        if repr(asked) not in self._asked:
            self._asked.add(repr(asked))
            self.trials.append(asked)
        return runs

    def _trial_input(
        self, source: Source | None, values: Mapping[str, Any], task: Task, seed: int
    ) -> Input | None:
        """The node that a trial's run starts from, planned if it isn't yet."""
        if source is None or source.stage is None:
            return self._input(source, 0, task, seed)[0]
        task = source.task or task
        stage = self._stages[source.stage]
        theirs = of_stage(values, stage.name)
        node_input = self._trial_input(stage.source, values, task, seed)
        settings = stage.resolve(theirs).runs[task.name].model_copy(update={"seed": seed})
        run = Run(
            stage=stage.name,
            trial=0,
            values=theirs,
            task=task.name,
            seed=seed,
            key=self._key(settings, node_input),
        )
        self._add(run, settings, node_input)
        return Input(key=run.key, task=task)

    def _add(self, run: Run, settings: RunSettings, node_input: Input | None) -> None:
        if (run.label, run.key) not in self._known:
            self._known.add((run.label, run.key))
            self.runs.append(run)
        node = Node(
            key=run.key,
            run=settings,
            input=node_input,
            stage=run.stage,
            trial=run.trial,
            label=run.label,
            part=run.part,
            values=run.values,
        )
        self._nodes.setdefault(run.key, node)

    def _key(self, settings: RunSettings, node_input: Input | None) -> str:
        return node_key(settings, node_input.key if node_input else None, self.algorithm)

    def node(self, key: str) -> Node:
        """The node with this key."""
        return self._nodes[key]

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
        run = Run(
            stage=stage.name,
            trial=trial,
            values={**values, **point.values},
            task=task.name,
            seed=seed,
            key=self._key(settings, node_input),
        )
        self._by_cell[stage.name, trial, task.name, seed] = run
        self._add(run, settings, node_input)

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


def _own(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if ":" not in name}


def short(value: Any) -> str:
    """A grid value in a few characters."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{short(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "x".join(short(inner) for inner in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def node_key(run: RunSettings, source: str | None, algorithm: str | None = None) -> str:
    """Key of the node that computes `run` from the weights of node `source`.

    Depends on all that determines the numbers and on nothing else: not on names, on where things
    are stored, on MLflow or on resources. The same on every machine.

    Args:
        run: The settings.
        source: Key of the node that the run starts from, if any.
        algorithm: Version of what is computed; None: this one.
    """
    content = {"run": run.identity(), "source": source, "algorithm": algorithm or ALGORITHM_VERSION}
    return content_key(content)


def make_plan(config: SweepConfig, *, algorithm: str | None = None) -> Plan:
    """Lay out a valid sweep, with the keys of this or of an earlier version of the algorithm."""
    plan = Plan(config.name, config.seeds, algorithm=algorithm)
    varied = {
        stage.source.stage
        for stage in config.stages
        if stage.search is not None and stage.source is not None
        if stage.source.stage in stages_in(stage.search)
    }
    used = {
        stage.source.stage
        for stage in config.stages
        if stage.source is not None and stage.source.stage not in (varied if stage.search else ())
    }
    for stage in config.stages:
        # A stage that only trials start from, each with settings of its own for it, has no others.
        plan.add_stage(stage, alone=stage.name not in varied - used)
    return plan
