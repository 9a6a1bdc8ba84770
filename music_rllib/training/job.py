"""What the driver sends to its workers: the run to compute, and the flag that stops them all."""

from __future__ import annotations

import threading
from typing import Any

from pydantic import BaseModel, ConfigDict
from ray.experimental import internal_kv

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Checkpoints, Resources
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import Node

LOOK_SECONDS = 0.3
"""Time between two looks at the stop flag."""
_NAMESPACE = b"music_rllib"


class NodeJob(BaseModel):
    """All that a worker needs to compute a node."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str
    label: str
    run: RunSettings
    source_key: str | None
    source_task: Task | None
    storage: str
    """Absolute folder, or URI."""
    resources: Resources = Resources(hang_minutes=None)
    until: int | None = None
    """The run pauses at the first evaluation at or after this environment step; None: never."""
    checkpoints: Checkpoints = Checkpoints()
    sweep: str = ""
    """Name of the sweep, for messages."""
    stop_key: str | None = None
    """Key of the flag that stops the worker; None: there is no flag."""
    environment: dict[str, str] | None = None
    """Fingerprint of the task's environment in the driver; None: not computed."""
    same_environments: frozenset[str] = frozenset()
    """Digests of environments that count as the same."""

    @classmethod
    def of(cls, node: Node, storage: str, **options: Any) -> NodeJob:
        """The job that computes `node` in this storage; `options` are the fields with defaults."""
        return cls(
            key=node.key,
            label=node.label,
            run=node.run,
            source_key=node.source_key,
            source_task=node.input.task if node.input else None,
            storage=storage,
            **options,
        )

    def to_tune(self) -> dict[str, Any]:
        """The job as a Tune config; as text, so that Tune finds no search spaces in it."""
        return {"job": self.model_dump_json()}

    @classmethod
    def from_tune(cls, config: dict[str, Any]) -> NodeJob:
        return cls.model_validate_json(config["job"])


class StopFlag:
    """The driver's side of a flag that stops all workers.

    The flag is in Ray's key-value store, which needs no shared disk and ends with the cluster.
    """

    def __init__(self, key: str) -> None:
        """Name the flag by a unique `key`."""
        self.key = key

    def set(self) -> None:
        """Stop all workers. Ray must be connected."""
        internal_kv._internal_kv_put(self.key, "stop", namespace=_NAMESPACE)

    def clear(self) -> None:
        internal_kv._internal_kv_del(self.key, namespace=_NAMESPACE)


class StopWatch:
    """The worker's side: a thread that polls the flag while the worker trains."""

    def __init__(self, key: str | None) -> None:
        """Poll the flag `key`; do nothing for None."""
        self._key = key
        self._asked, self._ended = threading.Event(), threading.Event()
        if key is not None:
            threading.Thread(target=self._look, name="stop-watch", daemon=True).start()

    def asked(self) -> bool:
        """Whether the worker should stop."""
        return self._asked.is_set()

    def end(self) -> None:
        self._ended.set()

    def _look(self) -> None:
        while not self._ended.wait(LOOK_SECONDS):
            try:
                flag = internal_kv._internal_kv_get(self._key, namespace=_NAMESPACE)
            except Exception:  # noqa: S112  Ray ends this process if its head does not return
                continue
            if flag is not None:
                self._asked.set()
                return
