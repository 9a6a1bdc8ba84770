"""Trained policies, loaded without Ray: they map observations to actions.

The names below are imported on first use, because :mod:`music_rllib.policy.network` is copied into
MLflow models and must load nothing but numpy and safetensors.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from music_rllib.policy.network import PolicyNetwork
    from music_rllib.policy.policy import (
        Policy,
        PolicyError,
        find_policy,
        load_policy,
        named_environment,
    )

__all__ = [
    "Policy",
    "PolicyError",
    "PolicyNetwork",
    "find_policy",
    "load_policy",
    "named_environment",
]


def __getattr__(name: str) -> Any:
    """Import a public name from its module."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = "network" if name == "PolicyNetwork" else "policy"
    return getattr(import_module(f"{__name__}.{home}"), name)
