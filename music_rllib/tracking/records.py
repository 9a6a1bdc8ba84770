"""What the tracker is told, as MLflow takes it."""

from __future__ import annotations

import json
from collections.abc import Mapping

import yaml

from music_rllib import names
from music_rllib.redaction import redact, without_secrets
from music_rllib.tracking.spool import Finish, Status

__all__ = ["as_yaml", "finish_of", "milliseconds", "number_of", "texts"]

MAX_FAILURE_LENGTH = 1000
"""Characters of a failure's cause that are kept as a tag; the rest is in the run's log."""


def number_of(name: str, value: float) -> float:
    """A metric's value; ValueError where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"metric {name} must be a number, got {value!r}") from error


def finish_of(status: Status, when: float, failure: str | None) -> Finish:
    """A run's end, with the beginning of its failure's cause, no secret in it."""
    tags = {} if failure is None else {names.TAG_FAILURE: redact(failure)[:MAX_FAILURE_LENGTH]}
    return Finish(time=milliseconds(when), status=status, tags=tags)


def texts(tags: Mapping[str, object]) -> dict[str, str]:
    """Tags without those that are None, no secret in them."""
    return {key: redact(str(value)) for key, value in tags.items() if value is not None}


def as_yaml(settings: Mapping[str, object]) -> str:
    """Settings as a file, no secret in it."""
    plain = json.loads(json.dumps(without_secrets(settings), default=str))
    return str(yaml.safe_dump(plain, sort_keys=False, allow_unicode=True))


def milliseconds(seconds: float) -> int:
    """MLflow's time."""
    return round(seconds * 1000)
