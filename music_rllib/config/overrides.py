"""`KEY=VALUE` arguments of the command line, which replace values of a sweep's file.

A setting (`tac.alpha=0.1`) holds in every stage and replaces the file's values in `defaults`, in
stages and for single tasks; `stages.NAME.tac.alpha=0.1` changes one stage. A key of the file's top
level (`seeds=5`, `resources.cpus_per_run=2`) replaces the value there.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from music_rllib.config.layers import LAYER_KEYS, SECTIONS, all_settings, varied_by
from music_rllib.config.problems import ConfigError, KeyPath, shown, unknown
from music_rllib.config.schema import Header, StageHeader
from music_rllib.config.yaml_file import read_value

TOP = (*Header.model_fields, "preset", "environments", "defaults", "stages")


class Override(NamedTuple):
    """One argument."""

    key: str
    parts: tuple[str, ...]
    """The parts of the dotted key."""
    value: Any


def parse_overrides(arguments: Iterable[str]) -> dict[str, Override]:
    """Key to override, for `KEY=VALUE` arguments with values in YAML.

    Raises:
        ConfigError: One has no `=`, its key is unknown or repeated, or its value is not YAML.
    """
    overrides: dict[str, Override] = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        parts = tuple(key.split("."))
        if not equals or not all(parts):
            raise _refusal(f"must be KEY=VALUE like tac.alpha=0.1, got {shown(argument)}")
        if parts[0] not in (*LAYER_KEYS, *TOP):
            raise _refusal(f"{key} {unknown(key, (*all_settings(), *TOP))}")
        try:
            value = read_value(text)
        except ValueError as error:
            raise _refusal(f"{key} {error}, got {shown(text)}") from None
        if key == "preset" and isinstance(value, str) and value.endswith((".yaml", ".yml")):
            try:
                value = str(Path(value).expanduser().absolute())
            except RuntimeError:  # `~name/...`, and nobody has this name
                rule = "preset must be a file in an existing home folder"
                raise _refusal(f"{rule}, got {shown(value)}") from None
        for one in _field_by_field(Override(key, parts, value)):
            if one.key in overrides:
                raise _refusal(f"{one.key} must not repeat")
            overrides[one.key] = one
    return overrides


def _field_by_field(override: Override) -> list[Override]:
    """The override; for a group, `tac={alpha: 0.1}`, one of each field, as layers merge."""
    key, _, value = override
    if key not in SECTIONS or not isinstance(value, dict):
        return [override]
    return [Override(f"{key}.{name}", (key, name), value[name]) for name in value]


def lay_overrides(
    document: Mapping[str, Any], overrides: Iterable[Override]
) -> tuple[dict[str, Any], dict[KeyPath, str]]:
    """The document with `overrides` in it, and the key of the command line at each changed place.

    Raises:
        ConfigError: One names a stage that does not exist, or a setting that a grid or search
            varies.
    """
    changed = _unshared(dict(document))
    origins: dict[KeyPath, str] = {}
    for override in overrides:
        if override.parts[0] in LAYER_KEYS:
            places = _places_of_setting(changed, override)
        elif override.parts[0] == "stages" and len(override.parts) > 1:
            places = [_place_in_stage(changed, override)]
        else:
            places = [override.parts]
        for place in places:
            _put(changed, place, _unshared(override.value), override.key)
            origins[place] = override.key
    return changed, origins


def _unshared(value: Any) -> Any:
    """A copy with a value of its own at each use of a YAML alias, so that one place can change."""
    if isinstance(value, dict):
        return {key: _unshared(inner) for key, inner in value.items()}
    return [_unshared(inner) for inner in value] if isinstance(value, list) else value


def _places_of_setting(document: dict[str, Any], override: Override) -> list[KeyPath]:
    """The places at which a setting holds in every stage; removes values that would replace it."""
    layers: list[KeyPath] = []
    for index, stage in enumerate(_stages(document)):
        _check_not_varied(stage, override)
        layers.append(("stages", index))
        tasks = stage.get("per_task")
        tasks = tasks if isinstance(tasks, dict) else {}
        layers += [("stages", index, "per_task", task) for task in tasks]
    *above, field = override.parts
    if len(above) <= 1:
        for layer in layers:
            group = _find(document, (*layer, *above))
            if isinstance(group, dict):
                group.pop(field, None)
        return [("defaults", *override.parts)]
    # A key inside of a value, as tac.alpha.value is: wherever that value is a mapping.
    places: list[KeyPath] = [
        (*layer, *override.parts)
        for layer in [("defaults",), *layers]
        if isinstance(_find(document, (*layer, *above)), dict)
    ]
    return places or [("defaults", *override.parts)]


def _check_not_varied(stage: Mapping[str, Any], override: Override) -> None:
    search = stage.get("search")
    groups = {"grid": stage.get("grid")}
    if isinstance(search, dict):
        groups |= {f"search.{name}": search.get(name) for name in ("space", "compare")}
    for group, values in groups.items():
        for name, choices in values.items() if isinstance(values, dict) else ():
            choices = choices.get("choice") if isinstance(choices, dict) else choices
            choices = choices if isinstance(choices, list) else []
            varied = varied_by(str(name).rpartition(":")[2], choices)
            if any(_overlap(override.key, setting) for setting in varied):
                place = f"stages.{stage.get('name')}.{group}.{name}"
                example = f"; {place}='[{shown(override.value)}]' replaces its values"
                raise _refusal(
                    f"{override.key} must not be given where {place} varies it"
                    + (example if group == "grid" and name == override.key else "")
                )


def _overlap(one: str, other: str) -> bool:
    """Whether two dotted settings are the same or one is inside of the other."""
    return f"{one}.".startswith(f"{other}.") or f"{other}.".startswith(f"{one}.")


def _place_in_stage(document: dict[str, Any], override: Override) -> KeyPath:
    """The place of `stages.NAME...`; a dotted key of a grid or space is one part of it."""
    key = override.key
    names = [str(stage.get("name")) for stage in _stages(document)]
    rest = key.removeprefix("stages.")
    # A stage's name may have dots.
    name = max((name for name in names if f"{rest}.".startswith(f"{name}.")), key=len, default=None)
    if name is None or rest == name:
        raise _refusal(f"{key} must be stages.NAME.KEY, with NAME one of {', '.join(names)}")
    rest = rest.removeprefix(f"{name}.")
    parts = tuple(rest.split("."))
    if parts[0] not in (*StageHeader.model_fields, *LAYER_KEYS):
        raise _refusal(f"{key} {unknown(rest, (*StageHeader.model_fields, *all_settings()))}")
    for group in (("grid",), ("search", "space"), ("search", "compare")):
        if parts[: len(group)] == group and len(parts) > len(group):
            parts = (*group, ".".join(parts[len(group) :]))
    return ("stages", names.index(name), *parts)


def _stages(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    stages = document.get("stages")
    stages = stages if isinstance(stages, list) else []
    return [stage if isinstance(stage, dict) else {} for stage in stages]


def _find(document: Any, path: KeyPath) -> Any:
    """The value at `path`; None if there is none."""
    for part in path:
        try:
            document = document[part]
        except (LookupError, TypeError):
            return None
    return document


def _put(document: dict[str, Any], path: KeyPath, value: Any, key: str) -> None:
    here: Any = document
    for part, following in itertools.pairwise(path):
        if isinstance(here, dict) and here.get(part) is None:
            here[part] = {}
        here = _find(here, (part,))
        if not isinstance(here, list if isinstance(following, int) else dict):
            raise _refusal(f"{key} must be inside of a mapping, got {shown(here)} at {part}")
    if path[-1] in SECTIONS and isinstance(here.get(path[-1]), dict) and isinstance(value, dict):
        value = here[path[-1]] | value  # as layers merge, field by field
    here[path[-1]] = value


def _refusal(rule: str) -> ConfigError:
    return ConfigError([f"command line: {rule}"])
