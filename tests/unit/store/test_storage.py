"""Addresses of storages, and the checks before a sweep starts, which leave no files."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.fs as pafs
import pytest
from fsspec.implementations.memory import MemoryFileSystem  # type: ignore[import-untyped]

from music_rllib.config.load import load_config
from music_rllib.config.problems import ConfigError
from music_rllib.store import storage as storage_module
from music_rllib.store.patience import be_patient
from music_rllib.store.sealed import SealedFolders
from music_rllib.store.storage import (
    StorageError,
    StorageFolder,
    below,
    check_answers,
    check_storage,
    open_storage,
    resolve_storage,
    storage_and_name,
    sweep_folder,
)
from music_rllib.sweep.driver import DEFAULT_CONFIG


def tree(folder: Path) -> list[str]:
    return sorted(str(path) for path in folder.rglob("*"))


@pytest.mark.parametrize("place", ["free", "folder", "folder/deep/er", "link", "folder/../free"])
def test_checking_a_folder_does_not_create_it(tmp_path: Path, place: str) -> None:
    Path(tmp_path, "folder").mkdir()
    Path(tmp_path, "link").symlink_to("folder")
    before = tree(tmp_path)
    check_storage(f"{tmp_path}/{place}", "sweep")
    check_storage(f"file://{tmp_path}/{place}", "sweep")
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("file", "file must be a writable folder, for .*: Not a directory"),
        ("folder/../file/x", "file must be a writable folder, for .*/x/sweep: Not a directory"),
        ("fifo", "fifo must be a writable folder, .* Not a directory"),
        ("dangling", "dangling must be a writable folder, .* No such file"),
        ("loop/x", "Too many levels of symbolic links"),
        ("taken", "taken/sweep must be a writable folder, .* Not a directory"),
        ("broken", "broken/nodes must be a writable folder, .* No such file"),
        ("x" * 300, "must be a writable folder, .* File name too long"),
        ("a/" * 2500, "File name too long"),
        ("a\nb", r"without control characters, got '.*a\\nb'"),
        ("a\x1b[31mb", r"without control characters, got '.*a\\x1b\[31mb'"),
        ("a\0b", r"without control characters, got '.*a\\x00b'"),
        (os.fsdecode(b"\xff"), r"UTF-8 text .* got '.*\\udcff'"),
    ],
)
def test_an_unusable_folder_is_refused(tmp_path: Path, place: str, message: str) -> None:
    Path(tmp_path, "file").touch()
    Path(tmp_path, "folder").mkdir()
    os.mkfifo(tmp_path / "fifo")
    Path(tmp_path, "dangling").symlink_to("nowhere")
    Path(tmp_path, "loop").symlink_to("loop")
    Path(tmp_path, "taken").mkdir()
    Path(tmp_path, "taken", "sweep").touch()
    Path(tmp_path, "broken").mkdir()
    Path(tmp_path, "broken", "nodes").symlink_to("gone")
    before = tree(tmp_path)
    with pytest.raises(StorageError, match=message) as refused:
        check_storage(f"{tmp_path}/{place}", "sweep")
    assert len(str(refused.value)) < 600
    assert tree(tmp_path) == before


def test_a_folder_of_another_user_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error is simulated, because root can write everywhere."""

    def refuse(dir: Path) -> None:  # noqa: A002
        raise PermissionError(13, "Permission denied", str(dir))

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    with pytest.raises(StorageError, match=f"{tmp_path} must be a writable folder, .* Permission"):
        check_storage(str(tmp_path), "sweep")


def test_unknown_homes_and_invalid_text_are_refused() -> None:
    with pytest.raises(StorageError, match="existing home folder, got '~nobody-at-all/x'"):
        resolve_storage("~nobody-at-all/x")
    with pytest.raises(ConfigError, match=r"^--storage must be UTF-8 text, got '\\udcff'$"):
        load_config(DEFAULT_CONFIG, storage=os.fsdecode(b"\xff"))


def test_a_bucket_that_does_not_answer_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The connection is accepted but nothing answers; the client would wait for minutes."""
    monkeypatch.setattr(storage_module, "ANSWER_SECONDS", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        uri = f"s3://key:secret@b/x?endpoint_override=127.0.0.1:{silent.getsockname()[1]}"
        began = time.monotonic()
        with pytest.raises(
            StorageError, match="must be a bucket that answers, got 's3://b/x"
        ) as no:
            check_answers(f"{uri}&scheme=http&region=x")
        assert time.monotonic() - began < 30
        assert "no answer within 1 s" in str(no.value)
        assert "secret" not in str(no.value)


@pytest.mark.parametrize(
    "storage", ["s3://bucket/sweeps", "s3://b?endpoint_override=h:1&scheme=http"]
)
def test_a_sweep_uri_keeps_the_options_of_its_storage(storage: str) -> None:
    uri = below(storage, "mine")
    assert storage_and_name(uri) == (storage, "mine")
    assert uri.partition("?")[0].endswith("/mine")


class Away(pafs.FSSpecHandler):  # type: ignore[misc]
    """A bucket of which every second request fails with `error`, as pyarrow words it."""

    error = "When reading, got AWS Error INTERNAL_FAILURE (HTTP status 500)"
    requests = 0

    def _fail(self) -> None:
        type(self).requests += 1
        if self.requests % 2:
            raise OSError(self.error)

    def get_file_info(self, paths: Any) -> Any:
        self._fail()
        return super().get_file_info(paths)

    def get_file_info_selector(self, selector: Any) -> Any:
        self._fail()
        return super().get_file_info_selector(selector)

    def open_input_stream(self, path: str) -> Any:
        self._fail()
        return super().open_input_stream(path)

    def open_output_stream(self, path: str, metadata: Any) -> Any:
        self._fail()
        return super().open_output_stream(path, metadata)

    def delete_dir(self, path: str) -> None:
        self._fail()
        super().delete_dir(path)


@pytest.fixture
def away(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[StorageFolder, list[str]]]:
    """The bucket, for which this process waits for a minute, and its messages."""
    memory = MemoryFileSystem()
    memory.store.clear()
    memory.pseudo_dirs[:] = [""]
    said: list[str] = []
    clock = iter(range(0, 10_000, 7))
    monkeypatch.setattr(time, "sleep", lambda _: None)
    monkeypatch.setattr(time, "monotonic", lambda: float(next(clock)))
    be_patient(1.0, said.append)
    yield StorageFolder(pafs.PyFileSystem(Away(memory)), "bucket/work"), said
    be_patient(0.0)


def test_a_bucket_that_answers_500_is_asked_again(
    away: tuple[StorageFolder, list[str]], tmp_path: Path
) -> None:
    bucket, said = away
    nodes = SealedFolders(bucket)
    with nodes.sealing("node", {"a": 1}) as folder:
        (folder / "weights").write_bytes(b"x" * 3_000_000)
    assert nodes.check("node").meta == {"a": 1}
    nodes.fetch("node", tmp_path)
    assert (tmp_path / "weights").stat().st_size == 3_000_000
    nodes.remove("node")
    assert not nodes.exists("node")
    assert said[0].startswith("the storage does not answer, trying again for 1 min: When reading")
    assert said[1] == "the storage answers again"


def test_a_bucket_that_refuses_is_not_asked_again(
    away: tuple[StorageFolder, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    bucket, said = away
    monkeypatch.setattr(Away, "requests", 0)
    monkeypatch.setattr(Away, "error", "AWS Error ACCESS_DENIED")
    with pytest.raises(OSError, match="ACCESS_DENIED"):
        bucket.read("x")
    monkeypatch.setattr(Away, "_fail", lambda _: (_ for _ in ()).throw(OSError("HTTP status 503")))
    with pytest.raises(OSError, match="503"):
        bucket.read("x")
    assert len(said) == 1, "it waits for a minute"


@pytest.mark.parametrize("storage", ["s3://b/x/", "s3://b/x/?region=y", "s3://b/", "s3://b/x"])
def test_a_slash_at_the_end_of_a_bucket_names_the_same_folder(storage: str) -> None:
    found, name = storage_and_name(below(storage, "s"))
    assert sweep_folder(found, name) == sweep_folder(storage, "s")


def test_a_folder_whose_name_is_not_utf8_is_no_sweep(tmp_path: Path) -> None:
    (tmp_path / os.fsdecode(b"\xdcbungen")).mkdir()
    (tmp_path / "s").mkdir()
    assert open_storage(str(tmp_path)).folders() == ["s"]
