"""Files of the package to start a sweep from: presets, the starter file, the JSON Schema.

A preset is a YAML file of settings that a sweep's `preset: NAME` puts below its `defaults`.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import music_rllib
from music_rllib.config.document import Place
from music_rllib.config.problems import ConfigError, shown
from music_rllib.config.schema import RESERVED_NAMES
from music_rllib.config.yaml_file import YamlFile, read_yaml
from music_rllib.envs.tasks import closest

FOLDER = "presets"
"""Folder beside the sweep's file; its presets replace the package's presets of the same name."""
SHIPPED = Path(music_rllib.__file__).with_name(FOLDER)
"""Folder of the package's presets."""
SCHEMA = Path(__file__).with_name("sweep.schema.json")
"""JSON Schema of a sweep's file, for editors; docs/generate_configuration.py writes it."""


def starter(file: Path) -> str:
    """The text of a commented sweep that is written as `file`."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", file.stem).strip("._-")[:80] or "sweep"
    if name in RESERVED_NAMES:
        name = f"{name}_sweep"
    # Quoted, since a name like 123 or true would not be text.
    known = {"name: NAME": f'name: "{name}"', "NAME": name, "FILE": shlex.quote(str(file))}
    text = Path(__file__).with_name("starter.yaml").read_text(encoding="utf-8")
    lines = re.sub("|".join(known), lambda found: known[found[0]], text)
    return f"# yaml-language-server: $schema={SCHEMA.as_uri()}\n{lines}"


def shipped_presets() -> dict[str, str]:
    """Map the names of the package's presets to the description in their first line."""
    descriptions = {}
    for path in sorted(SHIPPED.glob("*.yaml")):
        line = path.read_text(encoding="utf-8").partition("\n")[0]
        descriptions[path.stem] = line.removeprefix(f"# {path.stem}: ")
    return descriptions


def read_preset(name: Any, folder: Path, place: Place) -> YamlFile:
    """Read a preset by its name, or by its path if `name` ends in `.yaml`.

    Args:
        name: The value of `preset`.
        folder: The folder of the sweep's file.
        place: The place of `name`, for messages.

    Raises:
        ConfigError: There is no such preset, or it can't be read.
    """
    if not isinstance(name, str) or not name:
        raise ConfigError([f"{place}: preset must be a preset's name or a file, got {shown(name)}"])
    if name.endswith((".yaml", ".yml")):
        return read_yaml(folder / name)
    known = {path.stem: path for one in (SHIPPED, folder / FOLDER) for path in one.glob("*.yaml")}
    if name not in known:
        choice = ", ".join(sorted(known))
        raise ConfigError(
            [f"{place}: preset must be one of {choice}, got {shown(name)}{closest(name, known)}"]
        )
    return read_yaml(known[name])
