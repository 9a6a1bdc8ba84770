"""Requests to a bucket that does not answer are repeated for a while."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from music_rllib.errors import shorten
from music_rllib.redaction import redact

V = TypeVar("V")


@dataclass
class _Patience:
    """How long the requests of this process wait for a bucket that does not answer."""

    seconds: float = 0.0
    say: Callable[[str], None] = lambda text: None
    """Receives the beginning and the end of an outage."""
    waits: bool = False


_patience = _Patience()
_FIRST_PAUSE, _LAST_PAUSE = 1.0, 30.0
"""Seconds between two attempts, which grow from the first to the last value."""
_REFUSED = re.compile("ACCESS_DENIED|NO_SUCH_BUCKET|INVALID_ACCESS_KEY|SIGNATURE_DOES_NOT_MATCH")


def be_patient(minutes: float, say: Callable[[str], None] = lambda text: None) -> None:
    """Repeat the failed requests of this process to buckets for up to `minutes` each."""
    _patience.seconds, _patience.say = 60 * minutes, say


def patiently(request: Callable[[], V]) -> V:
    """The result of an idempotent request to a bucket, which is repeated while that is away."""
    began, pause = time.monotonic(), _FIRST_PAUSE
    while True:
        try:
            result = request()
        except OSError as error:
            left = began + _patience.seconds - time.monotonic()
            missing = isinstance(error, FileNotFoundError)
            if missing or left <= 0 or _REFUSED.search(str(error)):
                raise
            if not _patience.waits:
                _patience.waits = True
                minutes = f"{_patience.seconds / 60:g} min"
                reason = shorten(redact(str(error)))
                _patience.say(f"the storage does not answer, trying again for {minutes}: {reason}")
            time.sleep(min(pause, left))
            pause = min(2 * pause, _LAST_PAUSE)
        else:
            if _patience.waits:
                _patience.waits = False
                _patience.say("the storage answers again")
            return result
