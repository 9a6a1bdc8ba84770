"""Ray: a local one for the sweep, or the cluster that RAY_ADDRESS names."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import psutil
import ray

from music_rllib.config.schema import Resources
from music_rllib.envs.tasks import folders_for_workers, search_in
from music_rllib.errors import first_line
from music_rllib.runtime.machine import (
    RAY_FOLDER,
    ClusterError,
    RayStartError,
    check_cpus,
    cluster_address,
    cpus_here,
    free_memory,
    own_folder,
    ray_parent,
)
from music_rllib.runtime.quiet import quiet_third_parties

OBJECT_STORE_BYTES = 128 * 2**20
"""Enough for reports, the only data that workers send; Ray's default is a third of the memory."""
NODE_GROUP = "ray.io/node-group"
"""Label of nodes that a cluster launcher or KubeRay started."""
LISTED_MACHINES = "local.cluster.node"
"""The launcher's node group for listed machines, to which it cannot add others."""
WAITING = 200
"""Maximum number of waiting runs if an autoscaler adds nodes for them; Tune's own default."""
RESTART_MINUTES = 5.0
"""Time that the nodes of a cluster need to join its head again after a restart."""
LOOK_SECONDS = 5.0
"""Time between two checks of a cluster, and timeout of each."""
DAEMONS = ("gcs_server", "raylet")


@dataclass(frozen=True, kw_only=True)
class Capacity:
    """The capacity of a cluster, in runs."""

    now: int
    """Number of runs that the present nodes can hold at once; 0 only if the cluster grows."""
    nodes: int = 1
    grows: bool = False
    """Whether an autoscaler may add nodes."""
    memory: int = 0
    """Memory of the largest node, in bytes."""

    @property
    def node_memory(self) -> float:
        """Memory of the largest node that there may be, in bytes."""
        return math.inf if self.grows else self.memory

    @property
    def at_once(self) -> int:
        """Number of simultaneous runs to expect."""
        return max(self.now, 1)

    @property
    def waiting(self) -> int:
        """Maximum number of runs that wait for resources while others train."""
        return max(self.now, WAITING) if self.grows else self.now

    @property
    def remark(self) -> str | None:
        """Explanation for the user if no run can start yet."""
        if self.now:
            return None
        return (
            "no node of the cluster can hold a run yet; the sweep waits until its autoscaler adds "
            "one ('ray status' shows what it does, and requests that no node type can meet)"
        )


# -- connecting -------------------------------------------------------------------------------

_files = contextlib.ExitStack()
"""Removes the folder of this process's local Ray."""


def start_ray(**local_options: Any) -> None:
    """Connect to the cluster of RAY_ADDRESS, or start a local Ray with these options.

    Raises:
        ClusterError: There is no cluster at the address, or a local Ray does not start.
    """
    address = cluster_address()
    options: dict[str, Any] = {}
    if address is None:
        # Every user can write to Ray's folder and its sockets, so its parent is private.
        folder = _files.enter_context(own_folder(RAY_FOLDER, ray_parent()))
        options = {"_temp_dir": f"{folder}/r", **local_options}
        # Never another Ray that runs on this machine.
        options |= {"address": "local", "include_dashboard": False}
    try:
        ray.init(
            runtime_env={"worker_process_setup_hook": _worker_setup()},
            log_to_driver=False,
            logging_level=logging.WARNING,
            **options,
        )
    except Exception as error:  # Ray raises a plain Exception if a node needs more than 30 s
        stop_ray()
        cause = first_line(error)
        if address is None:
            raise RayStartError(
                f"Ray did not start on this machine, which may be too busy for it: {cause}"
            ) from error
        raise ClusterError(
            f"RAY_ADDRESS must be a Ray cluster that can be reached, got {address!r}: {cause}"
        ) from error


def stop_ray() -> None:
    """Disconnect from Ray; a local one ends and its files are removed."""
    ray.shutdown()
    _files.close()


def _worker_setup() -> Callable[[], None]:
    folders = folders_for_workers()

    def prepare_worker() -> None:
        quiet_third_parties()
        search_in(*folders)

    return prepare_worker


@contextlib.contextmanager
def cluster(
    resources: Resources,
    wait_minutes: float | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Iterator[Capacity]:
    """Connect to Ray for this `with`, and yield its capacity.

    Args:
        resources: The resources of a run.
        wait_minutes: Time to wait for a node that can hold a run. None: `RESTART_MINUTES`, if no
            node of the cluster has a CPU.
        say: Receives a message before the wait.

    Raises:
        ClusterError: There is no cluster at the address, a local one does not start, or no node can
            hold a run and no autoscaler adds nodes.
    """
    start_ray(
        num_cpus=check_cpus(resources) or (None if cluster_address() else cpus_here()),
        object_store_memory=OBJECT_STORE_BYTES,
        _memory=free_memory(),
    )
    try:
        yield _wait_for_nodes(resources, wait_minutes, say)
    finally:
        stop_ray()


def _wait_for_nodes(
    resources: Resources, wait_minutes: float | None, say: Callable[[str], None]
) -> Capacity:
    waited = 0.0
    while True:
        try:
            return _capacity(resources)
        except ClusterError as error:
            only_head = not any(n["Resources"].get("CPU") for n in ray.nodes() if n["Alive"])
            minutes = RESTART_MINUTES * only_head if wait_minutes is None else wait_minutes
            if cluster_address() is None or waited >= 60 * minutes:
                hint = "; no node with CPUs has joined its head yet" if only_head else ""
                raise ClusterError(f"{error}{hint}") from None
            if not waited:
                say(f"{error}; waiting up to {minutes:g} minutes for nodes (--wait-for-nodes)")
        time.sleep(LOOK_SECONDS)
        waited += LOOK_SECONDS


# -- capacity ---------------------------------------------------------------------------------


def _capacity(resources: Resources) -> Capacity:
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    kinds = ("memory", "object_store_memory")
    memory = int(max(sum(node.get(kind, 0) for kind in kinds) for node in nodes))
    local = cluster_address() is None
    may_grow = not local and grows()
    try:
        now = slots(resources, nodes, local=local)
    except ClusterError:
        if not may_grow:
            raise
        now = 0
    return Capacity(now=now, nodes=len(nodes), grows=may_grow, memory=memory)


def grows() -> bool:
    """Whether the cluster's nodes belong to groups, to which an autoscaler may add nodes."""
    groups = {node.get("Labels", {}).get(NODE_GROUP) for node in ray.nodes() if node["Alive"]}
    return bool(groups - {None, LISTED_MACHINES})


def slots(resources: Resources, nodes: Sequence[Mapping[str, float]], *, local: bool) -> int:
    """Number of runs that nodes with Ray's resources `nodes` can hold at once.

    Raises:
        ClusterError: No node can hold a run. The message depends on whether Ray is `local`.
    """
    bundle = resources.bundle
    count = sum(
        min(_held(name, node.get(name, 0), amount) for name, amount in bundle.items())
        for node in nodes
    )
    if count:
        return count
    where = "this machine, which" if local else "one node of the cluster, whose largest"
    for name, (setting, unit, scale) in _SETTINGS.items():
        largest = max((node.get(name, 0) for node in nodes), default=0)
        if bundle.get(name, 0) > largest:
            raise ClusterError(
                f"resources.{setting} must fit into {where} has "
                f"{math.floor(largest / scale * 10) / 10:g} {unit}, got "
                f"{getattr(resources, setting):g}"
            )
    raise ClusterError(
        "resources must fit into one node; each of them is on some node, but all together "
        f"({', '.join(f'{name} {amount:g}' for name, amount in bundle.items())}) on none"
    )


def _held(name: str, here: float, amount: float) -> int:
    """How often `amount` of a resource fits; a part of a GPU is a part of one GPU."""
    if name == "GPU" and amount < 1:
        return int(here) * int(1 / amount + 1e-9)
    return int(here / amount + 1e-9)


_SETTINGS = {
    "CPU": ("cpus_per_run", "CPUs", 1),
    "GPU": ("gpus_per_run", "GPUs", 1),
    "memory": ("memory_per_run", "GiB of memory for Ray", 2**30),
}
"""Ray's resource -> setting, unit in messages, and size of the unit."""


# -- a Ray that dies --------------------------------------------------------------------------


def silence_seconds() -> float:
    """Seconds after which a silent cluster counts as dead, before Ray itself ends the process.

    A head whose state is in Redis may return within this time.
    """
    setting = "RAY_gcs_rpc_server_reconnect_timeout_s"
    return float(os.environ.get(setting, "60")) * 2 / 3


class RayWatch:
    """Detect that the connected Ray has died; Ray itself would wait forever.

    It watches the daemons of a local Ray, or connects to a cluster's addresses.
    """

    def __init__(self) -> None:
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
        """A sentence that names what has died; None if nothing has."""
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
