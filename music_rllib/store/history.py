"""The history and the result of a run."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import BaseModel, ConfigDict, TypeAdapter

HISTORY = "history.jsonl"
"""File of a run's reports in its node and in each checkpoint, one JSON object per line."""


class Report(BaseModel):
    """Metrics of a run at one time; they may be NaN (`NaN` in JSON)."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")

    env_steps: int
    seconds: float
    """Training time so far, over all attempts at this run."""
    timestamp_ms: int
    """Unix time of the report. MLflow receives it too, so that logging it twice is harmless."""
    metrics: dict[str, float]


class RunResult(BaseModel):
    """The result of a finished run, in its node's manifest."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")

    label: str
    """Label of the run that computed it; another sweep may use a different label."""
    env_steps: int
    seconds: float
    metrics: dict[str, float]
    """The last reported value of each metric."""


_REPORTS = TypeAdapter(list[Report])


def to_json_lines(reports: Iterable[Report]) -> bytes:
    """Reports as JSON, one per line."""
    return b"".join(report.model_dump_json().encode() + b"\n" for report in reports)


def from_json_lines(data: bytes) -> list[Report]:
    """Inverse of `to_json_lines`.

    Raises:
        ValueError: A line is not a report.
    """
    return _REPORTS.validate_json(b"[%s]" % b",".join(data.splitlines()))


def last_values(reports: Iterable[Report]) -> dict[str, float]:
    """The last value of each metric; a report may lack some metrics."""
    values: dict[str, float] = {}
    for report in reports:
        values |= report.metrics
    return values
