"""Ctrl-C and SIGTERM while a sweep is being set up."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

from music_rllib.command_line import say_stopped_at_once

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class EarlySignals:
    """Raises KeyboardInterrupt for a signal, and remembers it in case a library swallows that."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> EarlySignals:
        self.received = None
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.getsignal(number) for number in SIGNALS}
            self.install()
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def install(self) -> None:
        """Set the handlers, again if a library has set others."""
        if self._before:
            for number in SIGNALS:
                signal.signal(number, self._handle)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal has come."""
        if self.received is not None:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            say_stopped_at_once()
            os._exit(128 + number)
        self.received = number
        raise KeyboardInterrupt


early = EarlySignals()
"""The handlers of this process, which drives one sweep at most."""
