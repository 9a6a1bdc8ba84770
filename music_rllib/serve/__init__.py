"""A trained policy behind HTTP: `music-rllib serve POLICY`.

`protocol` says what requests and answers look like, `api` is the web application (no Ray),
`application` puts it on Ray Serve, `limits` stands before it in Serve's proxies, `command` is the
command line.
"""

TOKEN_VARIABLE = "MUSIC_RLLIB_SERVE_TOKEN"  # noqa: S105 - the name of a variable
"""What clients must send as bearer token is read from this environment variable only."""
