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
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, TypeVar

import pyarrow.fs as pafs

from music_rllib.envs.fingerprint import Fingerprint
from music_rllib.store.history import HISTORY, Report, RunResult, from_json_lines, last_values
from music_rllib.store.object_folder import DamagedError, ObjectFolders, open_storage
from music_rllib.store.verified import Verified, fingerprint_of
from music_rllib.store.work_folder import KEEP, WorkFolder, environment_of

K = TypeVar("K")
V = TypeVar("V")
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
        return environment_of(self._nodes.manifest(key))

    def lines(self, key: str) -> tuple[bytes, dict[str, str], Fingerprint | None]:
        """The `HISTORY` of a finished run, and its code and environment as `publish` got them."""
        manifest = self._nodes.manifest(key)
        known = manifest.meta.get("provenance")
        provenance = known.items() if isinstance(known, dict) else ()
        lines = self._nodes.read(key, HISTORY, manifest)
        return lines, {k: str(value) for k, value in provenance}, environment_of(manifest)

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
