"""A searched stage checked before anything starts: its space, its objective, its source."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from music_rllib import names
from music_rllib.config.problems import ConfigError, Findings, shown
from music_rllib.config.problems import Path as KeyPath
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Point, Source, Stage, StageHeader
from music_rllib.config.search.settings import SearchSettings
from music_rllib.config.search.space import Choice
from music_rllib.envs.tasks import closest

Place = tuple[str | int, ...]
ResolveAt = Callable[[Mapping[str, tuple[KeyPath, Any]], Findings], Point]

_METRICS = frozenset(
    value
    for key, value in vars(names).items()
    if key.isupper()
    and isinstance(value, str)
    and not value.isupper()  # a variable of the environment
    and not key.startswith(("TAG_", "KIND_", "ARTEFACT_", "SETTING_"))
)


def of_stage(values: Mapping[str, Any], stage: str) -> dict[str, Any]:
    """Of dotted settings, those that are `stage`'s by their prefix, without it."""
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
    header: StageHeader,
    source: Source | None,
    earlier: Mapping[str, Stage | None],
    points: Sequence[Point],
    seeds: int,
    resolve_at: ResolveAt,
    path: KeyPath,
    findings: Findings,
) -> None:
    """Note what is wrong with a stage's `search` and with what it is searched from.

    Args:
        header: The stage, which has a search.
        source: What its runs start from.
        earlier: The stages above this one by name; None for one that can't be made out.
        points: The stage as it is without what is searched.
        seeds: How many the sweep has; 0 if that isn't known.
        resolve_at: Makes the stage's settings at a point.
        path: The stage's place in the document.
        findings: Takes the problems.
    """
    search = header.search
    assert search is not None
    place = (*path, "search")
    problems_before = len(findings.problems)
    if header.grid:
        findings.add((*path, "grid"), "must not be given beside search: put it into the space")
    for position, objective in enumerate(search.objectives):
        if objective.metric not in _METRICS:
            where = (*place, "objective", *([position] if len(search.objectives) > 1 else []))
            findings.add(
                (*where, "metric"),
                f"must be a metric that runs report, got {shown(objective.metric)}"
                f"{closest(objective.metric, _METRICS)}",
            )
    above = earlier.get(source.stage) if source is not None and source.stage else None
    if above is not None and above.search is None and len(above.points) > 1:
        findings.add(
            (*path, "init_from"),
            f"must be a stage without a grid where trials are searched, got {above.name!r}; "
            f"search its settings as '{above.name}:...'",
        )
    _check_values(search, above, resolve_at, place, findings)
    if len(findings.problems) == problems_before:  # the budget is a sound number then
        _check_rungs(search, seeds, most_env_steps(search, points), place, findings)


def most_env_steps(search: SearchSettings, points: Sequence[Point]) -> int:
    """Environment steps of a searched stage's longest run; 0 if nothing says so.

    Args:
        search: What is searched or compared.
        points: The stage as it is without that.
    """
    if "env_steps" in search.space:
        return int(max(search.space["env_steps"].ends()))
    if "env_steps" in search.compare:
        return max(int(float(str(value))) for value in search.compare["env_steps"])
    return max((run.env_steps for point in points for run in point.runs.values()), default=0)


def _check_rungs(
    search: SearchSettings, seeds: int, env_steps: int, place: Place, findings: Findings
) -> None:
    """A rung must be reached before a trial ends, or at its end."""
    for position, rung in enumerate(search.pruning.rungs if search.pruning else ()):
        here = (*place, "pruning", "rungs", position)
        if seeds and rung.seeds is not None and rung.seeds > seeds:
            rule = f"must be <= {seeds}, the number of the sweep's seeds, got {rung.seeds}"
            findings.add((*here, "seeds"), rule)
        if env_steps and rung.env_steps is not None and rung.env_steps > env_steps:
            rule = f"must be <= {env_steps}, the longest run's env steps, got {rung.env_steps}"
            findings.add((*here, "env_steps"), rule)


def _check_values(
    search: SearchSettings,
    above: Stage | None,
    resolve_at: ResolveAt,
    place: Place,
    findings: Findings,
) -> None:
    """Every end of the space, each compared value and each given point must make sound settings."""
    for stage in stages_in(search):
        if above is None or stage != above.name:
            known = f", which is {above.name!r}" if above else "; this one starts from none"
            findings.add(
                (*place, "space"),
                f"must name settings of this stage or of the one it starts from{known}, "
                f"got '{stage}:...'",
            )
            return
    problems_before = len(findings.problems)
    for name, values in search.compare.items():
        findings.forbid_repeats(values, (*place, "compare", name))
    for name, dimension in search.space.items():
        if isinstance(dimension, Choice):
            findings.forbid_repeats(dimension.choice, (*place, "space", name, "choice"))
    tried: list[tuple[KeyPath, Any, _Runs]] = []
    for where, point in _worth_trying(search):
        if where[-1] not in point:
            rule = f"must be able to hold, got {shown(search.space[str(where[-1])].when)}"
            findings.add((*place, *where, "when"), rule)
            continue
        own = resolve_at({name: at for name, at in point.items() if ":" not in name}, findings)
        theirs = None if above is None else _check_above(above, point, place[:-1], findings)
        tried.append((where, point[str(where[-1])][1], (own.runs, theirs)))
    if len(findings.problems) == problems_before:
        _forbid_equal_values(tried, place, findings)
    _check_points(search, place, findings)


_Runs = tuple[Mapping[str, RunSettings], Mapping[str, RunSettings] | None]
"""Settings of a stage's runs by task, and of those that they start from."""


def _worth_trying(
    search: SearchSettings,
) -> Iterator[tuple[KeyPath, Mapping[str, tuple[KeyPath, Any]]]]:
    """The place of a value below `search`, and a point that shows whether it is sound."""
    for name, corner in search.corners():
        point = {key: (("search", *at), value) for key, (at, value) in corner.items()}
        yield ("space", name), point
    for name, values in search.compare.items():
        for position, value in enumerate(values):
            yield ("compare", name), {name: (("search", "compare", name, position), value)}


def _forbid_equal_values(
    tried: Sequence[tuple[KeyPath, Any, _Runs]], place: Place, findings: Findings
) -> None:
    """Two spellings of one schedule, say: two studies, or two options, of the same runs."""
    for (where, _, one), (elsewhere, value, other) in itertools.combinations(tried, 2):
        if where == elsewhere and one == other and other[0]:
            rule = f"must not have two equal values, got {shown(value)} again"
            findings.add((*place, *where), rule)


def _check_above(
    above: Stage, point: Mapping[str, tuple[KeyPath, Any]], path: Place, findings: Findings
) -> Mapping[str, RunSettings] | None:
    """Settings of the stage above, with the problems at their place in this one."""
    theirs = of_stage({name: value for name, (_, value) in point.items()}, above.name)
    if not theirs:
        return None
    try:
        return above.resolve(theirs).runs
    except ConfigError as error:
        name = next(name for name in point if name.startswith(f"{above.name}:"))
        for line in error.lines:
            findings.add((*path, *point[name][0]), f"in stage {above.name}, {line}")
        return None


def _check_points(search: SearchSettings, place: Place, findings: Findings) -> None:
    """Each given value must be in the space, and beside what it depends on.

    The sampler chooses what a point leaves open: a setting that depends on that might be dropped.
    """
    for position, point in enumerate(search.points_to_evaluate):
        existing: dict[str, Any] = {}
        for name, dimension in search.space.items():
            if name not in point:
                continue
            here, value = (*place, "points_to_evaluate", position, name), point[name]
            if not dimension.contains(value):
                findings.add(here, f"must be {dimension.rule}, got {shown(value)}")
            elif dimension.applies(existing):
                existing[name] = value
            else:
                wanted = " and ".join(f"{key}: {shown(one)}" for key, one in dimension.when.items())
                findings.add(here, f"must only be given beside {wanted}, got {shown(point)}")
