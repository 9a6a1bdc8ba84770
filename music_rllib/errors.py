"""Errors that a user sees, and the exit codes of every command."""

import re
import signal
from collections.abc import Sequence

FAILED, BAD_INPUT = 1, 2
_COLORS = re.compile(r"\x1b\[[0-9;]*m")


def message_of(error: BaseException) -> str:
    """An error's message without colors; an environment's error class can fail to give it."""
    try:
        return _COLORS.sub("", str(error))
    except Exception as own:
        return f"(its message can't be read: {type(own).__name__})"


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or its type's name."""
    return next(iter(message_of(error).strip().splitlines()), type(error).__name__)


def one_line(error: BaseException) -> str:
    """`ValueError: message` on one line of at most 300 characters."""
    message = " ".join(message_of(error).split()) or "(no message)"
    return shorten(f"{type(error).__name__}: {message}")


def reason_of(error: Exception) -> str:
    """What is wrong with a file: a validation's first finding, or the first line of an error."""
    if callable(findings := getattr(error, "errors", None)):  # of pydantic
        finding = findings(include_url=False)[0]
        place = ".".join(map(str, finding["loc"]))
        text = f"{finding['msg'].replace('Input should', 'must')}, got {finding['input']!r}"
        return shorten(f"{place} {text}".strip())
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return f"must have {error}" if isinstance(error, KeyError) else first_line(error)


def shorten(text: str, limit: int = 300) -> str:
    """Cut a text to `limit` characters, ending with dots."""
    return text if len(text) <= limit else text[: limit - 3] + "..."


def indented(lines: Sequence[str], shown: int = 10) -> list[str]:
    """The first `shown` lines, indented, and the number of others."""
    more = [f"  ... and {len(lines) - shown} more"] if len(lines) > shown else []
    return [f"  {line}" for line in lines[:shown]] + more


def is_stop(error: BaseException | None) -> bool:
    """Whether an error is the user's signal: Ctrl-C, or SIGTERM by the handler of `ray.init`."""
    terminated = isinstance(error, SystemExit) and error.code == signal.SIGTERM
    return terminated or isinstance(error, KeyboardInterrupt)


class BadInputError(Exception):
    """A mistake of the user, found before anything starts.

    The message names the place, the rule and the value. Commands print it without a traceback.
    """

    exit_code = BAD_INPUT


class TrackingError(BadInputError, RuntimeError):
    """Tracking cannot be set up.

    The message names the place (URI or path), the rule and a remedy; it contains no password.
    """
