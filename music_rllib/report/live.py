"""The live page: a report of a running sweep and its progress, served on this machine.

The page is read-only: no request changes anything.
"""

from __future__ import annotations

import contextlib
import json
import secrets
import shlex
import socket
import sys
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from music_rllib import names
from music_rllib.command_line import plain
from music_rllib.errors import BadInputError, first_line
from music_rllib.experiment import sweep_files
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.names import ShortLabels
from music_rllib.redaction import for_people, redact
from music_rllib.store.storage import StorageError

HOST = "127.0.0.1"
LEAST_PAUSE = 10.0
"""Smallest number of seconds between two pages."""
PAUSE_FACTOR = 4.0
"""Pause between two pages as a multiple of the time that the last one took."""
READ_SECONDS = 10.0
"""Largest number of seconds to wait for more of a request, and for the next one."""
CONNECTIONS = 32
"""Largest number of open connections, each with a thread; a new one closes the oldest."""
WINDOW = 120.0
"""Seconds over which the speed is measured."""
SHOWN = 50
"""Largest number of running runs, and of failed ones, on the page."""


class Progress:
    """Reads a sweep's `state.json` for the page."""

    def __init__(self, location: SweepLocation) -> None:
        self._location = location
        self._seen: defaultdict[str, deque[tuple[float, int]]] = defaultdict(deque)
        """Heartbeats and steps of each driver: several may write the state in turn."""

    def read(self) -> dict[str, Any]:
        """State, steps, speed, stages, running and failed runs of the sweep.

        Raises:
            StorageError: `state.json` is damaged or cannot be read.
        """
        state = self._location.read(sweep_files.STATE)
        if state is None:
            return {"sweep": self._location.name, "state": "not started"}
        driver, steps = state["driver"], state["env_steps"]
        left = steps["left"] + steps["to_come"]
        running = sweep_files.is_alive(state)
        outcome = driver["outcome"]
        speed = self._speed(driver, steps["done"]) if running else None
        return {
            "sweep": self._location.name,
            "state": "interrupted" if outcome == "running" and not running else outcome,
            "command": self._command(outcome, running=running),
            "done": steps["done"],
            "left": left,
            "at_most": steps["to_come"] > 0,
            "speed": speed,
            "seconds_left": left / speed if speed else None,
            "stages": [{"name": one["name"], "runs": one["runs"]} for one in state["stages"]],
            "running": [
                one | {"run": self._short(one["run"]), "metric": names.word_of(one["metric"])}
                for one in state["running"][:SHOWN]
                if running
            ],
            "failures": [
                {"run": self._short(one["run"]), "cause": one["cause"]}
                for one in state["failures"][-SHOWN:]
            ],
        }

    def is_running(self) -> bool:
        """Whether the sweep's driver is alive; False if its state cannot be read."""
        try:
            return bool(self.read()["state"] == "running")
        except StorageError:
            return False

    def _command(self, outcome: str, *, running: bool) -> str | None:
        """The command that stops a running sweep or resumes a stopped one, without secrets."""
        if outcome == "finished":
            return None
        name, storage = self._location.name, redact(self._location.storage)
        verb = "stop" if running else "resume"
        return shlex.join(["music-rllib", verb, name, "--storage", storage])

    @cached_property
    def _short(self) -> ShortLabels:
        config = self._location.read(sweep_files.CONFIG) or {"tasks": [], "stages": []}
        tasks = {*config["tasks"]}.union(*(stage.get("tasks") or () for stage in config["stages"]))
        return ShortLabels((stage["name"] for stage in config["stages"]), tasks)

    def _speed(self, driver: Mapping[str, Any], done: int) -> float | None:
        """Environment steps per second of all runs; None before two states of this driver."""
        now, seen = driver["heartbeat"], self._seen[f"{driver['machine']} {driver['pid']}"]
        if seen and (now < seen[-1][0] or done < seen[-1][1]):
            seen.clear()  # the sweep was changed
        if not seen or now > seen[-1][0]:
            seen.append((now, done))
        while len(seen) > 2 and now - seen[0][0] > WINDOW:
            seen.popleft()
        (begin, before), (end, after) = seen[0], seen[-1]
        return (after - before) / (end - begin) if after > before else None


class LivePage:
    """The newest page, which is made again and again while the sweep runs."""

    def __init__(self, make: Callable[[], str], progress: Progress) -> None:
        """Make the first page.

        Raises:
            ReportError: There is no sweep to report on.
        """
        self._make, self._progress = make, progress
        self._pages, self._start, self.version = 0, secrets.token_hex(4), ""
        self._problem: str | None = None
        """The reason why the newest page could not be made."""
        before = self.state().get("state")  # the sweep may end while the page is made
        self._show(make())
        self._ended = threading.Event()
        follow = partial(self._follow, before)
        self._thread = threading.Thread(target=follow, name="live page", daemon=True)
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

    def _show(self, html: str) -> None:
        """Let `html` be the newest page; it contains its version, by which a tab tells it apart."""
        self._pages += 1
        self.version = f"{self._start}-{self._pages}"
        self.plain = html
        self.html = html.replace("<body", f'<body data-version="{self.version}"', 1)

    def _follow(self, before: str | None) -> None:
        took = 0.0
        while not self._ended.wait(max(LEAST_PAUSE, PAUSE_FACTOR * took)):
            now = self.state().get("state")
            if now != "running" and now == before:
                continue
            began = time.monotonic()
            try:
                html = self._make()
            except Exception as error:  # the storage is busy or down: try again later
                self._problem = f"The page is out of date: {for_people(first_line(error))}"
                continue
            self._problem, before = None, now
            took = time.monotonic() - began
            if html != self.plain:
                self._show(html)


class Server(ThreadingHTTPServer):
    """Answers each connection in a thread."""

    daemon_threads = True
    request_queue_size = 128  # with the default of 5, a client waits seconds in a burst

    def __init__(self, *arguments: Any) -> None:
        self._open: list[socket.socket] = []
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, and close the oldest connection if there are too many."""
        self._open.append(request)
        with contextlib.suppress(OSError):  # it has ended
            for oldest in self._open[:-CONNECTIONS]:
                oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with contextlib.suppress(ValueError):
            self._open.remove(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing about a tab that was closed, or about an invalid address."""
        if not isinstance(sys.exception(), ConnectionError | ValueError):
            super().handle_error(request, client_address)


def make_server(page: LivePage, port: int) -> Server:
    """A server on the port.

    Raises:
        BadInputError: The port is in use.
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
        text = json.dumps(plain(document), ensure_ascii=False)
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
