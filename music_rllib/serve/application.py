"""A policy as a Ray Serve application; its replicas compute waiting requests together.

`app` builds it for `serve run` and for `serve deploy` (cluster/serve.yaml), `application` for
`music-rllib serve`.
"""

from __future__ import annotations

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

from music_rllib.policy import Policy, PolicyNetwork, find_policy, load_policy
from music_rllib.runtime.process import give_back_freed_memory
from music_rllib.serve import TOKEN_VARIABLE, given_token
from music_rllib.serve.api import Array, PolicyFacts, Rows, compute, make_api, token_hash

TOGETHER = 64
"""Maximum number of requests that are computed together."""
WAIT_SECONDS = 0.002
"""Time that the first request waits for others."""
RETRY_SECONDS = 1
"""Value of the Retry-After header of a refused request."""


class ServeSettings(BaseModel):
    """The arguments of `app`: the policy, and how it is served."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    policy: str
    """Folder or URI of a finished node, an exported policy, or a run's key or label."""
    storage: str = "results"
    """Storage in which keys and labels are looked up."""
    replicas: int = Field(1, ge=1)
    """Processes that compute actions."""
    cpus_per_replica: float = Field(1.0, gt=0)
    """CPUs reserved for each."""
    max_requests: int = Field(256, ge=1)
    """Maximum number of requests that wait for a replica; further ones get status 503."""
    token_required: bool = False
    """Refuse to start without a token in the environment; for services beyond loopback."""


def app(settings: ServeSettings) -> Application:
    """The application. The weights are loaded once, and every replica gets them.

    Raises:
        PolicyError: There is no such policy.
        ValueError: A token is required and there is none.
    """
    return application(policy_of(settings), settings)


def policy_of(settings: ServeSettings) -> Policy:
    """The policy of `settings`; raises the errors of `app`."""
    return load_policy(find_policy(settings.policy, settings.storage))


def application(policy: Policy, settings: ServeSettings) -> Application:
    """The application of a loaded policy.

    Raises:
        BadInputError: No client can send the token.
        ValueError: A token is required and there is none.
    """
    token = given_token()
    if settings.token_required and not token:
        raise ValueError(f"{TOKEN_VARIABLE} must be set in the environment for token_required")
    deployment: Any = PolicyServer
    # The token's hash, because Ray keeps a deployment's arguments and may show them.
    return deployment.options(
        num_replicas=settings.replicas,
        max_queued_requests=settings.max_requests,
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
        """Load a policy's bytes (`Policy.to_bytes`), trained on the task of this name."""
        give_back_freed_memory()
        _stay_on_loopback()
        with TemporaryDirectory() as folder:
            file = Path(folder, "policy.safetensors")
            file.write_bytes(weights)
            self._policy = PolicyNetwork.from_file(file)
        self._facts = PolicyFacts.of(task, self._policy)
        self._token_sha256 = token_sha256

    def __serve_build_asgi_app__(self) -> Any:
        """The web application; Serve calls this when the replica has started."""
        return make_api(self._facts, self._act, self._token_sha256)

    def check_health(self) -> None:
        """Serve calls this periodically, and replaces a replica that raises an error.

        Raises:
            RuntimeError: The policy gives no finite action for zeros.
        """
        zeros = {name: np.zeros((1, n), np.float32) for name, n in self._facts.parts.items()}
        if not np.isfinite(compute(self._policy, [zeros])[0]).all():
            raise RuntimeError("the policy has no finite action for an observation of zeros")

    @serve.batch(max_batch_size=TOGETHER, batch_wait_timeout_s=WAIT_SECONDS)
    async def _act(self, waiting: list[Rows]) -> list[Array]:
        """Actions of several requests; called with the rows of one of them."""
        return compute(self._policy, waiting)


def _stay_on_loopback() -> None:
    """Make this replica listen on loopback only, if Ray's node does.

    Ray Serve 2.60 opens a port for calls between deployments on `[::]`. It has no setting for it:
    `HTTPOptions.host` and its environment variables are about the proxy only.
    """
    address = ray.util.get_node_ip_address()
    if ip_address(address).is_loopback:
        replica.add_port_to_grpc_server = lambda server, _: add_port_to_grpc_server(
            server, f"{address}:0"
        )
