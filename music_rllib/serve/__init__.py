"""A trained policy over HTTP: `music-rllib serve POLICY`.

`api` is the web application (no Ray), `application` puts it on Ray Serve, `command` is the command.
"""

TOKEN_VARIABLE = "MUSIC_RLLIB_SERVE_TOKEN"  # noqa: S105 - the name of a variable
"""Environment variable, and only source, of the bearer token that clients must send."""
