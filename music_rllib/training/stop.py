"""A flag by which the driver stops all its workers.

It is kept in Ray's own key-value store, so that it needs no shared disk and is gone with the
cluster. Workers poll it in a thread while they train.
"""

from __future__ import annotations

import threading

from ray.experimental import internal_kv

LOOK_SECONDS = 0.3
_NAMESPACE = b"music_rllib"


class StopFlag:
    """The driver's side."""

    def __init__(self, key: str) -> None:
        """The flag with this unique `key`."""
        self.key = key

    def set(self) -> None:
        """Stop all workers. Only where Ray is connected."""
        internal_kv._internal_kv_put(self.key, "stop", namespace=_NAMESPACE)

    def clear(self) -> None:
        """Remove the flag from a cluster that goes on."""
        internal_kv._internal_kv_del(self.key, namespace=_NAMESPACE)


class StopWatch:
    """A worker's side."""

    def __init__(self, key: str | None) -> None:
        """Poll the flag `key` from now on; nothing where it is None."""
        self._key = key
        self._asked, self._ended = threading.Event(), threading.Event()
        if key is not None:
            threading.Thread(target=self._look, name="stop-watch", daemon=True).start()

    def asked(self) -> bool:
        """Whether the worker is to stop."""
        return self._asked.is_set()

    def end(self) -> None:
        """Stop polling."""
        self._ended.set()

    def _look(self) -> None:
        while not self._ended.wait(LOOK_SECONDS):
            try:
                flag = internal_kv._internal_kv_get(self._key, namespace=_NAMESPACE)
            except Exception:  # noqa: S112  Ray ends this process if its head stays away
                continue
            if flag is not None:
                self._asked.set()
                return
