"""Files of sweeps that tests write."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from music_rllib.config.load import load_config
from music_rllib.config.schema import SweepConfig


def loaded(folder: Path, document: Mapping[str, Any] | str, **options: Any) -> SweepConfig:
    """Write `sweep.yaml` below `folder` and load it."""
    path = folder / "sweep.yaml"
    if not isinstance(document, str):
        document = yaml.safe_dump(document, sort_keys=False)
    path.write_text(document)
    return load_config(path, **options)
