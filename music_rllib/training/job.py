"""All that a worker is told about a node."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Checkpoints
from music_rllib.envs.tasks import Task
from music_rllib.experiment.plan import Node

__all__ = ["NodeJob"]


class NodeJob(BaseModel):
    """All that a worker needs to compute a node."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str
    label: str
    run: RunSettings
    source_key: str | None
    source_task: Task | None
    storage: str
    cpus: int
    gpus: float = 0.0
    memory: int = 0
    """Bytes that are reserved; 0: memory is not counted."""
    until: int | None = None
    """Stop at the first evaluation from so many environment steps on, to be continued; None: go on
    to the end."""
    checkpoints: Checkpoints = Checkpoints()
    sweep: str = ""
    """Name of the sweep, for messages."""
    stop_key: str | None = None
    """Where to look whether to stop; None: nowhere."""
    hang_minutes: float | None = None
    """How long a call of the environment may last; None: as long as it likes."""

    @classmethod
    def of(
        cls,
        node: Node,
        storage: str,
        cpus: int,
        *,
        gpus: float = 0.0,
        memory: int = 0,
        until: int | None = None,
        checkpoints: Checkpoints | None = None,
        sweep: str = "",
        stop_key: str | None = None,
        hang_minutes: float | None = None,
    ) -> NodeJob:
        """The job that computes `node` in the storage at this URI on so many CPUs."""
        return cls(
            gpus=gpus,
            memory=memory,
            until=until,
            checkpoints=checkpoints or Checkpoints(),
            sweep=sweep,
            stop_key=stop_key,
            hang_minutes=hang_minutes,
            key=node.key,
            label=node.label,
            run=node.run,
            source_key=node.source_key,
            source_task=node.input.task if node.input else None,
            storage=storage,
            cpus=cpus,
        )

    def to_tune(self) -> dict[str, Any]:
        """As a Tune config; text, so that Tune doesn't look for search spaces in it."""
        return {"job": self.model_dump_json()}

    @classmethod
    def from_tune(cls, config: dict[str, Any]) -> NodeJob:
        """Inverse of `to_tune`."""
        return cls.model_validate_json(config["job"])
