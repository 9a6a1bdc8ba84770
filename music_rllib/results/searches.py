"""Check of a sweep's `search.json`, which may come from anybody."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, JsonValue, TypeAdapter


class _Trial(BaseModel):
    number: int
    state: str
    values: dict[str, JsonValue]
    objective: list[float | None] | None = None
    interval: list[tuple[float | None, float | None]] | None = None
    reason: str | None


class _Arm(BaseModel):
    values: dict[str, JsonValue]
    importance: dict[str, float] | None
    trials: list[_Trial]


class _Ranked(BaseModel):
    trial: JsonValue
    values: dict[str, JsonValue]
    failure: str | None = None
    scores: list[list[JsonValue]] | None = None
    searched: list[float | None] | None = None
    fresh: list[float | None] | None = None
    interval: list[tuple[float | None, float | None]] | None = None
    best_is_better_with: float | None = None


class _Objective(BaseModel):
    name: str
    direction: str


class _Search(BaseModel):
    """The fields of a search that are read; there are more."""

    stage: str
    mode: str
    sampler: str
    objectives: list[_Objective]
    arms: list[_Arm]
    ranking: list[_Ranked] | None


def checked_searches(document: Any) -> list[dict[str, Any]]:
    """The searches of a `search.json`, which may come from anybody.

    Raises:
        ValueError: The document is something else.
    """
    TypeAdapter(list[_Search]).validate_python(document)
    searches: list[dict[str, Any]] = document
    for search in searches:
        objectives, ranking = len(search["objectives"]), search["ranking"] or []
        for row in [trial for arm in search["arms"] for trial in arm["trials"]] + ranking:
            for name in ("objective", "interval", "fresh"):
                if row.get(name) and len(row[name]) != objectives:
                    raise ValueError(
                        f"{name} must have {objectives} entries, it has {len(row[name])}"
                    )
        if any("failure" not in row and not row.get("scores") for row in ranking):
            raise ValueError("ranking must have scores where it has no failure")
    return searches
