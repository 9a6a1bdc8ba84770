"""Ray's autoscaler: whether a cluster has one, and whether it would add nodes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import ray
import ray.util.client

ANSWER_SECONDS = 40.0
"""Longest wait for its answer: it looks at requests every five seconds, or later if it is busy."""
REPORT_SECONDS = 10.0
"""Longest wait for its first report after a cluster was started."""
LOOKS = 2
"""Number of its looks after which a request counts as feasible if it reports nothing."""
LISTED_MACHINES = "local.cluster.node"
"""The launcher's node type for listed machines, to which it cannot add others."""


class State(NamedTuple):
    """The last report of Ray's second autoscaler."""

    version: int
    """Counts its looks at requests; 0 if the cluster has no autoscaler of this kind."""
    types: frozenset[str]
    """Names of the nodes' types; "" for a node that was started by hand."""
    infeasible: frozenset[str]
    """Descriptions of the placement groups that no node could hold that it may start."""


def is_there() -> bool:
    """Whether the cluster's nodes have types, as an autoscaler's nodes do.

    KubeRay's nodes have types even without an autoscaler: only `adds_nodes` is certain.
    """
    by_hand = {"", *(f"node_{node['NodeID']}" for node in ray.nodes())}
    return bool(_types() - by_hand - {LISTED_MACHINES})


def _types() -> frozenset[str]:
    """The nodes' types that the autoscaler reports; none if there is no report."""
    if ray.util.client.ray.is_connected():
        return frozenset()  # `ray://` has no access to the reports
    state = _state()
    return state.types if state.version else _types_of_the_first()


def adds_nodes(bundle: Mapping[str, float], count: int = 1) -> bool:
    """Whether the autoscaler adds nodes if the present ones cannot hold so many bundles.

    Asks by requesting a placement group, so the nodes are being started afterwards.
    """
    began = time.monotonic()
    while not is_there():
        if _types() or time.monotonic() - began > REPORT_SECONDS:
            return False
        time.sleep(0.5)
    if not _state().version:
        return True  # the first autoscaler, before Ray 2.50, does not report infeasible requests
    group = ray.util.placement_group([dict(bundle) for _ in range(count)])
    try:
        return _feasible(group.id.hex(), group.wait)
    finally:
        ray.util.remove_placement_group(group)


def _feasible(group: str, ready: Callable[[float], bool]) -> bool:
    """Whether the autoscaler can start nodes for a placement group, unless that is `ready`."""
    began, first = time.monotonic(), _state().version
    while not ready(1.0):
        state = _state()
        if any(group in details for details in state.infeasible):
            return False
        # The first look may have begun before the request.
        if state.version - first > LOOKS or time.monotonic() - began > ANSWER_SECONDS:
            return True
    return True


def _state() -> State:
    from ray.core.generated.autoscaler_pb2 import GetClusterStatusReply
    from ray.experimental.internal_kv import internal_kv_get_gcs_client

    status = internal_kv_get_gcs_client().get_cluster_status()
    reply: Any = GetClusterStatusReply.FromString(status)
    scaling, resources = reply.autoscaling_state, reply.cluster_resource_state
    return State(
        version=scaling.autoscaler_state_version,
        types=frozenset(node.ray_node_type_name for node in resources.node_states),
        infeasible=frozenset(
            request.details for request in scaling.infeasible_gang_resource_requests
        ),
    )


def _types_of_the_first() -> frozenset[str]:
    """The nodes' types in the report of Ray's first autoscaler, which every head node has."""
    from ray._private.ray_constants import DEBUG_AUTOSCALING_STATUS
    from ray.experimental.internal_kv import _internal_kv_get

    report = json.loads(_internal_kv_get(DEBUG_AUTOSCALING_STATUS) or b"{}")
    return frozenset((report.get("autoscaler_report") or {}).get("active_nodes") or ())
