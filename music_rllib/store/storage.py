"""A storage, which is a folder on a disk or a bucket: its address, its small files, its checks."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import subprocess
import sys
import tempfile
import unicodedata
from collections.abc import Callable, Container, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote, unquote

import pyarrow.fs as pafs

from music_rllib.errors import BadInputError
from music_rllib.redaction import redact
from music_rllib.store.files import write_atomically
from music_rllib.store.patience import patiently

K = TypeVar("K")
V = TypeVar("V")
REQUESTS = 16
"""Largest number of simultaneous requests to a bucket."""
ANSWER_SECONDS = 15.0
"""Timeout for a bucket to answer; its client would retry for minutes."""
SHOWN = 250
"""Number of characters of a path that a message shows."""
BUCKETS = ("s3://", "gs://", "gcs://", "abfs://", "abfss://")
_ASK_FOR_BUCKET = """
import sys
from music_rllib.store.storage import StorageError, open_storage
try:
    storage = open_storage(sys.stdin.read())
    bucket = storage.filesystem.get_file_info(storage.path.partition("/")[0])
except (StorageError, OSError) as error:
    sys.exit(str(error.__cause__ or error))
if bucket.type.name == "NotFound":
    sys.exit("the bucket does not exist")
"""


class StorageError(BadInputError, RuntimeError):
    """A storage cannot be used; the message names the place and the remedy."""


class DamagedError(StorageError):
    """Content differs from its manifest."""


@contextlib.contextmanager
def must_be_writable(path: str, codes: Container[int | None] | None = None) -> Iterator[None]:
    """Turn an OSError of this `with` into a StorageError; if `codes` are given, only these."""
    try:
        yield
    except OSError as error:
        if codes is not None and error.errno not in codes:
            raise
        raise StorageError(
            f"{error.filename or path} must be writable: {error.strerror or error}"
        ) from error


@dataclass(frozen=True)
class StorageFolder:
    """A folder on a disk or a prefix in a bucket; it need not exist."""

    filesystem: pafs.FileSystem
    path: str

    @property
    def is_local(self) -> bool:
        return isinstance(self.filesystem, pafs.LocalFileSystem)

    def __truediv__(self, name: str) -> StorageFolder:
        return StorageFolder(self.filesystem, f"{self.path}/{name}")

    def read(self, name: str) -> bytes | None:
        """Content of a small file; None if it does not exist."""

        def read() -> bytes:
            with self.filesystem.open_input_stream(f"{self.path}/{name}") as stream:
                return bytes(stream.read())

        try:
            return self.request(read)
        except FileNotFoundError:
            return None

    def read_text(self, name: str) -> str | None:
        """Content of a small text file; None if it does not exist."""
        data = self.read(name)
        return None if data is None else data.decode(errors="replace")

    def write(self, name: str, data: bytes) -> None:
        """Write a small file atomically, and create its folder if necessary.

        Raises:
            StorageError: The file cannot be written.
        """
        path = f"{self.path}/{name}"
        with must_be_writable(path):
            if self.is_local:
                Path(path).parent.mkdir(parents=True, exist_ok=True)
                write_atomically(Path(path), data)
                return
            self.upload(path, lambda sink: sink.write(data))

    def upload(self, path: str, write: Callable[[Any], object]) -> None:
        """Write an object of a bucket; `write` gets the stream, again if an attempt fails."""

        def attempt() -> None:
            with self.filesystem.open_output_stream(path) as sink:
                write(sink)

        patiently(attempt)

    def request(self, call: Callable[[], V]) -> V:
        """The result of a call of the file system, which is repeated if it asks a bucket."""
        return call() if self.is_local else patiently(call)

    def remove(self, name: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            self.request(lambda: self.filesystem.delete_file(f"{self.path}/{name}"))

    def delete(self, name: str = "") -> None:
        """Delete this folder, or the one called `name` in it, with its content if it exists."""
        with contextlib.suppress(FileNotFoundError):
            self.request(lambda: self.filesystem.delete_dir(f"{self.path}/{name}".rstrip("/")))

    def folders(self) -> list[str]:
        return [name for info in self.entries() if not info.is_file for name in _name(info)]

    def files(self) -> list[str]:
        return [name for info in self.entries() if info.is_file for name in _name(info)]

    def entries(self, *, recursive: bool = False) -> list[pafs.FileInfo]:
        """What is in this folder; `recursive`: and below it."""
        selector = pafs.FileSelector(self.path, allow_not_found=True, recursive=recursive)
        return self.request(lambda: self.filesystem.get_file_info(selector))

    def info(self, path: str) -> pafs.FileInfo:
        return self.request(lambda: self.filesystem.get_file_info(path))

    def having(self, file: str, folders: Iterable[str]) -> list[str]:
        """The folders among `folders` that contain `file`."""
        folders = list(folders)
        infos = self.map(self.info, [f"{self.path}/{name}/{file}" for name in folders])
        return [name for name, info in zip(folders, infos, strict=True) if info.is_file]

    def map(self, read: Callable[[K], V], keys: Iterable[K]) -> Iterator[V]:
        """Apply `read` to each key, in order; requests to a bucket run in parallel."""
        if self.is_local:
            yield from map(read, keys)
            return
        with ThreadPoolExecutor(REQUESTS) as pool:
            yield from pool.map(read, keys)


def _name(info: pafs.FileInfo) -> Iterator[str]:
    """The name of an entry; none if it is not UTF-8, which no name of this package is."""
    with contextlib.suppress(UnicodeDecodeError):
        yield info.base_name


def open_storage(uri: str) -> StorageFolder:
    """Open a folder or a bucket.

    Args:
        uri: A path (`~` is expanded, a relative path starts at the working directory) or a URI
            that pyarrow knows: `s3://bucket/path`, `gs://bucket/path`, `file:///path`.

    Raises:
        StorageError: The URI is not valid, or the place cannot be reached.
    """
    _check_uri(uri)
    try:
        if "://" not in uri:
            uri = str(Path(uri).expanduser().absolute())
        filesystem, root = pafs.FileSystem.from_uri(encoded(uri))
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: the home of no user
        raise StorageError(
            f"storage must be a folder or an s3:// or gs:// URI that can be reached, "
            f"got {uri!r}: {error}"
        ) from error
    return StorageFolder(filesystem, root.rstrip("/"))


def encoded(uri: str) -> str:
    """A storage for pyarrow, which decodes percent signs; our URIs have a bucket's keys as is."""
    if "://" not in uri or uri.startswith("file://"):
        return uri
    bucket, _, key = uri.partition("://")[2].partition("?")[0].partition("/")
    return uri.replace(f"{bucket}/{key}", f"{bucket}/{quote(key)}", 1)


# Addresses ----------------------------------------------------------------------------------------


def resolve_storage(storage: str) -> tuple[str, str | None]:
    """Make a folder absolute, so that it is the same for every worker; a URI stays as it is.

    Returns:
        The storage, and a notice for the user if it is not relative to the working directory.

    Raises:
        StorageError: The storage begins with the home folder of an unknown user, is a URI without
            a bucket, or not `file:///FOLDER`.
    """
    _check_uri(storage)
    if "://" in storage:
        return storage, None
    try:
        path = Path(storage).expanduser()
    except RuntimeError as error:
        rule = f"storage must be in an existing home folder, got {storage!r}"
        raise StorageError(rule) from error
    in_ray_job = "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ
    if path.is_absolute() or not in_ray_job:
        return str(path.absolute()), None
    resolved = Path.home() / path
    return str(resolved), (
        f"storage {storage!r} is relative and a Ray job's working directory is temporary: "
        f"using {resolved}. Give an absolute path or a bucket to choose another place."
    )


def _check_uri(storage: str) -> None:
    """Reject a URI without a bucket, with one slash, or not of the form `file:///FOLDER`."""
    if storage.startswith("file:") and not re.fullmatch(r"file:///[^?#]+", storage):
        raise StorageError(f"storage must be a folder, or file:///FOLDER, got {storage!r}")
    if re.match(r"(s3|gs|gcs|abfss?):(?!//)|(s3|gs|gcs|abfss?)://([^/?]*@)?([/?]|$)", storage):
        raise StorageError(f"storage must name a bucket as in s3://BUCKET, got {redact(storage)!r}")


def is_remote(storage: str) -> bool:
    """Whether a storage is a bucket, which does not contain the sweep's folder on this machine."""
    return "://" in storage and not storage.startswith("file://")


def below(storage: str, path: str) -> str:
    """The address of a path in a storage, whose URI may end with options: `s3://b?region=x`."""
    above, mark, options = storage.partition("?") if "://" in storage else (storage, "", "")
    return f"{above.rstrip('/')}/{path}{mark}{options}"


def storage_and_name(uri: str) -> tuple[str, str]:
    """Split the URI of a sweep into its storage and its name: the inverse of `below`."""
    path, mark, options = uri.partition("?")
    above, _, name = path.rstrip("/").rpartition("/")
    return f"{above}{mark}{options}", name


def sweep_folder(storage: str, name: str) -> Path:
    """Local folder of a sweep's own files: in the storage, or in the home folder for a bucket."""
    if is_remote(storage):
        above, mark, options = storage.partition("?")  # with or without a slash at the end
        place = f"{above.rstrip('/')}{mark}{options}"
        bucket = hashlib.sha256(place.encode()).hexdigest()[:12]
        return Path.home() / ".music_rllib" / bucket / name
    return Path(unquote(storage.removeprefix("file://")) if "://" in storage else storage) / name


def folder_at(place: str) -> Path | None:
    """The folder at `place`; None if it does not exist or cannot be reached.

    The name of the folder is the name of the sweep, so a link to the folder and `..` are resolved.
    A link further up stays: other machines may only know the folder by this path.
    """
    try:
        folder = Path(place).expanduser().absolute()
        if folder.is_symlink() or ".." in folder.parts:
            folder = folder.resolve()
        return folder if folder.is_dir() else None
    except (OSError, RuntimeError):  # the name is too long, links form a loop, the home is unknown
        return None


def expanded(path: str) -> str:
    """A path or URI with the values of its environment variables, `$NAME` or `${NAME}`.

    Raises:
        ValueError: A variable is not set, or is empty.
    """

    def value(match: re.Match[str]) -> str:
        name = match[1] or match[2]
        if not (found := os.environ.get(name)):
            raise ValueError(
                f"must name environment variables that are set, got {match[0]} in {redact(path)!r}"
            )
        return found

    return re.sub(r"\$(?:(\w+)|\{(\w+)\})", value, path)


def sqlite_url(file: Path | str) -> str:
    """SQLAlchemy's URL of an SQLite file, whatever characters its path has."""
    if not {"?", "%"} & set(str(file)):
        return f"sqlite:///{file}"
    from sqlalchemy.engine import URL

    # With its driver: MLflow creates the parent folder of `sqlite:///...` from the quoted path.
    return URL.create("sqlite+pysqlite", database=str(file)).render_as_string()


def database_url(url: str) -> str:
    """A database's URL with the driver that is installed, and with an absolute path for SQLite.

    SQLAlchemy 2.0 takes `postgresql://` for psycopg2, and 2.1 for psycopg 3. A relative path would
    mean a different file in every working directory.
    """
    scheme, _, path = url.partition("://")
    if scheme == "postgresql":
        return f"postgresql+psycopg2://{path}"
    file, mark, options = path.removeprefix("/").partition("?")
    if scheme != "sqlite" or not path.startswith("/") or not file or file.startswith(("/", ":")):
        return url
    return f"{sqlite_url(Path(unquote(file)).absolute())}{mark}{options}"


# Checks -------------------------------------------------------------------------------------------


def check_storage(storage: str, name: str) -> None:
    """Check that a sweep can write to a resolved storage, without leaving a file in it.

    Raises:
        StorageError: The storage cannot be written.
    """
    if any(unicodedata.category(character) in {"Cc", "Cs"} for character in storage):
        raise StorageError(
            f"storage must be UTF-8 text without control characters, got {storage!a}"
        )
    check_answers(storage)
    for entry in (name,) if is_remote(storage) else (name, "nodes", "work"):
        folder = sweep_folder(storage, entry)
        _check_folder(Path(os.path.normpath(folder)))  # a new folder has no ".." yet


def check_answers(storage: str) -> None:
    """Check that a bucket exists, in a child process because its client cannot be interrupted.

    Raises:
        StorageError: The bucket does not exist, refuses, or does not answer in time.
    """
    if not storage.startswith(BUCKETS):
        return
    try:
        done = subprocess.run(  # noqa: S603 - this Python, and the URI on its standard input
            [sys.executable, "-c", _ASK_FOR_BUCKET],
            input=storage,
            capture_output=True,
            text=True,
            timeout=ANSWER_SECONDS,
            check=False,
        )
        reason = done.stderr.strip().rpartition("\n")[2] if done.returncode else ""
    except subprocess.TimeoutExpired:
        reason = f"no answer within {ANSWER_SECONDS:g} s"
    if reason:
        raise StorageError(
            f"storage must be a bucket that answers, got {redact(storage)!r}: {redact(reason)}. "
            "Check its name, the credentials in the environment, and the network"
        )


def _check_folder(folder: Path) -> None:
    """Check that a folder can be written, or that it can be created."""
    nearest = folder
    try:
        while not _is_there(nearest):
            nearest = nearest.parent
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise StorageError(
            f"{str(nearest)[:SHOWN]} must be a writable folder, for {str(folder)[:SHOWN]}: "
            f"{error.strerror}"
        ) from error


def _is_there(path: Path) -> bool:
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True
