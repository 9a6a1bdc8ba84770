"""A trained policy behind HTTP: `python -m music_rllib.serve NODE`.

`protocol` says what requests and answers look like, `api` is the web application (no Ray),
`application` puts it on Ray Serve, `limits` stands before it in Serve's proxies, `command` is the
command line.
"""
