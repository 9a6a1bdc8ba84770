"""`serve`: a policy over HTTP until the program is stopped."""

from __future__ import annotations

import contextlib
import logging
import socket
import sys
import threading
from collections.abc import Sequence
from ipaddress import ip_address
from typing import TYPE_CHECKING, Annotated

import typer

from music_rllib.errors import BadInputError
from music_rllib.redaction import redact
from music_rllib.runtime.machine import check_reachable, cluster_address, cpus_here
from music_rllib.runtime.process import handle_signals
from music_rllib.serve import TOKEN_VARIABLE, given_token

if TYPE_CHECKING:
    from ray.serve import Application

    from music_rllib.serve.application import ServeSettings

QUIET = {"enable_access_log": False, "log_level": "WARNING"}
ANSWER_SECONDS = 10.0
"""Time to receive a request and to answer it; after it the answer is status 408."""

EXAMPLES = f"""\
Examples:
  music-rllib serve results/smoke/best
  music-rllib serve finetune/q=1.5/seed0 --storage results
  curl -s localhost:8000/act -H 'Content-Type: application/json' \\
    -d '{{"observation": [1.3, ...25 numbers], "desired_goal": [1.4, 0.7, 0.5]}}'

If {TOKEN_VARIABLE} is set in the environment, clients must send it as
'Authorization: Bearer ...'. Addresses other than loopback require it.
RAY_ADDRESS=HOST:PORT selects a Ray cluster.

Exit codes: 0 stopped by Ctrl-C or SIGTERM, 1 serving failed, 2 bad input.
"""


def serve(
    policy: Annotated[
        str,
        typer.Argument(
            metavar="POLICY",
            help="Folder or URI of a finished run or an exported policy, or a run's key or label.",
        ),
    ],
    storage: Annotated[
        str, typer.Option(metavar="PLACE", help="Storage in which keys and labels are looked up.")
    ] = "results",
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=2**16 - 1, help="Port to listen on.")] = 8000,
    replicas: Annotated[int, typer.Option(min=1, help="Number of processes.")] = 1,
    max_requests: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=1,
            help="Maximum number of waiting requests; further ones get status 503 and a "
            "Retry-After header.",
        ),
    ] = 256,
) -> int:
    """Serve a trained policy over HTTP until the program is stopped.

    POST /act takes an observation, or a batch of them, and answers with actions. GET /health and
    GET /policy describe the service, GET /openapi.json its requests.
    """
    _check_exposure(host)
    if (cluster := cluster_address()) is not None:
        check_reachable(cluster)  # Ray itself would try for minutes
    else:
        _check_port(host, port)
    try:
        import ray.serve  # noqa: F401
    except ImportError as error:
        raise BadInputError(
            f"Ray Serve must be installed (pip install 'music_rllib[serve]'): {error}"
        ) from error
    from music_rllib.runtime.ray_cluster import start_ray, stop_ray
    from music_rllib.serve.application import ServeSettings, application, policy_of

    settings = ServeSettings(
        policy=policy, storage=storage, replicas=replicas, max_requests=max_requests
    )
    served = policy_of(settings)
    if cluster is None:
        _check_replicas(settings, [cpus_here()])
    handle_signals(_interrupt)
    with contextlib.suppress(KeyboardInterrupt):
        start_ray(num_cpus=None if cluster else cpus_here())
        try:
            handle_signals(_interrupt)  # Ray's own handler of SIGTERM would end the process at once
            if cluster is not None:
                _check_cluster(settings)
            _serve(application(served, settings), settings, host, port)
        finally:
            stop_ray()
    return 0


def _interrupt(*_: object) -> None:
    """Raise KeyboardInterrupt for a signal, because Ray waits without end for its start."""
    raise KeyboardInterrupt


def _check_exposure(host: str) -> None:
    """Refuse an address that other machines reach, unless there is a token."""
    try:
        loopback = host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not given_token() and not loopback:
        raise BadInputError(
            f"--host must be a loopback address unless {TOKEN_VARIABLE} is set, got {host!r}: "
            "without a token anyone who reaches that address can use the policy"
        )


def _check_port(host: str, port: int) -> None:
    """Check that the port is free; Ray Serve reports that only in a worker's log."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, ValueError) as error:  # ValueError: not the name of a host
        raise BadInputError(
            f"--host and --port must name a free port of this machine, got {host}:{port}: "
            f"{getattr(error, 'strerror', None) or error}"
        ) from error


def _check_replicas(settings: ServeSettings, cpus_of_nodes: Sequence[float]) -> None:
    """Refuse more replicas than fit, because Ray would wait for them without end."""
    most = sum(int(cpus // settings.cpus_per_replica) for cpus in cpus_of_nodes)
    if settings.replicas > most:
        raise BadInputError(
            f"--replicas must be <= {most}, the number of CPUs, got {settings.replicas}"
        )


def _check_cluster(settings: ServeSettings) -> None:
    """Check that the cluster has room for the replicas, and no Ray Serve yet."""
    import ray
    from ray import serve as ray_serve

    from music_rllib.runtime.ray_cluster import grows

    if not grows():
        nodes = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
        _check_replicas(settings, nodes)
    if ray_serve.status().proxies:
        raise BadInputError(
            "RAY_ADDRESS must be a cluster that does not run Ray Serve yet, this one does; stop it "
            "first, or use 'serve deploy'"
        )


def _serve(app: Application, settings: ServeSettings, host: str, port: int) -> None:
    """Serve until a signal comes, or end the process when Ray dies."""
    from ray import serve as ray_serve

    from music_rllib.runtime.process import end_process
    from music_rllib.runtime.ray_cluster import LOOK_SECONDS, RayWatch

    logging.getLogger("ray.serve").setLevel(logging.ERROR)
    try:
        ray_serve.start(
            proxy_location="HeadOnly",
            http_options={"host": host, "port": port, "request_timeout_s": ANSWER_SECONDS},
            logging_config=QUIET,
        )
        ray_serve.run(app, name="policy", route_prefix="/", logging_config=QUIET)
        url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        stop = threading.Event()
        handle_signals(lambda *_: stop.set())
        print(f"Serving {redact(settings.policy)} at {url}", flush=True)
        print(f"POST /act, GET /health, GET /policy; described at {url}/openapi.json", flush=True)
        watch = RayWatch()
        while not stop.wait(LOOK_SECONDS):
            if (died := watch.look()) is not None:
                print(f"error: {died}", file=sys.stderr, flush=True)
                end_process(1)
    finally:
        if cluster_address() is not None:  # a local Ray ends with Serve
            ray_serve.shutdown()
        print("Stopped.", flush=True)
