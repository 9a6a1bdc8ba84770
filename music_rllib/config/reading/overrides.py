"""`KEY=VALUE` of the command line, laid over a sweep's file.

A setting (`tac.alpha=0.1`) holds in every stage, over what the file says of it in `defaults`, in
stages and for single tasks; `stages.NAME.tac.alpha=0.1` changes one stage. A key of the file's top
(`seeds=5`, `resources.cpus_per_run=2`) replaces that.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any, NamedTuple

from music_rllib.config.problems import ConfigError, Path, shown, unknown
from music_rllib.config.reading.layers import LAYER_KEYS, SECTIONS, all_settings
from music_rllib.config.reading.yaml_file import read_value
from music_rllib.config.schema import Header, StageHeader

TOP = (*Header.model_fields, "preset", "environments", "defaults", "stages")


class Override(NamedTuple):
    """One argument."""

    key: str
    parts: tuple[str, ...]
    value: Any

    @property
    def is_setting(self) -> bool:
        """Whether it holds in every stage."""
        return self.parts[0] in LAYER_KEYS


def parse_overrides(arguments: Iterable[str]) -> list[Override]:
    """What `KEY=VALUE` arguments mean; values are YAML.

    Raises:
        ConfigError: One has no `=`, its key is not known or is given twice, or its value no YAML.
    """
    found: dict[str, Override] = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        parts = tuple(key.split("."))
        if not equals or not all(parts):
            raise _refusal(f"must be KEY=VALUE like tac.alpha=0.1, got {shown(argument)}")
        if key in found:
            raise _refusal(f"{key} must not repeat")
        if parts[0] not in (*LAYER_KEYS, *TOP):
            raise _refusal(f"{key} {unknown(key, (*all_settings(), *TOP))}")
        try:
            value = read_value(text)
        except ValueError as error:
            raise _refusal(f"{key} {error}, got {shown(text)}") from None
        if key == "preset" and isinstance(value, str) and value.endswith((".yaml", ".yml")):
            value = str(FilePath(value).expanduser().absolute())
        found[key] = Override(key, parts, value)
    return list(found.values())


def lay_overrides(
    document: Mapping[str, Any], overrides: Sequence[Override]
) -> tuple[dict[str, Any], dict[Path, str]]:
    """The document with `overrides` in it, and the key of the command line at each changed place.

    Raises:
        ConfigError: One names a stage that there is not, or what a grid or search varies.
    """
    changed = copy.deepcopy(dict(document))
    origins: dict[Path, str] = {}
    for one in overrides:
        if one.is_setting:
            places = _of_every_stage(changed, one)
        elif one.parts[0] == "stages" and len(one.parts) > 1:
            places = [_of_stage(changed, one)]
        else:
            places = [one.parts]
        for place in places:
            _put(changed, place, copy.deepcopy(one.value), one.key)
            origins[place] = one.key
    return changed, origins


def _of_every_stage(document: dict[str, Any], one: Override) -> list[Path]:
    """Where to put a setting for it to hold everywhere; what would win over it is taken out."""
    layers: list[Path] = []
    for index, stage in enumerate(_stages(document)):
        _check_not_varied(stage, one)
        layers.append(("stages", index))
        tasks = stage.get("per_task")
        layers += [("stages", index, "per_task", task) for task in tasks or {}]
    if len(one.parts) <= 2:
        for layer in layers:
            _take_out(_find(document, layer), one.parts)
        return [("defaults", *one.parts)]
    # Inside of a value, as tac.alpha.value is: wherever that value is a mapping.
    inner = [
        place
        for place in [("defaults",), *layers]
        if isinstance(_find(document, (*place, *one.parts[:-1])), dict)
    ]
    return [(*place, *one.parts) for place in inner] or [("defaults", *one.parts)]


def _check_not_varied(stage: Mapping[str, Any], one: Override) -> None:
    search = stage.get("search")
    groups = {"grid": stage.get("grid")}
    if isinstance(search, dict):
        groups |= {f"search.{name}": search.get(name) for name in ("space", "compare")}
    for group, values in groups.items():
        for name in values if isinstance(values, dict) else ():
            setting = str(name).rpartition(":")[2]
            if f"{setting}.".startswith(f"{one.key}.") or f"{one.key}.".startswith(f"{setting}."):
                place = f"stages.{stage.get('name')}.{group}.{name}"
                example = f"; {place}='[{shown(one.value)}]' replaces its values"
                raise _refusal(
                    f"{one.key} must not be given where {place} varies it"
                    + (example if group == "grid" else "")
                )


def _of_stage(document: dict[str, Any], one: Override) -> Path:
    """The place of `stages.NAME...`, with the dotted keys of its grid or space in one piece."""
    names = [str(stage.get("name")) for stage in _stages(document)]
    # A stage's name may have dots.
    rest = one.key.removeprefix("stages.")
    name = next(
        (n for n in sorted(names, key=len, reverse=True) if f"{rest}.".startswith(f"{n}.")), None
    )
    if name is None or rest == name:
        raise _refusal(f"{one.key} must be stages.NAME.KEY, with NAME one of {', '.join(names)}")
    parts: Path = tuple(rest.removeprefix(f"{name}.").split("."))
    if parts[0] not in (*StageHeader.model_fields, *LAYER_KEYS):
        known = (*StageHeader.model_fields, *all_settings())
        raise _refusal(f"{one.key} {unknown('.'.join(map(str, parts)), known)}")
    head = 2 if parts[:1] == ("search",) else 1
    if parts[:head] in {("grid",), ("search", "space"), ("search", "compare")}:
        dotted = ".".join(map(str, parts[head:]))
        parts = (*parts[:head], *([dotted] if dotted else ()))
    return ("stages", names.index(name), *parts)


def _stages(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    stages = document.get("stages")
    return (
        [one if isinstance(one, dict) else {} for one in stages] if isinstance(stages, list) else []
    )


def _find(document: Any, path: Path) -> Any:
    for part in path:
        try:
            document = document[part]
        except (LookupError, TypeError):
            return None
    return document


def _take_out(layer: Any, parts: Sequence[str]) -> None:
    for part in parts[:-1]:
        layer = layer.get(part) if isinstance(layer, dict) else None
    if isinstance(layer, dict):
        layer.pop(parts[-1], None)


def _put(document: dict[str, Any], path: Path, value: Any, key: str) -> None:
    here: Any = document
    for part in path[:-1]:
        if isinstance(here, dict) and here.get(part) is None:
            here[part] = {}
        here = _find(here, (part,))
        if not isinstance(here, dict | list):
            raise _refusal(f"{key} must be inside of a mapping, got {shown(here)} at {part}")
    if path[-1] in SECTIONS and isinstance(here.get(path[-1]), dict) and isinstance(value, dict):
        value = here[path[-1]] | value  # as layers merge, field by field
    here[path[-1]] = value


def _refusal(rule: str) -> ConfigError:
    return ConfigError([f"command line: {rule}"])
