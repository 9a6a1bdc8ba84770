"""Policies of finished runs, loaded without Ray: they take observations and give actions.

The names below are loaded on first use: :mod:`music_rllib.policy.network` is read by lower layers,
and copied into MLflow models, so it must not cost more than numpy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from music_rllib.policy.locate import find_policy, named_environment
    from music_rllib.policy.network import PolicyNetwork
    from music_rllib.policy.policy import Policy, PolicyError, load_policy

__all__ = [
    "Policy",
    "PolicyError",
    "PolicyNetwork",
    "find_policy",
    "load_policy",
    "named_environment",
]

_HOMES = {
    "Policy": "policy",
    "PolicyError": "policy",
    "PolicyNetwork": "network",
    "find_policy": "locate",
    "load_policy": "policy",
    "named_environment": "locate",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{home}"), name)
