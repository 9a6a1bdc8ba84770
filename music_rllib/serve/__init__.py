"""A trained policy over HTTP: `music-rllib serve POLICY`.

`api` is the web application (no Ray), `application` puts it on Ray Serve, `command` is the command.
"""

import os
import re

from music_rllib.errors import BadInputError

TOKEN_VARIABLE = "MUSIC_RLLIB_SERVE_TOKEN"  # noqa: S105 - the name of a variable
"""Environment variable, and only source, of the bearer token that clients must send."""


def given_token() -> str | None:
    """The token of the environment, if there is one.

    Raises:
        BadInputError: No HTTP client can send it.
    """
    token = os.environ.get(TOKEN_VARIABLE)
    if not re.fullmatch(r"[!-~]*", token or ""):
        raise BadInputError(
            f"{TOKEN_VARIABLE} must have only ASCII characters without spaces or line ends, "
            "because HTTP clients can send no others"
        )
    return token
