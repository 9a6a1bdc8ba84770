"""Errors that a user sees, and the exit codes of every command."""

FAILED, BAD_INPUT = 1, 2


def message_of(error: BaseException) -> str:
    """An error's message; an environment's error class can fail to give it."""
    try:
        return str(error)
    except Exception as own:
        return f"(its message can't be read: {type(own).__name__})"


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or its type's name."""
    return next(iter(message_of(error).strip().splitlines()), type(error).__name__)


def one_line(error: BaseException) -> str:
    """`ValueError: message` on one line of at most 300 characters."""
    message = " ".join(message_of(error).split()) or "(no message)"
    return shorten(f"{type(error).__name__}: {message}")


def shorten(text: str, limit: int = 300) -> str:
    """Cut a text to `limit` characters, ending with dots."""
    return text if len(text) <= limit else text[: limit - 3] + "..."


class BadInputError(Exception):
    """A mistake of the user, found before anything starts.

    The message names the place, the rule and the value. Commands print it without a traceback.
    """


class TrackingError(BadInputError, RuntimeError):
    """Tracking cannot be set up.

    The message names the place (URI or path), the rule and a remedy; it contains no password.
    """
