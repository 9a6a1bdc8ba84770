"""The server of a running sweep's page, on loopback.

A request needs the token of the page's address to read the page and to stop or resume the sweep,
since other users of the machine can reach its ports, too. Pages of other sites cannot act: they do
not know the token, and browsers let no foreign page send the header that has it.
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

from music_rllib.errors import BadInputError, first_line
from music_rllib.experiment import sweep_files
from music_rllib.experiment.location import SweepLocation
from music_rllib.redaction import for_people
from music_rllib.report.live.state import Progress
from music_rllib.store.object_folder import StorageError

HOST = "127.0.0.1"
LEAST_PAUSE = 10.0
"""Least seconds between two pages."""
_RELAX = 4.0
"""Pause between two pages as a multiple of the time that the last one took."""
HEADER = "X-Token"
"""Name of the header that has the token."""


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
            except Exception as error:  # MLflow or the storage is busy or down: try again later
                self._problem = f"The page is an older one: {for_people(first_line(error))}"
                continue
            self._problem = None
            took = time.monotonic() - began
            if html != self.html:
                self.html, self.version = html, self.version + 1


def stop(found: SweepLocation) -> None:
    """Request that the sweep saves its runs and ends."""
    sweep_files.write(found.storage, f"{found.name}/{sweep_files.STOP}", '{"stop": true}')


def resume(found: SweepLocation, folder: Path) -> Path:
    """Resume the sweep in a new process that outlives the page.

    Returns:
        The file with the output of that process.
    """
    log = folder / "resume.log"
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "music_rllib.sweep", "resume", found.name]
    with log.open("ab") as output:
        subprocess.Popen(  # noqa: S603
            [*command, "--storage", found.storage],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    return log


class Server(ThreadingHTTPServer):
    """Answers requests that have its token."""

    daemon_threads = True
    token: str

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing about a tab that was closed, or about an address that is none."""
        if not isinstance(sys.exception(), ConnectionError | ValueError):
            super().handle_error(request, client_address)


def make_server(page: LivePage, found: SweepLocation, folder: Path, port: int) -> Server:
    """A server on the port, with a new token.

    Raises:
        BadInputError: the port is taken.
    """
    token = secrets.token_urlsafe(24)
    attributes = {"page": page, "found": found, "folder": folder, "token": token}
    try:
        server = Server((HOST, port), type("Handler", (_Handler,), attributes))
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
        url = urlsplit(self.path)
        token = self.headers.get(HEADER) or parse_qs(url.query).get("token", [""])[0]
        if not self._allowed(token):
            return
        if url.path == "/":
            self._answer(HTTPStatus.OK, self.page.html, "text/html")
        elif url.path == "/state":
            self._json(HTTPStatus.OK, self.page.state())
        else:
            self._json(HTTPStatus.NOT_FOUND, {"error": "there is no such page"})

    def do_POST(self) -> None:
        # Not the address' token: a form of another site could send that.
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
        # Another host name that resolves to this machine is an attack (DNS rebinding).
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
        """Log nothing: the address has the token."""
