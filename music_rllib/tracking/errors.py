"""The error that a user of tracking sees."""


class TrackingError(RuntimeError):
    """Tracking cannot be set up, or a spool cannot be read or written.

    The message names the place (URI or path), the rule and what to do; it holds no password.
    """
