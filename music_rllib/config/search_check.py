"""Checks of a searched stage before anything starts: its space, its objective, its source."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from music_rllib import names
from music_rllib.config.layers import PlacedPoint
from music_rllib.config.problems import ConfigError, Findings, KeyPath, shown
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Point, Stage
from music_rllib.config.search import SearchSettings
from music_rllib.config.space import Choice
from music_rllib.envs.tasks import closest

ResolveAt = Callable[[PlacedPoint, Findings], Point]

_METRICS = frozenset(
    value
    for key, value in vars(names).items()
    if key.isupper()
    and isinstance(value, str)
    and not value.isupper()  # a variable of the environment
    and not key.startswith(("TAG_", "KIND_", "ARTEFACT_", "SETTING_"))
)
_OF_SUCCESS = frozenset(
    {names.EVAL_SUCCESS, names.EVAL_SUCCESS_ANY, names.TRAIN_SUCCESS, names.TRAIN_SUCCESS_ANY}
)
"""Metrics of tasks that declare success."""


def of_stage(values: Mapping[str, Any], stage: str) -> dict[str, Any]:
    """The dotted settings that have the prefix of `stage`, without it."""
    prefix = f"{stage}:"
    return {
        name.removeprefix(prefix): value
        for name, value in values.items()
        if name.startswith(prefix)
    }


def stages_in(search: SearchSettings) -> set[str]:
    """Stages whose settings are part of the search, besides its own."""
    return {name.partition(":")[0] for name in (*search.space, *search.compare) if ":" in name}


def check_search(
    stage: Stage,
    search: SearchSettings,
    earlier: Mapping[str, Stage | None],
    seeds: int,
    resolve_at: ResolveAt,
    findings: Findings,
) -> None:
    """Check a stage's `search` and the stage that its runs start from.

    Args:
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
    above = _source_of(stage, earlier)
    source = above
    while source is not None:
        if source.search is None and len(source.points) > 1:
            findings.add(
                ("init_from",),
                "must lead to stages without a grid where trials are searched, got "
                f"{source.name!r}; search its settings as '{source.name}:...'",
            )
        source = _source_of(source, earlier)
    _check_values(search, above, resolve_at, findings)
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
    search: SearchSettings, above: Stage | None, resolve_at: ResolveAt, findings: Findings
) -> None:
    """Every end of the space, compared value and given point must make valid settings."""
    in_search = findings.below("search")
    for name in stages_in(search):
        if above is None or name != above.name:
            known = f", which is {above.name!r}" if above else "; this one starts from none"
            in_search.add(
                ("space",),
                f"must name settings of this stage or of the one it starts from{known}, "
                f"got '{name}:...'",
            )
            return
    problems_before = len(findings.problems)
    for name, values in search.compare.items():
        in_search.forbid_repeats(values, ("compare", name))
    for name, dimension in search.space.items():
        if isinstance(dimension, Choice):
            in_search.forbid_repeats(dimension.choice, ("space", name, "choice"))
    tried: list[tuple[KeyPath, Any, _Runs]] = []
    for section, name, point in _points_to_check(search):
        if name not in point:
            rule = f"must be able to hold, got {shown(search.space[name].when)}"
            in_search.add((section, name, "when"), rule)
            continue
        placed = {key: at for key, at in point.items() if ":" not in key}
        own = resolve_at(placed, findings)
        if search.final is not None and search.final.env_steps is not None:
            budget = (("search", "final", "env_steps"), search.final.env_steps)
            resolve_at({**placed, "env_steps": budget}, findings)
        theirs = None if above is None else _runs_above(above, point, findings)
        tried.append(((section, name), point[name][1], (own.runs, theirs)))
    if len(findings.problems) == problems_before:
        _forbid_equal_values(tried, in_search)
    _check_given_points(search, in_search)


_Runs = tuple[Mapping[str, RunSettings], Mapping[str, RunSettings] | None]
"""Settings of a stage's runs by task, and of the runs that they start from."""


def _points_to_check(search: SearchSettings) -> Iterator[tuple[str, str, PlacedPoint]]:
    """Section and name of a setting, and a point that has one of its values to check."""
    for name, corner in search.corners():
        point = {key: (("search", "space", key), value) for key, value in corner.items()}
        yield "space", name, point
    for name, values in search.compare.items():
        for position, value in enumerate(values):
            yield "compare", name, {name: (("search", "compare", name, position), value)}


def _forbid_equal_values(tried: Sequence[tuple[KeyPath, Any, _Runs]], findings: Findings) -> None:
    """Two values may be two spellings of one schedule, and so the same runs."""
    for (where, _, one), (elsewhere, value, other) in itertools.combinations(tried, 2):
        if where == elsewhere and one == other and other[0]:
            findings.add(where, f"must not have two equal values, got {shown(value)} again")


def _runs_above(
    above: Stage, point: PlacedPoint, findings: Findings
) -> Mapping[str, RunSettings] | None:
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


def _check_given_points(search: SearchSettings, findings: Findings) -> None:
    """Each value of `points_to_evaluate` must be in the space, and beside what it depends on.

    The sampler chooses what a point leaves open: a setting that depends on that might be dropped.
    """
    for position, point in enumerate(search.points_to_evaluate):
        existing: dict[str, Any] = {}
        for name, dimension in search.space.items():
            if name not in point:
                continue
            path, value = ("points_to_evaluate", position, name), point[name]
            if not dimension.contains(value):
                findings.add(path, f"must be {dimension.rule}, got {shown(value)}")
            elif dimension.applies(existing):
                existing[name] = value
            else:
                wanted = " and ".join(f"{key}: {shown(one)}" for key, one in dimension.when.items())
                findings.add(path, f"must only be given beside {wanted}, got {shown(point)}")
