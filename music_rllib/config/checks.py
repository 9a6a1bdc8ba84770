"""Checks of searches and of hypotheses, before anything starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from music_rllib import names
from music_rllib.config.layers import PlacedPoint, is_in
from music_rllib.config.problems import ConfigError, Findings, KeyPath, shown, unknown
from music_rllib.config.run_settings import VARIANTS, RunSettings
from music_rllib.config.schema import Analysis, Hypothesis, Point, Stage, same_value
from music_rllib.config.search import SearchSettings, of_stage
from music_rllib.config.space import Choice, FloatRange
from music_rllib.config.tac_settings import setting_text
from music_rllib.envs.tasks import closest
from music_rllib.redaction import flat_params

_OF_SUCCESS = frozenset(
    {names.EVAL_SUCCESS, names.EVAL_SUCCESS_ANY, names.TRAIN_SUCCESS, names.TRAIN_SUCCESS_ANY}
)
"""Metrics of tasks that declare success."""
_OF_OBJECTS = frozenset(
    {names.EVAL_DISPLACEMENT, names.EVAL_TOUCHED, names.TRAIN_DISPLACEMENT, names.TRAIN_TOUCHED}
)
"""Metrics of tasks with a split."""


def check_search(
    stage: Stage,
    search: SearchSettings,
    earlier: Mapping[str, Stage | None],
    seeds: int,
    resolve_at: Callable[[PlacedPoint, Findings], Point],
    findings: Findings,
) -> None:
    """Check a stage's `search` and the stage that its runs start from.

    `earlier` and `findings` are as in `resolve_stage`. `seeds` is the number of the sweep's seeds,
    0 if they are invalid. `resolve_at` gives the stage's settings at a point.
    """
    problems_before = len(findings.problems)
    in_search = findings.below("search")
    for position, objective in enumerate(search.objectives):
        if rule := _broken_metric(objective.metric, stage):
            several = (position,) if len(search.objectives) > 1 else ()
            in_search.add(("objective", *several, "metric"), rule)
    above = source = earlier.get(str(stage.source_stage))
    while source is not None:
        if source.search is None and len(source.points) > 1:
            findings.add(
                ("init_from",),
                "must lead to stages without a grid where trials are searched, got "
                f"{source.name!r}; search its settings as '{source.name}:...'",
            )
        source = earlier.get(str(source.source_stage))
    if foreign := search.stages - ({above.name} if above else set()):
        known = f", which is {above.name!r}" if above else "; this one starts from none"
        in_search.add(
            ("space",),
            f"must name settings of this stage or of the one it starts from{known}, "
            f"got '{min(foreign)}:...'",
        )
        return
    _check_values(search, above, resolve_at, findings)
    _check_points_to_evaluate(search, in_search)
    if len(findings.problems) == problems_before:  # the budget is a valid number then
        _check_rungs(search, seeds, stage.most_env_steps, in_search)


def _broken_metric(metric: str, stage: Stage) -> str | None:
    """The rule that an objective's metric breaks; None if each run reports it."""
    prefixes = (names.SHANNON_OF_DIMENSION, names.ENTROPY_OF_DIMENSION)
    known = {names.ENV_STEPS, names.GRAD_UPDATES} | {
        value
        for key, value in vars(names).items()
        if isinstance(value, str)
        and value.partition("/")[0] in names.GROUPS
        and value not in (*prefixes, names.SYSTEM_SECONDS)  # which is not part of reports
        and not key.startswith(("ARTIFACT_", "SETTING_"))
    }
    of_dimension = any(
        metric.startswith(one) and metric.removeprefix(one).isdecimal() for one in prefixes
    )
    if metric not in known and not of_dimension:
        hint = closest(metric, known)
        return f"must be a metric that runs report, got {shown(metric)}{hint}"
    without = [task.name for task in stage.tasks if task.success_key is None]
    if metric in _OF_SUCCESS and without:
        return (
            f"must be a metric that {', '.join(without)} has too, which declares no success: write "
            f"objective: {{metric: {names.EVAL_RETURN}}}, got {shown(metric)}"
        )
    without = [task.name for task in stage.tasks if not task.has_split]
    if metric in _OF_OBJECTS and without:
        return (
            f"must be a metric that {', '.join(without)} has too, which has no "
            f"surrounding_indices, got {shown(metric)}"
        )
    if metric.startswith("mutual_information/") and not VARIANTS[stage.variant].uses_mi:
        return f"must be a metric of {stage.variant}, which has no estimator, got {metric}"
    return None


def _check_rungs(search: SearchSettings, seeds: int, env_steps: int, findings: Findings) -> None:
    """A trial must reach each rung before its end, or at its end."""
    for position, rung in enumerate(search.pruning.rungs if search.pruning else ()):
        path = ("pruning", "rungs", position)
        if seeds and rung.seeds is not None and rung.seeds > seeds:
            rule = f"must be <= {seeds}, the number of the sweep's seeds, got {rung.seeds}"
            findings.add((*path, "seeds"), rule)
        if env_steps and rung.env_steps is not None and rung.env_steps > env_steps:
            rule = f"must be <= {env_steps}, the longest run's env steps, got {rung.env_steps}"
            findings.add((*path, "env_steps"), rule)


def _check_values(
    search: SearchSettings,
    above: Stage | None,
    resolve_at: Callable[[PlacedPoint, Findings], Point],
    findings: Findings,
) -> None:
    """Every end of the space and every compared value must make valid settings."""
    in_search = findings.below("search")
    problems_before = len(findings.problems)
    for name, values in search.compare.items():
        in_search.forbid_repeats(values, ("compare", name))
    for name, dimension in search.space.items():
        if isinstance(dimension, Choice):
            in_search.forbid_repeats(dimension.choice, ("space", name, "choice"))
    found: list[Any] = []
    for path, example in search.examples():
        section, name = path[0], str(path[1])
        if name not in example:
            rule = f"must be satisfiable, got {shown(search.space[name].when)}"
            in_search.add((section, name, "when"), rule)
            continue
        point: dict[str, tuple[KeyPath, Any]]
        point = {key: (("search", section, key), value) for key, value in example.items()}
        point[name] = (("search", *path), example[name])
        own = {key: at for key, at in point.items() if ":" not in key}
        runs = resolve_at(own, findings).runs
        if search.final is not None and search.final.env_steps is not None:
            budget = (("search", "final", "env_steps"), search.final.env_steps)
            resolve_at({**own, "env_steps": budget}, findings)
        settings = (name, runs, None if above is None else _runs_above(above, point, findings))
        # Two values can be two spellings of one schedule, and so the same runs.
        if len(findings.problems) == problems_before and settings in found and runs:
            value = shown(example[name])
            in_search.add((section, name), f"must not have two equal values, got {value} again")
        found.append(settings)
    if len(findings.problems) == problems_before:
        _check_inside(search, above, resolve_at, findings)


def _check_inside(
    search: SearchSettings,
    above: Stage | None,
    resolve_at: Callable[[PlacedPoint, Findings], Point],
    findings: Findings,
) -> None:
    """A range of real numbers can have valid ends, and only invalid values between them."""
    for path, example in search.examples():
        section, name = path[0], str(path[1])
        dimension = search.space[name] if section == "space" else None
        if not isinstance(dimension, FloatRange) or example[name] != dimension.ends()[0]:
            continue
        if (inside := dimension.inside()) is not None:
            values = {**example, name: inside}
            point = {key: (("search", "space", key), value) for key, value in values.items()}
            resolve_at({key: at for key, at in point.items() if ":" not in key}, findings)
            if above is not None:
                _runs_above(above, point, findings)


def _runs_above(above: Stage, point: PlacedPoint, findings: Findings) -> Mapping[str, Any] | None:
    """Settings of the stage above at a point, with problems at their place in this stage."""
    theirs = of_stage({name: value for name, (_, value) in point.items()}, above.name)
    if not theirs:
        return None
    try:
        return above.resolve({**above.points[0].values, **theirs}).runs
    except ConfigError as error:
        name = next(name for name in point if name.startswith(f"{above.name}:"))
        for line in error.lines:
            findings.add(point[name][0], f"in stage {above.name}, {line}")
        return None


def _check_points_to_evaluate(search: SearchSettings, findings: Findings) -> None:
    """Each given value must be in the space, beside the given values that it depends on.

    The sampler chooses omitted values, so a setting that depends on them could be dropped.
    """
    for position, point in enumerate(search.points_to_evaluate):
        for name, value in point.items():
            dimension, path = search.space.get(name), ("points_to_evaluate", position, name)
            if dimension is None:
                findings.add(path, unknown(name, search.space))
            elif not dimension.contains(value):
                findings.add(path, f"must be {dimension.rule}, got {shown(value)}")
            elif not dimension.applies(point):
                wanted = " and ".join(f"{key}: {shown(one)}" for key, one in dimension.when.items())
                findings.add(path, f"must only be given beside {wanted}, got {shown(point)}")


# Hypotheses ---------------------------------------------------------------------------------------

Settings = Mapping[str, Sequence[str]]
"""Dotted settings of a run to their values as text: in words, and in full if that differs."""


def check_analysis(
    analysis: Analysis, stages: Mapping[str, Stage | None], findings: Findings
) -> None:
    """Check that the hypotheses name conditions that the sweep has."""
    if analysis.stage is not None and analysis.stage not in stages:
        rule = f"must be one of {', '.join(stages)}, got {analysis.stage!r}"
        findings.add(("analysis", "stage"), rule)
        return
    default = analysis.stage or next(reversed(list(stages)), "")
    metrics, unknown = set(), set()
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
                if analysis.metric == "auc_total" and (found := _unknown_steps(stage, stages)):
                    unknown.add(found)
    for rule in sorted(unknown):  # once, however many hypotheses name the stage
        findings.add(("analysis", "metric"), rule)
    if analysis.margin is None and names.EVAL_RETURN in metrics:
        findings.add(("analysis", "margin"), "must be given for tasks without success, got null")
    if (analysis.margin or 0) >= 1 and metrics == {names.EVAL_SUCCESS}:
        rule = f"must be < 1 for a success rate (5% is 0.05), got {analysis.margin:g}"
        findings.add(("analysis", "margin"), rule)


def _unknown_steps(stage: Stage, stages: Mapping[str, Stage | None]) -> str | None:
    """The rule that a stage breaks whose pretraining's steps are unknown."""
    source: Stage | None = stage
    while source is not None and source.source is not None:
        if source.source.checkpoint is not None:
            return (
                "must not be auc_total where pretraining is outside the sweep: "
                f"{source.name!r} starts from a checkpoint"
            )
        source = stages.get(str(source.source_stage))
    return None


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
    params = flat_params(run.model_dump(mode="json"))
    words = {
        "tac.entropic_index": setting_text(run.tac.entropic_index),
        "tac.alpha": setting_text(run.tac.alpha),
        "music.mi_reward_weight": setting_text(run.music.mi_reward_weight),
    }
    both = [{name: (text,) for name, text in texts.items()} for texts in (words, params)]
    return {name: (*both[0].get(name, ()), *both[1].get(name, ())) for name in params | words}


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
        if not any(same_value(text, one) for value in values for one in value):
            has = ", ".join(dict.fromkeys(value[0] for value in values))
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
            "must not name a tuned setting: only the best trial has runs on fresh seeds. Compare "
            f"its values by mode: compare in the search of {stage.name}, got {tuned[0]!r}"
        )
    given = bool(search.points_to_evaluate) and search.final.baselines
    if search.final.trials == 1 and not given:
        return None
    always = [name for name, dimension in search.space.items() if not dimension.when]
    if all(any(is_in(name, one) for name in condition) for one in always):
        return None
    return (
        f"must name every setting in the space of {stage.name}, or be about the best trial alone: "
        f"write final: {{trials: 1{', baselines: false' * given}}}, and mode: compare with the "
        f"values that are compared, got final.trials: {search.final.trials}"
        f"{' and baselines: true' * given}"
    )


def _has(run: Settings, condition: Mapping[str, str]) -> bool:
    return all(
        any(same_value(text, one) for one in run.get(name, ())) for name, text in condition.items()
    )
