"""Ray: a local one for the sweep, or the cluster that the environment names."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import Any

import ray

from music_rllib._quiet import quiet_third_parties
from music_rllib.experiment.model import Resources
from music_rllib.sweep.local import ClusterError, check_cpus, cluster_address

__all__ = ["cluster"]

OBJECT_STORE_BYTES = 128 * 2**20
"""Enough, as reports are all that workers send; Ray's default takes a third of the memory."""


@contextlib.contextmanager
def cluster(resources: Resources) -> Iterator[int]:
    """Connect to Ray, and give how many runs fit at once.

    Raises:
        ClusterError: There is no cluster at the address, or no node of it can hold a run.
    """
    address = cluster_address()
    options: dict[str, Any] = {
        "runtime_env": {"worker_process_setup_hook": quiet_third_parties},
        "log_to_driver": False,
        "logging_level": logging.WARNING,
    }
    if address is None:
        options |= {
            "address": "local",  # and not one that happens to run on this machine
            "num_cpus": check_cpus(resources),
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
        }
    try:
        ray.init(**options)
    except (ConnectionError, RuntimeError, ValueError) as error:
        if address is None:
            raise
        raise ClusterError(
            f"RAY_ADDRESS must be a Ray cluster that can be reached, got {address!r}: "
            f"{str(error).strip().splitlines()[0]}"
        ) from error
    try:
        yield _slots(resources)
    finally:
        ray.shutdown()


def _slots(resources: Resources) -> int:
    nodes = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    slots = sum(int(cpus // resources.cpus_per_run) for cpus in nodes)
    if slots == 0:
        raise ClusterError(
            f"resources.cpus_per_run must fit into one node of the cluster, whose largest has "
            f"{max(nodes, default=0):g} CPUs, got {resources.cpus_per_run}"
        )
    return slots
