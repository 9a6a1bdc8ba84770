"""All that a worker is told about a node."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Checkpoints
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import Node


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
    cpus: int
    gpus: float = 0.0
    memory: int = 0
    """Bytes that are reserved; 0: memory is not counted."""
    until: int | None = None
    """The run is paused at the first evaluation from this environment step on; None: it goes on to
    its end."""
    checkpoints: Checkpoints = Checkpoints()
    sweep: str = ""
    """Name of the sweep, for messages."""
    stop_key: str | None = None
    """Key of the flag that stops the worker; None: nothing does."""
    environment: dict[str, str] | None = None
    """Fingerprint of the task's environment in the driver; None: it was not looked at."""
    same_environments: frozenset[str] = frozenset()
    """Digests of those in place of which it may be used."""
    hang_minutes: float | None = None
    """Longest duration of one call of the environment; None: there is no limit."""

    @classmethod
    def of(cls, node: Node, storage: str, cpus: int, **options: Any) -> NodeJob:
        """The job that computes `node` in this storage; `options` are the fields with defaults."""
        return cls(
            key=node.key,
            label=node.label,
            run=node.run,
            source_key=node.source_key,
            source_task=node.input.task if node.input else None,
            storage=storage,
            cpus=cpus,
            **options,
        )

    def to_tune(self) -> dict[str, Any]:
        """The job as a Tune config; as text, so that Tune finds no search spaces in it."""
        return {"job": self.model_dump_json()}

    @classmethod
    def from_tune(cls, config: dict[str, Any]) -> NodeJob:
        """Inverse of `to_tune`."""
        return cls.model_validate_json(config["job"])
