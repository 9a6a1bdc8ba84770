"""A sweep that was started, as its storage has it, without training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from music_rllib.experiment.open_sweep import open_sweep
from music_rllib.experiment.plan import make_plan
from music_rllib.experiment.record import keep_record
from tests.sweep_files import loaded

__all__ = ["kept_sweep"]


def kept_sweep(storage: Path, tracking_uri: str | None = None, **settings: Any) -> Path:
    """The folder of a tracked sweep `s`, with its whole record except for passwords."""
    stages = [{"name": "train", "variant": "tac"}]
    document = {
        "name": "s",
        "tasks": ["FetchReach"],
        "seeds": 3,
        "stages": stages,
        "storage": "elsewhere",
        **settings,
    }
    config = loaded(storage, document)
    folder = storage / "s"
    keep_record(open_sweep(config, make_plan(config), str(storage)))
    record = {"sweep_name": "s", "sweep_id": "0", "tracking_uri": tracking_uri, "run_id": "1"}
    (folder / "tracking").mkdir()
    (folder / "tracking" / "sweep.json").write_text(json.dumps(record))
    return folder
