"""Ray's autoscaler, where a cluster has one: whether it is there, and what it could add."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import ray
import ray.util.client

ANSWER_SECONDS = 40.0
"""It looks at what waits every five seconds; a busy one takes longer."""
REPORT_SECONDS = 10.0
"""A cluster that has just been started has no report yet."""
LOOKS = 2
"""As often must it have looked at a request before silence means that it can be met."""
MACHINES_OF_YOURS = "local.cluster.node"
"""The launcher's type for listed machines: it starts them, and can't find others."""


class State(NamedTuple):
    """What the autoscaler has reported last."""

    version: int
    """Grows with each look; 0 where there is no autoscaler of this kind."""
    types: frozenset[str]
    """Names of nodes' types; "" for a node that was started by hand."""
    infeasible: frozenset[str]
    """What it says of waiting placement groups that no node it may start could hold."""


def is_there() -> bool:
    """Whether this cluster's nodes are of types, as those of an autoscaler are.

    KubeRay names the types where nothing is scaled too: only `adds_nodes` is sure.
    """
    by_hand = {"", *(f"node_{node['NodeID']}" for node in ray.nodes())}
    return bool(_types() - by_hand - {MACHINES_OF_YOURS})


def _types() -> frozenset[str]:
    """Of the nodes, as the autoscaler reports them; none where nothing reports."""
    if ray.util.client.ray.is_connected():
        return frozenset()  # `ray://` doesn't reach what has the reports
    state = _state()
    return state.types if state.version else _types_of_the_first()


def adds_nodes(bundle: Mapping[str, float], count: int = 1) -> bool:
    """Whether nodes will be added where those that there are can't hold so many bundles.

    Asks by letting them wait for a place, so the nodes are on their way afterwards.
    """
    began = time.monotonic()
    while not is_there():
        if _types() or time.monotonic() - began > REPORT_SECONDS:
            return False
        time.sleep(0.5)
    if not _state().version:
        return True  # the first autoscaler, before Ray 2.50, says nothing of it
    group = ray.util.placement_group([dict(bundle) for _ in range(count)])
    try:
        return _feasible(group.id.hex(), group.wait)
    finally:
        ray.util.remove_placement_group(group)


def _feasible(
    group: str, ready: Callable[[float], bool], now: Callable[[], float] = time.monotonic
) -> bool:
    began, first = now(), _state().version
    while not ready(1.0):
        state = _state()
        if any(group in details for details in state.infeasible):
            return False
        # The request may have come in the middle of a look.
        if state.version - first > LOOKS or now() - began > ANSWER_SECONDS:
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
    """Types by the report of Ray's first autoscaler; every head node has such a report."""
    from ray._private.ray_constants import DEBUG_AUTOSCALING_STATUS
    from ray.experimental.internal_kv import _internal_kv_get

    report = json.loads(_internal_kv_get(DEBUG_AUTOSCALING_STATUS) or b"{}")
    return frozenset((report.get("autoscaler_report") or {}).get("active_nodes") or ())
