"""Limits of a service under load: requests at a time, bytes and seconds.

Ray Serve's proxy (uvicorn) passes a request on as soon as it has its headers, and waits without end
for the rest. The only hook into the proxy is an import path in the environment of Serve's
controller (`controller_environment`), here that of `middlewares`. `Admission` receives the whole
body before a replica gets the request; `guarded` limits the connection, which a middleware does not
see. Serve's own `max_queued_requests` protects replicas behind proxies without them.
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
"""Environment variable with `Limits` as JSON, for proxies that Serve starts."""
FOR_HEALTH = 16
"""Health requests that are answered at a time while all others are refused."""
HEALTH = ("/health", "/-/healthz", "/-/routes")
CONNECTIONS = 4096
"""Connections open at a time; further ones are closed at once."""
HEAD_BYTES = 64 * 2**10
"""Largest request line with all headers; also the largest overhead of a body's chunks."""
HELD_BYTES = 64 * 2**20
"""Largest bodies of all requests together; a single one may be larger."""
RETRY_SECONDS = 1


class Limits(BaseModel):
    """Limits of one proxy."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    max_requests: int = Field(256, ge=1)
    """Requests that are answered at a time, waiting ones included."""
    max_body_bytes: int = Field(16 * 2**20, ge=1)
    """Largest body of one request, in bytes."""
    send_seconds: float = Field(10.0, gt=0)
    """Time for a client to send a whole request, and to receive the answer."""


def controller_environment(limits: Limits) -> dict[str, str]:
    """Environment of Serve's controller that makes its proxies, which inherit it, keep `limits`."""
    return {
        "RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH": f"{__name__}.{middlewares.__name__}",
        LIMITS_VARIABLE: limits.model_dump_json(),
    }


def middlewares() -> list[Middleware]:
    """The middlewares of a proxy; Serve calls this in each proxy before it listens."""
    from uvicorn.protocols.http import auto

    limits = Limits.model_validate_json(os.environ.get(LIMITS_VARIABLE) or "{}")
    give_back_freed_memory()
    # Serve has no setting for it; uvicorn takes the class of its connections from here.
    auto.AutoHTTPProtocol = guarded(limits)
    return [Middleware(Admission, limits=limits)]


class Admission:
    """Middleware that receives whole requests up to the limits and refuses others at once."""

    def __init__(self, app: ASGIApp, limits: Limits) -> None:
        self._app = app
        self._limits = limits
        self._answering = 0
        """Requests that the application has."""
        self._held = 0
        """Bytes of all bodies in memory."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = _Request(scope, receive)
        try:
            refusal = self._refusal(request) or await self._receive_body(request)
            if refusal is not None:
                await refusal(scope, receive, send)
            elif request.whole:
                self._answering += 1
                try:
                    await self._app(scope, request.replay, send)
                finally:
                    self._answering -= 1
        finally:
            self._held -= request.size

    async def _receive_body(self, request: _Request) -> JSONResponse | None:
        """Receive the body piece by piece; returns a refusal as soon as it exceeds a limit."""
        async for piece in request.pieces():
            self._held += len(piece)
            if refusal := self._refusal(request):
                return refusal
        return None

    def _refusal(self, request: _Request) -> JSONResponse | None:
        """The refusal of a request that exceeds a limit so far; None if it doesn't."""
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


def announced_bytes(scope: Scope) -> int:
    """Size of a request's body by its header; 0 if the header is missing or no number."""
    value = dict(scope["headers"]).get(b"content-length", b"")
    return int(value) if value.isdigit() else 0


class _Request:
    """A request whose body is being received."""

    def __init__(self, scope: Scope, receive: Receive) -> None:
        self.for_health = scope["path"] in HEALTH
        self.whole = False
        self.size = 0
        """Bytes of the body so far."""
        self.announced = announced_bytes(scope)
        self._receive = receive
        self._pieces: list[bytes] = []

    async def pieces(self) -> AsyncIterator[bytes]:
        """The pieces of the body as they arrive; they end early if the client disconnects."""
        while not self.whole:
            message = await self._receive()
            if message["type"] != "http.request":
                return
            self.whole = not message.get("more_body", False)
            self._pieces.append(message.get("body", b""))
            self.size += len(self._pieces[-1])
            yield self._pieces[-1]

    async def replay(self) -> Message:
        """The application's `receive`: the whole body in one message, then further messages."""
        if not self._pieces:
            return await self._receive()
        body = b"".join(self._pieces)
        self._pieces.clear()
        return {"type": "http.request", "body": body, "more_body": False}


def _refusal(status: int, error: str, headers: Mapping[str, str] | None = None) -> JSONResponse:
    # Like `schema.Failure`, which would load a replica's libraries into each proxy.
    return JSONResponse({"error": error, "problems": []}, status, headers)


def guarded(limits: Limits) -> type[HttpToolsProtocol]:
    """Uvicorn's class of connections, whose only time limit is between requests, with `limits`."""

    class Guarded(HttpToolsProtocol):
        """A connection that is closed if a request or the receipt of an answer exceeds a limit."""

        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            self._request_timer = _Timer(self.loop, limits.send_seconds, self._request_overdue)
            """Runs while the client sends a request."""
            self._answer_timer = _Timer(self.loop, limits.send_seconds, self._abort)
            """Runs while the client has to receive more of an answer."""
            self._received = 0
            """Bytes of the current request so far."""
            self._in_head = True
            """Whether headers of the current request are missing."""

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > CONNECTIONS:
                transport.abort()
            else:
                self._begin()

        def connection_lost(self, exc: Exception | None) -> None:
            self._request_timer.stop()
            self._answer_timer.stop()
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            if self._idle and not self._request_timer.is_on:
                self._begin()
            self._received += len(data)
            super().data_received(data)
            if not self._request_timer.is_on:  # the request is complete
                return
            if self._in_head and self._received > HEAD_BYTES:
                self._close(431, f"the headers must be <= {HEAD_BYTES} bytes")
            # A chunk of one byte takes six.
            elif self._received > HEAD_BYTES + 6 * limits.max_body_bytes:
                self._close(413, f"the body must be <= {limits.max_body_bytes} bytes")

        def on_message_begin(self) -> None:
            if not self._request_timer.is_on:
                self._begin()
            super().on_message_begin()

        def on_headers_complete(self) -> None:
            self._in_head = False
            super().on_headers_complete()

        def on_message_complete(self) -> None:
            self._request_timer.stop()
            self._received = 0
            super().on_message_complete()

        def pause_writing(self) -> None:
            self._answer_timer.start()
            super().pause_writing()

        def resume_writing(self) -> None:
            self._answer_timer.stop()
            super().resume_writing()

        def timeout_keep_alive_handler(self) -> None:
            super().timeout_keep_alive_handler()
            # It waits for the client to receive the rest of the last answer.
            self._answer_timer.start()

        @property
        def _idle(self) -> bool:
            """Whether no request is being answered."""
            return bool(getattr(self.cycle, "response_complete", True))

        def _begin(self) -> None:
            self._received, self._in_head = 0, True
            self._request_timer.start()

        def _abort(self) -> None:
            self.transport.abort()

        def _request_overdue(self) -> None:
            if self.flow.read_paused:  # the delay is the server's: it does not read
                self._request_timer.start()
            else:
                self._close(408, f"the request must be sent within {limits.send_seconds:g} s")

        def _close(self, status: int, error: str) -> None:
            """Close the connection, with a last answer if none has been started."""
            self._request_timer.stop()
            if self.transport.is_closing():
                return
            if self._in_head if self._idle else not self.cycle.response_started:
                self.transport.write(_last_answer(status, error))
            self.transport.close()

    return Guarded


class _Timer:
    """Calls `action` some seconds after its last start, unless it is stopped."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, seconds: float, action: Callable[[], None]
    ) -> None:
        self._loop, self._seconds, self._action = loop, seconds, action
        self._handle: asyncio.TimerHandle | None = None

    @property
    def is_on(self) -> bool:
        return self._handle is not None

    def start(self) -> None:
        self.stop()
        self._handle = self._loop.call_later(self._seconds, self._action)

    def stop(self) -> None:
        if self._handle is not None:
            self._handle.cancel()
        self._handle = None


def _last_answer(status: int, error: str) -> bytes:
    """The bytes of a whole answer, after which the connection is closed."""
    answer = _refusal(status, error, {"Connection": "close"})
    head = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}".encode()]
    head += [name + b": " + value for name, value in answer.raw_headers]
    return b"\r\n".join([*head, b"", bytes(answer.body)])
