"""Name the cause of a run's failure in one or two lines."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

import psutil
from ray.exceptions import RayActorError, RayError, RayTaskError

from music_rllib.errors import BadInputError, message_of, shorten

_DETAIL = re.compile(r"Worker exit detail: (.*?)(?: Some common causes include|$)", re.MULTILINE)
_PLACE = re.compile(r"^\s*(pid|ip): (\S+)$", re.MULTILINE)


def cause_of(error: BaseException | None, text: str) -> str:
    """One or two lines of at most 300 characters that name the cause of a failure.

    Args:
        error: The exception that Ray raised in the driver; None if it could not be read.
        text: Its traceback, whose last line replaces a missing `error`.
    """
    if isinstance(error, RayTaskError) and isinstance(error.cause, BaseException):
        error = error.cause
    if error is None:
        lines = _non_empty(text)[-1:]
    elif isinstance(error, RayActorError):
        lines = _cause_of_death(str(error))
    elif isinstance(error, RayError):
        lines = _non_empty(str(error))[:2]
    elif isinstance(error, MemoryError):
        lines = [f"{type(error).__name__}: {message_of(error) or 'no memory was left'}", _memory()]
    else:
        first, *rest = _non_empty(message_of(error)) or ["(no message)"]
        lines = [f"{type(error).__name__}: {first}", *rest[:1]]
    return _encodable("\n".join(map(shorten, lines)))


def trace_of(error: BaseException) -> str:
    """The traceback of an exception of a run.

    Raises:
        SystemExit: The exception itself, if Ray raised it to end the process.
    """
    if hasattr(error, "ray_terminate_msg"):
        raise error
    return _encodable("".join(traceback.format_exception(error)))


def _encodable(text: str) -> str:
    """The text with escapes for what is not Unicode, such as file names of other encodings."""
    return text.encode("utf-8", "backslashreplace").decode()


@contextmanager
def in_words_only() -> Iterator[None]:
    """Replace an exception by its cause, since other processes may lack its class."""
    try:
        yield
    except BaseException as error:
        raise BadInputError(cause_of(error, trace_of(error))) from None


def _memory() -> str:
    memory, own = psutil.virtual_memory(), psutil.Process().memory_info().rss
    return (
        f"The process had {own / 2**30:.1f} GiB, {memory.available / 2**30:.1f} of the machine's "
        f"{memory.total / 2**30:.1f} GiB are free. Train fewer runs at once, or reduce "
        "replay.capacity."
    )


def _non_empty(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip()]


def _cause_of_death(text: str) -> list[str]:
    """The cause of death of a worker process, or the error of its first task."""
    if "creation task" in text:
        return _non_empty(text)[-1:]
    place = ", ".join(f"{name} {value}" for name, value in _PLACE.findall(text))
    detail = _DETAIL.search(text)
    return [
        f"The worker process died{f' ({place})' if place else ''}: "
        f"{detail[1] if detail else _non_empty(text)[-1]}",
        "Often the system killed it for lack of memory. The same command again continues from "
        "the last checkpoint.",
    ]
