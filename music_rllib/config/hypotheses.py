"""Whether hypotheses are about conditions that a sweep has, and what else these differ in."""

from __future__ import annotations

import contextlib
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from music_rllib.config.analysis import SETTINGS_IN_SHORT, Analysis, Hypothesis, parsed
from music_rllib.config.problems import ConfigError, Findings, lookup, same, shown
from music_rllib.config.tac_settings import Alpha, setting_text
from music_rllib.names import EVAL_RETURN, EVAL_SUCCESS
from music_rllib.schedules import AdaptiveSchedule

if TYPE_CHECKING:
    from music_rllib.config.schema import Stage

_SCHEDULE: TypeAdapter[Any] = TypeAdapter(Alpha | AdaptiveSchedule)


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
    runs = {name: _compared_runs(stage) for name, stage in stages.items() if stage is not None}
    for position, text in enumerate(analysis.hypotheses):
        hypothesis = Hypothesis.of(text)
        path = ("analysis", "hypotheses", position)
        for condition in (hypothesis.first, hypothesis.second):
            name = condition.get("stage", default)
            if name is None or name not in stages:
                findings.add(path, f"must name one of the stages {', '.join(stages)}, got {name!r}")
            elif (stage := stages[name]) is not None:
                metrics |= {task.primary_metric for task in stage.tasks}
                broken = _broken_rule(stage, runs[name], condition)
                if broken := broken or _broken_final(stage, condition):
                    findings.add(path, broken)
    if analysis.margin is None and EVAL_RETURN in metrics:
        findings.add(("analysis", "margin"), "must be given for tasks without success, got null")
    if (analysis.margin or 0) >= 1 and metrics == {EVAL_SUCCESS}:
        rule = f"must be < 1 for a success rate (5 % are 0.05), got {analysis.margin:g}"
        findings.add(("analysis", "margin"), rule)


def _compared_runs(stage: Stage) -> list[dict[str, Any]]:
    """A run of each point of a grid, or compared value of a search; none if one is invalid."""
    points = list(stage.points)
    if stage.search is not None and stage.search.compare:
        own = [{k: v for k, v in arm.items() if ":" not in k} for arm in stage.search.compared()]
        try:
            points = [stage.resolve(arm) for arm in own]
        except ConfigError:
            return []
    if not all(point.runs for point in points):
        return []
    return [next(iter(point.runs.values())).model_dump(mode="json") for point in points]


def _broken_rule(
    stage: Stage, runs: Sequence[Mapping[str, Any]], condition: Mapping[str, str]
) -> str | None:
    """The rule that a condition breaks; None if the stage has such runs."""
    space = [name for name in (stage.search.space if stage.search else ()) if ":" not in name]
    if not runs:  # the stage's settings are invalid, which is a problem of its own
        return None
    for name, text in condition.items():
        if isinstance(parsed(text), Mapping):
            return (
                "must name a schedule in words, like '1 to 2' or 'learned', and of another setting "
                f"a part, like '{name}.{next(iter(parsed(text)), 'kind')} = ...', got {text}"
            )
        if name == "stage" or _is_in(name, space):
            continue
        values = _values(runs, name)
        if not values:
            compared = stage.search.compare if stage.search else ()
            points = [*(name for point in stage.points for name in point.values), *compared]
            varied = dict.fromkeys([*(name for name in points if ":" not in name), *space])
            settings = ", ".join(varied) or "nothing"
            return f"must name settings, of which {stage.name} varies {settings}, got {name!r}"
        if not any(_equals(text, value) for value in values):
            return f"must name values that {stage.name} has, {name} is {shown(values)}, got {text}"
    fixed = {k: v for k, v in condition.items() if k != "stage" and not _is_in(k, space)}
    if not any(_has(run, fixed) for run in runs):
        pairs = ", ".join(f"{name} = {text}" for name, text in fixed.items())
        return f"must name values that a run of {stage.name} has together, got {pairs}"
    return None


def _broken_final(stage: Stage, condition: Mapping[str, str]) -> str | None:
    """The rule that a search's final ranking breaks; None if it leaves runs to compare.

    Two conditions are compared that are alike in the rest, which tuned settings are by chance only.
    """
    search = stage.search
    if search is None:
        return None
    if search.final is None:
        return (
            f"must be about runs on fresh seeds: write final: {{trials: 1}} in the search of "
            f"{stage.name}, got final: null"
        )
    if search.sampler == "grid" and search.final.trials >= search.count:
        return None
    if search.final.trials == 1:
        named = [name for name in condition if _is_in(name, list(search.space))]
        if not named:
            return None
        return (
            "must not name what is tuned, as only the best trial has runs on fresh seeds: compare "
            f"its values by mode: compare in the search of {stage.name}, got {named[0]!r}"
        )
    tuned = [name for name, dimension in search.space.items() if not dimension.when]
    if all(any(_is_in(name, [one]) for name in condition) for one in tuned):
        return None
    return (
        f"must name every setting in the space of {stage.name}, or be about the best trial alone: "
        "write final: {trials: 1}, and mode: compare with the values that are compared, "
        f"got final.trials: {search.final.trials}"
    )


def _is_in(name: str, settings: Sequence[str]) -> bool:
    """Whether a setting is one of these, a part of one or in a group of these."""
    return any(f"{name}.".startswith(f"{one}.") for one in settings)


def _values(runs: Sequence[Mapping[str, Any]], name: str) -> list[Any]:
    """The different values of a setting that runs have."""
    values: dict[str, Any] = {}
    for run in runs:
        with contextlib.suppress(LookupError):
            value = _value(run, name)
            values[json.dumps(value)] = value
    return list(values.values())


def _value(run: Mapping[str, Any], name: str) -> Any:
    """A setting of a run as MLflow has it: a schedule, whose params are its parts, in words.

    Raises:
        LookupError: The run has no such setting.
    """
    value = lookup(run, name.split("."))
    if isinstance(value, Mapping) and name in SETTINGS_IN_SHORT.values():
        return setting_text(_SCHEDULE.validate_python(value))
    return value


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
        return all(_equals(text, _value(run, name)) for name, text in settings.items())
    except LookupError:
        return False


def _equals(text: str, value: Any) -> bool:
    return text == value or same(parsed(text), value)
