"""What a finished run leaves behind besides its weights."""

from __future__ import annotations

import json
from collections.abc import Iterable

from pydantic import BaseModel, ConfigDict

HISTORY = "history.jsonl"
"""A run's reports, one JSON object per line, in a node and in a checkpoint."""


class Report(BaseModel):
    """Metrics of a run at one moment. Unlike settings, a metric may be NaN (JSON: `NaN`)."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")

    env_steps: int
    seconds: float
    """Training time so far, over all attempts at this run."""
    timestamp_ms: int
    """Unix time of the report; a replay to MLflow uses it again, so that nothing doubles."""
    metrics: dict[str, float]


class RunResult(BaseModel):
    """The end of a run, kept in its node's manifest."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")

    label: str
    """Of the run that made it; another sweep may call the same node differently."""
    env_steps: int
    seconds: float
    metrics: dict[str, float]
    """The last value that the run reported of each metric."""


def to_json_lines(reports: Iterable[Report]) -> bytes:
    """One line per report."""
    return b"".join(report.model_dump_json().encode() + b"\n" for report in reports)


def from_json_lines(data: bytes) -> list[Report]:
    """Inverse of `to_json_lines`.

    Raises:
        ValueError: A line isn't a report.
    """
    return [Report.model_validate(json.loads(line)) for line in data.splitlines()]


def last_values(reports: Iterable[Report]) -> dict[str, float]:
    """The last value of each metric; an evaluation isn't part of every report."""
    values: dict[str, float] = {}
    for report in reports:
        values |= report.metrics
    return values
