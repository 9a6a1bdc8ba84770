"""Which Ray cluster the environment names, and whether it answers. Loads no Ray."""

from __future__ import annotations

import os
import socket

from music_rllib.errors import BadInputError

REACH_SECONDS = 5.0


class ClusterError(BadInputError, RuntimeError):
    """Ray can't be reached, or can't hold a single run."""


def cluster_address() -> str | None:
    """The cluster that the environment names; Ray sets it in submitted jobs too."""
    return os.environ.get("RAY_ADDRESS") or None


def check_reachable(address: str) -> None:
    """Knock at a cluster's address; Ray itself would go on trying for minutes.

    Raises:
        ClusterError: Nobody answers there, or it is no address of a cluster.
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
