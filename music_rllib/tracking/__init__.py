"""MLflow. Knows neither Ray nor the environments.

The names below are loaded on first use, as MLflow takes a second to import.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from music_rllib.experiment.run_info import RunInfo
    from music_rllib.tracking.sender import Backlog
    from music_rllib.tracking.session import deliver
    from music_rllib.tracking.store import check_reachable, resolve_store
    from music_rllib.tracking.tracker import Point, Tracker

__all__ = [
    "Backlog",
    "Point",
    "RunInfo",
    "Tracker",
    "check_reachable",
    "deliver",
    "resolve_store",
]

_HOMES = {
    "Backlog": "sender",
    "Point": "tracker",
    "RunInfo": "tracker",
    "Tracker": "tracker",
    "check_reachable": "store",
    "deliver": "session",
    "resolve_store": "store",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{home}"), name)
