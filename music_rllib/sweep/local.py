"""What is known of this machine and of the environment without loading Ray."""

from __future__ import annotations

import os

from music_rllib._cluster import ClusterError, check_reachable, cluster_address
from music_rllib.experiment.model import Resources

__all__ = ["ClusterError", "check_cpus", "check_reachable", "cluster_address"]


def check_cpus(resources: Resources) -> int | None:
    """CPUs of the local Ray to start; None: what Ray finds, or a cluster is used instead.

    Raises:
        ClusterError: More are asked for than this machine has.
    """
    if cluster_address() is not None:
        return None
    here = len(os.sched_getaffinity(0))
    for name in ("num_cpus", "cpus_per_run"):
        asked = getattr(resources, name)
        if asked is not None and asked > here:
            raise ClusterError(
                f"resources.{name} must be <= {here}, the CPUs of this machine, got {asked}"
            )
    return resources.num_cpus
