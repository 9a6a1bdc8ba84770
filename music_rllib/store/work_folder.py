"""Checkpoints of unfinished runs, in the folder `work/<key>` of a storage (see `node_store`)."""

from __future__ import annotations

import contextlib
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import pyarrow.fs as pafs

from music_rllib.envs.fingerprint import Fingerprint
from music_rllib.store.history import HISTORY, Report, from_json_lines
from music_rllib.store.lease import LeaseFile
from music_rllib.store.object_folder import DamagedError, Manifest, ObjectFolders

FORMAT = "music_rllib checkpoint 2"
KEEP = 2
"""Number of checkpoints of a run that are kept by default."""


class WorkFolder:
    """The newest `keep` checkpoints of one run in the folder `root`, by environment steps.

    Data that does not change any more, such as old trajectories, is in *parts* below `parts/`.
    Several checkpoints may need the same parts; each names its own.
    """

    def __init__(self, filesystem: pafs.FileSystem, root: str, keep: int = KEEP) -> None:
        self.root = root
        self.lease = LeaseFile(filesystem, f"{root}/lease.json")
        self._checkpoints = ObjectFolders(filesystem, root)
        self._parts = ObjectFolders(filesystem, f"{root}/parts")
        self._keep = keep
        self._fs = filesystem
        self._local = isinstance(filesystem, pafs.LocalFileSystem)

    @contextlib.contextmanager
    def new_checkpoint(
        self, env_steps: int, environment: Fingerprint | None = None
    ) -> Iterator[NewCheckpoint]:
        """Yield a draft to fill; it becomes the newest checkpoint when the `with` ends.

        Raises:
            StorageError: The storage cannot be written; older checkpoints are intact.
        """
        # A run may save the same step twice: where the first checkpoint was damaged.
        name = f"{env_steps:012d}-{uuid.uuid4().hex[:8]}"
        meta: dict[str, Any] = {"format": FORMAT}
        if environment is not None:
            meta["environment"] = dict(environment)
        with self._checkpoints.sealing(name, meta) as folder:
            draft = NewCheckpoint(folder, self._parts)
            yield draft
            meta["parts"] = draft.needs
        self._prune(name)

    def _prune(self, new: str) -> None:
        """Delete what is too old, and what lies beyond `new`: it was damaged when the run began."""
        names = self._checkpoints.names()
        older = [name for name in names if steps_of(name) < steps_of(new)]
        kept = [*older, new][-self._keep :]
        for name in set(names) - set(kept):
            self._checkpoints.remove(name)
        needed: set[str] = set()
        for name in kept:
            # A checkpoint with a damaged manifest cannot be used, so it needs no parts.
            with contextlib.suppress(DamagedError):
                needed.update(_needs(self._checkpoints.manifest(name)))
        for name in set(self._parts.names()) - needed:
            self._parts.remove(name)

    @contextlib.contextmanager
    def newest(
        self, warn: Callable[[str], None] = warnings.warn, most: int | None = None
    ) -> Iterator[SavedCheckpoint | None]:
        """Yield a verified local copy of the newest sound checkpoint, or None.

        Args:
            warn: Called with a message for each damaged checkpoint, which is skipped.
            most: Largest number of environment steps of the checkpoint.
        """
        for name in reversed(self._checkpoints.names()):
            if most is not None and steps_of(name) > most:
                continue
            with TemporaryDirectory() as temporary:
                try:
                    saved = self._fetch(name, Path(temporary))
                except DamagedError as error:
                    warn(f"a damaged checkpoint is skipped: {error}")
                    continue
                yield saved
                return
        yield None

    def _fetch(self, name: str, folder: Path) -> SavedCheckpoint:
        manifest = self._checkpoints.fetch(name, folder / "checkpoint")
        if manifest.meta.get("format") != FORMAT:
            raise DamagedError(
                f"{self._checkpoints.path(name)} must be a {FORMAT!r}, "
                f"got {manifest.meta.get('format')!r}"
            )
        parts = {}
        for part in _needs(manifest):
            parts[part] = folder / "parts" / part
            self._parts.fetch(part, parts[part])
        return SavedCheckpoint(folder / "checkpoint", parts, environment_of(manifest))

    def environment(self) -> Fingerprint | None:
        """Fingerprint of the environment of the newest sound checkpoint; None: it is not known."""
        for name in reversed(self._checkpoints.names()):
            with contextlib.suppress(DamagedError):
                return environment_of(self._checkpoints.manifest(name))
        return None

    def history(self) -> list[Report]:
        """Reports of the newest checkpoint whose history is sound; [] if there is none."""
        return from_json_lines(self.lines())

    def lines(self) -> bytes:
        """The `HISTORY` of the newest checkpoint that has a sound one; empty if there is none."""
        for name in reversed(self._checkpoints.names()):
            with contextlib.suppress(DamagedError, FileNotFoundError):
                return self._checkpoints.read(name, HISTORY)
        return b""

    def tidy(self) -> None:
        """Delete what killed attempts have left; the caller must hold the lease."""
        self._checkpoints.tidy()
        self._parts.tidy()

    def names(self) -> list[str]:
        """Names of the checkpoints, oldest first."""
        return self._checkpoints.names()

    def read(self, name: str) -> str | None:
        """Content of a small text file in the folder; None if it does not exist."""
        try:
            with self._fs.open_input_stream(f"{self.root}/{name}") as stream:
                return bytes(stream.read()).decode(errors="replace")
        except FileNotFoundError:
            return None

    def remove_file(self, name: str) -> None:
        """Delete a file in the folder, if it exists."""
        with contextlib.suppress(FileNotFoundError):
            self._fs.delete_file(f"{self.root}/{name}")

    def remove_if_empty(self) -> None:
        """Delete the folder if it is on a disk and empty."""
        if self._local:
            with contextlib.suppress(OSError):
                Path(self.root).rmdir()

    def clear(self) -> None:
        """Delete all checkpoints and parts, as the run is finished."""
        self._parts.remove_all()
        self._checkpoints.remove_all()


def steps_of(checkpoint: str) -> int:
    """Environment steps of the checkpoint of this name."""
    return int(checkpoint.split("-")[0])


def _needs(manifest: Manifest) -> list[str]:
    parts = manifest.meta.get("parts", [])
    return [str(part) for part in parts] if isinstance(parts, list) else []


def environment_of(manifest: Manifest) -> Fingerprint | None:
    """Fingerprint of the environment in a manifest; None: it is not recorded."""
    found = manifest.meta.get("environment")
    return {k: str(v) for k, v in found.items()} if isinstance(found, dict) else None


class SavedCheckpoint(NamedTuple):
    """A verified copy of a checkpoint on the local disk."""

    folder: Path
    parts: Mapping[str, Path]
    """Folder of each part, by its name."""
    environment: Fingerprint | None = None


class NewCheckpoint:
    """A checkpoint that is being written to `folder`, with its new parts in `parts`."""

    def __init__(self, folder: Path, parts: ObjectFolders) -> None:
        self.folder = folder
        self.needs: list[str] = []
        """Names of the parts that the checkpoint needs, new or of earlier checkpoints."""
        self._parts = parts

    @contextlib.contextmanager
    def new_part(self, label: str) -> Iterator[tuple[str, Path]]:
        """Yield the name of a new part and a folder to fill."""
        # Never the name of an existing part, which may be damaged.
        name = f"{label}-{uuid.uuid4().hex[:8]}"
        with self._parts.sealing(name, {}) as folder:
            yield name, folder
        self.needs.append(name)
