"""The node store: finished runs by the hash of their settings, and checkpoints of unfinished runs.

All sweeps in a storage folder or bucket share one store::

    nodes/<key>/      a finished run: handoff/, history.jsonl, run.json, manifest.json last
    work/<key>/<n>/   checkpoints of an unfinished run, each with its manifest
    work/<key>/parts/ data that checkpoints share, such as old trajectories
    work/<key>/lease.json   the process that computes the run, and until when its lease is valid
    continuations/<key>/<n>/   the end of a finished run, for a run with a larger budget
    verified.json     on a disk: fingerprints of the files of verified runs

The store, not Tune's snapshot, decides which runs are finished.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from music_rllib.envs.fingerprint import Fingerprint
from music_rllib.errors import indented
from music_rllib.store.files import write_atomically
from music_rllib.store.history import HISTORY, Report, RunResult, from_json_lines, last_values
from music_rllib.store.sealed import MANIFEST, Manifest, SealedFolders
from music_rllib.store.storage import DamagedError, open_storage
from music_rllib.store.work_folder import KEEP, WorkFolder, environment_of

K = TypeVar("K")
V = TypeVar("V")
FEW = 64
"""Number of nodes up to which a request for each is cheaper than a list of all files."""
SETTLED_SECONDS = 2.0
"""A file that is newer may be written again without a change of its time stamp."""
CONTINUATIONS, VERIFIED = "continuations", "verified.json"
TRAIN_AGAIN = "to retrain damaged runs, give 'run' or 'resume' --retrain-damaged"


class NodeStore(SealedFolders):
    """The finished nodes of the storage `uri` (see `open_storage`), and its work folders.

    Methods raise DamagedError if a node does not exist or differs from its manifest, and
    StorageError if the storage cannot be reached or written.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self._root = open_storage(uri)
        super().__init__(self._root / "nodes")

    is_finished = SealedFolders.exists

    def finished(self, keys: Iterable[str]) -> set[str]:
        """The published nodes among `keys`."""
        present = set(keys).intersection(self.folder.folders())
        if self._root.is_local or len(present) <= FEW:
            return set(self.folder.having(MANIFEST, present))
        sizes = self._sizes()
        return {key for key in present if f"{self.path(key)}/{MANIFEST}" in sizes}

    def result(self, key: str) -> RunResult | None:
        """The result of a finished run; None for an imported handoff."""
        return self._result(self.manifest(key))

    def _result(self, manifest: Manifest) -> RunResult | None:
        result = manifest.meta.get("result")
        try:
            return None if result is None else RunResult.model_validate(result)
        except ValueError as error:
            place = f"{self.path(manifest.name)}/{MANIFEST}"
            raise DamagedError(f"{place} must hold a run's result: {error}") from error

    def history(self, key: str) -> list[Report]:
        try:
            return from_json_lines(self.read(key, HISTORY))
        except ValueError as error:
            raise DamagedError(f"{self.path(key)}/{HISTORY} must hold reports: {error}") from error

    def environment(self, key: str) -> Fingerprint | None:
        """Fingerprint of the environment that a finished run used; None if it is not recorded."""
        return environment_of(self.manifest(key))

    def described(self, key: str) -> tuple[Fingerprint | None, str]:
        """The environment of a finished run, and a hash of its history."""
        manifest = self.manifest(key)
        return environment_of(manifest), manifest.files[HISTORY].sha256[:16]

    def lines(self, key: str) -> tuple[bytes, dict[str, str], Fingerprint | None]:
        """The `HISTORY` of a finished run, and its code and environment as passed to `publish`."""
        manifest = self.manifest(key)
        lines = self.read(key, HISTORY, manifest)
        return lines, _provenance(manifest), environment_of(manifest)

    def provenance(self, key: str) -> dict[str, str]:
        """Tags that name the code of a finished run, as passed to `publish`."""
        return _provenance(self.manifest(key))

    def publish(
        self,
        key: str,
        folder: Path,
        result: RunResult | None = None,
        environment: Fingerprint | None = None,
        provenance: Mapping[str, str] | None = None,
    ) -> None:
        """Copy the files of `folder` to the node `key`, unless it exists already.

        `provenance` are tags that name the code that computed it.
        """
        if self.is_finished(key):
            return
        meta: dict[str, Any] = {"result": None if result is None else result.model_dump()}
        if environment is not None:
            meta["environment"] = dict(environment)
        if provenance is not None:
            meta["provenance"] = dict(provenance)
        with self.sealing(key, meta) as staging:
            # The modes of a temporary folder, which only its owner may read, are not copied.
            for file in filter(Path.is_file, folder.rglob("*")):
                target = staging / file.relative_to(folder)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, target)

    @contextlib.contextmanager
    def files(self, key: str) -> Iterator[Path]:
        """Yield a finished node's folder, verified; of a bucket, a temporary copy."""
        if self._root.is_local:
            # A storage that was copied from a bucket has a prefix.
            yield Path(self.path(key), self.check(key).prefix)
            return
        with TemporaryDirectory(prefix="music-rllib-node-") as copy:
            self.fetch(key, Path(copy))
            yield Path(copy)

    def lasting_files(self, key: str) -> Path:
        """As `files`, until the program ends."""
        stack = contextlib.ExitStack()
        atexit.register(stack.close)
        return stack.enter_context(self.files(key))

    def verify(self, key: str) -> None:
        """Check that a finished node matches its manifest, as `damage` does."""
        try:
            self._check(key, None)
        except DamagedError as error:
            raise DamagedError(f"{error}; {TRAIN_AGAIN}") from error

    def is_sound(self, key: str) -> bool:
        """Whether the node has been published and matches its manifest."""
        return self.is_finished(key) and not self.damage([key])

    def damage(self, keys: Iterable[str]) -> dict[str, DamagedError]:
        """The finished nodes among `keys` that differ from their manifests, with the errors.

        On a disk, a node that was verified earlier and whose files have the same inodes, sizes and
        times is not read again.
        """
        keys, before = list(keys), dict(self._verified)
        sizes = None if self._root.is_local or len(keys) <= FEW else self._sizes()
        errors = zip(keys, self.map(partial(self._damage_of, sizes=sizes), keys), strict=True)
        damaged = {key: error for key, error in errors if error is not None}
        if self._verified != before:
            with contextlib.suppress(OSError):  # without the file, nodes are verified again
                data = json.dumps(self._verified, indent=0).encode()
                write_atomically(Path(self._root.path, VERIFIED), data, sync=False)
        return damaged

    def map(self, read: Callable[[K], V], keys: Iterable[K]) -> Iterator[V]:
        """Apply `read` to each key, in order; requests to a bucket run in parallel."""
        return self._root.map(read, keys)

    @cached_property
    def _verified(self) -> dict[str, str]:
        """Fingerprint of the files of each verified node."""
        with contextlib.suppress(OSError, ValueError, TypeError):
            content = json.loads(self._root.read(VERIFIED) or b"") if self._root.is_local else {}
            return {key: str(value) for key, value in dict(content).items()}
        return {}

    def _sizes(self) -> dict[str, int]:
        """Size of every file of all nodes, by its path."""
        entries = self.folder.entries(recursive=True)
        return {entry.path.removeprefix("/"): entry.size for entry in entries}

    def _damage_of(self, key: str, sizes: Mapping[str, int] | None) -> DamagedError | None:
        try:
            fingerprint = self._fingerprint(key) if self._root.is_local else None
            if fingerprint is None or self._verified.get(key) != fingerprint:
                self._check(key, sizes)
                if fingerprint is not None:
                    self._verified[key] = fingerprint
        except DamagedError as error:
            return error
        except OSError as error:
            place = error.filename or self.path(key)
            return DamagedError(f"{place} must be readable: {error.strerror}")
        return None

    def _fingerprint(self, key: str) -> str | None:
        """A hash of the files' inodes, sizes and times; None if a file is new or missing."""
        digest, newest = hashlib.sha256(), 0
        for path in map(Path, self.paths(key)):
            try:
                status = path.stat()
            except FileNotFoundError:
                return None  # `_check` names the file
            digest.update(
                f"{path.name} {status.st_dev} {status.st_ino} {status.st_size} "
                f"{status.st_mtime_ns} {status.st_ctime_ns}\n".encode()
            )
            newest = max(newest, status.st_mtime_ns, status.st_ctime_ns)
        return None if time.time() - newest / 1e9 < SETTLED_SECONDS else digest.hexdigest()[:20]

    def _check(self, key: str, sizes: Mapping[str, int] | None) -> None:
        manifest = self.check(key, sizes)
        result = self._result(manifest)
        # The manifest has no hash of its own, but the history has the values of its result too.
        if self._root.is_local and result is not None and HISTORY in manifest.files:
            last = last_values(self.history(key))
            # As text, because NaN equals nothing.
            if _as_text(result.metrics) != _as_text(last):
                raise DamagedError(
                    f"{self.path(key)}/{MANIFEST} must have the last values of {HISTORY}, it has "
                    "others"
                )

    def begun(self) -> set[str]:
        return set((self._root / "work").folders())

    def work_folder(self, key: str, keep: int = KEEP) -> WorkFolder:
        """The folder of an unfinished run, with its newest `keep` checkpoints."""
        return WorkFolder(self._root / "work" / key, keep)

    def existing(self) -> dict[str, set[str]]:
        """Names of all folders in `nodes`, `work` and `continuations`, by three listings."""
        places = ("nodes", "work", CONTINUATIONS)
        return {name: set((self._root / name).folders()) for name in places}

    def continuation(self, key: str) -> WorkFolder:
        """The folder with the last checkpoint of the longest of runs that differ only in budget."""
        return WorkFolder(self._root / CONTINUATIONS / key, keep=1)


def _as_text(metrics: Mapping[str, float]) -> dict[str, str]:
    return {name: repr(value) for name, value in metrics.items()}


def damage_in_words(damage: Mapping[str, DamagedError]) -> str:
    """A message with the labels of damaged runs, their errors, and the remedy."""
    lines = indented([f"{label}: {error}" for label, error in damage.items()])
    what = "1 finished run is" if len(damage) == 1 else f"{len(damage)} finished runs are"
    return "\n".join((f"{what} damaged; {TRAIN_AGAIN}:", *lines))


def _provenance(manifest: Manifest) -> dict[str, str]:
    known = manifest.meta.get("provenance")
    return {k: str(value) for k, value in known.items()} if isinstance(known, dict) else {}
