"""A planned sweep with its storage open: what is done, and what it leaves about itself."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from music_rllib.experiment.files import write_atomically
from music_rllib.experiment.model import SweepConfig
from music_rllib.experiment.plan import Plan
from music_rllib.experiment.result import RunResult
from music_rllib.experiment.sealed import StorageError
from music_rllib.experiment.store import NodeStore
from music_rllib.sweep.board import Board, Status
from music_rllib.tracking.redaction import redact

__all__ = ["Sweep", "keep_record", "open_sweep"]


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """A planned sweep, its storage open."""

    config: SweepConfig
    plan: Plan
    storage: str
    """Absolute folder, or URI."""
    store: NodeStore
    folder: Path
    """The sweep's own files, on this machine."""
    board: Board

    @property
    def finished(self) -> set[str]:
        """Keys of the nodes that have a result."""
        return {node.key for node in self.board.having(Status.FINISHED, Status.REUSED)}

    def results(self) -> dict[str, RunResult]:
        """Node key to result, for the finished ones."""
        found = {key: self.store.result(key) for key in self.finished}
        return {key: result for key, result in found.items() if result is not None}


def open_sweep(config: SweepConfig, plan: Plan, storage: str, folder: Path) -> Sweep:
    """Open the storage and see what is finished already.

    Raises:
        StorageError: The storage can't be reached, or a finished node in it can't be read.
    """
    store = NodeStore(storage)
    finished = {node.key for node in plan.nodes if store.is_finished(node.key)}
    for key in finished:
        store.result(key)
    return Sweep(
        config=config,
        plan=plan,
        storage=storage,
        store=store,
        folder=folder,
        board=Board(plan, finished),
    )


def keep_record(sweep: Sweep) -> None:
    """Write the configuration and the plan into the sweep's folder.

    Raises:
        StorageError: The folder can't be written.
    """
    nodes = [
        {
            "key": node.key,
            "label": node.label,
            "input": node.input.key if node.input else None,
            "env_steps": node.run.env_steps,
        }
        for node in sweep.plan.nodes
    ]
    try:
        sweep.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(sweep.folder / "sweep.yaml", sweep.config.text.encode())
        write_atomically(
            sweep.folder / "plan.json",
            json.dumps({"storage": redact(sweep.storage), "nodes": nodes}, indent=1).encode(),
        )
    except OSError as error:
        place = error.filename or sweep.folder
        raise StorageError(f"{place} must be writable: {error.strerror}") from error
