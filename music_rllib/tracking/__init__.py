"""MLflow. Knows neither Ray nor the environments.

The names below are loaded on first use, as MLflow takes a second to import.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from music_rllib.experiment.run_info import RunInfo
    from music_rllib.tracking.from_store import deliver
    from music_rllib.tracking.projection import StoredRun
    from music_rllib.tracking.sender import Pending
    from music_rllib.tracking.store import check_reachable, resolve_store
    from music_rllib.tracking.tracker import Tracker

__all__ = [
    "Pending",
    "RunInfo",
    "StoredRun",
    "Tracker",
    "check_reachable",
    "deliver",
    "resolve_store",
]

_HOMES = {
    "Pending": "sender",
    "RunInfo": "tracker",
    "StoredRun": "projection",
    "Tracker": "tracker",
    "check_reachable": "store",
    "deliver": "from_store",
    "resolve_store": "store",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{home}"), name)
