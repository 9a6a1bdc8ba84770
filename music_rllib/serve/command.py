"""The command that serves a policy until it is stopped."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import signal
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from ipaddress import ip_address
from typing import TYPE_CHECKING, Annotated

import typer

from music_rllib.errors import BadInputError
from music_rllib.redaction import redact
from music_rllib.runtime.machine import check_reachable, cluster_address
from music_rllib.runtime.process import SIGNALS
from music_rllib.serve import TOKEN_VARIABLE

if TYPE_CHECKING:
    from music_rllib.policy import Policy
    from music_rllib.serve.application import ServeSettings

EXAMPLES = f"""\
Examples:
  music-rllib serve results/smoke/best
  music-rllib serve finetune/q=1.5/seed0 --storage results
  curl -s localhost:8000/act -H 'Content-Type: application/json' \\
    -d '{{"observation": [1.3, ...25 numbers], "desired_goal": [1.4, 0.7, 0.5]}}'

{TOKEN_VARIABLE} in the environment makes clients send it as
'Authorization: Bearer ...'. To listen on other addresses than loopback it must
be set. RAY_ADDRESS=HOST:PORT chooses a Ray cluster.

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
        str, typer.Option(metavar="PLACE", help="Where keys and labels are looked up.")
    ] = "results",
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=2**16 - 1, help="Port to listen on.")] = 8000,
    replicas: Annotated[int, typer.Option(min=1, help="Processes that compute actions.")] = 1,
    max_requests: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=1,
            help="Requests that wait for a replica; further ones get status 503 and a Retry-After "
            "header.",
        ),
    ] = 256,
) -> int:
    """Serve a trained policy over HTTP, until it is stopped.

    POST /act takes a goal observation, or a batch of them, and answers with actions; GET /health,
    GET /policy. GET /openapi.json describes them.
    """
    _check_exposure(host)
    _check_port(host, port)
    if (cluster := cluster_address()) is not None:
        check_reachable(cluster)  # Ray itself would go on trying for minutes
    try:
        import ray.serve  # noqa: F401
    except ImportError as error:
        raise BadInputError(
            f"Ray Serve must be installed (pip install 'music_rllib[serve]'): {error}"
        ) from error
    from music_rllib.serve.application import ServeSettings, policy_of

    settings = ServeSettings(
        policy=policy, storage=storage, replicas=replicas, max_requests=max_requests
    )
    served = policy_of(settings)
    if cluster is None:
        _check_room(settings, [len(os.sched_getaffinity(0))])
    _on_signals(_interrupt)
    with contextlib.suppress(KeyboardInterrupt):
        _connect(settings)
        _serve(served, settings, host, port)
    return 0


def _on_signals(handler: Callable[..., None]) -> None:
    for number in SIGNALS:
        signal.signal(number, handler)


def _interrupt(*_: object) -> None:
    """Raise KeyboardInterrupt for a signal: Ray waits without end for what does not start."""
    raise KeyboardInterrupt


def _check_exposure(host: str) -> None:
    """Refuse an address that others reach, unless there is a token."""
    try:
        loopback = host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback and not os.environ.get(TOKEN_VARIABLE):
        raise BadInputError(
            f"--host must be a loopback address unless {TOKEN_VARIABLE} is set, got {host!r}: "
            "without a token anyone who reaches that address can use the policy"
        )
    if not re.fullmatch(r"[!-~]*", os.environ.get(TOKEN_VARIABLE, "")):
        raise BadInputError(
            f"{TOKEN_VARIABLE} must have only ASCII characters without spaces or line ends, as no "
            "client can send others"
        )


def _check_port(host: str, port: int) -> None:
    """Check that the port is free: Ray Serve itself would say so only in a worker's log."""
    if cluster_address() is not None:
        return  # another machine listens
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, ValueError) as error:  # ValueError: no name that could be a host's
        raise BadInputError(
            f"--host and --port must name a free port of this machine, got {host}:{port}: "
            f"{getattr(error, 'strerror', None) or error}"
        ) from error


def _connect(settings: ServeSettings) -> None:
    """Start a local Ray, or connect to RAY_ADDRESS; refuse replicas that can never start."""
    import ray

    from music_rllib.runtime.ray_cluster import grows, start_ray, stop_ray

    start_ray()
    _on_signals(_interrupt)  # Ray's own handler of SIGTERM would end the process at once
    nodes = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    try:
        _check_room(settings, nodes)
    except BadInputError:
        if cluster_address() is None or not grows():
            stop_ray()
            raise
        print(
            f"The cluster has no room for {settings.replicas} replicas yet; the service waits "
            "until its autoscaler adds nodes ('ray status' shows what it does).",
            flush=True,
        )


def _check_room(settings: ServeSettings, cpus_of_nodes: Sequence[float]) -> None:
    """Refuse more replicas than can be placed: Ray would wait for them without end."""
    room = sum(int(cpus // settings.cpus_per_replica) for cpus in cpus_of_nodes)
    if settings.replicas > room:
        raise BadInputError(
            f"--replicas must be <= {room}, as many as there are CPUs, got {settings.replicas}"
        )


QUIET = {"enable_access_log": False, "log_level": "WARNING"}
APPLICATION = "policy"
ANSWER_SECONDS = 60.0
"""Time for a replica to answer a request; after it the answer is status 408."""


def _serve(policy: Policy, settings: ServeSettings, host: str, port: int) -> None:
    """Serve until a signal comes, then leave Ray; where that dies, end the process."""
    from ray import serve as ray_serve

    from music_rllib.runtime.ray_cluster import stop_ray
    from music_rllib.serve.application import application

    listening = False
    try:
        _listen(host, port)
        listening = True
        ray_serve.run(
            application(policy, settings),
            name=APPLICATION,
            route_prefix="/",
            logging_config=QUIET,
        )
        url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        stop = threading.Event()
        _on_signals(lambda *_: stop.set())
        print(f"Serving {redact(settings.policy)} at {url}", flush=True)
        print(f"POST /act, GET /health, GET /policy; described at {url}/openapi.json", flush=True)
        _wait(stop)
    finally:
        # Others may serve on a cluster too; a local Ray ends with all that runs on it.
        if listening and cluster_address() is not None:
            ray_serve.delete(APPLICATION)
        stop_ray()
        if listening:
            print("Stopped.", flush=True)


def _wait(stop: threading.Event) -> None:
    """Wait for the signal, or end the process when Ray has died: Ray itself would wait for it."""
    from music_rllib.runtime.process import end_process
    from music_rllib.runtime.ray_cluster import LOOK_SECONDS, RayWatch

    watch = RayWatch()
    while not stop.wait(LOOK_SECONDS):
        if (died := watch.look()) is not None:
            print(f"error: {died}", file=sys.stderr, flush=True)
            end_process(1)


def _listen(host: str, port: int) -> None:
    """Start Serve's proxy; refuse to disturb a Serve that runs on the cluster already."""
    from ray import serve as ray_serve
    from ray.serve.context import _get_global_client

    logging.getLogger("ray.serve").setLevel(logging.ERROR)
    ray_serve.start(
        proxy_location="HeadOnly",
        http_options={"host": host, "port": port, "request_timeout_s": ANSWER_SECONDS},
        logging_config=QUIET,
    )
    # Serve ignores new options where it runs already.
    options = _get_global_client().http_config
    if (options.host, options.port) != (host, port):
        raise BadInputError(
            "--host and --port must be those on which Ray Serve listens on this cluster already, "
            f"{options.host}:{options.port}, got {host}:{port}"
        )
    if APPLICATION in ray_serve.status().applications:
        raise BadInputError(
            "RAY_ADDRESS must be a cluster that serves no policy yet, this one does; stop that "
            "service first"
        )
