"""What a service takes on under load: so many requests, bytes and seconds, and no more.

Ray Serve's proxy (uvicorn) hands a request on as soon as its headers are there and waits for ever
for the rest. Its one hook for the proxy is an import path in the environment of Serve's controller
(`controller_environment`); it leads to `middlewares` below. `Admission` takes a request's body in
before a replica hears of it; `guarded` watches the connection, which a middleware doesn't see.
Serve's own `max_queued_requests` stands behind both, for proxies without them.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable, Mapping
from http import HTTPStatus
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.middleware import Middleware
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from music_rllib.runtime.allocator import give_back_freed_memory

LIMITS_VARIABLE = "MUSIC_RLLIB_SERVE_LIMITS"
"""`Limits` as JSON, for proxies that somebody else starts."""
FOR_HEALTH = 16
"""Requests for health that are answered while all others are refused."""
HEALTH = ("/health", "/-/healthz", "/-/routes")
CONNECTIONS = 4096
"""Open at a time; further ones are closed at once."""
HEAD_BYTES = 64 * 2**10
"""Of the request line and all headers; also of what chunks and trailers add to a body."""
HELD_BYTES = 64 * 2**20
"""Bodies of all requests together; one alone may be larger."""
RETRY_SECONDS = 1


class Limits(BaseModel):
    """Of one proxy."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    max_requests: int = Field(256, ge=1)
    """Requests that are answered at a time, waiting ones included."""
    max_body_bytes: int = Field(16 * 2**20, ge=1)
    """Of one request."""
    send_seconds: float = Field(10.0, gt=0)
    """For a client to send a whole request, and to take the answer."""


def controller_environment(limits: Limits) -> dict[str, str]:
    """Environment of Serve's controller, which its proxies inherit, so that they keep `limits`."""
    return {
        "RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH": f"{__name__}.{middlewares.__name__}",
        LIMITS_VARIABLE: limits.model_dump_json(),
    }


def middlewares() -> list[Middleware]:
    """Called by Serve in each of its proxies, before that one listens."""
    from uvicorn.protocols.http import auto

    limits = Limits.model_validate_json(os.environ.get(LIMITS_VARIABLE) or "{}")
    give_back_freed_memory()
    # Serve has no setting for it; uvicorn looks here for what it makes of a connection.
    auto.AutoHTTPProtocol = guarded(limits)
    return [Middleware(Admission, limits=limits)]


class Admission:
    """Takes whole requests in, as many as can be answered soon; refuses the others at once."""

    def __init__(self, app: ASGIApp, limits: Limits) -> None:
        self._app = app
        self._limits = limits
        self._answering = 0
        self._held = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = _Request(scope, receive)
        try:
            refusal = self._refusal(request) or await self._take_in(request)
            if refusal is not None:
                await refusal(scope, receive, send)
            elif request.whole:
                await self._answer(request, send)
        finally:
            self._held -= request.size

    async def _take_in(self, request: _Request) -> JSONResponse | None:
        """The body, piece by piece; why not, where it becomes too much."""
        async for piece in request.pieces():
            self._held += len(piece)
            if refusal := self._refusal(request):
                return refusal
        return None

    def _refusal(self, request: _Request) -> JSONResponse | None:
        most = self._limits.max_body_bytes
        if max(request.announced, request.size) > most:
            return _refusal(413, f"the body must be <= {most} bytes")
        most = self._limits.max_requests
        room = most + (FOR_HEALTH if request.for_health else 0)
        full = self._held > HELD_BYTES and self._held > request.size
        if self._answering >= room or full:
            rule = f"the service takes on {most} requests at a time: try again in {RETRY_SECONDS} s"
            return _refusal(503, rule, {"Retry-After": str(RETRY_SECONDS)})
        return None

    async def _answer(self, request: _Request, send: Send) -> None:
        self._answering += 1
        try:
            await self._app(request.scope, request.again, send)
        finally:
            self._answering -= 1


class _Request:
    """A request that is being taken in."""

    def __init__(self, scope: Scope, receive: Receive) -> None:
        self.scope = scope
        self.whole = False
        self.size = 0
        """Bytes of the body so far."""
        announced = dict(scope["headers"]).get(b"content-length", b"")
        self.announced = int(announced) if announced.isdigit() else 0
        """Bytes of the body by its header; 0 where that says nothing."""
        self._receive = receive
        self._pieces: list[bytes] = []

    @property
    def for_health(self) -> bool:
        """Whether it asks how the service is."""
        return self.scope["path"] in HEALTH

    async def pieces(self) -> AsyncIterator[bytes]:
        """The body as it comes; ends early where the client leaves."""
        while not self.whole:
            message = await self._receive()
            if message["type"] != "http.request":
                return
            self.whole = not message.get("more_body", False)
            self._pieces.append(message.get("body", b""))
            self.size += len(self._pieces[-1])
            yield self._pieces[-1]

    async def again(self) -> Message:
        """For the application: the whole body, then whatever comes."""
        if not self._pieces:
            return await self._receive()
        body = b"".join(self._pieces)
        self._pieces.clear()
        return {"type": "http.request", "body": body, "more_body": False}


def _refusal(status: int, error: str, headers: Mapping[str, str] | None = None) -> JSONResponse:
    # As `protocol.Failure`, without loading all that a replica needs into each proxy.
    return JSONResponse({"error": error, "problems": []}, status, headers)


def guarded(limits: Limits) -> type[HttpToolsProtocol]:
    """Uvicorn's connection, which has a time limit only between requests, with `limits`."""

    class Guarded(HttpToolsProtocol):
        """Closed where a request, or the taking of its answer, is too long in any sense."""

        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            self._sending = _Alarm(self.loop, limits.send_seconds, self._overdue)
            """On while a request is being sent."""
            self._taking = _Alarm(self.loop, limits.send_seconds, lambda: self.transport.abort())
            """On while the client must take more of an answer."""
            self._received = 0
            """Bytes of the request that is being sent."""
            self._in_head = True
            """Whether its headers are not all there."""

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > CONNECTIONS:
                transport.abort()
            else:
                self._begin()

        def connection_lost(self, exc: Exception | None) -> None:
            self._sending.stop()
            self._taking.stop()
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            if self._idle and not self._sending.is_on:
                self._begin()
            self._received += len(data)
            super().data_received(data)
            if not self._sending.is_on:  # it is there
                return
            if self._in_head and self._received > HEAD_BYTES:
                self._close(431, f"the headers must be <= {HEAD_BYTES} bytes")
            # A chunk of one byte takes six.
            elif self._received > HEAD_BYTES + 6 * limits.max_body_bytes:
                self._close(413, f"the body must be <= {limits.max_body_bytes} bytes")

        def on_message_begin(self) -> None:
            if not self._sending.is_on:
                self._begin()
            super().on_message_begin()

        def on_headers_complete(self) -> None:
            self._in_head = False
            super().on_headers_complete()

        def on_message_complete(self) -> None:
            self._sending.stop()
            self._received = 0
            super().on_message_complete()

        def pause_writing(self) -> None:
            self._taking.start()
            super().pause_writing()

        def resume_writing(self) -> None:
            self._taking.stop()
            super().resume_writing()

        def timeout_keep_alive_handler(self) -> None:
            super().timeout_keep_alive_handler()
            # Which waits for the client to take the rest of the last answer.
            self._taking.start()

        @property
        def _idle(self) -> bool:
            """Whether no answer is under way."""
            return bool(getattr(self.cycle, "response_complete", True))

        def _begin(self) -> None:
            self._received, self._in_head = 0, True
            self._sending.start()

        def _overdue(self) -> None:
            if self.flow.read_paused:  # it is we who don't read
                self._sending.start()
            else:
                self._close(408, f"the request must be sent within {limits.send_seconds:g} s")

        def _close(self, status: int, error: str) -> None:
            self._sending.stop()
            if self.transport.is_closing():
                return
            if self._in_head if self._idle else not self.cycle.response_started:
                self.transport.write(_last_answer(status, error))
            self.transport.close()

    return Guarded


class _Alarm:
    """Calls `ring` some seconds after it was last started, unless stopped."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, seconds: float, ring: Callable[[], None]
    ) -> None:
        self._loop, self._seconds, self._ring = loop, seconds, ring
        self._timer: asyncio.TimerHandle | None = None

    @property
    def is_on(self) -> bool:
        return self._timer is not None

    def start(self) -> None:
        self.stop()
        self._timer = self._loop.call_later(self._seconds, self._ring)

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None


def _last_answer(status: int, error: str) -> bytes:
    """An answer in one piece, after which the connection is closed."""
    answer = _refusal(status, error, {"Connection": "close"})
    head = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}".encode()]
    head += [name + b": " + value for name, value in answer.raw_headers]
    return b"\r\n".join([*head, b"", bytes(answer.body)])
