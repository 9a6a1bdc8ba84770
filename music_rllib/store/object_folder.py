"""Folders that are either complete and verifiable or not there, on disks and in object stores.

A sealed folder has a ``manifest.json`` with the size and SHA-256 of each of its files. The
manifest appears last: on a disk the whole folder is written under another name, flushed and
renamed; an object store can't rename, so the files of each attempt have a prefix of their own and
the manifest, which names it, is uploaded at the end. A folder without a manifest doesn't exist.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Annotated, Any, Literal

import pyarrow.fs as pafs
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, ValidationError

from music_rllib.errors import BadInputError
from music_rllib.limits import MOST_JSON_BYTES, open_regular, read_json
from music_rllib.store.files import sync_folder, write_atomically

MANIFEST = "manifest.json"
_CHUNK = 1 << 20
_CANNOT_WRITE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO}


class StorageError(BadInputError, RuntimeError):
    """Storage that can't be used; the message names the place and what to do."""


class DamagedError(StorageError):
    """Content that isn't what its manifest says."""


def _inside(name: str) -> str:
    path = PurePosixPath(name)
    strange = "\\" in name or not name.isprintable()
    if path.is_absolute() or ".." in path.parts or not path.parts or strange:
        raise ValueError(f"must be a path inside the folder, got {name!r}")
    return name


FileName = Annotated[str, AfterValidator(_inside)]


class FileRecord(BaseModel):
    """Size and hash of one file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bytes: Annotated[int, Field(ge=0)]
    sha256: str


class Manifest(BaseModel):
    """Content of a sealed folder's ``manifest.json``."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")

    format: Literal["music_rllib sealed folder 1"] = "music_rllib sealed folder 1"
    name: str
    prefix: Annotated[str, Field(pattern=r"^([0-9a-f]{32}/)?$")] = ""
    """Where the files lie below the folder: nowhere else, or below their attempt's name."""
    files: dict[FileName, FileRecord]
    meta: dict[str, JsonValue]
    """What the owner of the folder says about it."""


def open_storage(uri: str) -> tuple[pafs.FileSystem, str]:
    """Resolve a folder or bucket.

    Args:
        uri: A path (`~` is expanded, a relative one starts at the working directory) or a URI
            that pyarrow knows: `s3://bucket/path`, `gs://bucket/path`, `file:///path`.

    Returns:
        The file system, and the root within it, without a trailing slash.

    Raises:
        StorageError: The URI has no meaning, or the place can't be reached.
    """
    if "://" not in uri:
        uri = str(Path(uri).expanduser().absolute())
    try:
        filesystem, root = pafs.FileSystem.from_uri(uri)
    except (OSError, ValueError) as error:
        raise StorageError(
            f"storage must be a folder or an s3:// or gs:// URI that can be reached, "
            f"got {uri!r}: {error}"
        ) from error
    return filesystem, root.rstrip("/")


class ObjectFolders:
    """The sealed folders below one place."""

    def __init__(self, filesystem: pafs.FileSystem, root: str) -> None:
        """Look at `root`, which need not exist yet."""
        self._fs = filesystem
        self._root = root
        self._local = isinstance(filesystem, pafs.LocalFileSystem)

    def path(self, name: str) -> str:
        """Where `name` is or would be, for messages."""
        return f"{self._root}/{name}"

    def names(self) -> list[str]:
        """The sealed folders there are, sorted."""
        selector = pafs.FileSelector(self._root, allow_not_found=True)
        folders = [info.base_name for info in self._fs.get_file_info(selector) if not info.is_file]
        return sorted(name for name in folders if not name.startswith(".") and self.exists(name))

    def exists(self, name: str) -> bool:
        """Whether `name` is there, complete. Says nothing about damage since."""
        return bool(self._fs.get_file_info(f"{self.path(name)}/{MANIFEST}").is_file)

    def manifest(self, name: str) -> Manifest:
        """The manifest of a folder that exists.

        Raises:
            DamagedError: It can't be read.
        """
        path = f"{self.path(name)}/{MANIFEST}"
        try:
            with self._open(path) as stream:
                manifest = Manifest.model_validate(read_json(stream.read(MOST_JSON_BYTES + 1)))
        except FileNotFoundError as error:
            raise DamagedError(f"{path} must exist, it does not") from error
        except ValidationError as error:
            reason = error.errors(include_url=False)[0]["msg"]
            raise DamagedError(f"{path} must be a manifest: {reason}") from error
        except ValueError as error:
            raise DamagedError(f"{path} must be a manifest: {error}") from error
        if manifest.name != name:
            raise DamagedError(f"{path} must be the manifest of {name}, got {manifest.name!r}")
        return manifest

    @contextlib.contextmanager
    def sealing(self, name: str, meta: dict[str, Any]) -> Iterator[Path]:
        """Give a local folder to fill, and seal what is in it at the end of the `with`.

        Nothing remains of it after an exception. If `name` has been sealed by somebody else in
        the meantime, theirs stays and this one is dropped: equal names mean equal content.

        Raises:
            StorageError: The place can't be written; names the path.
        """
        attempt = uuid.uuid4().hex
        with contextlib.ExitStack() as cleaning:
            try:
                if self._local:
                    folder = Path(self._root, f".{name}.{attempt}")
                    folder.mkdir(parents=True)
                    cleaning.callback(shutil.rmtree, folder, ignore_errors=True)
                else:
                    folder = Path(cleaning.enter_context(tempfile.TemporaryDirectory()))
            except OSError as error:
                raise _unwritable(self.path(name), error) from error
            try:
                yield folder
            except OSError as error:
                # What the caller writes goes into the same disk; its error often names no path.
                if error.errno in _CANNOT_WRITE:
                    raise _unwritable(self.path(name), error) from error
                raise
            try:
                if self._local:
                    self._rename(name, folder, meta)
                else:
                    self._upload(name, folder, f"{attempt}/", meta)
            except OSError as error:
                raise _unwritable(self.path(name), error) from error

    def _rename(self, name: str, folder: Path, meta: dict[str, Any]) -> None:
        records = {file: _record(folder / file, sync=True) for file in _files_below(folder)}
        for inner in [path for path in folder.rglob("*") if path.is_dir()]:
            sync_folder(inner)
        manifest = Manifest(name=name, files=records, meta=meta)
        write_atomically(folder / MANIFEST, manifest.model_dump_json(indent=1).encode())
        target = Path(self.path(name))
        try:
            folder.rename(target)
        except OSError:
            if self.exists(name):
                return
            if not target.exists():
                raise
            # Left there without a manifest by something that copies folders: not a node.
            shutil.rmtree(target)
            folder.rename(target)
        sync_folder(target.parent)

    def _upload(self, name: str, folder: Path, prefix: str, meta: dict[str, Any]) -> None:
        records = {}
        for file in _files_below(folder):
            records[file] = _record(folder / file)
            target = f"{self.path(name)}/{prefix}{file}"
            # A no-op for object stores; other remote file systems want it.
            self._fs.create_dir(str(PurePosixPath(target).parent), recursive=True)
            with (folder / file).open("rb") as source, self._fs.open_output_stream(target) as sink:
                shutil.copyfileobj(source, sink, _CHUNK)
        if self.exists(name):
            self._fs.delete_dir(f"{self.path(name)}/{prefix}")
            return
        manifest = Manifest(name=name, prefix=prefix, files=records, meta=meta)
        with self._fs.open_output_stream(f"{self.path(name)}/{MANIFEST}") as sink:
            sink.write(manifest.model_dump_json(indent=1).encode())

    def read(self, name: str, file: str) -> bytes:
        """The content of one small file, verified.

        Raises:
            DamagedError: It isn't there or isn't what the manifest says.
        """
        manifest = self.manifest(name)
        if file not in manifest.files:
            raise DamagedError(f"{self.path(name)} must have {file}, it hasn't")
        source = self._source(name, manifest, file)
        try:
            with self._open(source) as stream:
                data: bytes = stream.read(manifest.files[file].bytes + 1)
        except FileNotFoundError as error:
            raise DamagedError(f"{source} must exist, its manifest lists it") from error
        _check(source, manifest.files[file], len(data), hashlib.sha256(data).hexdigest())
        return data

    def check(self, name: str) -> None:
        """Compare every file with the manifest: its size, and on a disk its hash.

        An object store keeps hashes of its own; there, files are hashed where they are read.

        Raises:
            DamagedError: One is missing, can't be read or isn't what the manifest says.
        """
        manifest = self.manifest(name)
        for file, expected in manifest.files.items():
            source = self._source(name, manifest, file)
            info = self._fs.get_file_info(source)
            if info.type == pafs.FileType.NotFound:
                raise DamagedError(f"{source} must exist, its manifest lists it")
            digest = expected.sha256
            if self._local:
                with self._open(source, expected.bytes) as stream:
                    digest = hashlib.file_digest(stream, "sha256").hexdigest()
            _check(source, expected, info.size, digest)

    def files(self, name: str) -> list[str]:
        """Where its files are, its manifest first.

        Raises:
            DamagedError: It can't be read.
        """
        manifest = self.manifest(name)
        own = [self._source(name, manifest, file) for file in sorted(manifest.files)]
        return [f"{self.path(name)}/{MANIFEST}", *own]

    def fetch(
        self, name: str, folder: Path, wanted: Callable[[str], bool] = lambda file: True
    ) -> Manifest:
        """Copy the files that are `wanted` by their names into `folder`, and verify them.

        Of none more is copied than the manifest says that it has.

        Raises:
            DamagedError: One is missing or isn't what the manifest says.
        """
        manifest = self.manifest(name)
        for file, expected in manifest.files.items():
            if not wanted(file):
                continue
            source, target = self._source(name, manifest, file), folder / file
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                with self._open(source, expected.bytes) as stream, target.open("wb") as sink:
                    size, digest = _copy(stream, sink, expected.bytes)
            except FileNotFoundError as error:
                raise DamagedError(f"{source} must exist, its manifest lists it") from error
            _check(source, expected, size, digest)
        return manifest

    def _open(self, path: str, size: int | None = None) -> contextlib.AbstractContextManager[Any]:
        """A file for reading; on a disk only a regular one, and only of `size` bytes.

        Raises:
            DamagedError: It is something else.
        """
        if not self._local:
            return self._fs.open_input_stream(path)  # type: ignore[no-any-return]
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

    def _source(self, name: str, manifest: Manifest, file: str) -> str:
        return f"{self.path(name)}/{manifest.prefix}{file}"

    def remove(self, name: str) -> None:
        """Delete a folder, its manifest first, so that a half deleted one doesn't exist."""
        with contextlib.suppress(FileNotFoundError):
            self._fs.delete_file(f"{self.path(name)}/{MANIFEST}")
        with contextlib.suppress(FileNotFoundError):
            self._fs.delete_dir(self.path(name))

    def tidy(self, name: str | None = None) -> None:
        """Delete what killed attempts have left on a disk, at sealing `name` or anything here.

        Only for who knows that nobody else is sealing that.
        """
        if self._local:
            pattern = ".*" if name is None else f".{name}"
            for folder in Path(self._root).glob(f"{pattern}.{'[0-9a-f]' * 32}"):
                shutil.rmtree(folder, ignore_errors=True)

    def remove_all(self) -> None:
        """Delete all there is below the root, also what was never sealed."""
        for name in self.names():
            self.remove(name)
        with contextlib.suppress(FileNotFoundError):
            self._fs.delete_dir(self._root)


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


def _copy(source: IO[bytes], target: IO[bytes], most: int) -> tuple[int, str]:
    """Size and hash of what was copied: `most` bytes, and one more where there are more."""
    size, digest = 0, hashlib.sha256()
    while chunk := source.read(min(_CHUNK, most + 1 - size)):
        target.write(chunk)
        digest.update(chunk)
        size += len(chunk)
    return size, digest.hexdigest()


def _check(path: str, expected: FileRecord, size: int, digest: str) -> None:
    if size != expected.bytes:
        raise DamagedError(f"{path} must have {expected.bytes} bytes, it has {size}")
    if digest != expected.sha256:
        raise DamagedError(f"{path} must have the hash in its manifest, its content has changed")


def _unwritable(path: str, error: OSError) -> StorageError:
    return StorageError(f"{error.filename or path} must be writable: {error.strerror or error}")
