"""The schema of a sweep's YAML file, and the resolved sweep with the settings of its runs."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import AfterValidator, Field, model_validator

from music_rllib import names
from music_rllib.config.problems import ConfigError
from music_rllib.config.run_settings import RunSettings, Variant
from music_rllib.config.search import SearchSettings
from music_rllib.envs.tasks import Task
from music_rllib.errors import BadInputError
from music_rllib.limits import MOST_SEEDS
from music_rllib.schedules import StrictModel
from music_rllib.store.handoff import HandoffManifest

RESERVED_NAMES = frozenset(
    {"nodes", "work", "continuations", "verified.json", "environments.json"}
    | {"mlartifacts", "mlflow.db", "mlflow.db.lock"}
)
"""Entries of a storage folder that are not sweeps' folders."""


class MlflowSettings(StrictModel):
    """The MLflow server that metrics are logged to."""

    tracking_uri: str | None = None
    """An MLflow server or database. null: a SQLite file and an artifact folder in the storage. Not
    given: the environment variable `MLFLOW_TRACKING_URI`, or null if it is not set."""


class Resources(StrictModel):
    """Resources of runs."""

    num_cpus: int | None = Field(None, gt=0)
    """CPUs of the local Ray, which is started if no cluster is given; null: all CPUs of the
    machine."""
    cpus_per_run: int = Field(1, gt=0)
    """CPUs reserved for a run; a run itself uses one."""
    gpus_per_run: float = Field(0.0, ge=0)
    """GPUs reserved for a run, whose networks then train on a GPU; with 0.25, four runs share a
    GPU."""
    memory_per_run: float | None = Field(None, gt=0)
    """GiB of memory reserved for a run, which limits the number of concurrent runs; null: no
    memory is reserved."""
    hang_minutes: float | None = Field(5.0, gt=0, le=1e6)
    """Minutes after which a call of an environment's `step()` or `reset()` counts as hanging: the
    run fails with the stack of the call, and other runs continue. null: no limit."""
    storage_minutes: float = Field(15.0, ge=0)
    """Minutes for which runs and the sweep wait for a bucket that does not answer."""

    @property
    def bundle(self) -> dict[str, float]:
        """Resources reserved for a run, by Ray's names; memory in bytes."""
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
        if self.gpus_per_run > 1 and not self.gpus_per_run.is_integer():
            raise ValueError(
                "gpus_per_run must be a whole number above 1, because a part of a GPU is of one "
                f"GPU, got {self.gpus_per_run:g}"
            )
        return self


class Checkpoints(StrictModel):
    """Checkpoints of runs; no run's result depends on them."""

    keep: int = Field(2, gt=0)
    """Checkpoints kept for a run; an older checkpoint is used if the newest one is damaged."""
    minutes: float = Field(10.0, gt=0)
    """Minutes between two checkpoints of a run, which is also saved at each evaluation."""
    grace_seconds: float = Field(30.0, ge=0)
    """Seconds that a stopping sweep waits for its runs to be saved."""
    finished_mb: float = Field(256.0, ge=0)
    """Largest replay buffer in megabytes with which a finished run keeps its last checkpoint, so
    that the same run with more `env_steps` continues from there; 0: no checkpoint is kept."""


# The `analysis` section ---------------------------------------------------------------------------

SETTINGS_IN_SHORT = {
    "q": "tac.entropic_index",
    "α": "tac.alpha",
    "alpha": "tac.alpha",
    "weight": "music.mi_reward_weight",
}
"""Short name of a setting in hypotheses to the setting."""
_HYPOTHESIS = re.compile(
    r"(?P<first>.+?) (?P<relation>better than|worse than|equivalent to|against) (?P<second>.+)"
)
_NEXT_SETTING = re.compile(r",(?=[^,=]+=)")
_JSON_FOR_PYTHON = {"True": "true", "False": "false", "None": "null"}


class Hypothesis(NamedTuple):
    """Two conditions and the expected relation between them: `q = 1.5 better than q = 1`."""

    text: str
    first: Mapping[str, str]
    """The first condition: dotted setting, or `stage`, to its value."""
    second: Mapping[str, str]
    relation: str
    """`better than`, `worse than`, `equivalent to`, or `against` if nothing is expected."""

    @property
    def sides(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        return self.first, self.second

    @classmethod
    def of(cls, text: str) -> Self:
        """Parse a hypothesis.

        Raises:
            ValueError: The text is not a hypothesis; the message has an example.
        """
        words = " ".join(text.split())
        match = _HYPOTHESIS.fullmatch(words)
        first = _condition(match["first"]) if match else {}
        second = _condition(match["second"]) if match else {}
        if match is None or not first or not second or _is_same(first, second):
            raise ValueError(
                "must be two different conditions with 'better than', 'worse than', 'equivalent "
                f"to' or 'against' between them, like 'q = 1.5 against q = 1', got {text!r}"
            )
        return cls(text=words, first=first, second=second, relation=match["relation"])


def _condition(text: str) -> dict[str, str]:
    """The settings of `q = 1.5, tac.lr = 0.001`; empty if the text is not such a list."""
    settings = {}
    for part in _NEXT_SETTING.split(text):
        name, _, value = (piece.strip() for piece in part.partition("="))
        name = SETTINGS_IN_SHORT.get(name, name)
        if not name or not value or name in settings:
            return {}
        settings[name] = value
    return settings


def _canonical(text: str) -> str:
    """A value of a hypothesis or an MLflow param as JSON: the same for `1` and `1.0`."""
    with contextlib.suppress(ValueError):
        return json.dumps(float(text))
    with contextlib.suppress(ValueError, RecursionError):
        value = json.loads(_JSON_FOR_PYTHON.get(text, text), parse_int=float)
        return json.dumps(value, sort_keys=True)
    return text


def _is_same(first: Mapping[str, str], second: Mapping[str, str]) -> bool:
    """Whether two conditions are equal; the names of stages are text."""
    return first.keys() == second.keys() and all(
        text == second[name] if name == "stage" else same_value(text, second[name])
        for name, text in first.items()
    )


def same_value(one: str, other: str) -> bool:
    """Whether two texts are the same value, such as `1` and `1.0`, or `true` and `True`."""
    return one == other or _canonical(one) == _canonical(other)


class Analysis(StrictModel):
    """The questions of a sweep, stated before the runs; no run's result depends on them."""

    question: str | None = Field(None, min_length=1, max_length=500, pattern=r"^[^\x00-\x1f\x7f]*$")
    """The question in a sentence, for the report's first line."""
    hypotheses: tuple[
        Annotated[
            str, Field(max_length=500), AfterValidator(lambda text: Hypothesis.of(text).text)
        ],
        ...,
    ] = Field(min_length=1, max_length=50)
    """Two conditions each with `better than`, `worse than`, `equivalent to` or `against` between
    them: `q = 1.5 better than q = 1`. A condition is all runs with these settings (`q`, `alpha`,
    `weight`, a dotted setting, `stage`). If more settings vary, differences are averaged over pairs
    with equal other settings."""
    stage: str | None = None
    """Stage of the conditions; null: the last stage. A condition can name another stage."""
    metric: Literal["auc", "auc_total", "final"] = "auc"
    """Number to compare. `auc`: the mean of the task's primary metric over the budget (the area
    under the learning curve). `auc_total`: the same over all steps, those of pretraining stages
    included, so that pretraining is not free. `final`: the last value."""
    margin: float | None = Field(None, gt=0)
    """Margin of equivalence tests: smaller differences do not matter. null: 0.05 for a success
    rate; required for a return. If tasks of both kinds are compared, a margin of 1 or more applies
    to returns, and success rates keep 0.05."""


# The sweep ----------------------------------------------------------------------------------------

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=80)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]


def _not_reserved(name: str) -> str:
    if name in RESERVED_NAMES:
        raise ValueError(f"must not be {name!r}, which the storage uses itself")
    return name


class Header(StrictModel):
    """The keys of the file; `environments`, `defaults` and `stages` are checked later."""

    name: Annotated[Name, AfterValidator(_not_reserved)]
    """The sweep's name: its folder in the storage and its experiment in MLflow."""
    tasks: tuple[str, ...] = Field(min_length=1)
    """Built-in tasks or tasks of `environments`; every trial has runs on each task."""
    seeds: tuple[Seed, ...] = Field((0,), min_length=1, max_length=MOST_SEEDS)
    """Seeds of every trial's runs. `5` is short for `[0, 1, 2, 3, 4]`."""
    storage: str = Field("results", min_length=1)
    """Folder or bucket (`s3://`, `gs://`); the sweep's own folder is `<storage>/<name>`. `$NAME` is
    replaced by that environment variable."""
    mlflow: MlflowSettings = MlflowSettings()
    resources: Resources = Resources()
    checkpoints: Checkpoints = Checkpoints()
    analysis: Analysis | None = None
    """Hypotheses for an analysis plan before the runs (docs/comparing_q.md); null: none."""
    preset: str | None = None
    """Settings below `defaults`: the name of a file in `presets/` beside the sweep's file, the name
    of one of the package's presets (`music-rllib presets`), or the path of a YAML file."""
    environments: dict[str, dict[str, Any]] | None = None
    """Name of a task of your own to its definition."""
    defaults: dict[str, Any] | None = None
    """Settings of every stage."""
    stages: list[dict[str, Any]] = Field(min_length=1)
    """The stages, in order."""


class InitFrom(StrictModel):
    """`init_from` of a stage as it is written."""

    stage: str | None = None
    """An earlier stage without a search. A run starts from that stage's run with the same seed; if
    that stage has a grid, each of its trials is combined with each point of this one's."""
    checkpoint: str | None = None
    """Instead of a stage: local folder of a handoff from outside the sweep, exported by `best` or
    of a finished run (`STORAGE/nodes/KEY`). It is copied into the storage: `resume` and commands on
    the sweep's folder do not need it later."""
    task: str | None = None
    """Task of the run or the checkpoint to start from; null: each run's own task."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.stage is None) == (self.checkpoint is None):
            raise ValueError("must have exactly one of stage and checkpoint")
        return self


class StageHeader(StrictModel):
    """Keys of a stage, except its settings."""

    name: Name
    """The stage's name in labels, reports and later stages."""
    variant: Variant
    """The algorithm; it fixes part of the settings (docs/algorithms.md)."""
    tasks: tuple[str, ...] | None = Field(None, min_length=1)
    """Tasks of this stage; null: the tasks of the sweep."""
    init_from: InitFrom | None = None
    """Source of the runs' initial weights. A bare name is short for `{stage: NAME}`."""
    per_task: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Task to settings for this task only: `{FetchSlide: {env_steps: 300000}}`."""
    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    """Dotted setting to its values; the stage's trials are the product of all lists. Settings that
    vary together form a group: `tac: [{entropic_index: 1, alpha: 0.05}, ...]`."""
    search: SearchSettings | None = None
    """A search for the trials instead of `grid` (docs/search.md)."""


IMPORTED = "handoff-"
"""Prefix of the keys of nodes that are handoffs from outside the sweep."""


@dataclass(frozen=True, kw_only=True)
class ImportedHandoff:
    """A handoff from outside the sweep."""

    folder: Path
    """Folder with `handoff.json`."""
    manifest: HandoffManifest

    @property
    def key(self) -> str:
        """Key of its node in a storage."""
        return f"{IMPORTED}{self.manifest.content_hash}"


@dataclass(frozen=True, kw_only=True)
class Source:
    """Source of the network weights that a stage's runs take over."""

    stage: str | None = None
    """An earlier stage; each run starts from that stage's run with the same seed..."""
    checkpoint: ImportedHandoff | None = None
    """... or all runs start from this handoff."""
    task: Task | None = None
    """Task of the source; None: the run's own task."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """One point of a stage's grid or search."""

    values: Mapping[str, Any]
    """Dotted setting to its value; empty for a stage without a grid."""
    runs: Mapping[str, RunSettings]
    """Task name to complete settings, with the sweep's first seed."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One stage, resolved."""

    name: str
    variant: Variant
    tasks: tuple[Task, ...]
    source: Source | None
    points: tuple[Point, ...]
    """The grid's points; for a search one point, with the settings that are not searched."""
    search: SearchSettings | None = None
    resolve: Callable[[Mapping[str, Any]], Point] = field(compare=False, repr=False)
    """Gives the point with dotted settings in place of this stage's; raises ConfigError."""

    @property
    def source_stage(self) -> str | None:
        """Name of the earlier stage that its runs start from."""
        return self.source.stage if self.source else None

    @property
    def primary_metric(self) -> str:
        """The metric for comparing its runs: success if each task has it, otherwise return."""
        metrics = {task.primary_metric for task in self.tasks}
        return names.EVAL_SUCCESS if metrics == {names.EVAL_SUCCESS} else names.EVAL_RETURN

    @property
    def evaluation_episodes(self) -> int:
        """Fewest episodes per evaluation of any of its runs."""
        return min(run.evaluation.episodes for point in self.points for run in point.runs.values())

    @property
    def most_env_steps(self) -> int:
        """Environment steps of its longest run; 0 if they are unknown."""
        own = max((run.env_steps for at in self.points for run in at.runs.values()), default=0)
        space, compare = (self.search.space, self.search.compare) if self.search else ({}, {})
        if (dimension := space.get("env_steps")) is not None:
            return max(*map(int, dimension.ends()), own if dimension.when else 0)
        return max((int(float(str(steps))) for steps in compare.get("env_steps", ())), default=own)

    def examples(self) -> Iterator[tuple[Mapping[str, Any], Point]]:
        """Points that represent everything that the stage can run, with their searched values.

        For a grid, all points; for a search, the ends of its space and each compared value. Values
        of the source are called `STAGE:setting`. Points with invalid settings are omitted.
        """
        yield from (({}, point) for point in self.points)
        if self.search is not None:
            ends = [at for place, at in self.search.examples() if place[0] == "space"]
            for values in (*ends, *self.search.compared()):
                own = {name: value for name, value in values.items() if ":" not in name}
                with contextlib.suppress(ConfigError):
                    yield values, self.resolve(own)


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """A valid, resolved sweep."""

    path: Path
    document: Mapping[str, Any] = field(repr=False)
    """The file's content as plain data, with the values of the command line."""
    name: str
    seeds: tuple[int, ...]
    storage: str
    mlflow: MlflowSettings
    resources: Resources
    checkpoints: Checkpoints
    analysis: Analysis | None
    stages: tuple[Stage, ...]

    def source_of(self, stage: Stage) -> Stage | None:
        """The earlier stage that the runs of a stage start from."""
        return next((one for one in self.stages if one.name == stage.source_stage), None)

    def stage(self, name: str | None = None) -> Stage:
        """The stage with this name; without a name, that of the analysis.

        Without an analysis, it is the last stage that trains for the task, or the last one.

        Raises:
            BadInputError: The sweep has no such stage.
        """
        stages = {stage.name: stage for stage in self.stages}
        last = self.stages[-1].name
        if self.analysis is None:
            rewarded = (s.name for s in reversed(self.stages) if not s.variant.endswith("-u"))
            last = next(rewarded, last)
        name = name or (self.analysis and self.analysis.stage) or last
        if name not in stages:
            raise BadInputError(f"--stage must be one of {', '.join(stages)}, got {name!r}")
        return stages[name]
