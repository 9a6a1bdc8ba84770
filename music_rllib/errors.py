"""Errors that a user sees, and the exit codes of every command."""

FAILED, BAD_INPUT = 1, 2


class BadInputError(Exception):
    """A mistake of the user, found before anything is started.

    The message names the place, the rule and the value. Commands print it without a traceback.
    """


class TrackingError(BadInputError, RuntimeError):
    """Tracking cannot be set up.

    The message names the place (URI or path), the rule and what to do; it holds no password.
    """
