"""The command that serves a policy until it is stopped."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Sequence
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any

from music_rllib.runtime.ray_address import ClusterError, check_reachable, cluster_address
from music_rllib.serve.schema import TOKEN_VARIABLE

if TYPE_CHECKING:
    from music_rllib.serve.application import ServeSettings
    from music_rllib.serve.load_limits import Limits

__all__ = ["main"]

BAD_INPUT = 2
DESCRIPTION = """\
Serve a trained policy over HTTP with Ray Serve: POST /act takes a goal observation, or a batch of
them, and answers with actions; GET /health, GET /policy. GET /docs describes them on a page, GET
/openapi.json for programs.
"""
EPILOG = f"""\
examples:
  python -m music_rllib.serve results/nodes/KEY
  python -m music_rllib.serve finetune/q=1.5/FetchPush/seed=0 --storage results
  curl -s localhost:8000/act -H 'Content-Type: application/json' \\
    -d '{{"observation": [1.3, ...25 numbers], "desired_goal": [1.4, 0.7, 0.5]}}'

{TOKEN_VARIABLE} in the environment makes clients send it as 'Authorization: Bearer ...'.
To listen on other addresses than loopback it must be set. RAY_ADDRESS chooses a Ray cluster.

exit codes: 0 stopped by Ctrl-C or SIGTERM, 1 serving failed, 2 bad input
"""


class _BadInputError(Exception):
    """Something that the user must change."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; its exit code."""
    arguments = _parser().parse_args(argv)
    try:
        _check_exposure(arguments.host)
        _check_port(arguments.host, arguments.port)
        _check_cluster()
        return _serve(arguments)
    except _BadInputError as error:
        from music_rllib.redaction import for_people

        print(f"error: {for_people(error)}", file=sys.stderr)
        return BAD_INPUT


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m music_rllib.serve",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "policy",
        metavar="POLICY",
        help="Folder or URI of a finished run or an exported policy, or a run's key or label.",
    )
    parser.add_argument(
        "--storage", default="results", help="Where keys and labels are looked up (results)."
    )
    parser.add_argument(
        "--env",
        metavar="ENV",
        help="The environment, where neither this package nor the policy's own file says what it "
        "takes and gives: a sweep's YAML file that declares it, or its id.",
    )
    parser.add_argument("--host", default="127.0.0.1", help="Address to listen on (127.0.0.1).")
    parser.add_argument("--port", type=_port, default=8000, help="Port to listen on (8000).")
    parser.add_argument(
        "--replicas", type=_positive, default=1, help="Processes that compute actions (1)."
    )
    parser.add_argument(
        "--max-requests",
        type=_positive,
        metavar="N",
        default=256,
        help="Requests that are answered at a time (256); further ones get status 503 and are "
        "asked to come again.",
    )
    parser.add_argument(
        "--send-seconds",
        type=_positive,
        metavar="S",
        default=10,
        help="For a client to send a request, and to take the answer (10); then it is cut off.",
    )
    return parser


def _port(text: str) -> int:
    port = _whole(text)
    if not 0 < port < 2**16:
        raise argparse.ArgumentTypeError(f"must be in 1..65535, got {port}")
    return port


def _positive(text: str) -> int:
    number = _whole(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be >= 1, got {number}")
    return number


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a whole number, got {text!r}") from None


def _check_exposure(host: str) -> None:
    try:
        loopback = host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback and not os.environ.get(TOKEN_VARIABLE):
        raise _BadInputError(
            f"--host must be a loopback address unless {TOKEN_VARIABLE} is set, got {host!r}: "
            "without a token anyone who reaches that address can use the policy"
        )


def _check_port(host: str, port: int) -> None:
    """Ray Serve itself would say so only in a worker's log."""
    if cluster_address() is not None:
        return  # it will be another machine that listens
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise _BadInputError(
            f"--host and --port must name a free port of this machine, got {host}:{port}: "
            f"{error.strerror}"
        ) from error


def _check_cluster() -> None:
    """Before anything is loaded for it; Ray itself would go on trying for minutes."""
    address = cluster_address()
    if address is None:
        return
    try:
        check_reachable(address)
    except ClusterError as error:
        raise _BadInputError(str(error)) from error


def _serve(arguments: argparse.Namespace) -> int:
    try:
        from ray import serve
    except ImportError as error:
        raise _BadInputError(
            f"Ray Serve must be installed (pip install 'music_rllib[serve]'): {error}"
        ) from error
    from music_rllib.config.load import ConfigError
    from music_rllib.policy import PolicyError
    from music_rllib.serve.application import ServeSettings, application, policy_of
    from music_rllib.serve.load_limits import Limits
    from music_rllib.serve.schema import PolicyFacts, request_model
    from music_rllib.store.object_folder import StorageError

    settings = ServeSettings(
        policy=arguments.policy,
        storage=arguments.storage,
        env=arguments.env,
        replicas=arguments.replicas,
        max_requests=arguments.max_requests,
    )
    try:
        policy = policy_of(settings)
    except (ConfigError, PolicyError, StorageError) as error:
        raise _BadInputError(str(error)) from error
    if cluster_address() is None:
        _check_room(settings, [len(os.sched_getaffinity(0))])
    limits = Limits(
        max_requests=arguments.max_requests,
        max_body_bytes=request_model(PolicyFacts.of(policy.task.name, policy)).max_bytes,
        send_seconds=arguments.send_seconds,
    )
    stop = _stop_signal()
    _connect(settings)
    try:
        _listen(arguments, limits, serve)
    except BaseException:
        _disconnect()
        raise
    try:
        _run(application(policy, settings), arguments, serve)
        stop.wait()
    finally:
        _shut_down(serve)
    return 0


def _stop_signal() -> threading.Event:
    """Set by Ctrl-C and SIGTERM."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def _connect(settings: ServeSettings) -> None:
    """A local Ray, or the cluster of the environment; refuses replicas that can never start."""
    import ray

    from music_rllib.runtime.quiet import quiet_third_parties

    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.WARNING}
    address = cluster_address()
    if address is None:
        options |= {"address": "local", "include_dashboard": False}
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        ray.init(runtime_env={"worker_process_setup_hook": quiet_third_parties}, **options)
    except (ConnectionError, RuntimeError, ValueError) as error:
        if address is None:
            raise
        raise _BadInputError(
            f"RAY_ADDRESS must be a Ray cluster that can be reached, got {address!r}: "
            f"{str(error).strip().splitlines()[0]}"
        ) from error
    finally:
        # Ray sets one of its own for SIGTERM, which would end the process at once.
        for number, handler in handlers.items():
            signal.signal(number, handler)
    nodes = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    try:
        _check_room(settings, nodes)
    except _BadInputError:
        if address is not None and _waits_for_nodes(settings):
            return
        ray.shutdown()
        raise


def _waits_for_nodes(settings: ServeSettings) -> bool:
    """Whether an autoscaler adds the nodes that replicas have no place on yet; says so."""
    from music_rllib.runtime import autoscaler

    if not autoscaler.adds_nodes({"CPU": settings.cpus_per_replica}, settings.replicas):
        return False
    print(
        f"The cluster has no room for {settings.replicas} replicas yet; its autoscaler is asked "
        "for more nodes, which may take minutes ('ray status' shows what it does).",
        flush=True,
    )
    return True


def _check_room(settings: ServeSettings, cpus_of_nodes: Sequence[float]) -> None:
    """Ray would wait for ever for more replicas than can be placed."""
    room = sum(int(cpus // settings.cpus_per_replica) for cpus in cpus_of_nodes)
    if settings.replicas > room:
        raise _BadInputError(
            f"--replicas must be <= {room}, as many as there are CPUs, got {settings.replicas}"
        )


QUIET = {"enable_access_log": False, "log_level": "WARNING"}
APPLICATION = "policy"
ANSWER_SECONDS = 60.0
"""A request that a replica has had for so long is answered with status 408."""


def _listen(arguments: argparse.Namespace, limits: Limits, serve: Any) -> None:
    """Start Serve's proxy; on a cluster where Serve runs already, see that we would not disturb."""
    from ray.serve.context import _get_global_client

    from music_rllib.serve.load_limits import controller_environment

    logging.getLogger("ray.serve").setLevel(logging.ERROR)
    wanted = (arguments.host, arguments.port)
    serve.start(
        proxy_location="HeadOnly",
        http_options={
            "host": arguments.host,
            "port": arguments.port,
            "request_timeout_s": ANSWER_SECONDS,
        },
        controller_options={"runtime_env": {"env_vars": controller_environment(limits)}},
        logging_config=QUIET,
    )
    # Serve ignores new options where it runs already.
    options = _get_global_client().http_config
    if (options.host, options.port) != wanted:
        raise _BadInputError(
            "--host and --port must be those on which Ray Serve listens on this cluster already, "
            f"{options.host}:{options.port}, got {arguments.host}:{arguments.port}"
        )
    if APPLICATION in serve.status().applications:
        raise _BadInputError(
            "RAY_ADDRESS must be a cluster that serves no policy yet, this one does; stop that "
            "service first"
        )


def _run(application: Any, arguments: argparse.Namespace, serve: Any) -> None:
    host, port = arguments.host, arguments.port
    serve.run(application, name=APPLICATION, route_prefix="/", logging_config=QUIET)
    shown = f"[{host}]" if ":" in host else host
    print(f"Serving {arguments.policy} at http://{shown}:{port}", flush=True)
    print(
        f"POST /act, GET /health, GET /policy; described at http://{shown}:{port}/docs", flush=True
    )


def _shut_down(serve: Any) -> None:
    # Others may serve on a cluster too; a local Ray ends with all that runs on it.
    if cluster_address() is not None:
        serve.delete(APPLICATION)
    _disconnect()
    print("Stopped.", flush=True)


def _disconnect() -> None:
    import ray

    ray.shutdown()
