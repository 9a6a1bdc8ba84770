"""Folders of a storage, and checks of whether a storage can be used."""

from __future__ import annotations

import hashlib
import os
import re
import stat
import subprocess
import sys
import tempfile
import unicodedata
from pathlib import Path
from urllib.parse import unquote

from music_rllib.redaction import redact
from music_rllib.store.object_folder import StorageError

ANSWER_SECONDS = 15.0
"""Timeout for a bucket to answer; its client would retry for minutes."""
NAME_BYTES = 255
"""Longest name of a file or folder on Linux."""
_KINDS = {
    stat.S_IFREG: "file",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
    stat.S_IFIFO: "pipe",
    stat.S_IFSOCK: "socket",
}
BUCKETS = ("s3://", "gs://", "gcs://", "abfs://", "abfss://")
_ASK_FOR_BUCKET = """
import sys
from music_rllib.store.object_folder import StorageError, open_storage
try:
    filesystem, root = open_storage(sys.stdin.read())
    bucket = filesystem.get_file_info(root.partition("/")[0])
except (StorageError, OSError) as error:
    sys.exit(str(error.__cause__ or error))
if bucket.type.name == "NotFound":
    sys.exit("there is no such bucket")
"""


def resolve_storage(storage: str) -> tuple[str, str | None]:
    """Make a folder absolute, so that it is the same for every worker; a URI stays as it is.

    Returns:
        The storage, and a notice for the user if it is not relative to the working directory.

    Raises:
        StorageError: The storage begins with the home folder of an unknown user, is a URI without
            a bucket, or no `file:///FOLDER`.
    """
    if storage.startswith("file:") and not re.fullmatch(r"file:///[^?#]+", storage):
        raise StorageError(f"storage must be a folder, or file:///FOLDER, got {storage!r}")
    if "://" in storage:
        host = re.split("[/?]", storage.partition("://")[2])[0]
        if storage.startswith(BUCKETS) and not host.rpartition("@")[2]:
            raise StorageError(f"storage must name a bucket, got {redact(storage)!r}")
        return storage, None
    try:
        path = Path(storage).expanduser()
    except RuntimeError as error:
        raise StorageError(f"storage must be in a home that is known, got {storage!r}") from error
    in_ray_job = "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ
    if path.is_absolute() or not in_ray_job:
        return str(path.absolute()), None
    resolved = Path.home() / path
    return str(resolved), (
        f"storage {storage!r} is relative and a Ray job's working directory is temporary: "
        f"using {resolved}. Give an absolute path or a bucket to choose another place."
    )


def below(storage: str, path: str) -> str:
    """The place of a path in a storage, whose URI may end with options: `s3://bucket?region=x`."""
    above, mark, options = storage.partition("?") if "://" in storage else (storage, "", "")
    return f"{above.rstrip('/')}/{path}{mark}{options}"


def storage_and_name(uri: str) -> tuple[str, str]:
    """The two of a sweep's URI, which `below` puts together."""
    path, mark, options = uri.partition("?")
    above, _, name = path.rstrip("/").rpartition("/")
    return f"{above}{mark}{options}", name


def sqlite_url(file: Path | str) -> str:
    """SQLAlchemy's URL of an sqlite file, whatever characters its path has."""
    if not {"?", "%"} & set(str(file)):
        return f"sqlite:///{file}"
    from sqlalchemy.engine import URL

    # With its driver: MLflow makes the parent folder of `sqlite:///...` from the quoted path.
    return URL.create("sqlite+pysqlite", database=str(file)).render_as_string()


def database_url(url: str) -> str:
    """A database's URL with the driver that is installed, and with an absolute path of sqlite.

    SQLAlchemy 2.0 takes `postgresql://` for psycopg2, and 2.1 for psycopg 3. A relative path would
    mean another file in every working directory.
    """
    scheme, _, path = url.partition("://")
    if scheme == "postgresql":
        return f"postgresql+psycopg2://{path}"
    file, mark, options = path.removeprefix("/").partition("?")
    if scheme != "sqlite" or not path.startswith("/") or not file or file.startswith(("/", ":")):
        return url
    return f"{sqlite_url(Path(unquote(file)).absolute())}{mark}{options}"


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


def sweep_folder(storage: str, name: str) -> Path:
    """Local folder of a sweep's own files: in the storage, or in the home folder for a bucket."""
    if storage.startswith("file://"):
        return Path(unquote(storage.removeprefix("file://"))) / name
    if "://" not in storage:
        return Path(storage) / name
    bucket = hashlib.sha256(storage.encode()).hexdigest()[:12]
    return Path.home() / ".music_rllib" / bucket / name


def folder_at(place: str) -> Path | None:
    """The folder that `place` names; None where there is none, or none can be reached.

    A sweep is known by its folder's name, which a link to it and `..` don't tell. A link further up
    stays: other machines may know the folder by that path alone.
    """
    try:
        folder = Path(place).expanduser().absolute()
        if folder.is_symlink() or ".." in folder.parts:
            folder = folder.resolve()
        return folder if folder.is_dir() else None
    except (OSError, RuntimeError):  # too long a name, a loop of links, nobody's home
        return None


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
    is_remote = "://" in storage.removeprefix("file://")
    for entry in (name,) if is_remote else (name, "nodes", "work"):
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
        reason = f"there was no answer within {ANSWER_SECONDS:g} s"
    if reason:
        raise StorageError(
            f"storage must be a bucket that answers, got {redact(storage)!r}: {redact(reason)}. "
            "Look at its name, the credentials in the environment, and the network"
        )


def _check_folder(folder: Path) -> None:
    """Check that a folder can be written, or that it can be created."""
    named = str(folder) if len(str(folder)) <= 300 else f"{str(folder)[:300]}..."
    for part in folder.parts:
        if (length := len(os.fsencode(part))) > NAME_BYTES:
            raise StorageError(
                f"storage must have names of at most {NAME_BYTES} bytes in its path, got one of "
                f"{length}: {part[:40]}..."
            )
    try:
        existing = _nearest(folder)
    except OSError as error:
        rule = "must be a folder that can be made and written"
        raise StorageError(f"{named} {rule}: {error.strerror}") from error
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise StorageError(f"{existing} must be writable, for {named}: {error.strerror}") from error


def _nearest(folder: Path) -> Path:
    """The folder itself, or the nearest folder above it that exists.

    Raises:
        StorageError: Something other than a folder is in its place.
        OSError: The status of a path cannot be read.
    """
    for path in (folder, *folder.parents):
        try:
            mode = path.stat().st_mode
        except FileNotFoundError:
            if not path.is_symlink():
                continue
            raise StorageError(
                f"{folder} must be a folder or free, {path} is a link to nothing: {path.readlink()}"
            ) from None
        except NotADirectoryError:
            continue
        if not stat.S_ISDIR(mode):
            kind = _KINDS.get(stat.S_IFMT(mode), "special file")
            raise StorageError(f"{folder} must be a folder or free, {path} is a {kind}")
        return path
    raise AssertionError("the root is a folder")
