"""The page of a sweep that runs, on loopback.

Whoever knows the token in the page's address may read it, stop the sweep and resume it: other users
of the machine reach its ports, too. A page of somebody else's site can't: it knows no token, and
has no answer to a request with a header of its own.
"""

from __future__ import annotations

import hmac
import json
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from music_rllib.errors import BadInputError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.location import SweepLocation
from music_rllib.report.live.state import Progress
from music_rllib.results.data import ReportError
from music_rllib.store.object_folder import StorageError

__all__ = ["LivePage", "Server", "make_server", "resume", "serve", "stop"]

HOST = "127.0.0.1"
LEAST_PAUSE = 10.0
"""Seconds between two pages; a page that takes long to make leaves four fifths of the time."""
_RELAX = 4.0
HEADER = "X-Token"


class LivePage:
    """The newest page, made anew while the sweep runs."""

    def __init__(self, make: Callable[[], str], progress: Progress) -> None:
        """Make the first page.

        Raises:
            ReportError: there is nothing to report on.
        """
        self._make, self._progress = make, progress
        self.html, self.version = make(), 1
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="live page", daemon=True)
        self._thread.start()

    def state(self) -> dict[str, Any]:
        """How far the sweep is, and which page is the newest."""
        try:
            return {**self._progress.read(), "version": self.version}
        except StorageError as error:
            return {"state": "unknown", "error": str(error), "version": self.version}

    def close(self) -> None:
        """Make no further page."""
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
            except ReportError:  # MLflow is busy or down: the next one, perhaps
                continue
            took = time.monotonic() - began
            if html != self.html:
                self.html, self.version = html, self.version + 1


def stop(found: SweepLocation) -> None:
    """Ask the sweep to save its runs and end."""
    sweep_files.write(found.storage, f"{found.name}/{sweep_files.STOP}", '{"stop": true}')


def resume(found: SweepLocation, folder: Path) -> Path:
    """Go on with the sweep in a process of its own, which outlives the page.

    Returns:
        The file that has what it prints.
    """
    log = folder / "resume.log"
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "music_rllib.sweep", "resume", found.name]
    with log.open("ab") as sink:
        subprocess.Popen(  # noqa: S603
            [*command, "--storage", found.storage],
            stdin=subprocess.DEVNULL,
            stdout=sink,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    return log


class Server(ThreadingHTTPServer):
    """Answers whoever knows its token."""

    daemon_threads = True
    token: str


def make_server(page: LivePage, found: SweepLocation, folder: Path, port: int) -> Server:
    """A server that is ready to serve, with a token of its own.

    Raises:
        BadInputError: the port is taken.
    """
    token = secrets.token_urlsafe(24)
    own = {"page": page, "found": found, "folder": folder, "token": token}
    try:
        server = Server((HOST, port), type("Handler", (_Handler,), own))
    except OSError as error:
        raise BadInputError(f"--port must be free, got {port}: {error.strerror}") from error
    server.token = token
    return server


def serve(server: Server, page: LivePage, say: Callable[[str], None]) -> None:
    """Serve until Ctrl-C."""
    say(f"Report: http://{HOST}:{server.server_port}/?token={server.token}")
    say("Whoever has this address may stop and resume the sweep. Ctrl-C ends the page, not it.")
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        server.server_close()
        page.close()


class _Handler(BaseHTTPRequestHandler):
    page: LivePage
    found: SweepLocation
    folder: Path
    token: str
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "music_rllib", ""

    def do_GET(self) -> None:
        asked = urlsplit(self.path)
        given = self.headers.get(HEADER) or parse_qs(asked.query).get("token", [""])[0]
        if not self._allowed(given):
            return
        if asked.path == "/":
            self._answer(HTTPStatus.OK, self.page.html, "text/html")
        elif asked.path == "/state":
            self._json(HTTPStatus.OK, self.page.state())
        else:
            self._json(HTTPStatus.NOT_FOUND, {"error": "there is no such page"})

    def do_POST(self) -> None:
        # Never from the address: a form of another site could send that.
        if not self._allowed(self.headers.get(HEADER, "")):
            return
        state = self.page.state().get("state")
        if self.path == "/stop" and state == "running":
            stop(self.found)
            self._json(HTTPStatus.OK, {"said": "The sweep was told to save its runs and stop."})
        elif self.path == "/resume" and state not in ("running", "unknown"):
            log = resume(self.found, self.folder)
            self._json(HTTPStatus.OK, {"said": f"The sweep goes on; what it prints is in {log}."})
        else:
            said = f"The sweep is {state}: there is nothing to do."
            self._json(HTTPStatus.CONFLICT, {"said": said})

    def _allowed(self, token: str) -> bool:
        # A name that leads here is somebody else's (DNS rebinding).
        host = (self.headers.get("Host") or "").rpartition(":")[0]
        if host in (HOST, "localhost") and hmac.compare_digest(token.encode(), self.token.encode()):
            return True
        self._json(HTTPStatus.FORBIDDEN, {"error": "open the address that the report printed"})
        return False

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
        """Nothing: the address with the token must not end up in a log."""
