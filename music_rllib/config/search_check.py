"""Checks of a searched stage before anything starts: its space, its objective, its source."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from music_rllib import names
from music_rllib.config.layers import PlacedPoint
from music_rllib.config.problems import ConfigError, Findings, shown
from music_rllib.config.schema import Point, Stage
from music_rllib.config.search import SearchSettings
from music_rllib.config.space import Choice
from music_rllib.envs.tasks import closest

_METRICS = frozenset(
    value
    for key, value in vars(names).items()
    if key.isupper()
    and isinstance(value, str)
    and not value.isupper()  # an environment variable
    and not key.startswith(("TAG_", "KIND_", "ARTIFACT_", "SETTING_"))
)
_OF_SUCCESS = frozenset(
    {names.EVAL_SUCCESS, names.EVAL_SUCCESS_ANY, names.TRAIN_SUCCESS, names.TRAIN_SUCCESS_ANY}
)
"""Metrics of tasks that declare success."""


def of_stage(values: Mapping[str, Any], stage: str) -> dict[str, Any]:
    """The dotted settings that have the prefix of `stage`, without the prefix."""
    return {
        name.removeprefix(f"{stage}:"): value
        for name, value in values.items()
        if name.startswith(f"{stage}:")
    }


def stages_in(search: SearchSettings) -> set[str]:
    """Other stages whose settings are part of the search."""
    return {name.partition(":")[0] for name in (*search.space, *search.compare) if ":" in name}


def check_search(
    stage: Stage,
    search: SearchSettings,
    earlier: Mapping[str, Stage | None],
    seeds: int,
    resolve_at: Callable[[PlacedPoint, Findings], Point],
    findings: Findings,
) -> None:
    """Check a stage's `search` and the stage that its runs start from.

    Args:
        stage: The stage.
        search: Its search.
        earlier: The stages above this one by name; None for an invalid one.
        seeds: Number of the sweep's seeds; 0 if they are invalid.
        resolve_at: Gives the stage's settings at a point.
        findings: Takes the problems; its path is the stage's.
    """
    problems_before = len(findings.problems)
    in_search = findings.below("search")
    for position, objective in enumerate(search.objectives):
        if rule := _broken_metric(objective.metric, stage):
            several = (position,) if len(search.objectives) > 1 else ()
            in_search.add(("objective", *several, "metric"), rule)
    above = source = _source_of(stage, earlier)
    while source is not None:
        if source.search is None and len(source.points) > 1:
            findings.add(
                ("init_from",),
                "must lead to stages without a grid where trials are searched, got "
                f"{source.name!r}; search its settings as '{source.name}:...'",
            )
        source = _source_of(source, earlier)
    if foreign := stages_in(search) - ({above.name} if above else set()):
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
        _check_rungs(search, seeds, most_env_steps(search, stage.points), in_search)


def _source_of(stage: Stage, earlier: Mapping[str, Stage | None]) -> Stage | None:
    """The stage that a stage's runs start from; None if there is none, or an invalid one."""
    return earlier.get(stage.source.stage) if stage.source and stage.source.stage else None


def _broken_metric(metric: str, stage: Stage) -> str | None:
    """The rule that an objective's metric breaks; None if each run reports it."""
    if metric not in _METRICS:
        hint = closest(metric, _METRICS)
        return f"must be a metric that runs report, got {shown(metric)}{hint}"
    without = [task.name for task in stage.tasks if task.success_key is None]
    if metric in _OF_SUCCESS and without:
        return (
            f"must be a metric that {', '.join(without)} has too, which declares no success: write "
            f"objective: {{metric: {names.EVAL_RETURN}}}, got {shown(metric)}"
        )
    return None


def most_env_steps(search: SearchSettings, points: Sequence[Point]) -> int:
    """Environment steps of the longest run of a searched stage with these points; 0 if unknown."""
    own = max((run.env_steps for point in points for run in point.runs.values()), default=0)
    if (dimension := search.space.get("env_steps")) is not None:
        return max(*map(int, dimension.ends()), own if dimension.when else 0)
    if "env_steps" in search.compare:
        return max(int(float(str(value))) for value in search.compare["env_steps"])
    return own


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
    found: list[tuple[str, Any, Any]] = []
    for section, name, point in _points_to_check(search):
        if name not in point:
            rule = f"must be satisfiable, got {shown(search.space[name].when)}"
            in_search.add((section, name, "when"), rule)
            continue
        own = {key: at for key, at in point.items() if ":" not in key}
        runs = resolve_at(own, findings).runs
        if search.final is not None and search.final.env_steps is not None:
            budget = (("search", "final", "env_steps"), search.final.env_steps)
            resolve_at({**own, "env_steps": budget}, findings)
        everything = (name, runs, None if above is None else _runs_above(above, point, findings))
        # Two values may be two spellings of one schedule, and so the same runs.
        if len(findings.problems) == problems_before and everything in found and runs:
            value = shown(point[name][1])
            in_search.add((section, name), f"must not have two equal values, got {value} again")
        found.append(everything)


def _points_to_check(search: SearchSettings) -> Iterator[tuple[str, str, PlacedPoint]]:
    """Section and name of a setting, and a point that has one of its values to check."""
    for name, corner in search.corners():
        point = {key: (("search", "space", key), value) for key, value in corner.items()}
        yield "space", name, point
    for name, values in search.compare.items():
        for position, value in enumerate(values):
            yield "compare", name, {name: (("search", "compare", name, position), value)}


def _runs_above(above: Stage, point: PlacedPoint, findings: Findings) -> Mapping[str, Any] | None:
    """Settings of the stage above at a point, with problems at their place in this stage."""
    theirs = of_stage({name: value for name, (_, value) in point.items()}, above.name)
    if not theirs:
        return None
    try:
        return above.resolve(theirs).runs
    except ConfigError as error:
        name = next(name for name in point if name.startswith(f"{above.name}:"))
        for line in error.lines:
            findings.add(point[name][0], f"in stage {above.name}, {line}")
        return None


def _check_points_to_evaluate(search: SearchSettings, findings: Findings) -> None:
    """Each given value must be in the space, and beside the values that it depends on.

    The sampler chooses what a point omits: a setting that depends on that might be dropped.
    """
    for position, point in enumerate(search.points_to_evaluate):
        for name, value in point.items():
            dimension, path = search.space[name], ("points_to_evaluate", position, name)
            if not dimension.contains(value):
                findings.add(path, f"must be {dimension.rule}, got {shown(value)}")
            elif not dimension.applies(point):
                wanted = " and ".join(f"{key}: {shown(one)}" for key, one in dimension.when.items())
                findings.add(path, f"must only be given beside {wanted}, got {shown(point)}")
