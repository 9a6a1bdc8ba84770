"""Presets: YAML files of settings that a sweep lays below its `defaults`, by `preset: NAME`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import music_rllib
from music_rllib.config.problems import ConfigError, shown
from music_rllib.config.reading.layers import SECTIONS
from music_rllib.config.reading.yaml_file import YamlFile, read_yaml
from music_rllib.envs.tasks import closest

FOLDER = "presets"
"""Beside the sweep's file: `presets/small.yaml` there comes before the package's `small`."""
SHIPPED = Path(music_rllib.__file__).with_name(FOLDER)
"""The package's own presets, one file each."""


def shipped_presets() -> dict[str, str]:
    """Names of the package's presets, and the line that each begins with."""
    found = {}
    for path in sorted(SHIPPED.glob("*.yaml")):
        line = path.read_text(encoding="utf-8").partition("\n")[0]
        found[path.stem] = line.removeprefix(f"# {path.stem}: ")
    return found


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
    known = {
        path.stem: path for place in (SHIPPED, folder / FOLDER) for path in place.glob("*.yaml")
    }
    if name not in known:
        choice = ", ".join(sorted(known))
        raise ConfigError(
            [f"{place}: preset must be one of {choice}, got {shown(name)}{closest(name, known)}"]
        )
    return read_yaml(known[name])


def _laid(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """`above` over `below`, the fields of sections one by one."""
    merged = dict(below) | dict(above)
    for section in SECTIONS:
        lower, upper = below.get(section), above.get(section)
        if isinstance(lower, Mapping) and (upper is None or isinstance(upper, Mapping)):
            merged[section] = dict(lower) | dict(upper or {})
    return merged
