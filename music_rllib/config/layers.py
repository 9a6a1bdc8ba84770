"""Merges the layers of run settings: variant < defaults < stage < its task < grid point.

Each value keeps the place where it was written, so that an error in the merged settings is reported
at the line to change.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from music_rllib.config.problems import KeyPath, Problem, known_fields, lookup, shown, unknown
from music_rllib.config.run_settings import (
    LAYER_KEYS,
    SECTIONS,
    VARIANTS,
    RunSettings,
    Variant,
    variant_intrinsic,
    variant_music,
)
from music_rllib.envs.tasks import Task

PlacedPoint = Mapping[str, tuple[KeyPath, Any]]
"""Dotted setting to (place below the stage, value) at one point of a grid or search."""


def all_settings() -> list[str]:
    """Names of all settings of a run; settings in groups have dotted names."""
    return [
        *LAYER_KEYS,
        *(
            f"{section}.{name}"
            for section in SECTIONS
            for name in known_fields(RunSettings, (section,))
        ),
    ]


def is_in(setting: str, group: str) -> bool:
    """Whether a dotted setting is `group`, or below it."""
    return f"{setting}.".startswith(f"{group}.")


def for_a_grid(rule: str, path: KeyPath, settings: Any) -> str:
    """`rule`; with a hint to use a grid if `settings` have several values at `path`."""
    try:
        value = lookup(settings, path)
    except LookupError:
        return rule
    lists = rule.startswith(("must be a list", "must have", "must not"))
    if not isinstance(value, list) or len(path) > 2 or lists:
        return rule
    key = ".".join(map(str, path))
    return f"{rule}; values to compare belong in a stage's grid: {{{key}: {shown(value)}}}"


class Layers:
    """Merged settings as plain data, with the origin of each value."""

    def __init__(self) -> None:
        self.data: dict[str, Any] = {}
        self._origins: dict[KeyPath, KeyPath] = {}

    def put(self, path: KeyPath, value: Any, origin: KeyPath) -> None:
        """Set the value at `path`, which is written at `origin` in the sweep's document."""
        here = self.data
        for position, part in enumerate(map(str, path[:-1]), start=1):
            inner = here.setdefault(part, {})
            if not isinstance(inner, Mapping) and position == 1:  # an invalid group
                return
            if not isinstance(inner, Mapping):
                self._origins[path[:position]] = origin
            here[part] = dict(inner) if isinstance(inner, Mapping) else {}
            here = here[part]
        here[str(path[-1])] = copy.deepcopy(value)
        self._origins[path] = origin

    def origin(self, path: KeyPath, otherwise: KeyPath) -> KeyPath:
        """The place where the value at `path` was written; below `otherwise` for a default."""
        for length in range(len(path), 0, -1):
            if path[:length] in self._origins:
                return self._origins[path[:length]] + path[length:]
        return otherwise + path


def varied_by(name: str, values: Iterable[Any]) -> list[str]:
    """Dotted settings that `values` of a grid or search have: `name`, or the fields of a group."""
    values = list(values)
    group = name.rpartition(":")[2] in SECTIONS
    if not group or not all(isinstance(value, Mapping) for value in values):
        return [name]
    return [f"{name}.{field}" for value in values for field in value]


def field_by_field(point: PlacedPoint) -> PlacedPoint:
    """A point whose groups, `tac: {entropic_index: 1, alpha: 0.05}`, are settings of their own.

    A group stays if one of its fields is also in the point by itself: `merge` rejects it.
    """
    settings: dict[str, tuple[KeyPath, Any]] = {}
    for dotted, (place, value) in point.items():
        fields = varied_by(dotted, [value])
        if any(field in point for field in fields):  # also if it is not a group
            settings[dotted] = (place, value)
        else:
            settings |= {f"{dotted}.{name}": ((*place, name), value[name]) for name in value}
    return settings


def merge(
    variant: Variant,
    task: Task,
    defaults: Mapping[str, Any],
    stage: Mapping[str, Any],
    stage_path: KeyPath,
    point: PlacedPoint,
) -> tuple[Layers, list[Problem]]:
    """Merge variant, defaults, stage, its `per_task` and one point of its grid or search.

    Args:
        defaults: The sweep's `defaults`, with those of its preset.
        stage: The stage's own settings, keys of `LAYER_KEYS` and `per_task` only.
        stage_path: The stage's place in the document.

    Returns:
        The merged settings, and the problems of their layers.
    """
    layers, problems = Layers(), []
    rules = VARIANTS[variant]
    idle = f"has no effect with variant {variant}"
    for field, value in variant_music(variant, task).items():
        layers.put(("music", field), value, ("music", field))
    for field, value in variant_intrinsic(variant).items():
        layers.put(("intrinsic", field), value, ("intrinsic", field))
    task_path = (*stage_path, "per_task", task.name)
    own = stage["per_task"].get(task.name) or {}
    for place, settings in ((("defaults",), defaults), (stage_path, stage), (task_path, own)):
        for path, value in _settings(settings):
            if ".".join(path) not in rules.without_effect:
                layers.put(path, value, (*place, *path))
            elif settings is not defaults:  # `defaults` can have an effect in other stages
                problems.append(Problem((*place, *path), idle))
    for dotted, (below, value) in point.items():
        place = (*stage_path, *below)
        once = place[: place.index(dotted) + 1] if dotted in place else place
        if dotted in rules.without_effect:
            problems.append(Problem(once, idle))
        elif dotted in SECTIONS and isinstance(value, Mapping):
            twice = ", ".join(name for name in value if f"{dotted}.{name}" in point)
            rule = f"must not hold a field that varies by itself too, got {twice}"
            problems.append(Problem(once, rule))
        elif dotted.partition(".")[0] not in (SECTIONS if "." in dotted else LAYER_KEYS):
            known = (*all_settings(), "seeds", "tasks")
            problems.append(Problem(once, unknown(dotted, known)))
        else:
            layers.put(tuple(dotted.split(".")), value, place)
    return layers, problems


def _settings(layer: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Paths and values of a layer's settings, the fields of groups one by one."""
    for key, value in layer.items():
        if key in SECTIONS and isinstance(value, Mapping):
            for field, inner in value.items():
                yield (key, field), inner
        elif key in LAYER_KEYS and (value is not None or key not in SECTIONS):
            yield (key,), value  # `tac:` with nothing below it has no value
