"""Ports for the servers that tests start."""

from __future__ import annotations

import contextlib
import random
import socket


def free_port() -> int:
    """An unused port of 127.0.0.1, below those that Linux gives to connections.

    A port that the kernel chooses is among those: another connection could get it before the server
    does, whose start takes seconds.
    """
    while True:
        port = random.SystemRandom().randrange(20_000, 32_768)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
