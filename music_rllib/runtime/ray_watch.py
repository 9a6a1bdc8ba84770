"""Detects that Ray has died. Ray itself would wait for ever."""

from __future__ import annotations

import contextlib
import os
import socket
import time

import psutil
import ray

from music_rllib.runtime.machine import cluster_address

LOOK_SECONDS = 5.0
"""Time between two checks of a cluster, and timeout of each."""
DAEMONS = ("gcs_server", "raylet")


def silence_seconds() -> float:
    """Seconds after which a silent cluster counts as dead, before Ray itself ends the process.

    A head whose state is in Redis may come back in this time.
    """
    setting = "RAY_gcs_rpc_server_reconnect_timeout_s"
    return float(os.environ.get(setting, "60")) * 2 / 3


class RayWatch:
    """Watches the daemons of a local Ray, or connects to a cluster's addresses."""

    def __init__(self) -> None:
        """Watch the Ray that this process is connected to."""
        self._address = cluster_address()
        self._daemons: dict[psutil.Process, str] = {}
        for child in [] if self._address else psutil.Process().children():
            with contextlib.suppress(psutil.NoSuchProcess):
                if (name := child.name()) in DAEMONS:
                    self._daemons[child] = name
        addresses = _addresses(self._address) if self._address else []
        self._checked = time.monotonic()
        self._answered = dict.fromkeys(addresses, self._checked)
        """Time of the last answer of each address."""

    def look(self) -> str | None:
        """A sentence that says what has died; None if nothing has."""
        for daemon, name in self._daemons.items():
            if not _is_alive(daemon):
                return (
                    f"the local Ray has died: its {name} (process {daemon.pid}) is gone; often the "
                    "system killed it for lack of memory"
                )
        now = time.monotonic()
        if now - self._checked < LOOK_SECONDS:
            return None
        if now - self._checked > 3 * LOOK_SECONDS:  # this machine slept, and the cluster may have
            self._answered = dict.fromkeys(self._answered, now)
        for address, answered in self._answered.items():
            if _answers(address):
                self._answered[address] = time.monotonic()
            elif time.monotonic() - answered > silence_seconds():
                return (
                    f"the Ray cluster at {self._address} has died or can't be reached: {address} "
                    f"has not answered for {time.monotonic() - answered:.0f} s"
                )
        self._checked = time.monotonic()
        return None


def _addresses(cluster: str) -> list[str]:
    """`HOST:PORT` of the head, and the socket of this machine's raylet if there is one."""
    if cluster.startswith("ray://"):
        return [cluster.removeprefix("ray://")]
    context = ray.get_runtime_context()
    own = [node for node in ray.nodes() if node["NodeID"] == context.get_node_id()]
    sockets = [node["RayletSocketName"].removeprefix("unix://") for node in own]
    return [context.gcs_address, *sockets]


def _answers(address: str) -> bool:
    try:
        if address.startswith("/"):
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
                connection.settimeout(LOOK_SECONDS)
                connection.connect(address)
            return True
        host, _, port = address.rpartition(":")
        socket.create_connection((host.strip("[]"), int(port)), timeout=LOOK_SECONDS).close()
    except OSError:
        return False
    return True


def _is_alive(process: psutil.Process) -> bool:
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
