"""The `analysis` section of a sweep: hypotheses about its conditions, stated before the runs."""

from __future__ import annotations

import contextlib
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

from pydantic import AfterValidator, Field

from music_rllib.config.problems import Findings, lookup, same, shown
from music_rllib.names import EVAL_RETURN
from music_rllib.schedules import StrictModel

if TYPE_CHECKING:
    from music_rllib.config.run_settings import RunSettings
    from music_rllib.config.schema import Stage

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


class Hypothesis(NamedTuple):
    """Two conditions and the expected relation between them: `q = 1.5 better than q = 1`."""

    text: str
    first: Mapping[str, str]
    """The first condition: dotted setting, or `stage`, to its value."""
    second: Mapping[str, str]
    relation: str
    """`better than`, `worse than`, `equivalent to`, or `against` if nothing is expected."""

    @classmethod
    def of(cls, text: str) -> Self:
        """Parse a hypothesis.

        Raises:
            ValueError: The text is none; says what one looks like.
        """
        words = " ".join(text.split())
        match = _HYPOTHESIS.fullmatch(words)
        first = _condition(match["first"]) if match else {}
        second = _condition(match["second"]) if match else {}
        if match is None or not first or not second or first == second:
            raise ValueError(
                "must be two different conditions with 'better than', 'worse than', 'equivalent "
                f"to' or 'against' between them, like 'q = 1.5 against q = 1', got {text!r}"
            )
        return cls(text=words, first=first, second=second, relation=match["relation"])


def _condition(text: str) -> dict[str, str]:
    """The settings of `q = 1.5, tac.lr = 0.001`; empty if it is no such list."""
    settings = {}
    for part in _NEXT_SETTING.split(text):
        name, _, value = (piece.strip() for piece in part.partition("="))
        name = SETTINGS_IN_SHORT.get(name, name)
        if not name or not value or name in settings:
            return {}
        settings[name] = value
    return settings


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
    """Two conditions each, with `better than`, `worse than`, `equivalent to` or `against` between
    them: `q = 1.5 better than q = 1`. A condition is all runs that have these settings (`q`,
    `alpha`, `weight`, a dotted setting, `stage`); if more settings vary, differences are averaged
    over pairs that are equal in the others."""
    stage: str | None = None
    """Stage of the conditions; null: the last one. A condition may name another."""
    metric: Literal["auc", "final"] = "auc"
    """Number of a run: the mean of the task's primary metric over the budget (the area under its
    curve), or its last value."""
    margin: float | None = Field(None, gt=0)
    """Differences below it do not matter: the margin of equivalence tests. null: 0.05 for a success
    rate; it must be given for a return."""


def check_analysis(
    analysis: Analysis, stages: Mapping[str, Stage | None], findings: Findings
) -> None:
    """Check that the hypotheses are about conditions that the sweep has."""
    if analysis.stage is not None and analysis.stage not in stages:
        rule = f"must be one of {', '.join(stages)}, got {analysis.stage!r}"
        findings.add(("analysis", "stage"), rule)
        return
    default = analysis.stage or next(reversed(list(stages)), None)
    metrics = set()
    for position, text in enumerate(analysis.hypotheses):
        hypothesis = Hypothesis.of(text)
        path = ("analysis", "hypotheses", position)
        for condition in (hypothesis.first, hypothesis.second):
            name = condition.get("stage", default)
            if name is None or name not in stages:
                findings.add(path, f"must name one of the stages {', '.join(stages)}, got {name!r}")
            elif (stage := stages[name]) is not None:
                metrics |= {task.primary_metric for task in stage.tasks}
                if broken := _broken_rule(stage, condition):
                    findings.add(path, broken)
    if analysis.margin is None and EVAL_RETURN in metrics:
        findings.add(("analysis", "margin"), "must be given for tasks without success, got null")


def _broken_rule(stage: Stage, condition: Mapping[str, str]) -> str | None:
    """The rule that a condition breaks; None if the stage has such runs."""
    space = stage.search.space if stage.search else {}
    points = stage.search.arms() if stage.search else [dict(p.values) for p in stage.points]
    runs = [run for point in stage.points for run in list(point.runs.values())[:1]]
    if not runs:  # the stage's settings are invalid, which is a problem of its own
        return None
    for name, text in condition.items():
        if name == "stage" or name in space:
            continue
        values = [point[name] for point in points if name in point] or _values(runs, name)
        if not values:
            varied = dict.fromkeys([*(name for point in points for name in point), *space])
            settings = ", ".join(varied) or "nothing"
            return f"must name settings, of which {stage.name} varies {settings}, got {name!r}"
        if not any(_equals(text, value) for value in values):
            return f"must name values that {stage.name} has, {name} is {shown(values)}, got {text}"
    return None


def _values(runs: Sequence[RunSettings], name: str) -> list[Any]:
    """The values of a setting that runs have."""
    values: list[Any] = []
    for run in runs:
        with contextlib.suppress(LookupError):
            value = lookup(run.model_dump(mode="json"), name.split("."))
            if value is not None and value not in values:
                values.append(value)
    return values


def unnamed_differences(
    analysis: Analysis, stages: Mapping[str, Stage]
) -> Iterator[tuple[str, list[str]]]:
    """Hypotheses whose two sides differ in settings that they do not name, and these settings.

    Without α, as the plan says by what it is controlled, and without MUSIC's, by which stages of
    different variants differ.
    """
    default = analysis.stage or list(stages)[-1]
    runs = {name: list(_documents(stage)) for name, stage in stages.items()}
    for text in analysis.hypotheses:
        hypothesis = Hypothesis.of(text)
        sides = (hypothesis.first, hypothesis.second)
        first, second = (_all_values(runs[side.get("stage", default)], side) for side in sides)
        named = {".".join(key.split(".")[:2]) for side in sides for key in side} | {"tac.alpha"}
        if unnamed := [key for key in first if key not in named and first[key] != second[key]]:
            yield text, unnamed


def _documents(stage: Stage) -> Iterator[dict[str, Any]]:
    for point in stage.points:
        for run in point.runs.values():
            yield run.model_dump(mode="json")


def _all_values(
    runs: Sequence[Mapping[str, Any]], condition: Mapping[str, str]
) -> dict[str, set[str]]:
    """Dotted setting to the values, in words, that it has in the runs of a condition."""
    settings = {name: text for name, text in condition.items() if name != "stage"}
    values: defaultdict[str, set[str]] = defaultdict(set)
    # What is searched is in no run of the stage yet: then they are all alike.
    for run in [run for run in runs if _has(run, settings)] or runs:
        for key in ("env_steps", "num_envs"):
            values[key].add(shown(run[key]))
        for section in ("tac", "replay"):
            for name, value in run[section].items():
                values[f"{section}.{name}"].add(shown(value))
    return values


def _has(run: Mapping[str, Any], settings: Mapping[str, str]) -> bool:
    try:
        return all(_equals(text, lookup(run, name.split("."))) for name, text in settings.items())
    except LookupError:
        return False


def _equals(text: str, value: Any) -> bool:
    try:
        return same(float(text), value)
    except ValueError:
        return text in (value, shown(value))
