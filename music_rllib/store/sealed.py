"""Sealed folders: written completely or not at all, and verifiable, on disks and in buckets.

A sealed folder has a `manifest.json` with the size and SHA-256 of each of its files. The manifest
is written last. On a disk, the whole folder is written under another name, flushed and renamed. A
bucket cannot rename, so each attempt uploads its files under a prefix of its own, and at the end
the manifest, which names the prefix. A folder without a manifest does not exist.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import os
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, BinaryIO, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue

from music_rllib.errors import reason_of
from music_rllib.limits import MOST_JSON_BYTES, open_regular, read_json
from music_rllib.store.files import sync_folder, write_atomically
from music_rllib.store.storage import DamagedError, StorageFolder, must_be_writable

MANIFEST = "manifest.json"
_CHUNK = 1 << 20
_CANNOT_WRITE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO}
_MOST_NAME = 255
"""Bytes of a file's name that any file system takes."""


def _inside(name: str) -> str:
    path = PurePosixPath(name)
    strange = "\\" in name or not name.isprintable() or len(name.encode()) > _MOST_NAME
    if path.is_absolute() or ".." in path.parts or not path.parts or strange:
        raise ValueError(f"must be a path inside the folder, got {name[:_MOST_NAME]!r}")
    return name


class FileRecord(BaseModel):
    """Size and hash of a file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bytes: Annotated[int, Field(ge=0)]
    sha256: str


class Manifest(BaseModel):
    """Content of a sealed folder's `manifest.json`."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")

    format: Literal["music_rllib sealed folder 1"] = "music_rllib sealed folder 1"
    name: str
    prefix: Annotated[str, Field(pattern=r"^([0-9a-f]{32}/)?$")] = ""
    """Path of the files below the folder: empty, or the name of an upload attempt."""
    files: dict[Annotated[str, AfterValidator(_inside)], FileRecord]
    meta: dict[str, JsonValue]
    """Data of the folder's owner."""


class SealedFolders:
    """The sealed folders in `folder`, which may not exist yet.

    Reading raises DamagedError if a sealed folder does not exist or differs from its manifest.
    """

    def __init__(self, folder: StorageFolder) -> None:
        self.folder = folder
        self._kept: dict[str, bytes] = {}
        """Checked manifests in a bucket, which do not change."""

    def path(self, name: str) -> str:
        """Path of the sealed folder `name`, whether it exists or not."""
        return f"{self.folder.path}/{name}"

    def names(self) -> list[str]:
        folders = [name for name in self.folder.folders() if not name.startswith(".")]
        return sorted(self.folder.having(MANIFEST, folders))

    def exists(self, name: str) -> bool:
        """Whether the folder has been sealed; it may have been damaged since."""
        return bool(self.folder.having(MANIFEST, [name]))

    def manifest(self, name: str, *, keep: bool = False) -> Manifest:
        path = f"{self.path(name)}/{MANIFEST}"
        try:
            data = self._kept.get(name) or self._start_of(path)
            manifest = Manifest.model_validate(read_json(data))
            if keep:
                self._kept[name] = data
        except FileNotFoundError as error:
            raise DamagedError(f"{path} must exist, it does not") from error
        except ValueError as error:
            raise DamagedError(f"{path} must be a manifest: {reason_of(error)}") from error
        if manifest.name != name:
            raise DamagedError(f"{path} must be the manifest of {name}, got {manifest.name!r}")
        return manifest

    def _start_of(self, path: str) -> bytes:
        """Content of a file, or one byte more than JSON may have."""

        def read() -> bytes:
            with self._open(path) as stream:
                return bytes(stream.read(MOST_JSON_BYTES + 1))

        return self.folder.request(read)

    @contextlib.contextmanager
    def sealing(self, name: str, meta: dict[str, Any]) -> Iterator[Path]:
        """Yield a local folder to fill, and seal it at the end of the `with`.

        Nothing is left after an exception. If another process has sealed `name` in the meantime,
        its folder stays and this one is dropped: equal names mean equal content.

        Raises:
            StorageError: The place cannot be written.
        """
        attempt, path = uuid.uuid4().hex, self.path(name)
        with contextlib.ExitStack() as cleaning:
            with must_be_writable(path):
                if self.folder.is_local:
                    draft = Path(self.folder.path, f".{name}.{attempt}")
                    draft.mkdir(parents=True)
                    cleaning.callback(shutil.rmtree, draft, ignore_errors=True)
                else:
                    draft = Path(cleaning.enter_context(tempfile.TemporaryDirectory()))
            # The caller writes to the same disk, and its errors often name no path.
            with must_be_writable(path, _CANNOT_WRITE):
                yield draft
            with must_be_writable(path):
                if self.folder.is_local:
                    self._rename(name, draft, meta)
                else:
                    self._upload(name, draft, f"{attempt}/", meta)

    def _rename(self, name: str, draft: Path, meta: dict[str, Any]) -> None:
        records = {file: _record(draft / file, sync=True) for file in _files_below(draft)}
        for inner in [path for path in draft.rglob("*") if path.is_dir()]:
            sync_folder(inner)
        manifest = Manifest(name=name, files=records, meta=meta)
        write_atomically(draft / MANIFEST, manifest.model_dump_json(indent=1).encode())
        target = Path(self.path(name))
        try:
            draft.rename(target)
        except OSError:
            if self.exists(name):
                return
            if not target.exists():
                raise
            # A folder without a manifest, left by a program that copies folders.
            shutil.rmtree(target)
            draft.rename(target)
        sync_folder(target.parent)

    def _upload(self, name: str, draft: Path, prefix: str, meta: dict[str, Any]) -> None:
        records = {}
        for file in _files_below(draft):
            records[file] = _record(draft / file)
            with (draft / file).open("rb") as source:

                def copy(sink: Any, source: BinaryIO = source) -> None:
                    source.seek(0)
                    shutil.copyfileobj(source, sink, _CHUNK)

                self.folder.upload(f"{self.path(name)}/{prefix}{file}", copy)
        if self.exists(name):
            self.folder.delete(f"{name}/{prefix}")
            return
        manifest = Manifest(name=name, prefix=prefix, files=records, meta=meta)
        self.folder.write(f"{name}/{MANIFEST}", manifest.model_dump_json(indent=1).encode())

    def read(self, name: str, file: str, manifest: Manifest | None = None) -> bytes:
        """The verified content of one small file; reads the folder's `manifest` if not given."""
        manifest = manifest or self.manifest(name)
        if file not in manifest.files:
            raise DamagedError(f"{self.path(name)} must have {file}, it does not")
        content = io.BytesIO()
        self._copy(self._source(manifest, file), manifest.files[file], content.write)
        return content.getvalue()

    def check(self, name: str, sizes: Mapping[str, int] | None = None) -> Manifest:
        """Compare the size of every file with the manifest, and on a disk its hash too.

        A bucket has hashes of its own; files from it are hashed when they are read. With the
        `sizes` of all files there, by path, only the manifest is read.
        """
        self._kept.pop(name, None)
        manifest = self.manifest(name, keep=not self.folder.is_local)
        for file, expected in manifest.files.items():
            source = self._source(manifest, file)
            if self.folder.is_local:
                self._copy(source, expected, write=len)
                continue
            size = self.folder.info(source).size if sizes is None else sizes.get(source)
            if size is None:
                raise DamagedError(f"{source} must exist, its manifest lists it")
            _check_size(source, expected, size)
        return manifest

    def paths(self, name: str) -> list[str]:
        manifest = self.manifest(name)
        own = [self._source(manifest, file) for file in sorted(manifest.files)]
        return [f"{self.path(name)}/{MANIFEST}", *own]

    def fetch(
        self, name: str, folder: Path, wanted: Callable[[str], bool] = lambda file: True
    ) -> Manifest:
        """Copy the files whose names are `wanted` into `folder`, verified."""
        manifest = self.manifest(name)
        for file in filter(wanted, manifest.files):
            target = folder / file
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("wb") as sink:
                self._copy(self._source(manifest, file), manifest.files[file], sink.write)
        return manifest

    def _copy(self, source: str, expected: FileRecord, write: Callable[[bytes], object]) -> None:
        """Pass a file to `write` in chunks, and at most one byte more than the manifest says."""
        size, digest = 0, hashlib.sha256()

        def read_on() -> None:
            nonlocal size
            with self._open(source, expected.bytes) as stream:
                stream.read(size)  # read by an attempt that failed
                while chunk := stream.read(min(_CHUNK, expected.bytes + 1 - size)):
                    write(chunk)
                    digest.update(chunk)
                    size += len(chunk)

        try:
            self.folder.request(read_on)
        except FileNotFoundError as error:
            raise DamagedError(f"{source} must exist, its manifest lists it") from error
        _check_size(source, expected, size)
        if digest.hexdigest() != expected.sha256:
            raise DamagedError(
                f"{source} must have the hash in its manifest, its content has changed"
            )

    def _open(self, path: str, size: int | None = None) -> contextlib.AbstractContextManager[Any]:
        """Open a file for reading; on a disk it must be a regular file of `size` bytes."""
        if not self.folder.is_local:
            return self.folder.filesystem.open_input_stream(path)  # type: ignore[no-any-return]
        try:
            file = open_regular(path)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise DamagedError(f"{path} must be readable: {error.strerror}") from error
        found = os.fstat(file.fileno()).st_size
        if size is not None and found != size:
            file.close()
            raise DamagedError(f"{path} must have {size} bytes, it has {found}")
        return file

    def _source(self, manifest: Manifest, file: str) -> str:
        return f"{self.path(manifest.name)}/{manifest.prefix}{file}"

    def remove(self, name: str) -> None:
        """Delete a folder, its manifest first, so that a half-deleted folder does not count."""
        self._kept.pop(name, None)
        self.folder.remove(f"{name}/{MANIFEST}")
        (self.folder / name).delete()

    def tidy(self, name: str | None = None) -> None:
        """Delete the remains of killed attempts to seal `name`, or any folder, on a disk.

        The caller must know that no other process is sealing it.
        """
        if self.folder.is_local:
            pattern = ".*" if name is None else f".{name}"
            for draft in Path(self.folder.path).glob(f"{pattern}.{'[0-9a-f]' * 32}"):
                shutil.rmtree(draft, ignore_errors=True)


def _files_below(folder: Path) -> list[str]:
    return sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    )


def _record(path: Path, *, sync: bool = False) -> FileRecord:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        if sync:
            os.fsync(file.fileno())
    return FileRecord(bytes=path.stat().st_size, sha256=digest)


def _check_size(path: str, expected: FileRecord, size: int) -> None:
    if size != expected.bytes:
        raise DamagedError(f"{path} must have {expected.bytes} bytes, it has {size}")
