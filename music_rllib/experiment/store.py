"""The node store: finished runs by the hash of what determines them, and the state of others.

Below one storage folder or bucket, shared by all sweeps in it::

    nodes/<key>/      a finished run: handoff/, history.jsonl, run.json, manifest.json last
    work/<key>/<n>/   checkpoints of a run that isn't finished, each with its manifest

The store, not Tune's snapshot, says what is finished.
"""

from __future__ import annotations

import contextlib
import shutil
import uuid
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from music_rllib.experiment.result import HISTORY, Report, RunResult, from_json_lines
from music_rllib.experiment.sealed import DamagedError, SealedFolders, open_storage

__all__ = ["NodeStore", "WorkFolder"]


class NodeStore:
    """Finished nodes and the checkpoints of unfinished ones."""

    def __init__(self, uri: str) -> None:
        """Open `uri`, a folder or bucket as for `sealed.open_storage`.

        Raises:
            StorageError: It can't be resolved or reached.
        """
        self.uri = uri
        self._fs, self._root = open_storage(uri)
        self._nodes = SealedFolders(self._fs, f"{self._root}/nodes")

    def path(self, key: str) -> str:
        """Where the node is or would be, for messages."""
        return self._nodes.path(key)

    def is_finished(self, key: str) -> bool:
        """Whether the node has been published."""
        return self._nodes.exists(key)

    def result(self, key: str) -> RunResult | None:
        """The end of a finished run; None for a node that is an imported handoff.

        Raises:
            DamagedError: The node isn't there or can't be read.
        """
        with self._saying_what_to_do(key):
            result = self._nodes.manifest(key).meta.get("result")
        return None if result is None else RunResult.model_validate(result)

    def history(self, key: str) -> list[Report]:
        """All reports of a finished run.

        Raises:
            DamagedError: The node has no readable history.
        """
        try:
            return from_json_lines(self._nodes.read(key, HISTORY))
        except ValueError as error:
            raise DamagedError(f"{self.path(key)}/{HISTORY} must hold reports: {error}") from error

    def publish(self, key: str, folder: Path, result: RunResult | None = None) -> None:
        """Make `folder`'s files the node `key`, for good. A node that exists stays as it is.

        Raises:
            StorageError: The storage can't be written; names the path.
        """
        if self.is_finished(key):
            return
        meta = {"result": None if result is None else result.model_dump()}
        with self._nodes.sealing(key, meta) as staging:
            shutil.copytree(folder, staging, dirs_exist_ok=True)

    def fetch(self, key: str, folder: Path) -> None:
        """Copy a finished node's files into `folder`, verified.

        Raises:
            DamagedError: The node isn't what its manifest says.
        """
        self._nodes.fetch(key, folder)

    def verify(self, key: str) -> None:
        """Read a finished node through, so that damage shows before anything depends on it.

        Raises:
            DamagedError: The node isn't what its manifest says; the message says what to do.
        """
        with TemporaryDirectory() as folder, self._saying_what_to_do(key):
            self.fetch(key, Path(folder))

    @contextlib.contextmanager
    def _saying_what_to_do(self, key: str) -> Iterator[None]:
        try:
            yield
        except DamagedError as error:
            raise DamagedError(f"{error}. Delete {self.path(key)} to train it again") from error

    def work_folder(self, key: str) -> WorkFolder:
        """Where a run that isn't finished keeps its checkpoints."""
        return WorkFolder(SealedFolders(self._fs, f"{self._root}/work/{key}"))


class WorkFolder:
    """Checkpoints of one run, numbered by environment steps."""

    def __init__(self, checkpoints: SealedFolders, keep: int = 2) -> None:
        """Keep the newest `keep` of `checkpoints`."""
        self._checkpoints = checkpoints
        self._keep = keep

    @contextlib.contextmanager
    def new_checkpoint(self, env_steps: int) -> Iterator[Path]:
        """Give a folder to save into; it becomes the newest checkpoint when the `with` ends.

        Raises:
            StorageError: The storage can't be written; older checkpoints are intact.
        """
        # Two attempts may reach the same step, the second one because the first is damaged.
        name = f"{env_steps:012d}-{uuid.uuid4().hex[:8]}"
        with self._checkpoints.sealing(name, {}) as folder:
            yield folder
        for name in self._checkpoints.names()[: -self._keep]:
            self._checkpoints.remove(name)

    @contextlib.contextmanager
    def newest(self, warn: Callable[[str], None] = warnings.warn) -> Iterator[Path | None]:
        """A verified local copy of the newest sound checkpoint, or None, for this `with`.

        Args:
            warn: Is told about each damaged checkpoint that is skipped.
        """
        with TemporaryDirectory() as above:
            for name in reversed(self._checkpoints.names()):
                folder = Path(above, name)
                try:
                    self._checkpoints.fetch(name, folder)
                except DamagedError as error:
                    warn(f"a damaged checkpoint is skipped: {error}")
                    continue
                yield folder
                return
            yield None

    def names(self) -> list[str]:
        """The checkpoints there are, oldest first."""
        return self._checkpoints.names()

    def clear(self) -> None:
        """Delete all checkpoints: the run is finished."""
        self._checkpoints.remove_all()
