"""Errors that a user sees, and the exit codes of every command."""

FAILED, BAD_INPUT = 1, 2


def first_line(error: BaseException) -> str:
    """The first line of an error's message; its type's name where it has none."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


class BadInputError(Exception):
    """A mistake of the user, found before anything is started.

    The message names the place, the rule and the value. Commands print it without a traceback.
    """


class TrackingError(BadInputError, RuntimeError):
    """Tracking cannot be set up.

    The message names the place (URI or path), the rule and what to do; it holds no password.
    """
