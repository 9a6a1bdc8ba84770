"""Starter file and JSON Schema of a sweep's YAML file."""

from __future__ import annotations

import re
from pathlib import Path

SCHEMA = Path(__file__).with_name("sweep.schema.json")
"""The JSON Schema, which docs/generate_configuration.py writes."""


def starter(file: Path) -> str:
    """The text of a commented sweep that is written as `file`."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", file.stem).strip("._-")[:80] or "sweep"
    text = Path(__file__).with_name("starter.yaml").read_text(encoding="utf-8")
    lines = text.replace("NAME", name).replace("FILE", str(file))
    return f"# yaml-language-server: $schema={SCHEMA.as_uri()}\n{lines}"
