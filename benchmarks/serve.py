"""Load test of the served policy on loopback: requests per second and latencies.

`python -m benchmarks.serve [POLICY]` starts the service as a user does. Clients send observations
without pauses, and every 100th answer is compared with the policy. Without POLICY the weights are
random, which costs the same.

`--storm N` sends N requests at once, in parallel with N requests whose bodies never end. See
`python -m benchmarks.serve --help`.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import aiohttp
import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.policy import Policy, PolicyNetwork, load_policy

START_SECONDS = 120
CHECKED = 100
"""One of this many answers is compared with the policy."""


@dataclass
class Load:
    """Result of one combination of clients and rows."""

    clients: int
    rows: int
    seconds: float = 0.0
    latencies: list[float] = field(default_factory=list)
    """Duration of each request with status 200, in seconds."""
    errors: int = 0
    """Other statuses, and connections that broke."""
    wrong: int = 0
    """Number of actions that differ from the policy's."""


def random_policy(task: str = "FetchPush", hidden: int = 256) -> bytes:
    """A policy file with random weights and FetchPush's sizes."""
    rng = np.random.default_rng(0)
    observation, goal, action = 25, 3, 4
    sizes = [observation + goal, hidden, hidden, hidden, 2 * action]
    about = {
        "task": BUILT_IN_TASKS[task].model_dump(mode="json"),
        "variant": "tac",
        "seed": 0,
        "node_key": "random",
        "env_steps": 0,
        "max_episode_steps": 50,
    }
    return PolicyNetwork(
        weights=tuple(
            rng.normal(0, into**-0.5, (out, into)).astype(np.float32)
            for into, out in pairwise(sizes)
        ),
        biases=tuple(np.zeros(out, np.float32) for out in sizes[1:]),
        mean=np.zeros(sizes[0], np.float32),
        inverse_std=np.ones(sizes[0], np.float32),
        clip=5.0,
        low=-np.ones(action, np.float32),
        high=np.ones(action, np.float32),
        goal_size=goal,
        about=about,
    ).to_bytes()


@contextmanager
def service(policy: str, replicas: int) -> Iterator[tuple[str, int]]:
    """Run `music-rllib serve` on a free port of loopback; yields its URL and process id."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    arguments = ["--port", str(port), "--replicas", str(replicas)]
    process = subprocess.Popen(
        [sys.executable, "-m", "music_rllib", "serve", policy, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        env={name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"},
    )
    try:
        assert process.stdout is not None
        if not process.stdout.readline().startswith("Serving"):
            raise SystemExit("the service did not start")
        yield f"http://127.0.0.1:{port}", process.pid
    finally:
        process.terminate()
        process.wait(timeout=START_SECONDS)


async def measure(url: str, policy: Policy, load: Load, seconds: float) -> None:
    """Let `load.clients` clients send requests for `seconds`."""
    began = time.perf_counter()
    until = began + seconds
    connector = aiohttp.TCPConnector(limit=load.clients)
    async with aiohttp.ClientSession(url, connector=connector) as session:
        await asyncio.gather(
            *(_client(session, policy, load, seed, until) for seed in range(load.clients))
        )
    load.seconds = time.perf_counter() - began


async def _client(
    session: aiohttp.ClientSession, policy: Policy, load: Load, seed: int, until: float
) -> None:
    rng = np.random.default_rng(seed)
    shape = () if load.rows == 1 else (load.rows,)
    observation: dict[str, Any] = {
        "observation": rng.normal(size=(*shape, policy.observation_size)).tolist()
    }
    if policy.goal_size:
        observation["desired_goal"] = rng.normal(size=(*shape, policy.goal_size)).tolist()
    expected = policy.act(observation)
    count = 0
    while (began := time.perf_counter()) < until:
        try:
            async with session.post("/act", json=observation) as answer:
                body = await answer.json()
        except aiohttp.ClientError:
            load.errors += 1
            continue
        if answer.status != 200:
            load.errors += 1
            continue
        load.latencies.append(time.perf_counter() - began)
        count += 1
        if count % CHECKED == 1:
            load.wrong += not np.allclose(body["action"], expected, atol=1e-5)


@dataclass
class Storm:
    """Result of many simultaneous requests."""

    answers: list[tuple[int, float]] = field(default_factory=list)
    """Status and seconds of each request; 0 if the connection broke."""
    healths: list[tuple[int, float]] = field(default_factory=list)
    """Status and seconds of each request to Serve's own health check meanwhile, one at a time."""
    without_retry: int = 0
    """Number of answers 503 without a Retry-After header."""

    def quantile(self, share: float, *statuses: int) -> float:
        """Seconds of the answers with these statuses."""
        return float(np.quantile([t for status, t in self.answers if status in statuses], share))

    def count(self, *statuses: int) -> int:
        """Number of answers with these statuses."""
        return sum(status in statuses for status, _ in self.answers)


async def storm(url: str, policy: Policy, count: int, token: str | None = None) -> Storm:
    """Send `count` requests in parallel, each on its own connection."""
    seen = Storm()
    body = {"observation": [0.5] * policy.observation_size}
    if policy.goal_size:
        body["desired_goal"] = [0.5] * policy.goal_size
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    over = asyncio.Event()

    async def ask(session: aiohttp.ClientSession) -> None:
        began = time.perf_counter()
        try:
            async with session.post("/act", json=body, headers=headers) as answer:
                await answer.read()
                status, again = answer.status, answer.headers.get("Retry-After")
        except aiohttp.ClientError:
            status, again = 0, None
        seen.answers.append((status, time.perf_counter() - began))
        seen.without_retry += status == 503 and again is None

    async def watch(session: aiohttp.ClientSession) -> None:
        while not over.is_set():
            began = time.perf_counter()
            async with session.get("/-/healthz") as answer:
                await answer.read()
            seen.healths.append((answer.status, time.perf_counter() - began))
            await asyncio.sleep(0.1)

    connector = aiohttp.TCPConnector(limit=0)
    async with aiohttp.ClientSession(url, connector=connector) as session:
        watching = asyncio.create_task(watch(session))
        await asyncio.gather(*(ask(session) for _ in range(count)))
        over.set()
        await watching
    return seen


@contextmanager
def half_sent(url: str, count: int) -> Iterator[list[socket.socket]]:
    """Send `count` requests whose bodies never end."""
    host, port = url.removeprefix("http://").split(":")
    head = f"POST /act HTTP/1.1\r\nHost: {host}\r\nContent-Length: 60000\r\n\r\n"
    with ExitStack() as stack:
        opened = []
        for _ in range(count):
            client = stack.enter_context(socket.create_connection((host, int(port))))
            client.sendall(head.encode() + b" " * 30000)
            opened.append(client)
        yield opened


def memory(service: int) -> float:
    """MB of the proxy and the replicas below the process `service`."""
    workers = psutil.Process(service).children(recursive=True)
    serving = [w for w in workers if re.match("ray::(Proxy|ServeReplica)", w.cmdline()[0])]
    assert len(serving) >= 2
    return float(sum(worker.memory_info().rss for worker in serving) / 1e6)


def weather(url: str, policy: Policy, count: int, process: int) -> int:
    """Run and print a storm; 1 if an answer was neither a result nor a refusal with Retry-After."""
    before = memory(process)
    with half_sent(url, count):
        seen = asyncio.run(storm(url, policy, count))
        during = memory(process)
        time.sleep(12)
    after = memory(process)
    again = asyncio.run(storm(url, policy, 1))
    print(f"{count} requests at once, in parallel with {count} whose bodies never end:")
    for status in (200, 503):
        if seen.count(status):
            shown = [f"{seen.quantile(share, status):.2f}" for share in (0.5, 0.99, 1)]
            print(f"  {status}: {seen.count(status)}, median, 99% and slowest s {shown}")
    worst = max(seconds for _, seconds in seen.healths)
    print(f"  /-/healthz meanwhile: {len(seen.healths)} times, slowest {worst:.2f} s")
    print(f"  proxy and replica: {before:.0f} MB before, {during:.0f} during, {after:.0f} after")
    print(f"  load average {os.getloadavg()[0]:.1f}")
    bad = len(seen.answers) - seen.count(200, 503) + seen.without_retry
    return int(bad > 0 or again.count(200) != 1 or {s for s, _ in seen.healths} != {200})


def table(loads: list[Load]) -> Table:
    """A table with a row per combination."""
    shown = Table("clients", "rows", "requests/s", "actions/s", "median ms", "95 %", "99 %", "bad")
    for load in loads:
        rate = len(load.latencies) / load.seconds
        quantiles = np.quantile(load.latencies or [np.nan], [0.5, 0.95, 0.99]) * 1000
        shown.add_row(
            str(load.clients),
            str(load.rows),
            f"{rate:,.0f}",
            f"{rate * load.rows:,.0f}",
            *(f"{value:.1f}" for value in quantiles),
            str(load.errors + load.wrong),
        )
    return shown


def main() -> int:
    """Measure, print, and fail if an answer was an error or wrong."""
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m benchmarks.serve")
    parser.add_argument("policy", nargs="?", help="folder, URI or file of a policy")
    parser.add_argument("--seconds", type=float, default=5.0, help="per combination (5)")
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--rows", type=int, nargs="+", default=[1, 64], help="per request (1 64)")
    parser.add_argument("--replicas", type=int, default=1)
    parser.add_argument("--storm", type=int, metavar="N", help="N requests at once instead")
    arguments = parser.parse_args()
    loads = [Load(clients, rows) for rows in arguments.rows for clients in arguments.clients]
    with TemporaryDirectory() as folder:
        place = arguments.policy
        if place is None:
            place = str(Path(folder, "policy.safetensors"))
            Path(place).write_bytes(random_policy())
        policy = load_policy(place)
        with service(place, arguments.replicas) as (url, process):
            if arguments.storm:
                return weather(url, policy, arguments.storm, process)
            for load in loads:
                asyncio.run(measure(url, policy, load, arguments.seconds))
    Console().print(table(loads))
    return int(any(load.errors or load.wrong or not load.latencies for load in loads))


if __name__ == "__main__":
    sys.exit(main())
