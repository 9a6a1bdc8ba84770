"""The web application of a policy: requests, answers, token, errors. It does not use Ray.

Legend: B rows of a batch, D size of an observation, G size of a goal, A size of an action.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Awaitable, Callable
from ipaddress import ip_address
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt
from fastapi import Body, Depends, FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from fastapi.security.utils import get_authorization_scheme_param
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, create_model, model_validator
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import music_rllib

if TYPE_CHECKING:
    from music_rllib.policy import Policy, PolicyNetwork

Array = npt.NDArray[np.float32]
Rows = dict[str, Array]
"""Name of a part of the observation to [B, D] or [B, G]."""
Act = Callable[[Rows], Awaitable[Array]]
"""Function from the rows of one request to their actions [B, A]."""
Responses = dict[int | str, dict[str, Any]]
"""Status to FastAPI's description of the response."""

MAX_ROWS = 1024
"""Most observations in one request."""
SHOWN = 10
"""Most problems of a request that the answer lists."""
_FLOAT32 = float(np.finfo(np.float32).max)

DESCRIPTION = """
Send an observation of the environment to `POST /act`. The answer is the policy's deterministic
action in the environment's scale. Vectors are one observation; lists of vectors are a batch with
one action for each row. Requests that arrive together are computed together.
"""


class PolicyFacts(BaseModel):
    """Facts about a policy that a client needs."""

    model_config = ConfigDict(frozen=True)

    task: str
    observation_size: int
    goal_size: int
    """0 if the task has no goals; requests then have none."""
    action_size: int
    max_rows: int = MAX_ROWS
    """Most observations in one request."""

    @classmethod
    def of(cls, task: str, policy: Policy | PolicyNetwork) -> PolicyFacts:
        return cls(
            task=task,
            observation_size=policy.observation_size,
            goal_size=policy.goal_size,
            action_size=policy.action_size,
        )

    @property
    def parts(self) -> dict[str, int]:
        """Names and sizes of the parts of an observation."""
        goals = {"desired_goal": self.goal_size, "achieved_goal": self.goal_size}
        return {"observation": self.observation_size} | (goals if self.goal_size else {})


class Health(BaseModel):
    """The service can act."""

    status: Literal["ok"] = "ok"
    task: str


class Answer(BaseModel):
    """Actions in the environment's scale: one, or one for each row of the request."""

    action: list[float] | list[list[float]]


class Problem(BaseModel):
    """One problem of a request."""

    place: str
    """Path into the request's body."""
    rule: str


class Failure(BaseModel):
    """The reason why a request has no action."""

    error: str
    problems: list[Problem] = Field(default_factory=list)


class ActRequest(BaseModel):
    """One observation; base of the models of `request_type`."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    def rows(self) -> Rows:
        """The given parts as arrays with a row dimension."""
        given = self.model_dump(exclude_none=True)
        return {name: np.atleast_2d(np.asarray(part, np.float32)) for name, part in given.items()}

    def answer(self, actions: Array) -> Answer:
        """`actions` [B, A] in the shape of this request."""
        return Answer(action=actions[0].tolist())


class _Batch(ActRequest):
    @model_validator(mode="after")
    def _as_many_rows(self) -> Self:
        given = self.model_dump(exclude_none=True)
        count = len(given["observation"])
        for name, rows in given.items():
            if len(rows) != count:
                raise ValueError(
                    f"{name} must have as many rows as observation ({count}), got {len(rows)}"
                )
        return self

    def answer(self, actions: Array) -> Answer:
        return Answer(action=actions.tolist())


def request_type(facts: PolicyFacts) -> Any:
    """The type of bodies that a policy of these sizes accepts: one observation or a batch.

    `achieved_goal` is accepted, so that a client can send an environment's whole observation, and
    not used.
    """

    def rows(vector: Any) -> Any:
        return Annotated[list[vector], Field(min_length=1, max_length=facts.max_rows)]

    one: Any = _model("Observation", ActRequest, facts, lambda vector: vector)
    many: Any = _model("Observations", _Batch, facts, rows)
    either: Any = Annotated[one, Tag("one")] | Annotated[many, Tag("many")]
    return Annotated[either, Discriminator(_one_or_many)]


def _model(
    name: str, base: type[ActRequest], facts: PolicyFacts, shape: Callable[[Any], Any]
) -> type[ActRequest]:
    fields: dict[str, Any] = {}
    for part, size in facts.parts.items():
        number = Annotated[float, Field(ge=-_FLOAT32, le=_FLOAT32, allow_inf_nan=False)]
        kind = shape(Annotated[list[number], Field(min_length=size, max_length=size)])
        fields[part] = (kind | None, None) if part == "achieved_goal" else (kind, ...)
    return create_model(name, __base__=base, **fields)


def _one_or_many(body: Any) -> str:
    """Tag of the model for a body."""
    observation = body.get("observation") if isinstance(body, dict) else None
    nested = isinstance(observation, list) and observation and isinstance(observation[0], list)
    return "many" if nested else "one"


def compute(policy: PolicyNetwork, waiting: list[Rows]) -> list[Array]:
    """Actions [B_i, A] of several requests in one pass through the network."""
    # Without achieved goals, which only some requests may have.
    needed = ("observation", "desired_goal") if policy.goal_size else ("observation",)
    stacked = {name: np.concatenate([rows[name] for rows in waiting]) for name in needed}
    # Huge numbers may overflow; the caller checks that actions are finite.
    with np.errstate(over="ignore", invalid="ignore"):
        actions = policy.act(stacked)
    ends = np.cumsum([len(rows["observation"]) for rows in waiting])[:-1]
    return np.split(actions, ends)


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
    api = FastAPI(
        title="music_rllib policy",
        summary=f"Actions for {facts.task}",
        description=DESCRIPTION,
        version=music_rllib.__version__,
        # Both pages load scripts from a CDN; the service must work without the internet.
        docs_url=None,
        redoc_url=None,
    )
    most_bytes = 4096 + 64 * facts.max_rows * sum(facts.parts.values())
    # Without a token the service listens on loopback only.
    api.add_middleware(_Lenient, most_bytes=most_bytes, token_sha256=token_sha256)
    api.add_exception_handler(RequestValidationError, _invalid)
    api.add_exception_handler(StarletteHTTPException, _refused)
    protected, unauthorized = [], Responses()
    if token_sha256:
        protected = [Depends(_bearer(token_sha256))]
        unauthorized = {401: {"model": Failure, "description": "The token is missing or wrong"}}
    failures: Responses = {
        400: {"model": Failure, "description": "The body is not JSON"},
        408: {"model": Failure, "description": "The request was not sent, or answered, in time"},
        413: {"model": Failure, "description": "The body is longer than any valid one"},
        422: {"model": Failure, "description": "The observation does not fit the task"},
        503: {"model": Failure, "description": "Busy; Retry-After says when to try again"},
    }

    @api.get("/health")
    async def health() -> Health:
        """Whether the policy is loaded and can act."""
        return Health(task=facts.task)

    @api.get("/policy", dependencies=protected, responses=unauthorized)
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

    # The body's type depends on the policy, so the signature can't name it.
    sizes = {name: size for name, size in facts.parts.items() if name != "achieved_goal"}
    zeros: Any = {"zeros": {"value": {name: [0.0] * size for name, size in sizes.items()}}}
    act_on.__annotations__["request"] = Annotated[request_type(facts), Body(openapi_examples=zeros)]
    api.post("/act", dependencies=protected, responses=failures | unauthorized)(act_on)

    return api


_SCHEME = HTTPBearer(auto_error=False)
"""The bearer token of a request. FastAPI looks annotations up in the module."""


def _bearer(expected: str) -> Callable[..., None]:
    """A check of the bearer token against the expected `token_hash`."""

    def check(given: Annotated[HTTPAuthorizationCredentials | None, Depends(_SCHEME)]) -> None:
        _check_token("" if given is None else given.credentials, expected)

    return check


def _check_token(token: str, expected: str) -> None:
    """Answer with 401 unless `token` has the expected `token_hash`."""
    if not hmac.compare_digest(token_hash(token), expected):
        raise HTTPException(
            401, "a valid bearer token is needed", headers={"WWW-Authenticate": "Bearer"}
        )


async def _refused(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, StarletteHTTPException)
    content = Failure(error=str(error.detail)).model_dump()
    return JSONResponse(content, status_code=error.status_code, headers=error.headers)


async def _invalid(_: Request, error: Exception) -> JSONResponse:
    """Answer with the rules, and not with the values: these may be NaN, or megabytes."""
    assert isinstance(error, RequestValidationError)
    findings = error.errors()
    if findings and findings[0]["type"] == "json_invalid":
        return JSONResponse(Failure(error="the body must be JSON").model_dump(), status_code=400)
    problems = [
        Problem(
            # In front of the place in the body stand "body" and the tag of the request.
            place=".".join(map(str, finding["loc"][2:])),
            rule=finding["msg"].removeprefix("Value error, "),
        )
        for finding in findings[:SHOWN]
    ]
    more = f" (the first {SHOWN} of {len(findings)} problems)" if len(findings) > SHOWN else ""
    rule = f"the body must be an observation of this task{more}"
    return JSONResponse(Failure(error=rule, problems=problems).model_dump(), status_code=422)


def _is_loopback(host: str) -> bool:
    """Whether a Host header names this machine."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ip_address(name).is_loopback
    except ValueError:
        return False


class _Lenient:
    """Middleware that treats HEAD as GET and any body as JSON, and rejects too long bodies.

    Without a token it also rejects requests whose Host header names another machine. With one, a
    body from a client without it is received and not parsed, which FastAPI would do first.
    """

    def __init__(self, app: ASGIApp, most_bytes: int, token_sha256: str | None) -> None:
        self._app = app
        self._most_bytes = most_bytes
        self._token_sha256 = token_sha256

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        received = 0

        async def counting() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._most_bytes:
                raise HTTPException(413, f"the body must be <= {self._most_bytes} bytes")
            # Only at its end: slow clients occupy a place, and get 408 or 503 like others.
            ends = message["type"] == "http.request" and not message.get("more_body", False)
            if ends and self._token_sha256:
                _check_token(token, self._token_sha256)
            return message

        given = {name: value.decode("latin-1") for name, value in scope["headers"]}
        host = given.get(b"host", "")
        scheme, token = get_authorization_scheme_param(given.get(b"authorization"))
        token = token if scheme.lower() == "bearer" else ""
        if not self._token_sha256 and not _is_loopback(host):
            # Another host name that resolves to this machine is an attack (DNS rebinding).
            failure = Failure(error=f"the Host header must name this machine, got {host!r}")
            await JSONResponse(failure.model_dump(), 403)(scope, receive, send)
            return
        headers = [header for header in scope["headers"] if header[0] != b"content-type"]
        headers.append((b"content-type", b"application/json"))
        # The server itself leaves out the body of an answer to HEAD.
        method = "GET" if scope["method"] == "HEAD" else scope["method"]
        await self._app({**scope, "method": method, "headers": headers}, counting, send)
