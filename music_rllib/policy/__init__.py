"""Trained policies, loaded without Ray: they map observations to actions.

The names below are imported on first use, because :mod:`music_rllib.policy.network` is imported by
lower layers and copied into MLflow models and must load nothing but numpy and safetensors.
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
    """Imports a public name from its module."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{home}"), name)
