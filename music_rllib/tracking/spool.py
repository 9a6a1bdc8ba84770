"""What a run has to say to MLflow, kept on disk until it is delivered.

A spool is one folder per run::

    spool.jsonl      one record per line, append-only
    delivered.json   {"run_id", "offset", "records"}: what MLflow has of it
    outbox/          artefacts still to be uploaded; a file leaves when it has arrived

Records are written with one ``write`` each, so that a killed process leaves at most one torn
last line, which is cut off when the spool is opened again. The writer never waits for the disk:
the sender calls :meth:`Spool.sync` before it sends, so whatever MLflow has is on disk too, and a
value that a power cut took from the spool can be logged again without becoming a second value.
"""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from music_rllib.errors import TrackingError

logger = logging.getLogger(__name__)

Status = Literal["FINISHED", "FAILED", "KILLED"]
READ_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Start:
    """The run begins, or goes on after a resume. ``time`` in ms since the epoch."""

    time: int
    name: str
    tags: Mapping[str, str] = field(default_factory=dict)
    params: Mapping[str, str] = field(default_factory=dict)
    source_node: str | None = None


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Values at one number of environment steps. ``time`` in ms since the epoch."""

    time: int
    step: int
    values: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Finish:
    """The run ended. ``time`` in ms since the epoch."""

    time: int
    status: Status
    tags: Mapping[str, str] = field(default_factory=dict)


Record = Start | Metrics | Finish
_KINDS: dict[str, type[Start] | type[Metrics] | type[Finish]] = {
    "start": Start,
    "metrics": Metrics,
    "finish": Finish,
}
_NAMES = {kind: name for name, kind in _KINDS.items()}


@dataclass(frozen=True)
class Delivered:
    """How far a spool reached MLflow: bytes and records sent, and the run they went to."""

    run_id: str | None = None
    offset: int = 0
    records: int = 0


_PART = r"(?!\.{1,2}(?:/|$))[\w.\-: ]+"
_METRIC_NAME = re.compile(rf"{_PART}(?:/{_PART})*")


def check_metric_name(name: str) -> None:
    """Raises ValueError where MLflow would refuse the name."""
    if len(name) > 250 or not _METRIC_NAME.fullmatch(name):
        raise ValueError(
            "a metric's name must have at most 250 letters, digits, '_', '-', '.', ':', spaces, "
            f"and single slashes between them, got {name!r}"
        )


class Spool:
    """The records of one run. One writer process at a time; threads may share it."""

    def __init__(self, folder: Path) -> None:
        """Open or create the spool in ``folder``.

        Raises:
            TrackingError: where the folder cannot be read or written.
        """
        self.folder = folder
        self.path = folder / "spool.jsonl"
        self.outbox = folder / "outbox"
        self.start: Start | None = None
        """The first one, without its params: they are many, and a sweep has many spools."""
        self.finished: Status | None = None
        self.records = 0
        self._last_step: dict[str, int] = {}
        self._lock = threading.Lock()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._size = self._cut_torn_line()
        except OSError as error:
            raise _cannot("be opened", self.path, error) from error
        for record, _ in self.read(0):
            self._note(record)
        self.delivered = _read_delivered(folder, self._size)

    def append(self, records: Iterable[Record]) -> None:
        """Write ``records``, all or none, without waiting for the disk.

        A value whose step is not above the last one of its metric is left out: after a resume a
        run repeats the steps between its checkpoint and its end, and MLflow would show them twice.

        Raises:
            TrackingError: where the spool cannot be written (disk full, read-only folder).
        """
        with self._lock:
            last_step = dict(self._last_step)
            fresh = [new for record in records if (new := _unseen(record, last_step)) is not None]
            if not fresh:
                return
            self._write("".join(_line(record) for record in fresh).encode())
            for record in fresh:
                self._note(record)

    def read(self, offset: int) -> Iterator[tuple[Record, int]]:
        """Records from byte ``offset`` on, each with the offset of its end.

        Only whole lines are read; a line that is no record is skipped with a warning.
        """
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            file.seek(offset)
            for line in file:
                if not line.endswith(b"\n"):
                    return
                offset += len(line)
                record = _parse(line)
                if record is None:
                    logger.warning("%s: skipped a line that is no record", self.path)
                else:
                    yield record, offset

    def history(self) -> list[Metrics]:
        """Every metrics record, in the order in which it was logged."""
        return [record for record, _ in self.read(0) if isinstance(record, Metrics)]

    def sync(self) -> None:
        """Wait until everything written so far is on disk (survives a power cut)."""
        if self.path.exists():
            with self.path.open("rb") as file:
                os.fsync(file.fileno())

    @property
    def undelivered(self) -> int:
        """Number of records that MLflow does not have yet."""
        return self.records - self.delivered.records

    def set_delivered(self, delivered: Delivered) -> None:
        """Remember what was sent. Not synced: repeating a delivery is harmless."""
        temporary = self.folder / ".delivered.json"
        temporary.write_text(json.dumps(asdict(delivered)), encoding="utf-8")
        temporary.replace(self.folder / "delivered.json")
        self.delivered = delivered

    def put_artefact(self, name: str, content: str | bytes | Path) -> None:
        """Queue an artefact: text, bytes, or a file to copy. The last one of a name counts.

        Raises:
            TrackingError: where it cannot be read or written.
            ValueError: where ``name`` leaves the run's artefact folder.
        """
        target = (self.outbox / name).resolve()
        if self.outbox.resolve() not in target.parents:
            raise ValueError(f"artefact name must stay inside the run's folder, got {name!r}")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            temporary = target.with_name(f".{target.name}.part")
            if isinstance(content, Path):
                shutil.copyfile(content, temporary)
            else:
                temporary.write_bytes(content.encode() if isinstance(content, str) else content)
            with self._lock:
                temporary.replace(target)
        except OSError as error:
            raise _cannot("be queued", target, error) from error

    def queued_artefacts(self) -> list[str]:
        """Names of the artefacts that are still to be uploaded."""
        return sorted(
            path.relative_to(self.outbox).as_posix()
            for path in self.outbox.rglob("*")
            if path.is_file() and not path.name.startswith(".")
        )

    def send_artefact(self, name: str, upload: Callable[[Path], None]) -> None:
        """Upload a queued artefact; it leaves the outbox unless a newer one came meanwhile."""
        file = self.outbox / name
        sent = file.stat()
        upload(file)
        with self._lock:
            now = file.stat()
            if (now.st_ino, now.st_mtime_ns) == (sent.st_ino, sent.st_mtime_ns):
                file.unlink()

    def _cut_torn_line(self) -> int:
        """Drop an unfinished last line; the size of what remains, in bytes."""
        with self.path.open("ab+") as file:
            size = end = file.tell()
            while end > 0:
                begin = max(0, end - READ_BYTES)
                file.seek(begin)
                newline = file.read(end - begin).rfind(b"\n")
                if newline >= 0:
                    end = begin + newline + 1
                    break
                end = begin
            if end != size:
                file.truncate(end)
            return end

    def _write(self, data: bytes) -> None:
        try:
            with self.path.open("ab", buffering=0) as file:
                if file.write(data) != len(data):
                    file.truncate(self._size)
                    raise OSError("only a part of the record was written; is the disk full?")
        except OSError as error:
            raise _cannot("be written", self.path, error) from error
        self._size += len(data)

    def _note(self, record: Record) -> None:
        self.records += 1
        if isinstance(record, Metrics):
            self._last_step.update(dict.fromkeys(record.values, record.step))
        elif isinstance(record, Start):
            self.start = self.start or replace(record, params={})
            self.finished = None
        else:
            self.finished = record.status


def has_undelivered(folder: Path) -> bool:
    """Whether the spool in ``folder`` holds something for MLflow, without reading its records."""
    try:
        size = (folder / "spool.jsonl").stat().st_size
    except OSError:
        return False
    queued = any(path.is_file() for path in (folder / "outbox").rglob("*"))
    return queued or _read_delivered(folder, size).offset < size


def _read_delivered(folder: Path, size: int) -> Delivered:
    """What was remembered; nothing where that cannot be, since repeating is harmless."""
    try:
        stored = json.loads((folder / "delivered.json").read_text(encoding="utf-8"))
        delivered = Delivered(**stored)
    except (OSError, ValueError, TypeError):
        return Delivered()
    return delivered if delivered.offset <= size else Delivered()


def _unseen(record: Record, last_step: dict[str, int]) -> Record | None:
    """The part of ``record`` that is new; notes its steps in ``last_step``."""
    if not isinstance(record, Metrics):
        return record
    values = {
        name: value
        for name, value in record.values.items()
        if name not in last_step or record.step > last_step[name]
    }
    last_step.update(dict.fromkeys(values, record.step))
    return Metrics(time=record.time, step=record.step, values=values) if values else None


def _line(record: Record) -> str:
    return json.dumps({"kind": _NAMES[type(record)], **asdict(record)}, ensure_ascii=False) + "\n"


def _parse(line: bytes) -> Record | None:
    try:
        fields = json.loads(line)
        return _KINDS[fields.pop("kind")](**fields)
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def _cannot(action: str, path: Path, error: OSError) -> TrackingError:
    reason = error.strerror or str(error)
    return TrackingError(f"{path} must be writable, it could not {action}: {reason}")
