"""The node store: finished runs by the hash of their settings, and checkpoints of unfinished runs.

All sweeps in a storage folder or bucket share one store::

    nodes/<key>/      a finished run: handoff/, history.jsonl, run.json, manifest.json last
    work/<key>/<n>/   checkpoints of an unfinished run, each with its manifest
    work/<key>/parts/ data that checkpoints share, such as old trajectories
    work/<key>/lease.json   the process that computes the run, and until when that holds
    continuations/<key>/<n>/   the end of a finished run, for a run with a larger budget
    verified.json     on a disk: fingerprints of finished runs that were verified

The store, not Tune's snapshot, decides which runs are finished.
"""

from __future__ import annotations

import atexit
import contextlib
import shutil
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, NamedTuple, TypeVar

import pyarrow.fs as pafs

from music_rllib.envs.fingerprint import Fingerprint
from music_rllib.store.lease import LeaseFile
from music_rllib.store.object_folder import DamagedError, Manifest, ObjectFolders, open_storage
from music_rllib.store.run_record import HISTORY, Report, RunResult, from_json_lines, last_values
from music_rllib.store.verified import Verified, fingerprint_of

FORMAT = "music_rllib checkpoint 2"
K = TypeVar("K")
V = TypeVar("V")
KEEP = 2
"""Number of checkpoints of a run that are kept by default."""
READERS = 16
"""Largest number of requests to a bucket at a time."""
SHOWN = 10
"""Number of damaged runs that a message names."""
CONTINUATIONS = "continuations"
TRAIN_AGAIN = "'run' and 'resume' train what is damaged again with --retrain-damaged"


class NodeStore:
    """The finished nodes and the work folders of the storage `uri` (see `open_storage`).

    Methods raise DamagedError if a node does not exist or differs from its manifest, and
    StorageError if the storage cannot be reached or written.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self._fs, self._root = open_storage(uri)
        self._nodes = ObjectFolders(self._fs, f"{self._root}/nodes")
        self._local = isinstance(self._fs, pafs.LocalFileSystem)
        self._verified = Verified(Path(self._root, "verified.json"))

    def path(self, key: str) -> str:
        """Path of a node, whether it exists or not."""
        return self._nodes.path(key)

    def is_finished(self, key: str) -> bool:
        """Whether the node has been published."""
        return self._nodes.exists(key)

    def finished(self, keys: Iterable[str]) -> set[str]:
        """The published nodes among `keys`, from one request for all of them."""
        return self._nodes.existing(dict.fromkeys(keys))

    def result(self, key: str) -> RunResult | None:
        """The result of a finished run; None for an imported handoff."""
        with self._advice():
            return self._result(key)

    def _result(self, key: str) -> RunResult | None:
        result = self._nodes.manifest(key).meta.get("result")
        try:
            return None if result is None else RunResult.model_validate(result)
        except ValueError as error:
            place = f"{self.path(key)}/manifest.json"
            raise DamagedError(f"{place} must hold a run's result: {error}") from error

    def history(self, key: str) -> list[Report]:
        """All reports of a finished run."""
        try:
            return from_json_lines(self._nodes.read(key, HISTORY))
        except ValueError as error:
            raise DamagedError(f"{self.path(key)}/{HISTORY} must hold reports: {error}") from error

    def environment(self, key: str) -> Fingerprint | None:
        """Fingerprint of the environment that a finished run used; None: it is not known."""
        return _environment(self._nodes.manifest(key))

    def lines(self, key: str) -> tuple[bytes, dict[str, str], Fingerprint | None]:
        """The `HISTORY` of a finished run, and its code and environment as `publish` got them."""
        manifest = self._nodes.manifest(key)
        known = manifest.meta.get("provenance")
        provenance = known.items() if isinstance(known, dict) else ()
        lines = self._nodes.read(key, HISTORY, manifest)
        return lines, {k: str(value) for k, value in provenance}, _environment(manifest)

    def publish(
        self,
        key: str,
        folder: Path,
        result: RunResult | None = None,
        environment: Fingerprint | None = None,
        provenance: Mapping[str, str] | None = None,
    ) -> None:
        """Copy the files of `folder` to the node `key`, unless it exists already.

        `provenance` are tags that name the code that has made it.
        """
        if self.is_finished(key):
            return
        meta: dict[str, Any] = {"result": None if result is None else result.model_dump()}
        if environment is not None:
            meta["environment"] = dict(environment)
        if provenance is not None:
            meta["provenance"] = dict(provenance)
        with self._nodes.sealing(key, meta) as staging:
            # The modes of a temporary folder, which only its owner may read, are not copied.
            for file in filter(Path.is_file, folder.rglob("*")):
                target = staging / file.relative_to(folder)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, target)

    def tidy(self, key: str) -> None:
        """Delete what killed attempts at publishing a node have left; needs the node's lease."""
        self._nodes.tidy(key)

    def fetch(self, key: str, folder: Path) -> None:
        """Copy a finished node's files into `folder`, verified."""
        self._nodes.fetch(key, folder)

    def folder(self, key: str) -> Path:
        """A finished node's folder on this machine; of a bucket, a copy until the program ends."""
        if self._local:
            return Path(self.path(key))
        copy = Path(mkdtemp(prefix="music-rllib-node-"))
        atexit.register(shutil.rmtree, copy, ignore_errors=True)
        self.fetch(key, copy)
        return copy

    def verify(self, key: str) -> None:
        """Check that a finished node matches its manifest."""
        with self._advice():
            self._nodes.check(key)

    def is_sound(self, key: str) -> bool:
        """Whether the node has been published and matches its manifest."""
        return self.is_finished(key) and not self.damage([key])

    def damage(self, keys: Iterable[str]) -> dict[str, DamagedError]:
        """The finished nodes among `keys` that differ from their manifests, with the errors.

        On a disk, a node that was sound before and whose files have the same inodes, sizes and
        times is not read again.
        """
        keys = list(keys)
        errors = zip(keys, self.map(self._damage_of, keys), strict=True)
        damaged = {key: error for key, error in errors if error is not None}
        self._verified.save()
        return damaged

    def map(self, read: Callable[[K], V], keys: Iterable[K]) -> Iterator[V]:
        """`read` of each key, in order; several at once where each has to be fetched."""
        if self._local:
            yield from map(read, keys)
            return
        with ThreadPoolExecutor(READERS) as pool:
            yield from pool.map(read, keys)

    def _damage_of(self, key: str) -> DamagedError | None:
        try:
            fingerprint = self._fingerprint(key)
            if not self._verified.has(key, fingerprint):
                self._check(key)
                self._verified.add(key, fingerprint)
        except DamagedError as error:
            return error
        except OSError as error:
            place = error.filename or self.path(key)
            return DamagedError(f"{place} must be readable: {error.strerror}")
        return None

    def _fingerprint(self, key: str) -> str | None:
        if not self._local:
            return None
        try:
            return fingerprint_of(map(Path, self._nodes.files(key)))
        except FileNotFoundError:
            return None  # `_check` names the file

    def _check(self, key: str) -> None:
        self._nodes.check(key)
        result = self._result(key)
        # The manifest has no hash of its own, but the history has the values of its result too.
        if self._local and result is not None and HISTORY in self._nodes.manifest(key).files:
            last = last_values(self.history(key))
            # As text, because NaN equals nothing.
            if _as_text(result.metrics) != _as_text(last):
                raise DamagedError(
                    f"{self.path(key)}/manifest.json must have the last values of {HISTORY}, it "
                    "has others"
                )

    def remove(self, key: str) -> None:
        """Delete a node, so that it is trained again."""
        self._nodes.remove(key)

    @contextlib.contextmanager
    def _advice(self) -> Iterator[None]:
        """Append what to do to the message of a DamagedError."""
        try:
            yield
        except DamagedError as error:
            raise DamagedError(f"{error}. {TRAIN_AGAIN}") from error

    def begun(self) -> set[str]:
        """Keys of the runs that have a work folder."""
        selector = pafs.FileSelector(f"{self._root}/work", allow_not_found=True)
        return {info.base_name for info in self._fs.get_file_info(selector)}

    def work_folder(self, key: str, keep: int = KEEP) -> WorkFolder:
        """The folder of an unfinished run, with its newest `keep` checkpoints."""
        return WorkFolder(self._fs, f"{self._root}/work/{key}", keep)

    def has_continuations(self) -> bool:
        """Whether there is any folder of `continuation`."""
        selector = pafs.FileSelector(f"{self._root}/{CONTINUATIONS}", allow_not_found=True)
        return bool(self._fs.get_file_info(selector))

    def continuation(self, key: str) -> WorkFolder:
        """The folder with the last checkpoint of the longest of runs that differ only in budget."""
        return WorkFolder(self._fs, f"{self._root}/{CONTINUATIONS}/{key}", keep=1)


def _as_text(metrics: Mapping[str, float]) -> dict[str, str]:
    return {name: repr(value) for name, value in metrics.items()}


def damage_in_words(damage: Mapping[str, DamagedError]) -> str:
    """A message with the labels of damaged runs, their errors, and what to do."""
    lines = [f"  {label}: {error}" for label, error in list(damage.items())[:SHOWN]]
    if len(damage) > SHOWN:
        lines.append(f"  ... and {len(damage) - SHOWN} more")
    what = "1 finished run is" if len(damage) == 1 else f"{len(damage)} finished runs are"
    return "\n".join((f"{what} damaged; {TRAIN_AGAIN}:", *lines))


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
    ) -> Iterator[Draft]:
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
            draft = Draft(folder, self._parts)
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
    ) -> Iterator[Saved | None]:
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

    def _fetch(self, name: str, folder: Path) -> Saved:
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
        return Saved(folder / "checkpoint", parts, _environment(manifest))

    def environment(self) -> Fingerprint | None:
        """Fingerprint of the environment of the newest sound checkpoint; None: it is not known."""
        for name in reversed(self._checkpoints.names()):
            with contextlib.suppress(DamagedError):
                return _environment(self._checkpoints.manifest(name))
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


def _environment(manifest: Manifest) -> Fingerprint | None:
    found = manifest.meta.get("environment")
    return {k: str(v) for k, v in found.items()} if isinstance(found, dict) else None


class Saved(NamedTuple):
    """A verified copy of a checkpoint on the local disk."""

    folder: Path
    parts: Mapping[str, Path]
    """Folder of each part, by its name."""
    environment: Fingerprint | None = None


class Draft:
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
