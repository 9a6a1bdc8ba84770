"""The plan of a sweep: its runs, in order.

Runs with the same key have the same result, within a sweep and between sweeps: the nodes of a plan
are its runs of different keys, and each is computed once.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from pydantic import BaseModel

from music_rllib.config.run_settings import VARIANTS, RunSettings
from music_rllib.config.schema import ImportedHandoff, Source, Stage, SweepConfig
from music_rllib.config.search import of_stage
from music_rllib.config.tac_settings import LearnedAlpha
from music_rllib.envs.tasks import Task
from music_rllib.names import in_runs
from music_rllib.schedules import Linear, extremes
from music_rllib.store.serialization import content_key
from music_rllib.version import ALGORITHM_VERSION

REPORT_INTERVAL = 1_000
"""Environment steps between two reports, unless evaluations are more frequent."""


@dataclass(frozen=True, kw_only=True)
class Input:
    """The source of the network weights that a node starts from."""

    key: str
    """A node of the plan, or the node that holds an imported checkpoint."""
    task: Task
    """Task that the networks were trained on."""
    checkpoint: ImportedHandoff | None = None
    """The handoff to import as `key`; None if `key` is a node of the plan."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """One run: a trial of a stage on one task with one seed."""

    stage: str
    trial: int
    """Position in the stage: the trials of its source times the points of its grid."""
    values: Mapping[str, Any] = field(compare=False)
    """The settings that differ between the stage's trials: dotted setting to value;
    `pretrain:tac.alpha` is a value of its source."""
    run: RunSettings
    input: Input | None
    key: str
    """Hash of everything that determines the result."""
    part: str = ""
    """In a searched stage `trial7`, or `final7` on fresh seeds."""

    @property
    def task(self) -> str:
        return self.run.task.name

    @property
    def seed(self) -> int:
        return self.run.seed

    @property
    def label(self) -> str:
        """`finetune/FetchPush/tac.alpha=0.1,tac.entropic_index=1.5/seed0`, unique in a sweep."""
        values = ",".join(f"{name}={short(value, name)}" for name, value in self.values.items())
        parts = (self.stage, self.task, self.part, values, f"seed{self.seed}")
        return "/".join(filter(None, parts))

    @property
    def source_key(self) -> str | None:
        """Key of the node whose networks it starts from."""
        return self.input.key if self.input else None

    @cached_property
    def continuation(self) -> str:
        """Key that it shares with the runs that differ only in their budget."""
        return continuation_key(self.run, self.source_key)


class Plan:
    """All runs of a sweep; runs of searched stages are added when their trials are chosen."""

    def __init__(
        self, name: str, seeds: Sequence[int] = (), *, algorithm: str | None = None
    ) -> None:
        """An empty plan, with keys of the present version of the algorithm or of a given one."""
        self.name = name
        self.seeds = tuple(seeds)
        self.algorithm = algorithm or ALGORITHM_VERSION
        self._runs: dict[tuple[str, str], Node] = {}
        """Node by label and key."""
        self._trials: dict[str, dict[str, Any]] = {}
        self._nodes: dict[str, Node] = {}
        self._by_cell: dict[tuple[str, int, str, int], Node] = {}
        """Runs of stages without a search, by stage, trial, task and seed."""
        self._stages: dict[str, Stage] = {}

    @property
    def runs(self) -> list[Node]:
        """All runs, in the order of planning."""
        return list(self._runs.values())

    @property
    def trials(self) -> list[dict[str, Any]]:
        """The arguments of each call of `add_trial`, each once, as plain data."""
        return list(self._trials.values())

    @property
    def nodes(self) -> list[Node]:
        """All nodes, every one after its input."""
        return list(self._nodes.values())

    def chain(self, key: str) -> list[Node]:
        """The node of a run, after the planned nodes that it starts from."""
        nodes = [self.node(key)]
        while (source := nodes[0].input) is not None and source.checkpoint is None:
            nodes.insert(0, self.node(source.key))
        return nodes

    @property
    def searched(self) -> tuple[Stage, ...]:
        return tuple(stage for stage in self._stages.values() if stage.search is not None)

    @property
    def env_steps(self) -> int:
        """Environment steps of training, over all nodes."""
        return sum(node.run.env_steps for node in self._nodes.values())

    @property
    def imports(self) -> tuple[ImportedHandoff, ...]:
        """Handoffs from outside that runs start from, each once."""
        sources = [stage.source for stage in self._stages.values() if stage.source]
        found = [source.checkpoint for source in sources if source.checkpoint]
        return tuple({handoff.key: handoff for handoff in found}.values())

    @property
    def transfers(self) -> list[tuple[Source, Task]]:
        """The source and the run's task, of stages that take over the agent of another task."""
        return [
            (stage.source, task)
            for stage in self._stages.values()
            if stage.source and stage.source.task and VARIANTS[stage.variant].starts_from == "agent"
            for task in stage.tasks
            if task.name != stage.source.task.name
        ]

    @property
    def settings(self) -> list[RunSettings]:
        """Settings of all nodes, and of example runs of the searches."""
        searched = (point for stage in self.searched for _, point in stage.examples())
        return [
            *(node.run for node in self._nodes.values()),
            *(run for point in searched for run in point.runs.values()),
        ]

    def node(self, key: str) -> Node:
        return self._nodes[key]

    def add_stage(self, stage: Stage, *, with_runs: bool) -> None:
        """Add a stage, `with_runs` of its grid; its source stage must be in the plan already.

        `add_trial` adds the runs of a searched stage.
        """
        self._stages[stage.name] = stage
        if stage.search is not None or not with_runs:
            return
        points = itertools.product(self._source_trials(stage.source), stage.points)
        for trial, (source_trial, point) in enumerate(points):
            for task, seed in itertools.product(stage.tasks, self.seeds):
                node_input, inherited = self._input(stage.source, source_trial, task, seed)
                settings = point.runs[task.name].model_copy(update={"seed": seed})
                values = {**inherited, **point.values}
                run = self._add_run(stage, trial, values, settings, node_input)
                self._by_cell[stage.name, trial, task.name, seed] = run

    def add_trial(
        self, stage: str, trial: int, values: Mapping[str, Any], seeds: Sequence[int], part: str
    ) -> list[Node]:
        """Add the runs of a searched stage's trial and the runs that it starts from.

        The `values` are dotted settings, `STAGE:setting` for a source stage; `part` is the name of
        the trial in labels.

        Returns:
            The trial's runs, grouped by seed.

        Raises:
            ConfigError: The values are not valid settings.
        """
        searched = self._stages[stage]
        point = searched.resolve({k: value for k, value in values.items() if ":" not in k})
        final = searched.search.final if searched.search else None
        budget = {}
        if final is not None and final.env_steps is not None and part.startswith("final"):
            budget = {"env_steps": final.env_steps}
        runs = []
        for seed, task in itertools.product(seeds, searched.tasks):
            node_input = self._trial_input(searched.source, values, task, seed)
            settings = point.runs[task.name].model_copy(update={"seed": seed, **budget})
            runs.append(self._add_run(searched, trial, values, settings, node_input, part))
        arguments = {
            "stage": stage,
            "trial": trial,
            "values": dict(values),
            "seeds": list(seeds),
            "part": part,
        }
        self._trials.setdefault(repr(arguments), arguments)
        return runs

    def _trial_input(
        self, source: Source | None, values: Mapping[str, Any], task: Task, seed: int
    ) -> Input | None:
        """The node that a trial's run starts from; adds it to the plan if it is new."""
        if source is None or source.stage is None:
            return self._input(source, 0, task, seed)[0]
        task = source.task or task
        stage = self._stages[source.stage]
        source_values = {**stage.points[0].values, **of_stage(values, stage.name)}
        node_input = self._trial_input(stage.source, values, task, seed)
        settings = stage.resolve(source_values).runs[task.name].model_copy(update={"seed": seed})
        run = self._add_run(stage, 0, source_values, settings, node_input)
        return Input(key=run.key, task=task)

    def _add_run(
        self,
        stage: Stage,
        trial: int,
        values: Mapping[str, Any],
        settings: RunSettings,
        node_input: Input | None,
        part: str = "",
    ) -> Node:
        node = Node(
            stage=stage.name,
            trial=trial,
            values=dict(values),
            run=settings,
            input=node_input,
            key=node_key(settings, node_input.key if node_input else None, self.algorithm),
            part=part,
        )
        self._runs.setdefault((node.label, node.key), node)
        self._nodes.setdefault(node.key, node)
        return node

    def _source_trials(self, source: Source | None) -> list[int]:
        """Trials of a source stage, each of which is combined with every point of the grid."""
        if source is None or source.stage is None:
            return [0]
        return sorted({run.trial for run in self._runs.values() if run.stage == source.stage})

    def _input(
        self, source: Source | None, source_trial: int, task: Task, seed: int
    ) -> tuple[Input | None, dict[str, Any]]:
        """The input of a run, and the values of the source's trial."""
        if source is None:
            return None, {}
        task = source.task or task
        if source.checkpoint is not None:
            checkpoint = source.checkpoint
            return Input(key=checkpoint.key, task=task, checkpoint=checkpoint), {}
        run = self._by_cell[str(source.stage), source_trial, task.name, seed]
        values = {
            name if ":" in name else f"{run.stage}:{name}": value
            for name, value in run.values.items()
        }
        return Input(key=run.key, task=task), values


def remarks(plan: Plan) -> list[str]:
    """A line for each property of a valid plan that may be unintended."""
    return [*_shared_runs(plan), *_idle_indices(plan), *_unbounded_alphas(plan)]


def _shared_runs(plan: Plan) -> Iterator[str]:
    """A line about each stage or task with runs whose settings are all equal to another one's."""
    counts = Counter(
        (run.stage, run.task, first.stage, first.task)
        for run in plan.runs
        for first in [plan.node(run.key)]
    )
    points = Counter(
        run.stage
        for run in plan.runs
        for first in [plan.node(run.key)]
        if not run.part and (run.stage, run.task) == (first.stage, first.task)
        if run.trial != first.trial
    )
    for stage, count in points.items():
        yield f"{stage}: {in_runs(count)} equal to runs of other points of its grid: trained once"
    stages: Counter[tuple[str, str]] = Counter()
    for (stage, task, first_stage, first_task), count in counts.items():
        if stage != first_stage:
            stages[stage, first_stage] += count
        elif task != first_task:
            yield _shared_text(f"{stage} on {task}", count, f"{first_stage} on {first_task}")
    for (stage, first), count in stages.items():
        yield _shared_text(stage, count, first)


def _shared_text(where: str, count: int, first: str) -> str:
    return (
        f"{where}: {in_runs(count)} equal to runs of {first}: trained once, and counted for "
        f"{first} only in reports, comparisons and hypotheses"
    )


def _idle_indices(plan: Plan) -> Iterator[str]:
    """A line if runs differ in q without an entropy in their losses: they train the same."""
    count = sum("tac.entropic_index" in run.values and run.run.tac.alpha == 0 for run in plan.runs)
    if count:
        yield f"{in_runs(count)} of a grid over q with alpha 0, where q has no effect on training"


def _unbounded_alphas(plan: Plan) -> Iterator[str]:
    """A line if runs learn α at q >= 2 in the joint form without bounds for the critics."""
    count = sum(
        isinstance(run.tac.alpha, LearnedAlpha)
        and run.tac.entropy_form == "joint"
        and extremes(run.tac.entropic_index)[1] >= 2.0
        and run.tac.target_bounds is None
        for run in plan.settings
    )
    if count:
        yield (
            f"{in_runs(count)} with q >= 2 and the joint entropy, where a learned alpha can make "
            "critics diverge: set tac.target_bounds (docs/comparing_q.md)"
        )


def short(value: Any, setting: str) -> str:
    """A value of a dotted setting as short text: `1.5`, `256x256` for layers, `[-20,0]`."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{short(inner, key)}" for key, inner in value.items()) + "}"
    if isinstance(value, list | tuple):
        items = [short(inner, "") for inner in value]
        return "x".join(items) if setting.endswith("hidden_sizes") else f"[{','.join(items)}]"
    if not isinstance(value, float):
        return str(value)
    # A value of a file in full, so that labels differ; computed ones such as 0.1 + 0.2 in short.
    text = f"{value:.12g}"
    return text if float(text) == value else f"{value:g}"


def node_key(run: RunSettings, source: str | None, algorithm: str | None = None) -> str:
    """Key of the node that computes `run` from the weights of node `source`.

    It depends on everything that determines the numbers and on nothing else: not on names, places,
    MLflow or resources. It is the same on every machine. `algorithm` is a version of the algorithm,
    by default the present one.
    """
    content = {"run": run.identity(), "source": source, "algorithm": algorithm or ALGORITHM_VERSION}
    return content_key(content)


def continuation_key(run: RunSettings, source: str | None, algorithm: str | None = None) -> str:
    """Key that all runs share which differ only in their budget; `algorithm` as in `node_key`."""
    return node_key(run.model_copy(update={"env_steps": 0}), source, algorithm)


def budget_settings(run: RunSettings) -> list[str]:
    """Dotted settings whose value at a step depends on the budget: linear schedules."""
    return [
        f"{section}.{name}"
        for section in ("tac", "music", "intrinsic", "replay")
        for name, value in getattr(run, section)
        if any(isinstance(inner, Linear) for inner in _values(value))
    ]


def _values(value: object) -> Iterator[object]:
    yield value
    if isinstance(value, BaseModel):
        for _, inner in value:
            yield from _values(inner)


def is_continuable(run: RunSettings) -> bool:
    """Whether a longer run passes through the state in which this one ends.

    It does not if a schedule spans the budget, or if the last evaluation or report is due only
    because the budget ends.
    """
    interval = run.evaluation.interval
    even = not run.env_steps % interval and not run.env_steps % min(interval, REPORT_INTERVAL)
    return even and not budget_settings(run)


def make_plan(config: SweepConfig, *, algorithm: str | None = None) -> Plan:
    """The plan of a sweep, with keys of the present or of a given version of the algorithm."""
    plan = Plan(config.name, config.seeds, algorithm=algorithm)
    sources = [(stage.search, stage.source_stage) for stage in config.stages]
    varied = {source for search, source in sources if search and source in search.stages}
    used = {source for search, source in sources if not (search and source in varied)}
    for stage in config.stages:
        # If trials choose the settings of a source stage, the stage has no other runs.
        plan.add_stage(stage, with_runs=stage.name not in varied - used)
    return plan
