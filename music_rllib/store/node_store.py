"""The node store: finished runs by the hash of what determines them, and the state of others.

Below one storage folder or bucket, shared by all sweeps in it::

    nodes/<key>/      a finished run: handoff/, history.jsonl, run.json, manifest.json last
    work/<key>/<n>/   checkpoints of a run that isn't finished, each with its manifest
    work/<key>/parts/ what checkpoints share, such as old trajectories
    work/<key>/lease.json   who is computing the run, and until when that holds
    continuations/<key>/<n>/   where a finished run ended, for one with a larger budget
    verified.json     on a disk: finished runs that have been read through

The store, not Tune's snapshot, says what is finished.
"""

from __future__ import annotations

import contextlib
import shutil
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import pyarrow.fs as pafs

from music_rllib.store.lease import LeaseFile
from music_rllib.store.object_folder import DamagedError, Manifest, ObjectFolders, open_storage
from music_rllib.store.run_record import (
    HISTORY,
    Report,
    RunResult,
    from_json_lines,
    last_values,
)
from music_rllib.store.verified import Verified, fingerprint

FORMAT = "music_rllib checkpoint 2"
KEEP = 2
"""Checkpoints of a run that are kept, unless a sweep says else."""
LEASE = "lease.json"
SHOWN = 10
"""Damaged runs that are named."""
CONTINUATIONS = "continuations"
VERIFIED = "verified.json"
TRAIN_AGAIN = "'run' and 'resume' train what is damaged again with --retrain-damaged"


class NodeStore:
    """Finished nodes and the checkpoints of unfinished ones."""

    def __init__(self, uri: str) -> None:
        """Open `uri`, a folder or bucket as for `sealed.open_storage`.

        Raises:
            StorageError: It can't be resolved or reached.
        """
        self.uri = uri
        self._fs, self._root = open_storage(uri)
        self._nodes = ObjectFolders(self._fs, f"{self._root}/nodes")
        self._local = isinstance(self._fs, pafs.LocalFileSystem)
        self._verified = Verified(Path(self._root, VERIFIED))

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
            # Without the modes of a temporary folder, which only its owner may read.
            for file in filter(Path.is_file, folder.rglob("*")):
                target = staging / file.relative_to(folder)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, target)

    def tidy(self, key: str) -> None:
        """Delete what killed attempts at publishing `key` have left: for its lease's holder."""
        self._nodes.tidy(key)

    def fetch(self, key: str, folder: Path) -> None:
        """Copy a finished node's files into `folder`, verified.

        Raises:
            DamagedError: The node isn't what its manifest says.
        """
        self._nodes.fetch(key, folder)

    def verify(self, key: str) -> None:
        """Compare a finished node with its manifest, so that nothing depends on a damaged one.

        Raises:
            DamagedError: The node isn't what its manifest says; the message says what to do.
        """
        with self._saying_what_to_do(key):
            self._nodes.check(key)

    def is_sound(self, key: str) -> bool:
        """Whether the node has been published and is what its manifest says."""
        return self.is_finished(key) and not self.damage([key])

    def damage(self, keys: Iterable[str]) -> dict[str, DamagedError]:
        """Which of these finished nodes aren't what their manifests say, and why.

        On a disk a node that was sound before, and whose files have the same places, sizes and
        times, isn't read again.
        """
        found = {}
        for key in keys:
            try:
                mark = self._fingerprint(key)
                if not self._verified.has(key, mark):
                    self._check(key)
                    self._verified.add(key, mark)
            except DamagedError as error:
                found[key] = error
            except OSError as error:
                place = error.filename or self.path(key)
                found[key] = DamagedError(f"{place} must be readable: {error.strerror}")
        self._verified.keep()
        return found

    def _fingerprint(self, key: str) -> str | None:
        if not self._local:
            return None
        try:
            return fingerprint(map(Path, self._nodes.files(key)))
        except FileNotFoundError:
            return None  # to be named

    def _check(self, key: str) -> None:
        self._nodes.check(key)
        manifest = self._nodes.manifest(key)
        result = manifest.meta.get("result")
        # The manifest has no hash of its own; what it says of the result is in the history too.
        if self._local and result is not None and HISTORY in manifest.files:
            last = last_values(self.history(key))
            if not _same(RunResult.model_validate(result).metrics, last):
                raise DamagedError(
                    f"{self.path(key)}/manifest.json must have the last values of {HISTORY}, it "
                    "has others"
                )

    def remove(self, key: str) -> None:
        """Delete a node, for it to be trained again."""
        self._nodes.remove(key)

    @contextlib.contextmanager
    def _saying_what_to_do(self, key: str) -> Iterator[None]:
        try:
            yield
        except DamagedError as error:
            raise DamagedError(f"{error}. {TRAIN_AGAIN}") from error

    def begun(self) -> set[str]:
        """Keys of runs that have a work folder."""
        selector = pafs.FileSelector(f"{self._root}/work", allow_not_found=True)
        return {info.base_name for info in self._fs.get_file_info(selector)}

    def work_folder(self, key: str, keep: int = KEEP) -> WorkFolder:
        """Where a run that isn't finished keeps its newest `keep` checkpoints."""
        return WorkFolder(self._fs, f"{self._root}/work/{key}", keep)

    def has_continuations(self) -> bool:
        """Whether any run has left its end to a longer one."""
        selector = pafs.FileSelector(f"{self._root}/{CONTINUATIONS}", allow_not_found=True)
        return bool(self._fs.get_file_info(selector))

    def continuation(self, key: str) -> WorkFolder:
        """Where runs that differ in their budget alone leave the last checkpoint of the longest."""
        return WorkFolder(self._fs, f"{self._root}/{CONTINUATIONS}/{key}", keep=1)


def _same(one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Also where both have a NaN, which equals nothing."""
    return {name: repr(value) for name, value in one.items()} == {
        name: repr(value) for name, value in other.items()
    }


def damage_in_words(damage: Mapping[str, DamagedError]) -> str:
    """Labels of runs, and what is wrong with each; with what to do."""
    lines = [f"  {label}: {error}" for label, error in list(damage.items())[:SHOWN]]
    if len(damage) > SHOWN:
        lines.append(f"  ... and {len(damage) - SHOWN} more")
    what = "1 finished run is" if len(damage) == 1 else f"{len(damage)} finished runs are"
    return "\n".join((f"{what} damaged; {TRAIN_AGAIN}:", *lines))


class WorkFolder:
    """Checkpoints of one run, numbered by environment steps.

    Content that doesn't change any more (old trajectories) is in *parts* of their own, below
    ``parts/``: a checkpoint names those that it needs, and a later one needs them too.
    """

    def __init__(self, filesystem: pafs.FileSystem, root: str, keep: int = KEEP) -> None:
        """Look at `root`; keep the newest `keep` checkpoints, and the parts that they need."""
        self.root = root
        self.lease = LeaseFile(filesystem, f"{root}/{LEASE}")
        self._checkpoints = ObjectFolders(filesystem, root)
        self._parts = ObjectFolders(filesystem, f"{root}/parts")
        self._keep = keep
        self._fs = filesystem
        self._local = isinstance(filesystem, pafs.LocalFileSystem)

    @contextlib.contextmanager
    def new_checkpoint(self, env_steps: int) -> Iterator[Draft]:
        """Give a draft to fill; it becomes the newest checkpoint when the `with` ends.

        Raises:
            StorageError: The storage can't be written; older checkpoints are intact.
        """
        # Two attempts may reach the same step, the second one because the first is damaged.
        name = f"{env_steps:012d}-{uuid.uuid4().hex[:8]}"
        meta: dict[str, Any] = {"format": FORMAT}
        with self._checkpoints.sealing(name, meta) as folder:
            draft = Draft(folder, self._parts)
            yield draft
            meta["parts"] = draft.needs
        self._prune()

    def _prune(self) -> None:
        names = self._checkpoints.names()
        for name in names[: -self._keep]:
            self._checkpoints.remove(name)
        needed: set[str] = set()
        for name in names[-self._keep :]:
            # One whose manifest is damaged can't be used, whatever it needs.
            with contextlib.suppress(DamagedError):
                needed.update(_needs(self._checkpoints.manifest(name)))
        for name in set(self._parts.names()) - needed:
            self._parts.remove(name)

    @contextlib.contextmanager
    def newest(
        self, warn: Callable[[str], None] = warnings.warn, most: int | None = None
    ) -> Iterator[Saved | None]:
        """A verified local copy of the newest sound checkpoint, or None, for this `with`.

        Args:
            warn: Is told about each damaged checkpoint that is skipped.
            most: Only those of at most so many environment steps.
        """
        for name in reversed(self._checkpoints.names()):
            if most is not None and steps_of(name) > most:
                continue
            with TemporaryDirectory() as above:
                try:
                    saved = self._fetch(name, Path(above))
                except DamagedError as error:
                    warn(f"a damaged checkpoint is skipped: {error}")
                    continue
                yield saved
                return
        yield None

    def _fetch(self, name: str, above: Path) -> Saved:
        manifest = self._checkpoints.fetch(name, above / "checkpoint")
        if manifest.meta.get("format") != FORMAT:
            raise DamagedError(
                f"{self._checkpoints.path(name)} must be a {FORMAT!r}, "
                f"got {manifest.meta.get('format')!r}"
            )
        parts = {}
        for part in _needs(manifest):
            parts[part] = above / "parts" / part
            self._parts.fetch(part, parts[part])
        return Saved(above / "checkpoint", parts)

    def history(self) -> list[Report]:
        """Reports up to the newest checkpoint whose history is sound; none where there is none."""
        for name in reversed(self._checkpoints.names()):
            with contextlib.suppress(DamagedError, ValueError):
                return from_json_lines(self._checkpoints.read(name, HISTORY))
        return []

    def tidy(self) -> None:
        """Delete what killed attempts have left. Only for who holds the lease."""
        self._checkpoints.tidy()
        self._parts.tidy()

    def names(self) -> list[str]:
        """The checkpoints there are, oldest first."""
        return self._checkpoints.names()

    def read(self, name: str) -> str | None:
        """A small text file in the folder; None where it isn't there."""
        try:
            with self._fs.open_input_stream(f"{self.root}/{name}") as stream:
                return bytes(stream.read()).decode(errors="replace")
        except FileNotFoundError:
            return None

    def remove_file(self, name: str) -> None:
        """Delete such a file, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._fs.delete_file(f"{self.root}/{name}")

    def remove_if_empty(self) -> None:
        """Delete the folder, where it is on a disk and has nothing in it."""
        if self._local:
            with contextlib.suppress(OSError):
                Path(self.root).rmdir()

    def clear(self) -> None:
        """Delete all checkpoints: the run is finished."""
        self._parts.remove_all()
        self._checkpoints.remove_all()


def steps_of(checkpoint: str) -> int:
    """Environment steps of a checkpoint, by its name."""
    return int(checkpoint.split("-")[0])


def _needs(manifest: Manifest) -> list[str]:
    parts = manifest.meta.get("parts", [])
    return [str(part) for part in parts] if isinstance(parts, list) else []


class Saved(NamedTuple):
    """A checkpoint, on the local disk and verified."""

    folder: Path
    parts: Mapping[str, Path]
    """Name to folder of what it shares with other checkpoints."""


class Draft:
    """A checkpoint that is being written."""

    def __init__(self, folder: Path, parts: ObjectFolders) -> None:
        """Let `folder` be filled, and parts be added to `parts`."""
        self.folder = folder
        self.needs: list[str] = []
        """Names of the parts that belong to it: new ones and those of earlier checkpoints."""
        self._parts = parts

    @contextlib.contextmanager
    def new_part(self, label: str) -> Iterator[tuple[str, Path]]:
        """Give the name of a new part, and a folder to fill with it.

        Raises:
            StorageError: The storage can't be written.
        """
        # Never the name of one that is there: that one may be damaged.
        name = f"{label}-{uuid.uuid4().hex[:8]}"
        with self._parts.sealing(name, {}) as folder:
            yield name, folder
        self.needs.append(name)
