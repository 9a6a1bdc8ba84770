"""What a sweep's YAML file holds, and the same with every run's settings resolved."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from music_rllib import names
from music_rllib.config.analysis import Analysis
from music_rllib.config.run_settings import RunSettings, Variant
from music_rllib.config.search.settings import SearchSettings
from music_rllib.envs.tasks import Task
from music_rllib.store.handoff import HandoffManifest

RESERVED_NAMES = frozenset(
    {"nodes", "work", "continuations", "verified.json"}
    | {"mlartifacts", "mlflow.db", "mlflow.db.lock"}
)
"""Entries of a storage folder that are no sweeps."""


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class MlflowSettings(_Strict):
    """Where metrics go."""

    tracking_uri: str | None = None
    """An MLflow server; null: a sqlite file and an artefact folder in the storage."""


class Resources(_Strict):
    """What runs may use."""

    num_cpus: int | None = Field(None, gt=0)
    """CPUs of the local Ray that is started where no cluster is given; null: all there are."""
    cpus_per_run: int = Field(1, gt=0)
    """CPUs reserved for a run; a run itself uses one."""
    gpus_per_run: float = Field(0.0, ge=0)
    """GPUs reserved for a run, whose networks then train on one; 0.25 shares one between four."""
    memory_per_run: float | None = Field(None, gt=0)
    """GiB of memory reserved for a run, so that fewer run side by side; null: memory is not
    counted."""

    hang_minutes: float | None = Field(5.0, gt=0)
    """A run whose environment takes longer for one call of `step()` or `reset()` has hung: it
    fails, with the stack that it hangs in, and the others go on. null: it is waited for."""

    @property
    def bundle(self) -> dict[str, float]:
        """What is reserved for a run, by Ray's names; memory in bytes."""
        wanted: dict[str, float] = {"CPU": self.cpus_per_run}
        if self.gpus_per_run:
            wanted["GPU"] = self.gpus_per_run
        if self.memory_per_run is not None:
            wanted["memory"] = round(self.memory_per_run * 2**30)
        return wanted

    @model_validator(mode="after")
    def _one_fits(self) -> Self:
        if self.num_cpus is not None and self.cpus_per_run > self.num_cpus:
            raise ValueError(
                f"cpus_per_run must be <= num_cpus ({self.num_cpus}), got {self.cpus_per_run}"
            )
        return self


class Checkpoints(_Strict):
    """What is kept of runs besides their results; no run's result depends on it."""

    keep: int = Field(2, gt=0)
    """Checkpoints of a run that are kept; older ones serve where the newest is damaged."""
    minutes: float = Field(10.0, gt=0)
    """A run is saved at each evaluation, and when the last time is so long ago."""
    grace_seconds: float = Field(30.0, ge=0)
    """How long a sweep that is told to stop waits for its runs to be saved."""
    finished_mb: float = Field(256.0, ge=0)
    """A finished run keeps its last checkpoint where its replay takes at most so many megabytes, so
    that the same run with more `env_steps` goes on from there; 0: none is kept."""


Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=80)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]


class Header(_Strict):
    """The document without its stages, tasks' definitions and defaults."""

    name: Name
    """The sweep's name: its folder in the storage and its experiment in MLflow."""
    tasks: tuple[str, ...] = Field(min_length=1)
    """Built-in tasks or those of `environments`; every trial is run on each."""
    seeds: tuple[Seed, ...] = Field((0,), min_length=1)
    """Every trial is run with each. `5` is short for `[0, 1, 2, 3, 4]`."""
    storage: str = Field("results", min_length=1)
    """Folder or bucket (`s3://`, `gs://`); the sweep's own folder is `<storage>/<name>`."""
    mlflow: MlflowSettings = MlflowSettings()
    resources: Resources = Resources()
    checkpoints: Checkpoints = Checkpoints()
    analysis: Analysis | None = None
    """What is asked, for an analysis plan before the runs (docs/comparing_q.md); null: none."""


class InitFrom(_Strict):
    """Where a stage starts from, as it is written."""

    stage: str | None = None
    """An earlier stage; a run starts from that stage's run with the same seed."""
    checkpoint: str | None = None
    """Folder of a handoff from outside the sweep, in place of a stage."""
    task: str | None = None
    """Task of the run, or of the checkpoint, to start from; null: each run's own task."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.stage is None) == (self.checkpoint is None):
            raise ValueError("must have exactly one of stage and checkpoint")
        return self


class StageHeader(_Strict):
    """A stage without its settings."""

    name: Name
    """What labels, reports and later stages call it."""
    variant: Variant
    """The algorithm; it fixes part of the settings (docs/algorithms.md)."""
    tasks: tuple[str, ...] | None = Field(None, min_length=1)
    """Tasks of this stage; null: the sweep's."""
    init_from: InitFrom | None = None
    """What its runs start from. A bare name is short for `{stage: NAME}`."""
    per_task: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Task to settings for it alone, laid over the stage's: `{FetchSlide: {env_steps: 300000}}`."""
    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    """Dotted setting to the values it takes; the product of all lists is the stage's trials."""
    search: SearchSettings | None = None
    """In place of `grid`: the trials are searched for (docs/search.md)."""


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A handoff from outside the sweep."""

    folder: Path
    """Where `handoff.json` lies."""
    manifest: HandoffManifest


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where a stage's runs get the modules that their variant wants handed over."""

    stage: str | None = None
    """An earlier stage; each run starts from that stage's run with the same seed..."""
    checkpoint: Checkpoint | None = None
    """... or all runs start from this handoff."""
    task: Task | None = None
    """Task of the source; None: the run's own."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """One point of a stage's grid."""

    values: Mapping[str, Any]
    """Dotted setting to its value here; empty for a stage without a grid."""
    runs: Mapping[str, RunSettings]
    """Task name to complete settings, with the sweep's first seed."""


Resolve = Callable[[Mapping[str, Any]], Point]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One stage, resolved."""

    name: str
    variant: Variant
    tasks: tuple[Task, ...]
    source: Source | None
    points: tuple[Point, ...]
    """The grid's; for a searched stage one, which stands for all: what is the same in each."""
    search: SearchSettings | None = None
    resolve: Resolve = field(compare=False, repr=False)
    """Makes a point of dotted settings laid over this stage's; raises ConfigError."""

    @property
    def primary_metric(self) -> str:
        """What its runs are judged by: the return, unless each of its tasks has a success."""
        found = {task.primary_metric for task in self.tasks}
        return names.EVAL_SUCCESS if found == {names.EVAL_SUCCESS} else names.EVAL_RETURN

    @property
    def evaluation_episodes(self) -> int:
        """Of an evaluation, in the run that has the fewest."""
        return min(run.evaluation.episodes for point in self.points for run in point.runs.values())


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """A whole sweep, valid."""

    path: Path
    text: str = field(repr=False)
    """The file as it was written."""
    arguments: tuple[str, ...] = ()
    """`KEY=VALUE` of the command line, which `document` has and `text` has not."""
    document: Mapping[str, Any] = field(repr=False)
    """Its content as plain data, with the options of the command line."""
    name: str
    seeds: tuple[int, ...]
    storage: str
    mlflow: MlflowSettings
    resources: Resources
    checkpoints: Checkpoints
    analysis: Analysis | None
    stages: tuple[Stage, ...]
