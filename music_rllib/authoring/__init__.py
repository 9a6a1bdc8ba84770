"""Starter file and JSON Schema of a sweep's YAML file."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

SCHEMA = Path(__file__).with_name("sweep.schema.json")
"""The JSON Schema, which docs/generate_configuration.py writes."""


def starter(file: Path) -> str:
    """The text of a commented sweep that is written as `file`."""
    from music_rllib.config.schema import RESERVED_NAMES

    name = re.sub(r"[^A-Za-z0-9._-]+", "_", file.stem).strip("._-")[:80] or "sweep"
    if name in RESERVED_NAMES:
        name = f"{name}_sweep"
    # Unquoted, a name like 123 or true would be no text.
    known = {"name: NAME": f'name: "{name}"', "NAME": name, "FILE": shlex.quote(str(file))}
    text = Path(__file__).with_name("starter.yaml").read_text(encoding="utf-8")
    lines = re.sub("|".join(known), lambda found: known[found[0]], text)
    return f"# yaml-language-server: $schema={SCHEMA.as_uri()}\n{lines}"
