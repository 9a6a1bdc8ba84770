"""The web application of a policy: validation, token, errors. It does not use Ray."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
from collections.abc import Awaitable, Callable
from typing import Annotated, Any

import numpy as np
from fastapi import Body, Depends, FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import music_rllib
from music_rllib.serve.schema import (
    Answer,
    Array,
    Failure,
    Health,
    PolicyFacts,
    Problem,
    Rows,
    request_model,
)

Act = Callable[[Rows], Awaitable[Array]]
"""Function from the rows of one request to their actions [B, A]."""

Failures = dict[int | str, dict[str, Any]]
"""Status to FastAPI's description of the response."""

SEND_SECONDS = 10
"""Longest pause of a client while it sends a body."""
SHOWN = 10
"""Most problems of a request that the answer lists."""

DESCRIPTION = """
Send `POST /act` what the environment observes; the answer is the policy's deterministic action
in the environment's scale. Vectors are one observation; lists of vectors are a batch, one action
for each row. Requests that arrive together are computed together.
"""


def token_hash(token: str) -> str:
    """The hash that is passed between processes in place of the token."""
    return hashlib.sha256(token.encode()).hexdigest()


def make_api(facts: PolicyFacts, act: Act, token_sha256: str | None = None) -> FastAPI:
    """The application.

    Args:
        facts: Facts about the policy, with the sizes that requests must have.
        act: Called once per valid request.
        token_sha256: `token_hash` of the bearer token that clients must send; None: no token.
    """
    body = request_model(facts)
    api = FastAPI(
        title="music_rllib policy",
        summary=f"Actions for {facts.task}",
        description=DESCRIPTION,
        version=music_rllib.__version__,
        # Both load scripts from a CDN; the service must work without the internet.
        docs_url=None,
        redoc_url=None,
    )
    api.add_middleware(_Lenient)
    api.add_middleware(_BodyLimit, limit=body.max_bytes)
    api.add_exception_handler(RequestValidationError, _invalid)
    api.add_exception_handler(StarletteHTTPException, _refused)
    protected, unauthorised = [], Failures()
    if token_sha256:
        protected = [Depends(_bearer(token_sha256))]
        unauthorised = {401: {"model": Failure, "description": "The token is missing or wrong"}}
    failures: Failures = {
        400: {"model": Failure, "description": "The body is not JSON"},
        408: {"model": Failure, "description": "The request was not sent, or answered, in time"},
        413: {"model": Failure, "description": "The body is longer than any valid one"},
        422: {"model": Failure, "description": "The observation is not one of this task"},
        503: {"model": Failure, "description": "Busy; Retry-After says when to come again"},
    }

    @api.get("/health")
    async def health() -> Health:
        """Whether the policy is loaded and can act."""
        return Health(task=facts.task)

    @api.get("/policy", dependencies=protected, responses=unauthorised)
    async def policy() -> PolicyFacts:
        """Task and sizes."""
        return facts

    async def act_on(request: Any) -> Answer:
        """The actions for an observation or a batch of them."""
        actions = await act(request.rows())
        if not np.isfinite(actions).all():
            raise HTTPException(422, "the policy has no finite action for these numbers")
        answer: Answer = request.answer(actions)
        return answer

    # The body's type depends on the policy, so it can't stand in the signature.
    act_on.__annotations__["request"] = Annotated[
        body.annotation, Body(openapi_examples={"zeros": {"value": body.example}})
    ]
    api.post("/act", dependencies=protected, responses=failures | unauthorised)(act_on)

    return api


_SCHEME = HTTPBearer(auto_error=False)
"""The bearer token of a request. FastAPI looks annotations up in the module."""


def _bearer(expected: str) -> Callable[..., None]:
    """A check of the bearer token against the expected `token_hash`."""

    def check(given: Annotated[HTTPAuthorizationCredentials | None, Depends(_SCHEME)]) -> None:
        if given is None or not hmac.compare_digest(token_hash(given.credentials), expected):
            raise HTTPException(
                401, "a valid bearer token is needed", headers={"WWW-Authenticate": "Bearer"}
            )

    return check


def _failure(status: int, failure: Failure, headers: Any = None) -> JSONResponse:
    return JSONResponse(failure.model_dump(), status_code=status, headers=headers)


async def _refused(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, StarletteHTTPException)
    return _failure(error.status_code, Failure(error=str(error.detail)), error.headers)


async def _invalid(_: Request, error: Exception) -> JSONResponse:
    """Answer with the rules, and not with the values: these may be NaN, or megabytes."""
    assert isinstance(error, RequestValidationError)
    findings = error.errors()
    if findings and findings[0]["type"] == "json_invalid":
        return _failure(400, Failure(error="the body must be JSON"))
    problems = [
        Problem(
            # Before the place in the body stand "body" and the kind of request.
            place=".".join(map(str, finding["loc"][2:])),
            rule=finding["msg"].removeprefix("Value error, "),
        )
        for finding in findings[:SHOWN]
    ]
    more = f" (the first {SHOWN} of {len(findings)} problems)" if len(findings) > SHOWN else ""
    rule = f"the body must be an observation of this task{more}"
    return _failure(422, Failure(error=rule, problems=problems))


class _Lenient:
    """Middleware that takes HEAD for GET, and any body for JSON, whatever its header says."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            headers = [header for header in scope["headers"] if header[0] != b"content-type"]
            # The server itself leaves out the body of an answer to HEAD.
            method = "GET" if scope["method"] == "HEAD" else scope["method"]
            json_header = (b"content-type", b"application/json")
            scope = {**scope, "method": method, "headers": [*headers, json_header]}
        await self._app(scope, receive, send)


class _BodyLimit:
    """Middleware that refuses too long or stalled bodies before they are parsed."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        received = 0

        async def counting() -> Message:
            nonlocal received
            try:
                message = await asyncio.wait_for(receive(), SEND_SECONDS)
            except TimeoutError:
                raise HTTPException(408, f"the body must arrive within {SEND_SECONDS} s") from None
            received += len(message.get("body", b""))
            if received > self._limit:
                raise HTTPException(413, f"the body must be <= {self._limit} bytes")
            return message

        announced = dict(scope["headers"]).get(b"content-length", b"")
        if announced.isdigit() and int(announced) > self._limit:
            failure = Failure(error=f"the body must be <= {self._limit} bytes")
            await _failure(413, failure)(scope, receive, send)
            return
        await self._app(scope, counting, send)
