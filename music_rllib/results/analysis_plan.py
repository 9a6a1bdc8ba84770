"""Analysis plans: a question and how it will be decided, recorded before the runs.

Every version is kept in `analysis_plan.json` with the time at which it was recorded, so that a
report can tell planned comparisons from others: a hypothesis counts as planned if the last version
before the first result of its stages has it. `analysis_plan.md` has the same content for readers.
The hash is that of the plan alone: the same `analysis` section has the same hash on every machine,
and can be cited or committed before anything runs.

Texts of a plan are part of its hash, so existing ones must not change.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self

import numpy as np
import yaml
from pydantic import Field, TypeAdapter, model_validator

from music_rllib import names
from music_rllib.config.schema import Hypothesis, Stage, SweepConfig
from music_rllib.config.tac_settings import setting_text
from music_rllib.errors import reason_of
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.record import results_of_other_budgets
from music_rllib.experiment.sweep_files import ANALYSIS_PLAN, SweepLocation, as_json
from music_rllib.schedules import StrictModel
from music_rllib.store.serialization import content_key
from music_rllib.store.storage import StorageError

MARGIN_OF_A_RATE = 0.05
"""Default margin of a success rate."""
_PRIMARY = {
    "auc": "area under the learning curve of {metric}: its mean over the budget, by the trapezoid "
    "rule over environment steps",
    "auc_total": "area under the learning curve of {metric}: its mean over the budget, pretraining "
    "included, by the trapezoid rule over environment steps",
    "final": "{metric} of the last evaluation",
}
_TEST = (
    "Student's t test of the differences of a seed, Welch's where the conditions share no seeds; "
    "equivalence within the margin by two one-sided tests; Holm's correction over the planned "
    "comparisons, 5 %; finished runs only, none left out"
)
_NOTE = (
    "A failed run counts with the worst value of the metric. The test is Welch's unless both "
    "conditions have exactly the same seeds."
)
"""Completes `_TEST`, which can't change: it is a part of the hashes of published plans."""
MOST_VERSIONS = 1000
PLANS_TO_READ = "analysis_plan.md"

Line = Annotated[str, Field(max_length=100_000, pattern=r"^[^\x00-\x1f\x7f]*$")]
"""Plans may come from strangers: text without control characters, which a terminal would obey."""


@dataclass(frozen=True)
class PlannedHypothesis:
    """A hypothesis of a plan, equal to one that says the same, with or without a default stage."""

    meaning: Hashable = field(repr=False)
    text: str = field(compare=False)
    stages: frozenset[str] = field(compare=False)
    """The stages that it compares."""

    @classmethod
    def of(cls, text: str, stage: str) -> PlannedHypothesis:
        """The hypothesis `text` of a plan whose default stage is `stage`."""
        relation, sides = Hypothesis.of(text).relation, Hypothesis.of(text).sides
        whole = [{"stage": stage, **side} for side in sides]
        meaning = (relation, *(frozenset(side.items()) for side in whole))
        return cls(meaning, text, frozenset(side["stage"] for side in whole))


class AnalysisPlan(StrictModel, strict=True):
    """A question, and everything needed to decide it."""

    question: Line | None
    hypotheses: tuple[Line, ...] = Field(min_length=1, max_length=50, strict=False)
    stage: Line
    """Stage of the conditions, unless a hypothesis names another one."""
    metric: Literal["auc", "auc_total", "final"]
    primary_metric: Line
    """`metric` in words."""
    margin: float | None = Field(gt=0)
    seeds: Line
    control: Line
    """What is held equal so that different q can be compared."""
    budget: dict[Line, int]
    """Environment steps over which runs are compared, by task: the fewest of any stage."""
    test: Line
    more_steps: dict[Line, dict[Line, int]] = Field({})
    """The steps of stages that have more than `budget`, by stage and task."""

    @model_validator(mode="after")
    def _are_hypotheses(self) -> Self:
        for text in self.hypotheses:
            Hypothesis.of(text)
        return self

    @property
    def planned(self) -> tuple[PlannedHypothesis, ...]:
        """The hypotheses, without those that repeat an earlier one."""
        return tuple(dict.fromkeys(PlannedHypothesis.of(t, self.stage) for t in self.hypotheses))

    @property
    def stages(self) -> frozenset[str]:
        return frozenset[str]().union(*(one.stages for one in self.planned))

    def seeds_of(self, stage: str) -> str:
        """The seeds of a stage in words."""
        parts = re.split(r"; (?=[^;:]+: )", self.seeds)
        return dict(part.split(": ", 1) for part in parts if ": " in part).get(stage, self.seeds)

    @property
    def seed_count(self) -> int:
        """Number of seeds of each condition; 0 if stages have different seeds."""
        fresh = re.match(r"(\d+) fresh ones; [^;:]*$", self.seeds)
        if fresh is not None:
            return int(fresh[1])
        return len(self.seeds.split(", ")) if re.fullmatch(r"-?\d+(, -?\d+)*", self.seeds) else 0

    @property
    def hash(self) -> str:
        # A field that a version of the package adds must not change the hashes of earlier plans.
        return content_key(self.model_dump(mode="json", exclude_defaults=True))

    def steps(self, stages: Collection[str], task: str) -> float:
        """Environment steps over which runs of these stages are compared; infinite if unknown."""
        least = self.budget.get(task, np.inf)
        return min(self.more_steps.get(stage, {}).get(task, least) for stage in stages)

    def has_same_test(self, other: AnalysisPlan) -> bool:
        return (self.metric, self.margin) == (other.metric, other.margin)

    def asks_as(self, other: AnalysisPlan) -> bool:
        """Whether the `analysis` section is the same; seeds and budgets may differ."""
        asked = {"question", "hypotheses", "stage", "metric", "margin"}
        return self.model_dump(include=asked) == other.model_dump(include=asked)

    def is_part_of(self, other: AnalysisPlan) -> bool:
        """Whether this is `other`, possibly for a subset of its seeds."""
        own, others = (set(plan.seeds.split(", ")) for plan in (self, other))
        return own <= others and self == other.model_copy(update={"seeds": self.seeds})


class PlanVersion(StrictModel, strict=True):
    """A recorded version of a plan."""

    version: int = Field(ge=1)
    recorded_ms: int = Field(ge=0, lt=2**47)
    hash: str
    plan: AnalysisPlan

    @model_validator(mode="after")
    def _is_what_was_recorded(self) -> Self:
        if self.plan.hash != self.hash:
            raise ValueError(f"the plan must have the hash that it was recorded with, {self.hash}")
        return self

    @property
    def recorded(self) -> str:
        """`2026-11-23 07:20 UTC`."""
        return datetime.fromtimestamp(self.recorded_ms / 1000, UTC).strftime("%Y-%m-%d %H:%M UTC")


_VERSIONS = TypeAdapter(tuple[PlanVersion, ...])


def checked_plans(document: Any) -> tuple[PlanVersion, ...]:
    """Validate versions from plain data that may come from strangers, and sort them by time.

    Raises:
        ValueError: The data are malformed, or a plan does not have its recorded hash.
    """
    if not isinstance(document, list) or len(document) > MOST_VERSIONS:
        raise ValueError(f"must be a list of at most {MOST_VERSIONS} versions of a plan")
    versions = _VERSIONS.validate_python(document)
    return tuple(sorted(versions, key=lambda one: one.recorded_ms))


def as_document(versions: Sequence[PlanVersion]) -> list[dict[str, Any]]:
    """Inverse of :func:`checked_plans`."""
    return [version.model_dump(mode="json", exclude_defaults=True) for version in versions]


def with_plan(
    versions: tuple[PlanVersion, ...], plan: AnalysisPlan, now_ms: int
) -> tuple[PlanVersion, ...]:
    """Append `plan` to `versions` as a new version, unless the last version has it."""
    if versions and versions[-1].hash == plan.hash:
        return versions
    new = PlanVersion(version=len(versions) + 1, recorded_ms=now_ms, hash=plan.hash, plan=plan)
    return (*versions, new)


def as_markdown(name: str, versions: Sequence[PlanVersion]) -> str:
    """The versions as Markdown, the newest first."""
    parts = [f"# Analysis plan of {name}\n\n{_NOTE}\n"]
    for one in reversed(versions):
        content = one.plan.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=88)
        parts.append(
            f"## Version {one.version}\n\nRecorded {one.recorded}. Hash of the plan "
            f"(SHA-256, first digits): `{one.hash}`\n\n```yaml\n{text}```\n"
        )
    return "\n".join(parts)


# From the configuration ---------------------------------------------------------------------------


def analysis_plan(config: SweepConfig) -> AnalysisPlan | None:
    """The plan of a sweep's `analysis` section; None without one."""
    analysis = config.analysis
    if analysis is None:
        return None
    default = analysis.stage or config.stages[-1].name
    planned = [PlannedHypothesis.of(text, default) for text in analysis.hypotheses]
    about = frozenset[str]().union(*(one.stages for one in planned))
    stages = [stage for stage in config.stages if stage.name in about]
    metrics = sorted({task.primary_metric for stage in stages for task in stage.tasks})
    margin = analysis.margin
    if margin is None and metrics == [names.EVAL_SUCCESS]:
        margin = MARGIN_OF_A_RATE
    steps = _steps(stages, config if analysis.metric == "auc_total" else None)
    tasks = dict.fromkeys(task for own in steps.values() for task in own)
    budget = {task: min(own[task] for own in steps.values() if task in own) for task in tasks}
    more = {
        stage: {task: number for task, number in own.items() if number > budget[task]}
        for stage, own in steps.items()
    }
    return AnalysisPlan(
        question=analysis.question,
        hypotheses=analysis.hypotheses,
        stage=default,
        metric=analysis.metric,
        primary_metric=_PRIMARY[analysis.metric].format(metric=" or ".join(metrics)),
        margin=margin,
        seeds=_of_each({stage.name: _seeds(stage, config.seeds) for stage in stages}),
        control=_of_each({stage.name: _control(stage) for stage in stages}),
        budget=budget,
        test=_TEST,
        more_steps={stage: own for stage, own in more.items() if own},
    )


def _of_each(texts: Mapping[str, str]) -> str:
    """The text of each stage, or one text if all stages have the same."""
    if len(set(texts.values())) == 1:
        return next(iter(texts.values()))
    return "; ".join(f"{name}: {text}" for name, text in texts.items())


def _seeds(stage: Stage, seeds: Sequence[int]) -> str:
    listed = ", ".join(map(str, seeds))
    if stage.search is None or stage.search.final is None:
        return listed
    return f"{stage.search.final.seeds} fresh ones; {listed} for the tuning"


def _control(stage: Stage) -> str:
    search = stage.search
    if search is not None:
        tuned = ", ".join(search.space)
        each = f" for each value of {', '.join(search.compare)}" if search.compare else ""
        return f"{tuned} tuned{each}, with {search.count} trials"
    runs = [run for point in stage.points for run in point.runs.values()]
    pairs = {(setting_text(run.tac.entropic_index), setting_text(run.tac.alpha)) for run in runs}
    words = sorted({alpha for _, alpha in pairs})
    if len(words) > 1 and len(dict(pairs)) == len(pairs):
        own = ", ".join(f"{alpha} at q = {q}" for q, alpha in sorted(pairs))
        return f"α of its own for each q: {own}"
    of_tasks: dict[str, set[str]] = {}
    for point in stage.points:
        for task, run in point.runs.items():
            of_tasks.setdefault(task, set()).add(setting_text(run.tac.alpha))
    if len(words) > 1 and all(len(own) == 1 for own in of_tasks.values()):
        texts = ", ".join(f"{min(own)} on {task}" for task, own in of_tasks.items())
        return f"α of its own for each task: {texts}"
    if len(words) > 1:
        return f"α varied: {', '.join(words)}; differences are means over it"
    return f"α {words[0]}" if is_controlled(words[0]) else f"none: one α of {words[0]} for all"


def is_controlled(alpha: str) -> bool:
    """Whether α, in words, adapts so that policies of different q can be compared."""
    return any(word in alpha for word in ("matched", "learned", "normalised"))


def _steps(stages: Sequence[Stage], pretrained_in: SweepConfig | None) -> dict[str, dict[str, int]]:
    """Smallest budget by stage and task; in a search, of its runs on fresh seeds.

    Pretraining stages of the sweep `pretrained_in` count; None: pretraining does not count.
    """
    found: dict[str, dict[str, int]] = {}
    for stage in stages:
        final = stage.search.final if stage.search else None
        of_stage = found.setdefault(stage.name, {})
        for point in stage.points:
            for task, run in point.runs.items():
                steps = (final.env_steps if final else None) or run.env_steps
                if pretrained_in is not None:
                    steps += _steps_before(pretrained_in, stage, task)
                of_stage[task] = min(of_stage.get(task, steps), steps)
    return found


def _steps_before(config: SweepConfig, stage: Stage, task: str) -> int:
    """Environment steps of the pretraining of a stage's runs on a task."""
    if stage.source is None or stage.source.stage is None:
        return 0
    source = config.stage(stage.source.stage)
    own = stage.source.task.name if stage.source.task else task
    steps = min(point.runs[own].env_steps for point in source.points)
    return steps + _steps_before(config, source, own)


def plans_in(storage: str, name: str) -> tuple[PlanVersion, ...]:
    """Versions of a sweep's plan, the oldest first; empty if none was recorded.

    Raises:
        StorageError: The versions can't be read or are malformed.
    """
    location = SweepLocation(storage=storage, name=name)
    document = location.read(ANALYSIS_PLAN)
    try:
        return () if document is None else checked_plans(document)
    except ValueError as error:
        raise StorageError(
            f"{location.place}/{ANALYSIS_PLAN} must hold the versions of an analysis plan "
            f"as they were recorded: {reason_of(error)}"
        ) from error


def record_plan(
    sweep: OpenSweep, *, only_questions: bool = False
) -> tuple[Sequence[PlanVersion], tuple[str, ...]]:
    """Record the plan of a sweep's configuration as a new version if it changed.

    With `only_questions`, a plan that asks what the last version asks is not recorded: `plan` can
    show other seeds and budgets, which count when they are run.

    Returns:
        All versions; and the hypotheses of a new one that neither the version before it has, with
        the same test, nor the last one before the first result of their stages.

    Raises:
        StorageError: The plan can't be written, or earlier versions can't be read.
    """
    before = plans_in(sweep.storage, sweep.config.name)
    plan = analysis_plan(sweep.config)
    if plan is None:
        return before, ()
    if only_questions and before and plan.asks_as(before[-1].plan):
        return before, ()
    versions = with_plan(before, plan, int(time.time() * 1000))
    if len(versions) == len(before):
        return versions, ()
    sweep.location.keep(ANALYSIS_PLAN, as_json(as_document(versions)))
    sweep.location.keep(PLANS_TO_READ, as_markdown(sweep.config.name, versions))
    first = _first_results(sweep)

    def is_known(hypothesis: PlannedHypothesis) -> bool:
        time = min(first.get(stage, np.inf) for stage in hypothesis.stages)
        in_time = [one for one in versions if one.recorded_ms < time][-1:]
        return any(
            hypothesis in one.plan.planned and plan.has_same_test(one.plan)
            for one in (*in_time, *before[-1:])
        )

    return versions, tuple(one.text for one in plan.planned if not is_known(one))


def _first_results(sweep: OpenSweep) -> dict[str, int]:
    """Stage to the time of its first result in ms, also of runs with other `env_steps`."""
    stages = {node.key: node.stage for node in sweep.plan.nodes}
    searched = {stage.name for stage in sweep.plan.searched}
    for one in sweep.recorded.get("nodes", ()):  # the plan does not have a search's trials yet
        if (stage := one["label"].partition("/")[0]) in searched:
            stages[one["key"]] = stage
    shown = results_of_other_budgets(sweep).items()
    times = [(stages[key], int(tags[names.TAG_EARLIER_RESULT])) for key, tags in shown]
    for key in sweep.store.finished(stages):
        with contextlib.suppress(StorageError):  # the result of a damaged run is not known
            times.append((stages[key], sweep.store.history(key)[-1].timestamp_ms))
    return {stage: min(time for one, time in times if one == stage) for stage, _ in times}
