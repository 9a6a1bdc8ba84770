"""Where a sweep keeps things."""

from __future__ import annotations

import hashlib
import os
import stat
import subprocess
import sys
import tempfile
import unicodedata
from pathlib import Path

from music_rllib.redaction import redact
from music_rllib.store.object_folder import StorageError

ANSWER_SECONDS = 15.0
"""For a bucket to say whether it is there; its client would go on trying for minutes."""
NAME_BYTES = 255
"""Of a file or folder, on Linux."""
BUCKETS = ("s3://", "gs://", "gcs://", "abfs://", "abfss://")
_ASK = """
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


def in_ray_job() -> bool:
    """Whether this is the driver of a submitted Ray job, in a working directory that will go."""
    return "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ


def resolve_storage(storage: str) -> tuple[str, str | None]:
    """Make a folder absolute, so that it is the same for every worker; leave a URI as it is.

    Returns:
        The storage, and what to tell the user if it isn't where a shell would look for it.

    Raises:
        StorageError: It begins with the home folder of nobody.
    """
    if "://" in storage:
        return storage, None
    try:
        path = Path(storage).expanduser()
    except RuntimeError as error:
        raise StorageError(f"storage must be in a home that is known, got {storage!r}") from error
    if path.is_absolute() or not in_ray_job():
        return str(path.absolute()), None
    resolved = Path.home() / path
    return str(resolved), (
        f"storage {storage!r} is relative and a Ray job's working directory is temporary: "
        f"using {resolved}. Give an absolute path or a bucket to choose another place."
    )


def sweep_folder(storage: str, name: str) -> Path:
    """Local folder of a sweep's own files: in the storage, or in the home folder for a bucket."""
    if "://" not in storage:
        return Path(storage) / name
    if storage.startswith("file://"):
        return Path(storage.removeprefix("file://")) / name
    bucket = hashlib.sha256(storage.encode()).hexdigest()[:12]
    return Path.home() / ".music_rllib" / bucket / name


def check_storage(storage: str, name: str) -> None:
    """Look whether results can be kept there, without leaving anything behind.

    Args:
        storage: An absolute folder, or a URI, of `resolve_storage`.
        name: Of the sweep.

    Raises:
        StorageError: They can't.
    """
    if any(unicodedata.category(character) in {"Cc", "Cs"} for character in storage):
        raise StorageError(
            f"storage must be UTF-8 text without control characters, got {storage!a}"
        )
    check_answers(storage)
    folder = storage.removeprefix("file://")
    if "://" not in folder:
        plain = os.path.normpath(folder)  # a folder that isn't there yet has no ".."
        for entry in (name, "nodes", "work"):
            _check_folder(Path(plain, entry))
    else:  # its own files are on this machine as well
        _check_folder(sweep_folder(storage, name))


def check_answers(storage: str) -> None:
    """Ask a bucket whether it is there, in a process of its own: its client can't be interrupted.

    Raises:
        StorageError: It isn't, refuses, or doesn't answer in time.
    """
    if not storage.startswith(BUCKETS):
        return
    command = [sys.executable, "-c", _ASK]
    try:
        done = subprocess.run(  # noqa: S603 - this Python, and the URI on its standard input
            command,
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
    """Look whether a folder is there and can be written, or can be made."""
    named = _cut(str(folder), 300)
    for part in folder.parts:
        if (length := len(os.fsencode(part))) > NAME_BYTES:
            raise StorageError(
                f"storage must have names of at most {NAME_BYTES} bytes in its path, got one of "
                f"{length}: {_cut(part, 40)}"
            )
    try:
        there = _nearest(folder)
    except OSError as error:
        rule = "must be a folder that can be made and written"
        raise StorageError(f"{named} {rule}: {error.strerror}") from error
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise StorageError(f"{there} must be writable, for {named}: {error.strerror}") from error


def _cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[:longest]}..."


def _nearest(folder: Path) -> Path:
    """The folder itself, or the one of those above it that is there.

    Raises:
        StorageError: Something else is in its place.
        OSError: It can't be looked at.
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
            raise StorageError(f"{folder} must be a folder or free, {path} is a {_kind(mode)}")
        return path
    raise AssertionError("the root is a folder")


def _kind(mode: int) -> str:
    kinds = {stat.S_ISREG: "file", stat.S_ISCHR: "device", stat.S_ISBLK: "device"}
    kinds |= {stat.S_ISFIFO: "pipe", stat.S_ISSOCK: "socket"}
    return next((name for is_one, name in kinds.items() if is_one(mode)), "special file")
