"""`KEY=VALUE` arguments of the command line, which replace values of a sweep's file.

A setting (`tac.alpha=0.1`) holds in every stage and replaces the file's values in `defaults`, in
stages and for single tasks; `stages.NAME.tac.alpha=0.1` changes one stage. A key of the file's top
level (`seeds=5`, `resources.cpus_per_run=2`) replaces the value there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from music_rllib.config.document import Document, find
from music_rllib.config.layers import all_settings, is_in, varied_by
from music_rllib.config.problems import ConfigError, KeyPath, shown, unknown
from music_rllib.config.run_settings import LAYER_KEYS, SECTIONS
from music_rllib.config.schema import Header, StageHeader
from music_rllib.config.yaml_file import read_value


def parse_overrides(arguments: Iterable[str]) -> dict[str, Any]:
    """Key to value, for `KEY=VALUE` arguments with values in YAML.

    A group, `tac={alpha: 0.1}`, gives one key for each field.

    Raises:
        ConfigError: One has no `=`, its key is unknown or repeated, or its value is not YAML.
    """
    overrides: dict[str, Any] = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals or not all(key.split(".")):
            raise _refusal(f"must be KEY=VALUE like tac.alpha=0.1, got {shown(argument)}")
        if key.partition(".")[0] in LAYER_KEYS and key.count(".") > 1:
            setting = ".".join(key.split(".")[:2])
            raise _refusal(
                f"{key} must be a whole setting, {setting}={{...}}, got {shown(argument)}"
            )
        if key.partition(".")[0] not in (*LAYER_KEYS, *Header.model_fields):
            raise _refusal(f"{key} {unknown(key, (*all_settings(), *Header.model_fields))}")
        try:
            value = read_value(text)
        except ValueError as error:
            raise _refusal(f"{key} {error}, got {shown(text)}") from None
        fields = {key: value}
        if key in SECTIONS and isinstance(value, dict):
            fields = {f"{key}.{name}": inner for name, inner in value.items()}
        for one in fields.keys() & overrides.keys():
            raise _refusal(f"{one} must not repeat")
        overrides |= fields
    return overrides


def preset_path(value: Any) -> Any:
    """The value of `preset=...`, where a file is relative to the current folder."""
    if not isinstance(value, str) or not value.endswith((".yaml", ".yml")):
        return value
    try:
        return str(Path(value).expanduser().absolute())
    except RuntimeError:  # `~name/...`, and nobody has this name
        rule = "preset must be a file in an existing home folder"
        raise _refusal(f"{rule}, got {shown(value)}") from None


def lay_overrides(document: Document, overrides: Mapping[str, Any]) -> None:
    """Put `overrides` into the document.

    Raises:
        ConfigError: One names a stage that does not exist, or a setting that a grid or search
            varies.
    """
    for key, value in overrides.items():
        place: KeyPath = tuple(key.split("."))
        if place[0] in LAYER_KEYS:
            for stage in _stages(document):
                _check_not_varied(stage, key, value)
                tasks = find(stage, ("per_task",))
                for layer in (stage, *(tasks.values() if isinstance(tasks, dict) else ())):
                    if isinstance(group := find(layer, place[:-1]), dict):
                        group.pop(place[-1], None)
            place = ("defaults", *place)
        elif place[0] == "stages" and len(place) > 1:
            place = _place_in_stage(document, key)
        document.put(place, value)


def _check_not_varied(stage: Mapping[str, Any], key: str, value: Any) -> None:
    for group in (("grid",), ("search", "space"), ("search", "compare")):
        varied = find(stage, group)
        for name, choices in varied.items() if isinstance(varied, dict) else ():
            choices = choices.get("choice") if isinstance(choices, dict) else choices
            choices = choices if isinstance(choices, list) else []
            settings = varied_by(str(name).rpartition(":")[2], choices)
            if any(is_in(key, one) or is_in(one, key) for one in settings):
                place = f"stages.{stage.get('name')}.{'.'.join(group)}.{name}"
                rule = f"{key} must not be given where {place} varies it"
                if group == ("grid",) and name == key:
                    rule += f"; {place}='[{shown(value)}]' replaces its values"
                raise _refusal(rule)


def _place_in_stage(document: Document, key: str) -> KeyPath:
    """The place of `stages.NAME...`; a dotted key of a grid or space is one part of it."""
    names = [str(stage.get("name")) for stage in _stages(document)]
    rest = key.removeprefix("stages.")
    # A stage's name may have dots.
    name = max((name for name in names if f"{rest}.".startswith(f"{name}.")), key=len, default=None)
    if name is None or rest == name:
        raise _refusal(f"{key} must be stages.NAME.KEY, with NAME one of {', '.join(names)}")
    rest = rest.removeprefix(f"{name}.")
    parts = tuple(rest.split("."))
    known = (*StageHeader.model_fields, *all_settings())
    if parts[0] not in known:
        raise _refusal(f"{key} {unknown(rest, known)}")
    for group in (("grid",), ("search", "space"), ("search", "compare")):
        if parts[: len(group)] == group and len(parts) > len(group):
            parts = (*group, ".".join(parts[len(group) :]))
    return ("stages", names.index(name), *parts)


def _stages(document: Document) -> list[dict[str, Any]]:
    stages = document.data.get("stages")
    stages = stages if isinstance(stages, list) else []
    return [stage if isinstance(stage, dict) else {} for stage in stages]


def _refusal(rule: str) -> ConfigError:
    return ConfigError([f"command line: {rule}"])
