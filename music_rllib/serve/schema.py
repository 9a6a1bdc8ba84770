"""Requests and answers of a served policy: models with the sizes of the policy.

Legend: B rows of a batch, D size of an observation, G size of a goal, A size of an action.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, create_model, model_validator

if TYPE_CHECKING:
    from music_rllib.policy import Policy, PolicyNetwork

MAX_ROWS = 1024
"""Most observations in one request."""
_FLOAT32 = float(np.finfo(np.float32).max)

Array = npt.NDArray[np.float32]
Rows = dict[str, Array]
"""Name of a part of the observation to [B, D] or [B, G]."""


class PolicyFacts(BaseModel):
    """Facts about a policy that a client needs."""

    model_config = ConfigDict(frozen=True)

    task: str
    observation_size: int
    goal_size: int
    """0: the task has no goals, and requests have none."""
    action_size: int
    max_rows: int = MAX_ROWS
    """Most observations in one request."""

    @classmethod
    def of(cls, task: str, policy: Policy | PolicyNetwork) -> PolicyFacts:
        """The facts about `policy`."""
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
    """One thing that is wrong with a request."""

    place: str
    """Path into the request's body."""
    rule: str


class Failure(BaseModel):
    """The reason why a request has no action."""

    error: str
    problems: list[Problem] = Field(default_factory=list)


class Request(BaseModel):
    """Base of the models that `request_model` makes."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    def rows(self) -> Rows:
        """The given parts as arrays with a row dimension."""
        given = self.model_dump(exclude_none=True)
        return {name: np.atleast_2d(np.asarray(part, np.float32)) for name, part in given.items()}

    def answer(self, actions: Array) -> Answer:
        """`actions` [B, A] in the shape of this request."""
        return Answer(action=actions[0].tolist())


class _Batch(Request):
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


class RequestType(NamedTuple):
    """The type of a request's body."""

    annotation: Any
    """The annotation for FastAPI: one observation or a batch of them."""
    example: dict[str, Any]
    max_bytes: int
    """Upper bound on the size of a valid body."""


def request_model(facts: PolicyFacts) -> RequestType:
    """The bodies that a policy of these sizes accepts.

    `achieved_goal` is accepted, so that a client can send an environment's whole observation, and
    not used.
    """

    def rows(vector: Any) -> Any:
        return Annotated[list[vector], Field(min_length=1, max_length=facts.max_rows)]

    one: Any = _model("Observation", Request, facts, lambda vector: vector)
    many: Any = _model("Observations", _Batch, facts, rows)
    either: Any = Annotated[one, Tag("one")] | Annotated[many, Tag("many")]
    body = Annotated[either, Discriminator(_one_or_many)]
    numbers = facts.max_rows * sum(facts.parts.values())
    example = {name: [0.0] * size for name, size in facts.parts.items() if name != "achieved_goal"}
    return RequestType(body, example, max_bytes=4096 + 64 * numbers)


def _model(
    name: str, base: type[Request], facts: PolicyFacts, shape: Callable[[Any], Any]
) -> type[Request]:
    fields: dict[str, Any] = {}
    for part, size in facts.parts.items():
        number = Annotated[float, Field(ge=-_FLOAT32, le=_FLOAT32, allow_inf_nan=False)]
        kind = shape(Annotated[list[number], Field(min_length=size, max_length=size)])
        fields[part] = (kind | None, None) if part == "achieved_goal" else (kind, ...)
    # The rows' rule is of the base class; the sizes are of this policy.
    return create_model(name, __base__=base, **fields)


def _one_or_many(body: Any) -> str:
    """Tag of the model that a body is meant to be."""
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
