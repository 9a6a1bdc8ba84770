"""Tsallis actor-critic (TAC) with MUSIC on RLlib, and a sweeper that compares entropic indices.

The names below are loaded on first use (PEP 562): ``import music_rllib`` itself loads neither
torch nor ray, so the command line answers at once and pure mathematics is usable alone.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from music_rllib.results.frames import load_sweep
    from music_rllib.tac.algorithm import TAC, TACConfig
    from music_rllib.tac.learner import TACLearner
    from music_rllib.tac.rl_module import TACModule

__version__ = "0.1.0"

__all__ = ["TAC", "TACConfig", "TACLearner", "TACModule", "__version__", "load_sweep"]

_HOMES = {
    "TAC": "music_rllib.tac.algorithm",
    "TACConfig": "music_rllib.tac.algorithm",
    "TACLearner": "music_rllib.tac.learner",
    "TACModule": "music_rllib.tac.rl_module",
    "load_sweep": "music_rllib.results.frames",
}


def __getattr__(name: str) -> Any:
    """Import a public name from its module at its first use."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
