"""Checkpoints of unfinished runs, in the folder `work/<key>` of a storage (see `node_store`)."""

from __future__ import annotations

import contextlib
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from music_rllib.envs.fingerprint import Fingerprint
from music_rllib.store.history import HISTORY
from music_rllib.store.lease import LeaseFile
from music_rllib.store.sealed import Manifest, SealedFolders
from music_rllib.store.storage import DamagedError, StorageFolder

FORMAT = "music_rllib checkpoint 2"
KEEP = 2
"""Default number of checkpoints of a run that are kept."""


class SavedCheckpoint(NamedTuple):
    """A verified copy of a checkpoint on the local disk."""

    folder: Path
    parts: Mapping[str, Path]
    environment: Fingerprint | None = None


class NewCheckpoint:
    """A checkpoint that is being written to `folder`, with its new parts in `parts`."""

    def __init__(self, folder: Path, parts: SealedFolders) -> None:
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


class WorkFolder:
    """The newest `keep` checkpoints of one run in `folder`, by environment steps.

    Data that no longer changes, such as old trajectories, is in *parts* below `parts/`. Several
    checkpoints may need the same parts; each names its own.
    """

    def __init__(self, folder: StorageFolder, keep: int = KEEP) -> None:
        self.folder = folder
        self.lease = LeaseFile(folder, "lease.json")
        self._checkpoints = SealedFolders(folder)
        self._parts = SealedFolders(folder / "parts")
        self._keep = keep

    @contextlib.contextmanager
    def new_checkpoint(
        self, env_steps: int, environment: Fingerprint | None = None
    ) -> Iterator[NewCheckpoint]:
        """Yield a checkpoint to fill; it becomes the newest one when the `with` ends.

        Raises:
            StorageError: The storage cannot be written; older checkpoints are intact.
        """
        # A run saves the same step twice if the first checkpoint was damaged.
        name = f"{env_steps:012d}-{uuid.uuid4().hex[:8]}"
        meta: dict[str, Any] = {"format": FORMAT}
        if environment is not None:
            meta["environment"] = dict(environment)
        with self._checkpoints.sealing(name, meta) as folder:
            new = NewCheckpoint(folder, self._parts)
            yield new
            meta["parts"] = new.needs
        self._prune(name)

    def _prune(self, new: str) -> None:
        """Delete old checkpoints, and later ones than `new`: they were damaged at the start."""
        names = self.names()
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

    def names(self) -> list[str]:
        return self._checkpoints.names()

    @contextlib.contextmanager
    def newest(
        self, warn: Callable[[str], None] = warnings.warn, most: int | None = None
    ) -> Iterator[SavedCheckpoint | None]:
        """Yield a verified local copy of the newest undamaged checkpoint, or None.

        Args:
            warn: Called with a message for each damaged checkpoint, which is skipped.
            most: Largest number of environment steps of the checkpoint.
        """
        for name in reversed(self.names()):
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
        if (found := manifest.meta.get("format")) != FORMAT:
            raise DamagedError(
                f"{self._checkpoints.path(name)} must be a {FORMAT!r}, got {found!r}"
            )
        parts = {part: folder / "parts" / part for part in _needs(manifest)}
        for part, place in parts.items():
            self._parts.fetch(part, place)
        return SavedCheckpoint(folder / "checkpoint", parts, environment_of(manifest))

    def environment(self) -> Fingerprint | None:
        """Fingerprint of the newest undamaged checkpoint's environment; None if not recorded."""
        for name in reversed(self.names()):
            with contextlib.suppress(DamagedError):
                return environment_of(self._checkpoints.manifest(name))
        return None

    def lines(self) -> bytes:
        """The `HISTORY` of the newest checkpoint with an undamaged one; empty if none has."""
        for name in reversed(self.names()):
            with contextlib.suppress(DamagedError):
                return self._checkpoints.read(name, HISTORY)
        return b""

    def tidy(self) -> None:
        """Delete the remains of killed attempts; the caller must hold the lease."""
        self._checkpoints.tidy()
        self._parts.tidy()

    def remove_if_empty(self) -> None:
        """Delete the folder if it is on a disk and empty."""
        if self.folder.is_local:
            with contextlib.suppress(OSError):
                Path(self.folder.path).rmdir()

    def clear(self) -> None:
        for name in self.names():  # their manifests first, so that nobody uses a half-deleted one
            self._checkpoints.remove(name)
        self.folder.delete()


def steps_of(checkpoint: str) -> int:
    """Environment steps of the checkpoint of this name."""
    return int(checkpoint.split("-")[0])


def environment_of(manifest: Manifest) -> Fingerprint | None:
    """Fingerprint of the environment in a manifest; None if it is not recorded."""
    found = manifest.meta.get("environment")
    return {k: str(v) for k, v in found.items()} if isinstance(found, dict) else None


def _needs(manifest: Manifest) -> list[str]:
    parts = manifest.meta.get("parts", [])
    return [str(part) for part in parts] if isinstance(parts, list) else []
