"""Whether the Ray that a driver talks to is still there: Ray itself would wait for it for good."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable

import psutil
import ray

from music_rllib.runtime.machine import cluster_address

LOOK_SECONDS = 5.0
"""Between two looks at a cluster, and for each to answer."""
DAEMONS = ("gcs_server", "raylet")


def silence_seconds() -> float:
    """After so long a cluster counts as dead: sooner than Ray ends the process with its own words.

    A head whose state is in Redis may come back before that.
    """
    setting = "RAY_gcs_rpc_server_reconnect_timeout_s"
    return float(os.environ.get(setting, "60")) * 2 / 3


class RayWatch:
    """Looks at a local Ray's daemons, or knocks at a cluster's. Only while Ray is connected."""

    def __init__(
        self,
        now: Callable[[], float] = time.monotonic,
        doors: tuple[str, ...] | None = None,
    ) -> None:
        """Watch the Ray that this process is connected to.

        Args:
            now: A clock in seconds.
            doors: In place of the cluster's: `HOST:PORT`, or the path of a socket.
        """
        self._now = now
        self._address = cluster_address()
        self._daemons: dict[psutil.Process, str] = {}
        if self._address is None and doors is None:
            named = {child: child.name() for child in psutil.Process().children()}
            self._daemons = {child: name for child, name in named.items() if name in DAEMONS}
            doors = ()
        self._doors = doors if doors is not None else tuple(_doors(self._address or ""))
        self._answered = dict.fromkeys(self._doors, now())
        self._looked = now()

    def look(self) -> str | None:
        """What is gone, in a sentence; None while all is there."""
        for daemon, name in self._daemons.items():
            if not _is_alive(daemon):
                return (
                    f"the local Ray has died: its {name} (process {daemon.pid}) is gone; often the "
                    "system killed it for lack of memory"
                )
        now = self._now()
        if now - self._looked < LOOK_SECONDS:
            return None
        if now - self._looked > 3 * LOOK_SECONDS:  # this process slept, and the others may have
            self._answered = dict.fromkeys(self._doors, now)
        for door, answered in self._answered.items():
            if _opens(door):
                self._answered[door] = self._now()
            elif self._now() - answered > silence_seconds():
                return (
                    f"the Ray cluster at {self._address} has died or can't be reached: {door} has "
                    f"not answered for {self._now() - answered:.0f} s"
                )
        self._looked = self._now()
        return None


def _doors(address: str) -> list[str]:
    """Where the head and this machine's raylet take connections."""
    if address.startswith("ray://"):
        return [address.removeprefix("ray://")]
    doors = [ray.get_runtime_context().gcs_address]
    node = ray._private.worker._global_node
    if node is not None and node.raylet_socket_name:
        doors.append(node.raylet_socket_name.removeprefix("unix://"))
    return doors


def _opens(door: str) -> bool:
    try:
        if door.startswith("/"):
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as knock:
                knock.settimeout(LOOK_SECONDS)
                knock.connect(door)
            return True
        host, _, port = door.rpartition(":")
        socket.create_connection((host.strip("[]"), int(port)), timeout=LOOK_SECONDS).close()
    except OSError:
        return False
    return True


def _is_alive(process: psutil.Process) -> bool:
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
