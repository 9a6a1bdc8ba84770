"""The server of a running sweep's page, on loopback. It only shows; no request changes anything."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from music_rllib.errors import BadInputError, first_line
from music_rllib.experiment import sweep_files
from music_rllib.redaction import for_people
from music_rllib.report.live.state import Progress
from music_rllib.store.storage import StorageError

HOST = "127.0.0.1"
LEAST_PAUSE = 10.0
"""Least seconds between two pages."""
_RELAX = 4.0
"""Pause between two pages as a multiple of the time that the last one took."""
READ_SECONDS = 10.0
"""Longest wait for more of a request, and for the next one on a connection."""


class LivePage:
    """The newest page, made again and again while the sweep runs."""

    def __init__(self, make: Callable[[], str], progress: Progress) -> None:
        """Make the first page.

        Raises:
            ReportError: there is no sweep to report on.
        """
        self._make, self._progress = make, progress
        self.html, self.version = make(), 1
        self._problem: str | None = None
        """Why the newest page could not be made."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="live page", daemon=True)
        self._thread.start()

    def state(self) -> dict[str, Any]:
        """The sweep's progress and the number of the newest page."""
        try:
            problem = {} if self._problem is None else {"error": self._problem}
            return {**self._progress.read(), "version": self.version, **problem}
        except StorageError as error:
            return {"state": "unknown", "error": str(error), "version": self.version}

    def close(self) -> None:
        """End the thread that makes pages."""
        self._ended.set()
        self._thread.join(60.0)

    def _follow(self) -> None:
        took, before = 0.0, self.state().get("state")
        while not self._ended.wait(max(LEAST_PAUSE, _RELAX * took)):
            now = self.state().get("state")
            if now != "running" and now == before:
                continue
            before, began = now, time.monotonic()
            try:
                html = self._make()
            except Exception as error:  # the storage is busy or down: try again later
                self._problem = f"The page is an older one: {for_people(first_line(error))}"
                continue
            self._problem = None
            took = time.monotonic() - began
            if html != self.html:
                self.html, self.version = html, self.version + 1


class Server(ThreadingHTTPServer):
    """Answers each connection in a thread."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing about a tab that was closed, or about an address that is none."""
        if not isinstance(sys.exception(), ConnectionError | ValueError):
            super().handle_error(request, client_address)


def make_server(page: LivePage, port: int) -> Server:
    """A server on the port.

    Raises:
        BadInputError: the port is taken.
    """
    handler = type("Handler", (_Handler,), {"page": page, "timeout": READ_SECONDS})
    try:
        return Server((HOST, port), handler)
    except OSError as error:
        raise BadInputError(f"--port must be free, got {port}: {error.strerror}") from error


def serve(server: Server, page: LivePage, say: Callable[[str], None]) -> None:
    """Serve until Ctrl-C."""
    say(f"Report: http://{HOST}:{server.server_port}/")
    say("Ctrl-C ends the page, not the sweep.")
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        server.server_close()
        page.close()


class _Handler(BaseHTTPRequestHandler):
    page: LivePage
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "music_rllib", ""

    def do_GET(self) -> None:
        path = urlsplit(self.path).path
        # Another host name that resolves to this machine is an attack (DNS rebinding).
        if urlsplit(f"//{self.headers.get('Host')}").hostname not in (HOST, "localhost"):
            self._json(HTTPStatus.FORBIDDEN, {"error": "open the address that the report printed"})
        elif path == "/":
            self._answer(HTTPStatus.OK, self.page.html, "text/html")
        elif path == "/state":
            self._json(HTTPStatus.OK, self.page.state())
        else:
            self._json(HTTPStatus.NOT_FOUND, {"error": "there is no such page"})

    def _json(self, status: HTTPStatus, document: Any) -> None:
        text = json.dumps(sweep_files.plain(document), ensure_ascii=False)
        self._answer(status, text, "application/json")

    def _answer(self, status: HTTPStatus, text: str, kind: str) -> None:
        body = text.encode()
        self.close_connection = status is not HTTPStatus.OK
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        for name, value in (
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
            ("Referrer-Policy", "no-referrer"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: Any) -> None:
        """Log nothing: the page asks every two seconds."""
