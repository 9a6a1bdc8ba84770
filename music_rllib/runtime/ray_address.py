"""The address of the Ray cluster that the environment names. Loads no Ray."""

from __future__ import annotations

import os
import socket

from music_rllib.errors import BadInputError

REACH_SECONDS = 5.0


class ClusterError(BadInputError, RuntimeError):
    """Ray cannot be reached, or cannot hold a single run."""


def cluster_address() -> str | None:
    """RAY_ADDRESS, which Ray sets in submitted jobs too; None for a local Ray."""
    return os.environ.get("RAY_ADDRESS") or None


def check_reachable(address: str) -> None:
    """Connect to a cluster's address once, as Ray itself would retry for minutes.

    Raises:
        ClusterError: Nothing answers, or it is no address of a cluster.
    """
    if address in {"auto", "local"}:
        return
    if address.startswith(("http://", "https://")):
        raise ClusterError(
            f"RAY_ADDRESS must be HOST:PORT of a cluster's head, got {address!r}; an http "
            "address is for 'ray job submit'"
        )
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=REACH_SECONDS).close()
    except (OSError, ValueError, OverflowError) as error:
        raise ClusterError(
            f"RAY_ADDRESS must be HOST:PORT of a Ray cluster that answers, got {address!r}: {error}"
        ) from error
