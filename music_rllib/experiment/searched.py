"""A searched stage checked before anything starts: its space, its objective, its source."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from music_rllib.envs.registry import closest
from music_rllib.experiment.model import Point, Source, Stage, StageHeader
from music_rllib.experiment.problems import Findings, shown
from music_rllib.experiment.problems import Path as KeyPath
from music_rllib.experiment.space import SearchSettings
from music_rllib.tracking import names

__all__ = ["check_search", "of_stage", "stages_in"]

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
    resolve_at: ResolveAt,
    path: KeyPath,
    findings: Findings,
) -> None:
    """Note what is wrong with a stage's `search` and with what it is searched from."""
    search = header.search
    assert search is not None
    place = (*path, "search")
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
    points: list[dict[str, tuple[KeyPath, Any]]] = [
        {name: (("search", *at), value) for name, (at, value) in corner.items()}
        for corner in search.corners()
    ]
    points += [
        {name: (("search", "compare", name, position), value)}
        for name, values in search.compare.items()
        for position, value in enumerate(values)
    ]
    for point in points:
        resolve_at({name: at for name, at in point.items() if ":" not in name}, findings)
        if above is not None:
            _check_above(above, point, place[:-1], findings)
    _check_points(search, place, findings)


def _check_above(
    above: Stage, point: Mapping[str, tuple[KeyPath, Any]], path: Place, findings: Findings
) -> None:
    """Settings of the stage above, with the problems at their place in this one."""
    from music_rllib.experiment.problems import ConfigError

    theirs = of_stage({name: value for name, (_, value) in point.items()}, above.name)
    if not theirs:
        return
    try:
        above.resolve(theirs)
    except ConfigError as error:
        name = next(name for name in point if name.startswith(f"{above.name}:"))
        for line in error.lines:
            findings.add((*path, *point[name][0]), f"in stage {above.name}, {line}")


def _check_points(search: SearchSettings, place: Place, findings: Findings) -> None:
    from music_rllib.experiment.space import Choice

    for position, point in enumerate(search.points_to_evaluate):
        for name, value in point.items():
            dimension = search.space[name]
            if isinstance(dimension, Choice):
                inside = value in dimension.choice
                rule = f"must be one of {shown(list(dimension.choice))}"
            else:
                low, high = dimension.ends()
                number = isinstance(value, int | float) and not isinstance(value, bool)
                inside = number and low <= float(str(value)) <= high
                rule = f"must be in [{low:g}, {high:g}]"
            if not inside:
                findings.add(
                    (*place, "points_to_evaluate", position, name), f"{rule}, got {shown(value)}"
                )
