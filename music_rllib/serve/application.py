"""The policy as a Ray Serve application: replicas that compute waiting requests together.

`app` builds it, for `python -m music_rllib.serve`, `serve run` and the configuration of
`serve deploy` (cluster/serve.yaml).
"""

from __future__ import annotations

import os
from ipaddress import ip_address
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import ray
from pydantic import BaseModel, ConfigDict, Field
from ray import serve
from ray._common.tls_utils import add_port_to_grpc_server
from ray.serve import Application
from ray.serve._private import replica
from ray.serve.config import BackpressureConfig

from music_rllib.policy import Policy, PolicyNetwork, find_policy, load_policy, named_environment
from music_rllib.runtime.allocator import give_back_freed_memory
from music_rllib.serve import TOKEN_VARIABLE
from music_rllib.serve.api import make_api, token_hash
from music_rllib.serve.load_limits import FOR_HEALTH, RETRY_SECONDS, Limits
from music_rllib.serve.schema import Array, PolicyFacts, Rows, compute

TOGETHER = 64
"""Requests that are computed together at most."""
WAIT_SECONDS = 0.002
"""How long the first one waits for more."""


class ServeSettings(BaseModel):
    """What is served; the arguments of `app`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    policy: str = Field(min_length=1)
    """Folder or URI of a finished node, an exported policy, or a run's key or label."""
    storage: str = "results"
    """Where keys and labels are looked up."""
    env: str | None = None
    """The environment, where the policy doesn't say what it takes and gives: a sweep's YAML file
    that declares it, or its id."""
    replicas: int = Field(1, ge=1)
    """Processes that compute actions."""
    cpus_per_replica: float = Field(1.0, gt=0)
    """CPUs reserved for each."""
    max_requests: int = Field(Limits().max_requests, ge=1)
    """Requests that wait for a replica at most, for each proxy; further ones get status 503."""
    token_required: bool = False
    """Refuse to start without a token in the environment; for services beyond loopback."""


def app(settings: ServeSettings) -> Application:
    """Load the policy once and give its weights to every replica, so that all act the same.

    Raises:
        PolicyError: There is no such policy.
        ConfigError: The file that declares its environment is wrong.
        ValueError: A token is required and there is none.
    """
    return application(policy_of(settings), settings)


def policy_of(settings: ServeSettings) -> Policy:
    """The policy that is to be served; raises as `app` does."""
    place = find_policy(settings.policy, settings.storage)
    return load_policy(place, named_environment(settings.env))


def application(policy: Policy, settings: ServeSettings) -> Application:
    """The same for a policy that is loaded.

    Raises:
        ValueError: A token is required and there is none.
    """
    token = os.environ.get(TOKEN_VARIABLE)
    if settings.token_required and not token:
        raise ValueError(f"{TOKEN_VARIABLE} must be set in the environment for token_required")
    deployment: Any = PolicyServer
    # The token's hash: a deployment's arguments are kept by Ray and may be shown.
    return deployment.options(
        num_replicas=settings.replicas,
        max_queued_requests=settings.max_requests + FOR_HEALTH,
        ray_actor_options={"num_cpus": settings.cpus_per_replica},
    ).bind(policy.to_bytes(), policy.task.name, token_hash(token) if token else None)


@serve.deployment(
    name="policy",
    max_ongoing_requests=2 * TOGETHER,
    backpressure_config=BackpressureConfig(retry_after_s=RETRY_SECONDS),
)
@serve.ingress()
class PolicyServer:
    """A replica."""

    def __init__(self, weights: bytes, task: str, token_sha256: str | None) -> None:
        """Take a policy's bytes (`Policy.to_bytes`) for the task of this name."""
        give_back_freed_memory()
        _stay_on_loopback()
        with TemporaryDirectory() as folder:
            file = Path(folder, "policy.safetensors")
            file.write_bytes(weights)
            self._policy = PolicyNetwork.from_file(file)
        self._facts = PolicyFacts.of(task, self._policy)
        self._token_sha256 = token_sha256

    def __serve_build_asgi_app__(self) -> Any:
        """Called by Serve when the replica is there."""
        return make_api(self._facts, self._act, self._token_sha256)

    def check_health(self) -> None:
        """Called by Serve now and then; a replica that can't act is replaced.

        Raises:
            RuntimeError: The policy gives no finite action for zeros.
        """
        zeros = {name: np.zeros((1, n), np.float32) for name, n in self._facts.parts.items()}
        if not np.isfinite(compute(self._policy, [zeros])[0]).all():
            raise RuntimeError("the policy has no finite action for an observation of zeros")

    async def _act(self, rows: Rows) -> Array:
        actions: Array = await self._act_together(rows)
        return actions

    @serve.batch(max_batch_size=TOGETHER, batch_wait_timeout_s=WAIT_SECONDS)
    async def _act_together(self, waiting: list[Rows]) -> list[Array]:
        return compute(self._policy, waiting)


def _stay_on_loopback() -> None:
    """Where Ray's node listens on loopback only, have this replica do so, too.

    Serve opens a port for calls between deployments on all addresses, and has no setting for it.
    """
    address = ray.util.get_node_ip_address()
    if ip_address(address).is_loopback:
        replica.add_port_to_grpc_server = lambda server, _: add_port_to_grpc_server(
            server, f"{address}:0"
        )
