"""Sealed folders: written completely or not at all, and verifiable, on disks and object stores.

A sealed folder has a `manifest.json` with the size and SHA-256 of each of its files. The manifest
appears last: on a disk the whole folder is written under another name, flushed and renamed. An
object store cannot rename, so each attempt uploads its files under a prefix of its own, and the
manifest, which names the prefix, at the end. A folder without a manifest does not exist.
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
from collections.abc import Callable, Container, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal
from urllib.parse import quote

import pyarrow.fs as pafs
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, ValidationError

from music_rllib.errors import BadInputError
from music_rllib.limits import MOST_JSON_BYTES, open_regular, read_json
from music_rllib.store.files import sync_folder, write_atomically

MANIFEST = "manifest.json"
_CHUNK = 1 << 20
_CANNOT_WRITE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO}


class StorageError(BadInputError, RuntimeError):
    """Storage that cannot be used; the message names the place and what to do."""


class DamagedError(StorageError):
    """Content that differs from its manifest."""


@contextlib.contextmanager
def must_be_writable(path: str, codes: Container[int | None] | None = None) -> Iterator[None]:
    """Raise StorageError for an OSError of this `with`; if `codes` are given, only for these."""
    try:
        yield
    except OSError as error:
        if codes is not None and error.errno not in codes:
            raise
        raise StorageError(
            f"{error.filename or path} must be writable: {error.strerror or error}"
        ) from error


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


def encoded(uri: str) -> str:
    """A storage for pyarrow, which decodes a bucket's keys; ours are as they are in the bucket."""
    if "://" not in uri or uri.startswith("file://"):
        return uri
    bucket, _, key = uri.partition("://")[2].partition("?")[0].partition("/")
    return uri.replace(f"{bucket}/{key}", f"{bucket}/{quote(key)}", 1)


def open_storage(uri: str) -> tuple[pafs.FileSystem, str]:
    """Open a folder or bucket.

    Args:
        uri: A path (`~` is expanded, a relative path starts at the working directory) or a URI
            that pyarrow knows: `s3://bucket/path`, `gs://bucket/path`, `file:///path`.

    Returns:
        The file system, and the root within it, without a trailing slash.

    Raises:
        StorageError: The URI is not valid, or the place cannot be reached.
    """
    try:
        if "://" not in uri:
            uri = str(Path(uri).expanduser().absolute())
        filesystem, root = pafs.FileSystem.from_uri(encoded(uri))
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: nobody's home
        raise StorageError(
            f"storage must be a folder or an s3:// or gs:// URI that can be reached, "
            f"got {uri!r}: {error}"
        ) from error
    return filesystem, root.rstrip("/")


class ObjectFolders:
    """The sealed folders below `root`, which may not exist yet.

    Reading raises DamagedError if a folder does not exist or differs from its manifest.
    """

    def __init__(self, filesystem: pafs.FileSystem, root: str) -> None:
        self._fs = filesystem
        self._root = root
        self._local = isinstance(filesystem, pafs.LocalFileSystem)

    def path(self, name: str) -> str:
        """Path of the folder `name`, whether it exists or not."""
        return f"{self._root}/{name}"

    def names(self) -> list[str]:
        """Sorted names of the sealed folders."""
        selector = pafs.FileSelector(self._root, allow_not_found=True)
        folders = [info.base_name for info in self._fs.get_file_info(selector) if not info.is_file]
        return sorted(self.existing(name for name in folders if not name.startswith(".")))

    def exists(self, name: str) -> bool:
        """Whether the folder has been sealed; it may have been damaged since."""
        return name in self.existing([name])

    def existing(self, names: Iterable[str]) -> set[str]:
        """The sealed folders among `names`, from one request for all of them."""
        names = list(names)
        infos = self._fs.get_file_info([f"{self.path(name)}/{MANIFEST}" for name in names])
        return {name for name, info in zip(names, infos, strict=True) if info.is_file}

    def manifest(self, name: str) -> Manifest:
        """The manifest of a folder."""
        path = f"{self.path(name)}/{MANIFEST}"
        try:
            with self._open(path) as stream:
                manifest = Manifest.model_validate(read_json(stream.read(MOST_JSON_BYTES + 1)))
        except FileNotFoundError as error:
            raise DamagedError(f"{path} must exist, it does not") from error
        except ValueError as error:
            reason: object = error
            if isinstance(error, ValidationError):
                reason = error.errors(include_url=False)[0]["msg"]
            raise DamagedError(f"{path} must be a manifest: {reason}") from error
        if manifest.name != name:
            raise DamagedError(f"{path} must be the manifest of {name}, got {manifest.name!r}")
        return manifest

    @contextlib.contextmanager
    def sealing(self, name: str, meta: dict[str, Any]) -> Iterator[Path]:
        """Yield a local folder to fill, and seal it at the end of the `with`.

        Nothing is left after an exception. If another process has sealed `name` meanwhile, its
        folder stays and this one is dropped: equal names mean equal content.

        Raises:
            StorageError: The place cannot be written.
        """
        attempt, path = uuid.uuid4().hex, self.path(name)
        with contextlib.ExitStack() as cleaning:
            with must_be_writable(path):
                if self._local:
                    folder = Path(self._root, f".{name}.{attempt}")
                    folder.mkdir(parents=True)
                    cleaning.callback(shutil.rmtree, folder, ignore_errors=True)
                else:
                    folder = Path(cleaning.enter_context(tempfile.TemporaryDirectory()))
            # The caller writes to the same disk, and its errors often name no path.
            with must_be_writable(path, _CANNOT_WRITE):
                yield folder
            with must_be_writable(path):
                if self._local:
                    self._rename(name, folder, meta)
                else:
                    self._upload(name, folder, f"{attempt}/", meta)

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
            # A folder without a manifest, left by something that copies folders.
            shutil.rmtree(target)
            folder.rename(target)
        sync_folder(target.parent)

    def _upload(self, name: str, folder: Path, prefix: str, meta: dict[str, Any]) -> None:
        records = {}
        for file in _files_below(folder):
            records[file] = _record(folder / file)
            target = f"{self.path(name)}/{prefix}{file}"
            # Object stores ignore it, but other remote file systems need it.
            self._fs.create_dir(str(PurePosixPath(target).parent), recursive=True)
            with (folder / file).open("rb") as source, self._fs.open_output_stream(target) as sink:
                shutil.copyfileobj(source, sink, _CHUNK)
        if self.exists(name):
            self._fs.delete_dir(f"{self.path(name)}/{prefix}")
            return
        manifest = Manifest(name=name, prefix=prefix, files=records, meta=meta)
        with self._fs.open_output_stream(f"{self.path(name)}/{MANIFEST}") as sink:
            sink.write(manifest.model_dump_json(indent=1).encode())

    def read(self, name: str, file: str, manifest: Manifest | None = None) -> bytes:
        """The verified content of one small file; the folder's `manifest` is read if not given."""
        manifest = manifest or self.manifest(name)
        if file not in manifest.files:
            raise DamagedError(f"{self.path(name)} must have {file}, it hasn't")
        content = io.BytesIO()
        self._copy(self._source(name, manifest, file), manifest.files[file], content.write)
        return content.getvalue()

    def check(self, name: str) -> None:
        """Compare the size of every file with the manifest, and on a disk its hash too.

        An object store keeps hashes of its own; there, files are hashed when they are read.
        """
        manifest = self.manifest(name)
        for file, expected in manifest.files.items():
            source = self._source(name, manifest, file)
            if self._local:
                self._copy(source, expected, write=len)
                continue
            info = self._fs.get_file_info(source)
            if info.type == pafs.FileType.NotFound:
                raise DamagedError(f"{source} must exist, its manifest lists it")
            _check_size(source, expected, info.size)

    def files(self, name: str) -> list[str]:
        """Paths of the manifest and of the folder's files."""
        manifest = self.manifest(name)
        own = [self._source(name, manifest, file) for file in sorted(manifest.files)]
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
                self._copy(self._source(name, manifest, file), manifest.files[file], sink.write)
        return manifest

    def _copy(self, source: str, expected: FileRecord, write: Callable[[bytes], object]) -> None:
        """Pass a file to `write` in chunks, and at most one byte more than the manifest says."""
        size, digest = 0, hashlib.sha256()
        try:
            with self._open(source, expected.bytes) as stream:
                while chunk := stream.read(min(_CHUNK, expected.bytes + 1 - size)):
                    write(chunk)
                    digest.update(chunk)
                    size += len(chunk)
        except FileNotFoundError as error:
            raise DamagedError(f"{source} must exist, its manifest lists it") from error
        _check_size(source, expected, size)
        if digest.hexdigest() != expected.sha256:
            raise DamagedError(
                f"{source} must have the hash in its manifest, its content has changed"
            )

    def _open(self, path: str, size: int | None = None) -> contextlib.AbstractContextManager[Any]:
        """Open a file for reading; on a disk it must be a regular file of `size` bytes."""
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
        """Delete a folder, its manifest first, so that a half-deleted folder does not count."""
        with contextlib.suppress(FileNotFoundError):
            self._fs.delete_file(f"{self.path(name)}/{MANIFEST}")
        with contextlib.suppress(FileNotFoundError):
            self._fs.delete_dir(self.path(name))

    def tidy(self, name: str | None = None) -> None:
        """Delete what killed attempts at sealing `name` (or any folder) have left on a disk.

        The caller must know that no other process is sealing it.
        """
        if self._local:
            pattern = ".*" if name is None else f".{name}"
            for folder in Path(self._root).glob(f"{pattern}.{'[0-9a-f]' * 32}"):
                shutil.rmtree(folder, ignore_errors=True)

    def remove_all(self) -> None:
        """Delete the root with everything in it, including folders that were never sealed."""
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


def _check_size(path: str, expected: FileRecord, size: int) -> None:
    if size != expected.bytes:
        raise DamagedError(f"{path} must have {expected.bytes} bytes, it has {size}")
