"""Connects to Ray: a local Ray for the sweep, or the cluster that the environment names."""

from __future__ import annotations

import contextlib
import logging
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import ray

from music_rllib.config.schema import Resources
from music_rllib.envs.modules import folders_for_workers, search_in
from music_rllib.errors import first_line
from music_rllib.runtime.machine import (
    RAY_FOLDER,
    ClusterError,
    check_cpus,
    cluster_address,
    ray_parent,
)
from music_rllib.runtime.quiet import quiet_third_parties

OBJECT_STORE_BYTES = 128 * 2**20
"""Enough for reports, the only data of workers; Ray's default is a third of the memory."""
NODE_GROUP = "ray.io/node-group"
"""Label of nodes that a cluster launcher or KubeRay started."""
LISTED_MACHINES = "local.cluster.node"
"""The launcher's node group for listed machines, to which it cannot add others."""
WAITING = 200
"""Most runs that wait if an autoscaler adds nodes for them; Tune's own default."""


@dataclass(frozen=True, kw_only=True)
class Room:
    """The capacity of a cluster."""

    now: int
    """Number of runs that the present nodes can hold at once; 0 only if the cluster grows."""
    grows: bool = False
    """Whether an autoscaler may add nodes."""
    memory: int = 0
    """Memory of the largest node, in bytes."""

    @property
    def at_once(self) -> int:
        """Number of runs at a time to count on."""
        return max(self.now, 1)

    @property
    def waiting(self) -> int:
        """Number of runs that may wait for a place, beside those that have one."""
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
        # Ray lets every user write to its folder, sockets included: the one above it is ours alone.
        folder = tempfile.TemporaryDirectory(
            prefix=RAY_FOLDER, dir=ray_parent(), ignore_cleanup_errors=True
        )
        options = {"_temp_dir": f"{_files.enter_context(folder)}/r", **local_options}
        # Never a Ray that happens to run on this machine.
        options |= {"address": "local", "include_dashboard": False}
    try:
        ray.init(
            runtime_env={"worker_process_setup_hook": _worker_setup()},
            log_to_driver=False,
            logging_level=logging.WARNING,
            **options,
        )
    except Exception as error:  # plain ones, too: for a node that is not up within 30 s
        stop_ray()
        cause = first_line(error)
        if address is None:
            raise ClusterError(
                f"Ray did not start on this machine, which may be too busy for it: {cause}"
            ) from error
        raise ClusterError(
            f"RAY_ADDRESS must be a Ray cluster that can be reached, got {address!r}: {cause}"
        ) from error


def stop_ray() -> None:
    """Leave Ray; a local one ends and leaves no files."""
    ray.shutdown()
    _files.close()


def _worker_setup() -> Callable[[], None]:
    """What each worker does first."""
    folders = folders_for_workers()

    def prepare_worker() -> None:
        quiet_third_parties()
        search_in(*folders)

    return prepare_worker


@contextlib.contextmanager
def cluster(resources: Resources) -> Iterator[Room]:
    """Connect to Ray for this `with`, and yield its capacity.

    Raises:
        ClusterError: There is no cluster at the address, a local one does not start, or no node can
            hold a run and no autoscaler adds nodes.
    """
    start_ray(num_cpus=check_cpus(resources), object_store_memory=OBJECT_STORE_BYTES)
    try:
        yield _room(resources)
    finally:
        stop_ray()


def check_fits(resources: Resources) -> str | None:
    """Check that Ray can hold a run, if that is not obvious without asking it.

    Returns:
        `Room.remark`.

    Raises:
        ClusterError: Ray cannot be reached, or cannot hold a run.
    """
    if resources.bundle.keys() != {"CPU"} or (
        cluster_address() is not None and resources.cpus_per_run > 1
    ):
        with cluster(resources) as room:
            return room.remark
    return None


def _room(resources: Resources) -> Room:
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    kinds = ("memory", "object_store_memory")
    memory = int(max(sum(node.get(kind, 0) for kind in kinds) for node in nodes))
    if cluster_address() is None:
        return Room(now=slots(resources, nodes, local=True), memory=memory)
    try:
        now = slots(resources, nodes, local=False)
    except ClusterError:
        if not grows():
            raise
        return Room(now=0, grows=True, memory=memory)
    return Room(now=now, grows=grows(), memory=memory)


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
        min(int(node.get(name, 0) / amount + 1e-9) for name, amount in bundle.items())
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


_SETTINGS = {
    "CPU": ("cpus_per_run", "CPUs", 1),
    "GPU": ("gpus_per_run", "GPUs", 1),
    "memory": ("memory_per_run", "GiB of memory for Ray", 2**30),
}
"""Ray's resource -> setting, unit in messages, and size of the unit."""
