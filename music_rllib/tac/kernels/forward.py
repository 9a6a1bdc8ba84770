"""What TAC's networks give for a minibatch, and its losses and diagnostics take.

Shape legend: B batch, A action dimensions, C critics.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

__all__ = ["Bootstrap", "TACForward"]


class Bootstrap(NamedTuple):
    """What the target networks say of the next states."""

    value: Tensor
    """[B] V of the averaged value network, or the smallest averaged critic at the next action."""
    log_density: Tensor | None = None
    """[B, A] of the next action, whose entropy a critic's value lacks; None: V has it already."""


class TACForward(NamedTuple):
    """What one minibatch's losses are made of."""

    action: Tensor
    """[B, A] of the current policy at the batch's states."""
    log_density: Tensor | None
    """[B, A] of that action; None for a deterministic policy."""
    log_std: Tensor | None
    """[B, A]; None for a deterministic policy."""
    q_values: Tensor
    """[C, B] critics at the batch's actions."""
    q_of_policy: Tensor
    """[C, B] critics, frozen, at the policy's actions."""
    value: Tensor | None
    """[B]; None without a value network."""
    next: Bootstrap
