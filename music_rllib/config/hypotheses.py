"""Checks that hypotheses name conditions that a sweep has, and lists their unnamed differences."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from music_rllib.config.analysis import Analysis, Hypothesis, same_value
from music_rllib.config.layers import is_in
from music_rllib.config.problems import ConfigError, Findings
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.tac_settings import setting_text
from music_rllib.names import EVAL_RETURN, EVAL_SUCCESS
from music_rllib.redaction import flat_params

if TYPE_CHECKING:
    from music_rllib.config.schema import Stage

Settings = Mapping[str, str]
"""Dotted settings of a run to their values as text; a schedule in words, and its parts."""


def check_analysis(
    analysis: Analysis, stages: Mapping[str, Stage | None], findings: Findings
) -> None:
    """Check that the hypotheses name conditions that the sweep has."""
    if analysis.stage is not None and analysis.stage not in stages:
        rule = f"must be one of {', '.join(stages)}, got {analysis.stage!r}"
        findings.add(("analysis", "stage"), rule)
        return
    default = analysis.stage or next(reversed(list(stages)), "")
    metrics = set()
    for position, text in enumerate(analysis.hypotheses):
        path = ("analysis", "hypotheses", position)
        for condition in Hypothesis.of(text).sides:
            name = condition.get("stage", default)
            if name not in stages:
                findings.add(path, f"must name one of the stages {', '.join(stages)}, got {name!r}")
            elif (stage := stages[name]) is not None:
                metrics |= {task.primary_metric for task in stage.tasks}
                if broken := _broken_rule(stage, condition) or _broken_final(stage, condition):
                    findings.add(path, broken)
    if analysis.margin is None and EVAL_RETURN in metrics:
        findings.add(("analysis", "margin"), "must be given for tasks without success, got null")
    if (analysis.margin or 0) >= 1 and metrics == {EVAL_SUCCESS}:
        rule = f"must be < 1 for a success rate (5 % are 0.05), got {analysis.margin:g}"
        findings.add(("analysis", "margin"), rule)


def _compared_runs(stage: Stage) -> list[Settings]:
    """A run of each point of a grid, or compared value of a search; none if one is invalid."""
    points = list(stage.points)
    if stage.search is not None and stage.search.compare:
        compared = stage.search.compared()
        own = [{k: v for k, v in values.items() if ":" not in k} for values in compared]
        try:
            points = [stage.resolve(values) for values in own]
        except ConfigError:
            return []
    if not all(point.runs for point in points):
        return []
    return [_settings(next(iter(point.runs.values()))) for point in points]


def _settings(run: RunSettings) -> Settings:
    """The settings of a run as tracking has them: params, and schedules in words."""
    return flat_params(run.model_dump(mode="json")) | {
        "tac.entropic_index": setting_text(run.tac.entropic_index),
        "tac.alpha": setting_text(run.tac.alpha),
        "music.mi_reward_weight": setting_text(run.music.mi_reward_weight),
    }


def _broken_rule(stage: Stage, condition: Mapping[str, str]) -> str | None:
    """The rule that a condition breaks; None if the stage has such runs."""
    if mapping := next((text for text in condition.values() if text.startswith("{")), None):
        return f"must name a schedule in words, like '1 to 2' or 'learned', got {mapping}"
    search, runs = stage.search, _compared_runs(stage)
    if not runs:  # the stage's settings are invalid, which is a problem of its own
        return None
    space = [name for name in (search.space if search else ()) if ":" not in name]
    fixed = {
        name: text
        for name, text in condition.items()
        if name != "stage" and not any(is_in(name, one) for one in space)
    }
    for name, text in fixed.items():
        values = list(dict.fromkeys(run[name] for run in runs if name in run))
        if not values:
            varied = [*(key for point in stage.points for key in point.values)]
            varied += [key for key in (search.compare if search else ()) if ":" not in key]
            settings = ", ".join(dict.fromkeys([*varied, *space])) or "nothing"
            return f"must name settings, of which {stage.name} varies {settings}, got {name!r}"
        if not any(same_value(text, value) for value in values):
            has = ", ".join(values)
            return f"must name values that {stage.name} has ({name}: {has}), got {text}"
    if not any(_has(run, fixed) for run in runs):
        pairs = ", ".join(f"{name} = {text}" for name, text in fixed.items())
        return f"must name values that a run of {stage.name} has together, got {pairs}"
    return None


def _broken_final(stage: Stage, condition: Mapping[str, str]) -> str | None:
    """The rule that a search's final ranking breaks; None if it has runs to compare.

    The two conditions must have equal other settings, which tuned settings have only by chance.
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
    tuned = [name for name in condition if any(is_in(name, one) for one in search.space)]
    if search.final.trials == 1 and tuned:
        return (
            "must not name what is tuned, as only the best trial has runs on fresh seeds: compare "
            f"its values by mode: compare in the search of {stage.name}, got {tuned[0]!r}"
        )
    if search.final.trials == 1:
        return None
    always = [name for name, dimension in search.space.items() if not dimension.when]
    if all(any(is_in(name, one) for name in condition) for one in always):
        return None
    return (
        f"must name every setting in the space of {stage.name}, or be about the best trial alone: "
        "write final: {trials: 1}, and mode: compare with the values that are compared, "
        f"got final.trials: {search.final.trials}"
    )


def _has(run: Settings, condition: Mapping[str, str]) -> bool:
    return all(name in run and same_value(text, run[name]) for name, text in condition.items())


def unnamed_differences(
    analysis: Analysis, stages: Mapping[str, Stage]
) -> Iterator[tuple[str, list[str]]]:
    """Hypotheses whose sides differ in settings that they do not name, and these settings.

    Omits α, which the analysis plan describes, and the settings of MUSIC, in which stages of
    different variants always differ.
    """
    default = analysis.stage or list(stages)[-1]
    for text in analysis.hypotheses:
        sides = Hypothesis.of(text).sides
        named = {".".join(key.split(".")[:2]) for side in sides for key in side} | {"tac.alpha"}
        first, second = (_all_values(stages[side.get("stage", default)], side) for side in sides)
        differ = {key for key in first if first[key] != second[key]}
        if unnamed := sorted({".".join(key.split(".")[:2]) for key in differ} - named):
            yield text, unnamed


def _all_values(stage: Stage, condition: Mapping[str, str]) -> Mapping[str, set[str]]:
    """Dotted setting to the values that it has in the runs of a condition."""
    settings = {name: text for name, text in condition.items() if name != "stage"}
    runs: Sequence[Settings] = [
        _settings(run) for point in stage.points for run in point.runs.values()
    ]
    values: defaultdict[str, set[str]] = defaultdict(set)
    # The stage has no run with a searched setting yet: then all its runs are alike.
    for run in [run for run in runs if _has(run, settings)] or runs:
        for name, value in run.items():
            if name in {"env_steps", "num_envs"} or name.startswith(("tac.", "replay.")):
                values[name].add(value)
    return values
