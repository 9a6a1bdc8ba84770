"""Presets: YAML files of settings that a sweep lays below its `defaults`, by `preset: NAME`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from music_rllib.envs.registry import closest
from music_rllib.experiment.layers import SECTIONS
from music_rllib.experiment.problems import ConfigError, shown
from music_rllib.experiment.yaml_file import YamlFile, read_yaml

__all__ = ["FOLDER", "with_preset"]

FOLDER = "presets"
"""Beside the sweep's file; `preset: small` is `presets/small.yaml` there."""


def with_preset(file: YamlFile, check: Callable[[YamlFile], Iterable[str]]) -> dict[str, Any]:
    """The sweep's document with its preset's settings laid below its `defaults`.

    Args:
        file: The sweep.
        check: Gives what is wrong with a preset's own settings, as lines.

    Raises:
        ConfigError: There is no such preset, or it has mistakes of its own.
    """
    document = dict(file.data)
    if "preset" not in document:
        return document
    preset = _read(file, document.pop("preset"))
    if problems := list(check(preset)):
        raise ConfigError(problems)
    defaults = document.get("defaults") or {}
    if isinstance(defaults, Mapping):  # else it is reported as what it is
        document["defaults"] = _laid(preset.data, defaults)
    return document


def _read(file: YamlFile, name: Any) -> YamlFile:
    place, folder = file.place(("preset",)), file.path.parent
    if not isinstance(name, str) or not name:
        raise ConfigError([f"{place}: preset must be a preset's name or a file, got {shown(name)}"])
    if name.endswith((".yaml", ".yml")):
        return read_yaml(folder / name)
    path = folder / FOLDER / f"{name}.yaml"
    if not path.is_file():
        known = sorted(found.stem for found in (folder / FOLDER).glob("*.yaml"))
        choice = f"one of {', '.join(known)}" if known else f"a file in {folder / FOLDER}"
        hint = closest(name, known)
        raise ConfigError([f"{place}: preset must be {choice}, got {shown(name)}{hint}"])
    return read_yaml(path)


def _laid(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """`above` over `below`, the fields of sections one by one."""
    merged = dict(below) | dict(above)
    for section in SECTIONS:
        lower, upper = below.get(section), above.get(section)
        if isinstance(lower, Mapping) and (upper is None or isinstance(upper, Mapping)):
            merged[section] = dict(lower) | dict(upper or {})
    return merged
