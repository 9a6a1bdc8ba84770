"""What stands between the network and the policy service's replicas, over real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any

import aiohttp
import numpy as np
import pytest
import requests
import uvicorn
from starlette.types import Receive, Scope, Send

from music_rllib.serve.load_limits import HEAD_BYTES, Admission, Limits, guarded
from music_rllib.serve.schema import Failure

SEND_SECONDS = 0.4
LIMITS = Limits(max_requests=8, max_body_bytes=100_000, send_seconds=SEND_SECONDS)
PATIENT = LIMITS.model_copy(update={"send_seconds": 30.0})


@dataclass
class Application:
    """Takes its time, then answers with the hash of the body, or with as much as is asked for."""

    seconds: float = 0.0
    address: tuple[str, int] = ("", 0)
    bodies: list[bytes] = field(default_factory=list)
    at_once: int = 0
    most_at_once: int = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.at_once += 1
        self.most_at_once = max(self.most_at_once, self.at_once)
        try:
            message = await receive()
            assert not message["more_body"]
            self.bodies.append(message["body"])
            await asyncio.sleep(self.seconds)
            answer = bytes(int(scope["query_string"] or 0)) or sha256(message["body"]).digest()
            start = {"type": "http.response.start", "status": 200}
            await send(start | {"headers": [(b"content-length", str(len(answer)).encode())]})
            await send({"type": "http.response.body", "body": answer})
        finally:
            self.at_once -= 1

    @property
    def url(self) -> str:
        return f"http://{self.address[0]}:{self.address[1]}"

    def connect(self) -> socket.socket:
        """A client that does as it likes."""
        connection = socket.create_connection(self.address)
        connection.settimeout(20)
        return connection


@contextmanager
def serving(seconds: float = 0.0, limits: Limits = LIMITS) -> Iterator[Application]:
    application = Application(seconds)
    config = uvicorn.Config(
        Admission(application, limits), http=guarded(limits), log_level="critical", ws="none"
    )
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0), backlog=1024) as listening:
        application.address = listening.getsockname()
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        while not server.started:
            time.sleep(0.01)
        try:
            yield application
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="module")
def service() -> Iterator[Application]:
    with serving() as application:
        yield application


def rest(connection: socket.socket) -> bytes:
    """What comes until the service closes the connection."""
    received = b""
    while piece := connection.recv(65536):
        received += piece
    return received


def check_refusal(answer: bytes, status: int) -> None:
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(f"HTTP/1.1 {status} ".encode()), answer[:200]
    assert b"must" in body
    assert Failure.model_validate(json.loads(body)).model_dump() == json.loads(body)


def test_a_storm_is_answered_or_asked_to_come_again() -> None:
    async def ask(session: aiohttp.ClientSession, path: str) -> tuple[int, str | None, float]:
        began = time.monotonic()
        async with session.post(path, data=b"x" * 500) as answer:
            await answer.read()
            return answer.status, answer.headers.get("Retry-After"), time.monotonic() - began

    async def storm(url: str) -> list[list[Any]]:
        connector = aiohttp.TCPConnector(limit=0)
        async with aiohttp.ClientSession(url, connector=connector) as session:
            requests = asyncio.gather(*(ask(session, "/act") for _ in range(300)))
            await asyncio.sleep(0.05)
            health = asyncio.gather(*(ask(session, "/health") for _ in range(5)))
            return [await requests, await health]

    with serving(seconds=0.2, limits=PATIENT) as service:
        answers, healths = asyncio.run(storm(service.url))
        assert service.at_once == 0
        assert requests.post(f"{service.url}/act", timeout=20).status_code == 200
    assert {(status, again) for status, again, _ in answers} == {(200, None), (503, "1")}
    assert sum(status == 200 for status, *_ in answers) >= LIMITS.max_requests
    assert {status for status, *_ in healths} == {200}
    assert service.most_at_once <= LIMITS.max_requests + len(healths)
    assert np.quantile([seconds for *_, seconds in answers], 0.99) < 10


HALF = b"POST /act HTTP/1.1\r\nHost: x\r\nContent-Length: 1000\r\n\r\n" + b"x" * 500


def test_half_sent_bodies_reach_no_replica_and_are_cut(service: Application) -> None:
    before = len(service.bodies)
    began = time.monotonic()
    clients = [service.connect() for _ in range(10 * LIMITS.max_requests)]
    for client in clients:
        client.sendall(HALF)
    # They take nobody's place.
    assert requests.post(f"{service.url}/act", data=b"whole", timeout=20).status_code == 200
    for client in clients:
        check_refusal(rest(client), 408)
        client.close()
    assert 0.9 * SEND_SECONDS < time.monotonic() - began < 20
    assert service.bodies[before:] == [b"whole"]


CHUNKED = b"POST /act HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
WHOLE = b"POST /act HTTP/1.1\r\nHost: x\r\nContent-Length: 5\r\n\r\nhello"


@pytest.mark.parametrize(
    ("at_once", "dripped"),
    [
        (b"", b""),
        (b"", HALF),
        (b"", b"\r\n" * 1000),
        (HALF, b"x" * 400),
        (WHOLE, b"GET /policy HTTP/1.1\r\nHost: " + b"x" * 1000),
        (WHOLE, b"\r\n" * 1000),
        (
            CHUNKED,
            b"1\r\nx\r\n" * 99,
        ),
    ],
)
def test_who_drips_is_cut(service: Application, at_once: bytes, dripped: bytes) -> None:
    """A byte now and then doesn't count as progress, on a new connection or a used one."""
    began = time.monotonic()
    with service.connect() as client:
        client.sendall(at_once)
        client.settimeout(0.02)
        answer, drops, open_ = b"", iter(dripped), True
        while open_:
            with contextlib.suppress(BrokenPipeError):
                client.sendall(bytes(itertools.islice(drops, 1)))
            try:
                piece = client.recv(65536)
            except TimeoutError:
                assert time.monotonic() - began < 20, "never cut"
            except ConnectionResetError:
                open_ = False
            else:
                open_ = piece != b""
                answer += piece
    assert time.monotonic() - began > 0.9 * SEND_SECONDS
    if at_once == WHOLE:
        assert answer.startswith(b"HTTP/1.1 200 ")
        assert sha256(b"hello").digest() in answer
    else:
        check_refusal(answer, 408)


@pytest.mark.parametrize(
    ("begin", "more", "status"),
    [
        (b"POST /act HTTP/1.1\r\nHost: x\r\nContent-Length: 100001\r\n\r\n", b"", 413),
        (
            CHUNKED,
            b"2000\r\n" + b"x" * 0x2000 + b"\r\n",
            413,
        ),
        (b"GET /policy HTTP/1.1\r\nA: ", b"x" * 8192, 431),
        (b"GET /", b"x" * 8192, 431),
        (b"GET /policy HTTP/1.1\r\n", (b"a: " + b"x" * 60 + b"\r\n") * 100, 431),
        (
            CHUNKED + b"0\r\n",
            b"a: " + b"x" * 8000 + b"\r\n",
            413,
        ),
    ],
)
def test_what_is_too_long_is_refused_before_it_is_there(
    begin: bytes, more: bytes, status: int
) -> None:
    with serving(limits=PATIENT) as service, service.connect() as client:
        client.sendall(begin)
        sent, answer = 0, b""
        client.settimeout(0.02)
        while not answer:
            try:
                sent += client.send(more) if more else 0
                answer = client.recv(65536)
            except TimeoutError:
                continue
            except (BrokenPipeError, ConnectionResetError):
                break  # closed before all was read, so the answer may be lost
            assert sent < 20 * (HEAD_BYTES + 6 * LIMITS.max_body_bytes)
        if answer:
            check_refusal(answer, status)
        assert service.bodies == []


@pytest.mark.parametrize("cuts", [0, 1, 7])
def test_a_body_is_the_same_in_however_many_pieces(service: Application, cuts: int) -> None:
    rng = np.random.default_rng(cuts)
    body = rng.bytes(70_000)
    places = [0, *sorted(rng.integers(0, len(body), cuts).tolist()), len(body)]
    head = f"POST /act HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n\r\n".encode()
    with service.connect() as client:
        client.sendall(head)
        for begin, end in itertools.pairwise(places):
            client.sendall(body[begin:end])
            time.sleep(0.01)
        assert sha256(body).digest() in client.recv(65536)
    assert service.bodies[-1] == body


def test_an_answer_that_is_not_taken_is_not_kept(service: Application) -> None:
    size = 50_000_000  # the system's own buffers take a few
    with service.connect() as client:
        client.sendall(f"GET /act?{size} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        head = client.recv(10)
        time.sleep(4 * SEND_SECONDS)
        received = len(head)
        with contextlib.suppress(ConnectionResetError):
            received += len(rest(client))
        assert received < size


def test_bodies_of_all_together_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("music_rllib.serve.load_limits.HELD_BYTES", 3000)
    with serving(limits=PATIENT) as service:
        clients = [service.connect() for _ in range(7)]
        for client in clients:
            client.sendall(HALF)
            time.sleep(0.02)
        answer = requests.post(f"{service.url}/act", data=b"x", timeout=20)
        assert (answer.status_code, answer.headers["Retry-After"]) == (503, "1")
        for client in clients:
            client.close()
        deadline = time.monotonic() + 20
        while requests.post(f"{service.url}/act", data=b"x", timeout=20).status_code != 200:
            assert time.monotonic() < deadline
            time.sleep(0.02)
