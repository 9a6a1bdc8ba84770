"""The node store on a disk and in a bucket."""

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pyarrow.fs as pafs
import pytest
from fsspec.implementations.memory import MemoryFileSystem  # type: ignore[import-untyped]

from music_rllib.store import node_store, sealed
from music_rllib.store.files import write_atomically
from music_rllib.store.history import (
    HISTORY,
    Report,
    RunResult,
    from_json_lines,
    last_values,
    to_json_lines,
)
from music_rllib.store.node_store import NodeStore
from music_rllib.store.sealed import Manifest, SealedFolders
from music_rllib.store.serialization import canonical_json
from music_rllib.store.storage import DamagedError, StorageError, StorageFolder, open_storage
from music_rllib.store.work_folder import steps_of

KEY = "0123456789abcdef0123"
RESULT = RunResult(label="a/b", env_steps=10, seconds=1.5, metrics={"m": 0.5})


@pytest.fixture
def produced(tmp_path: Path) -> Path:
    folder = tmp_path / "produced"
    (folder / "handoff").mkdir(parents=True)
    (folder / "handoff" / "w.bin").write_bytes(b"weights")
    reports = [Report(env_steps=5, seconds=1.0, timestamp_ms=7, metrics={"m": float("nan")})]
    reports.append(Report(env_steps=10, seconds=1.5, timestamp_ms=9, metrics={"m": 0.5}))
    (folder / HISTORY).write_bytes(to_json_lines(reports))
    return folder


def local_store(tmp_path: Path) -> NodeStore:
    return NodeStore(str(tmp_path / "storage"))


def object_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> NodeStore:
    """A store on a file system without renames and folders, like a bucket."""
    memory = MemoryFileSystem()
    memory.store.clear()
    memory.pseudo_dirs[:] = [""]
    filesystem = pafs.PyFileSystem(pafs.FSSpecHandler(memory))
    monkeypatch.setattr(
        "music_rllib.store.node_store.open_storage",
        lambda _: StorageFolder(filesystem, "bucket/path"),
    )
    return NodeStore("s3://bucket/path")


@pytest.fixture(params=["disk", "object store"])
def store(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> NodeStore:
    if request.param == "disk":
        return local_store(tmp_path)
    return object_store(tmp_path, monkeypatch)


def test_a_published_node_comes_back_verified(
    store: NodeStore, produced: Path, tmp_path: Path
) -> None:
    assert not store.is_finished(KEY)
    store.publish(KEY, produced, RESULT)
    assert store.is_finished(KEY)
    assert store.result(KEY) == RESULT
    report, last = store.history(KEY)
    assert (report.env_steps, last.env_steps) == (5, 10)
    assert report.metrics["m"] != report.metrics["m"]
    store.verify(KEY)
    store.fetch(KEY, tmp_path / "fetched")
    assert (tmp_path / "fetched" / "handoff" / "w.bin").read_bytes() == b"weights"


def test_a_published_node_is_not_replaced(store: NodeStore, produced: Path) -> None:
    store.publish(KEY, produced, RESULT)
    (produced / "handoff" / "w.bin").write_bytes(b"other")
    store.publish(KEY, produced, RESULT.model_copy(update={"label": "other"}))
    assert store.result(KEY) == RESULT
    store.verify(KEY)


def test_an_imported_handoff_has_no_result(store: NodeStore, produced: Path) -> None:
    store.publish("handoff-1", produced)
    assert store.is_finished("handoff-1")
    assert store.result("handoff-1") is None


def test_a_missing_node_is_named(store: NodeStore) -> None:
    with pytest.raises(DamagedError, match=r"nodes/absent/manifest\.json must exist"):
        store.result("absent")


def test_an_interrupted_publication_leaves_nothing(
    store: NodeStore, produced: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    for step in ("_rename", "_upload"):
        monkeypatch.setattr(SealedFolders, step, interrupted)
    with pytest.raises(KeyboardInterrupt):
        store.publish(KEY, produced, RESULT)
    monkeypatch.undo()
    assert not store.is_finished(KEY)


def test_two_publishers_at_once_leave_one_sound_node(store: NodeStore, produced: Path) -> None:
    together = threading.Barrier(4)
    failures = []

    def publish() -> None:
        together.wait()
        try:
            store.publish(KEY, produced, RESULT)
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=publish) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    store.verify(KEY)


@pytest.mark.parametrize(
    ("tamper", "message"),
    [
        (lambda path: path.write_bytes(b"weight"), "must have 7 bytes, it has 6"),
        (lambda path: path.write_bytes(b"weightz"), "its content has changed"),
        (lambda path: path.unlink(), "must exist, its manifest lists it"),
    ],
    ids=["truncated", "flipped", "deleted"],
)
def test_damage_is_found_and_named(
    tmp_path: Path, produced: Path, tamper: Callable[[Path], None], message: str
) -> None:
    store = local_store(tmp_path)
    store.publish(KEY, produced, RESULT)
    tamper(tmp_path / "storage" / "nodes" / KEY / "handoff" / "w.bin")
    with pytest.raises(DamagedError, match=message) as error:
        store.verify(KEY)
    assert "--retrain-damaged" in str(error.value)
    assert list(store.damage([KEY])) == [KEY]
    assert not store.is_sound(KEY)
    store.remove(KEY)
    store.publish(KEY, produced, RESULT)
    assert store.is_sound(KEY)


def test_verified_files_are_read_once_and_later_damage_is_found(
    tmp_path: Path, produced: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []
    check = SealedFolders.check

    def counting(folders: SealedFolders, name: str, *sizes: None) -> Manifest:
        read.append(name)
        return check(folders, name, *sizes)

    monkeypatch.setattr(SealedFolders, "check", counting)
    # A file's ctime cannot be set to an older time, so new files must count as old here.
    monkeypatch.setattr(node_store, "SETTLED_SECONDS", 0.0)
    keys = [f"{number:020d}" for number in range(3)]
    for key in keys:
        local_store(tmp_path).publish(key, produced, RESULT)
    for _ in range(3):
        assert local_store(tmp_path).damage(keys) == {}
    assert read == keys, "each is read once, by any process"

    weights = tmp_path / "storage" / "nodes" / keys[1] / "handoff" / "w.bin"
    times = weights.stat()
    weights.write_bytes(b"weightz")
    os.utime(weights, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert list(local_store(tmp_path).damage(keys)) == [keys[1]]
    assert list(local_store(tmp_path).damage(keys)) == [keys[1]], "damage is not remembered"
    weights.write_bytes(b"weights")
    assert local_store(tmp_path).damage(keys) == {}


@pytest.mark.parametrize("content", [b"", b"[]", b'{"a": 1', b"\xff", b'{"KEY": null}'])
def test_with_a_damaged_verified_json_files_are_read_again(
    tmp_path: Path, produced: Path, content: bytes
) -> None:
    local_store(tmp_path).publish(KEY, produced, RESULT)
    listed = tmp_path / "storage" / "verified.json"
    listed.write_bytes(content.replace(b"KEY", KEY.encode()))
    assert local_store(tmp_path).damage([KEY]) == {}
    (tmp_path / "storage" / "nodes" / KEY / HISTORY).unlink()
    assert list(local_store(tmp_path).damage([KEY])) == [KEY]


def test_a_new_file_is_read_again(tmp_path: Path, produced: Path) -> None:
    """It may be written again without a change of its time stamp."""
    store = local_store(tmp_path)
    store.publish(KEY, produced, RESULT)
    assert store.damage([KEY]) == {}
    assert not (tmp_path / "storage" / "verified.json").exists()


def test_a_result_that_contradicts_its_history_is_damaged(tmp_path: Path, produced: Path) -> None:
    store = local_store(tmp_path)
    store.publish(KEY, produced, RESULT.model_copy(update={"metrics": {"m": 0.5}}))
    assert store.damage([KEY]) == {}, "it is the last value"
    path = tmp_path / "storage" / "nodes" / KEY / "manifest.json"
    path.write_text(path.read_text().replace("0.5", "0.75"))
    (error,) = store.damage([KEY]).values()
    assert "manifest.json must have the last values of history.jsonl" in str(error)


def test_a_manifest_with_an_invalid_result_is_damaged(store: NodeStore, produced: Path) -> None:
    store.publish(KEY, produced, RESULT)
    path = f"{store.path(KEY)}/manifest.json"
    with store._root.filesystem.open_input_stream(path) as stream:
        text = stream.read().decode()
    with store._root.filesystem.open_output_stream(path) as sink:
        sink.write(text.replace('"seconds"', '"secunds"').encode())
    assert "must hold a run's result" in str(store.damage([KEY])[KEY])
    with pytest.raises(DamagedError, match="must hold a run's result"):
        store.result(KEY)


def test_sizes_are_checked_without_reading(store: NodeStore, produced: Path) -> None:
    store.publish(KEY, produced, RESULT)
    assert store.damage([KEY]) == {}
    (weights,) = [file for file in store.paths(KEY) if file.endswith("w.bin")]
    with store._root.filesystem.open_output_stream(weights) as sink:
        sink.write(b"weight")
    (error,) = store.damage([KEY]).values()
    assert "w.bin must have 7 bytes, it has 6" in str(error)
    store._root.filesystem.delete_file(weights)
    (error,) = store.damage([KEY]).values()
    assert "w.bin must exist, its manifest lists it" in str(error)


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o007])
def test_the_umask_decides_who_can_read_a_node(tmp_path: Path, produced: Path, mask: int) -> None:
    """A group can share a storage, and a user can keep it private."""
    shutil.rmtree(tmp_path / "storage", ignore_errors=True)
    before = os.umask(mask)
    try:
        local_store(tmp_path).publish(KEY, produced, RESULT)
        write_atomically(tmp_path / "storage" / "state.json", b"{}")
    finally:
        os.umask(before)
    manifest = tmp_path / "storage" / "nodes" / KEY / "manifest.json"
    for path in (manifest, tmp_path / "storage" / "state.json"):
        assert path.stat().st_mode & 0o777 == 0o666 & ~mask
    assert manifest.parent.stat().st_mode & 0o777 == 0o777 & ~mask


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "must be a manifest"),
        (
            '{"name": "x", "files": {"../../w": {"bytes": 1, "sha256": ""}}, "meta": {}}',
            "must be a path inside the folder",
        ),
        ('{"name": "x", "prefix": "../", "files": {}, "meta": {}}', "must be a manifest"),
        ('{"name": "x", "files": {}, "meta": {}}', f"must be the manifest of {KEY}, got 'x'"),
    ],
    ids=["torn", "path", "prefix", "name"],
)
def test_an_invalid_manifest_is_refused(
    tmp_path: Path, produced: Path, text: str, message: str
) -> None:
    store = local_store(tmp_path)
    store.publish(KEY, produced, RESULT)
    (tmp_path / "storage" / "nodes" / KEY / "manifest.json").write_text(text)
    with pytest.raises(DamagedError, match=message):
        store.result(KEY)


def test_a_folder_without_a_manifest_is_replaced(tmp_path: Path, produced: Path) -> None:
    store = local_store(tmp_path)
    (tmp_path / "storage" / "nodes" / KEY / "rest").mkdir(parents=True)
    assert not store.is_finished(KEY)
    store.publish(KEY, produced, RESULT)
    store.verify(KEY)
    assert not (tmp_path / "storage" / "nodes" / KEY / "rest").exists()


def test_a_killed_publisher_leaves_no_node(tmp_path: Path, produced: Path) -> None:
    code = (
        "import os, sys; from music_rllib.store import node_store, sealed\n"
        "sealed.write_atomically = lambda *_: os._exit(9)\n"
        "from pathlib import Path\n"
        "node_store.NodeStore(sys.argv[1]).publish('k', Path(sys.argv[2]))\n"
    )
    storage = str(tmp_path / "storage")
    killed = subprocess.run([sys.executable, "-c", code, storage, str(produced)], check=False)
    assert killed.returncode == 9
    store = NodeStore(storage)
    assert not store.is_finished("k")
    store.publish("k", produced)
    store.verify("k")


def test_a_full_disk_names_the_path(
    tmp_path: Path, produced: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(sealed, "write_atomically", full)
    with pytest.raises(StorageError, match=f"nodes/{KEY} must be writable: No space left"):
        local_store(tmp_path).publish(KEY, produced, RESULT)
    assert list((tmp_path / "storage" / "nodes").iterdir()) == []


def test_checkpoints_are_kept_newest_first_and_pruned(store: NodeStore) -> None:
    work = store.work_folder(KEY)
    with work.newest() as newest:
        assert newest is None
    parts: list[str] = []
    for env_steps in (1000, 2000, 10_000):
        with work.new_checkpoint(env_steps) as draft:
            (draft.folder / "state").write_text(str(env_steps))
            with draft.new_part("part") as (name, folder):
                (folder / "data").write_text(str(env_steps))
            parts.append(name)
            draft.needs = parts[-2:]
    with work.newest() as newest:
        assert newest is not None
        assert (newest.folder / "state").read_text() == "10000"
        read = [(newest.parts[name] / "data").read_text() for name in newest.parts]
        assert read == ["2000", "10000"]
    assert [int(name.split("-")[0]) for name in work.names()] == [2000, 10_000]
    work.clear()
    with work.newest() as newest:
        assert newest is None


def test_a_save_that_fails_leaves_the_older_checkpoint(store: NodeStore) -> None:
    work = store.work_folder(KEY)
    with work.new_checkpoint(1000) as draft:
        (draft.folder / "state").write_text("good")

    def save_half() -> None:
        with work.new_checkpoint(2000) as draft:
            (draft.folder / "state").write_text("half")
            raise RuntimeError("boom")

    with pytest.raises(RuntimeError, match="boom"):
        save_half()
    with work.newest() as newest:
        assert newest is not None
        assert (newest.folder / "state").read_text() == "good"


def test_a_damaged_checkpoint_is_skipped_with_a_warning(tmp_path: Path) -> None:
    work = local_store(tmp_path).work_folder(KEY)
    for env_steps in (1000, 2000):
        with work.new_checkpoint(env_steps) as draft:
            (draft.folder / "state").write_text(str(env_steps))
    newest_name = work.names()[-1]
    (tmp_path / "storage" / "work" / KEY / newest_name / "state").write_text("2001")
    warnings: list[str] = []
    with work.newest(warnings.append) as newest:
        assert newest is not None
        assert (newest.folder / "state").read_text() == "1000"
    assert len(warnings) == 1
    assert newest_name in warnings[0]
    # The run saves the same step again, and this checkpoint is used.
    with work.new_checkpoint(2000) as draft:
        (draft.folder / "state").write_text("2000")
    with work.newest(warnings.append) as newest:
        assert newest is not None
        assert (newest.folder / "state").read_text() == "2000"


@pytest.mark.parametrize("keep", [1, 2])
def test_checkpoints_after_damage_replace_the_damaged_ones(store: NodeStore, keep: int) -> None:
    """The run restarts, and has fewer steps than the damaged checkpoint for a while."""
    work = store.work_folder("0" * 20, keep)
    parts: list[str] = []

    def save(steps: int) -> None:
        with work.new_checkpoint(steps) as draft:
            with draft.new_part("segment") as (name, folder):
                (folder / "data").write_text("x")
            parts.append(name)
            draft.needs = list(parts)

    save(8000)
    if keep == 2:
        save(9000)
    for name in work.names():
        work.folder.write(f"{name}/manifest.json", b"damage")
    parts.clear()
    warnings: list[str] = []
    for steps in (4000, 8000, 12000):
        save(steps)
        with work.newest(warnings.append) as newest:
            assert newest is not None
            assert list(newest.parts) == parts
    assert [steps_of(name) for name in work.names()] == [8000, 12000][-keep:]
    assert warnings == []


def test_an_invalid_storage_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="must be a folder or an s3:// or gs:// URI"):
        open_storage("ftp://host/path")
    (tmp_path / "file").write_text("")
    store = NodeStore(str(tmp_path / "file"))
    with pytest.raises(StorageError, match="must be writable: Not a directory"):
        store.publish(KEY, tmp_path)


def test_storage_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert open_storage("results/").path == f"{tmp_path}/results"
    assert open_storage("~/results").path == "/home/somebody/results"
    assert open_storage("file:///data/results").path == "/data/results"
    assert open_storage("/data/q%201?#").path == "/data/q%201?#"
    for key in ("q%201", "a b#c", "ü/50%", "x+y=1,z"):  # as other clients of a bucket read them
        assert open_storage(f"s3://k:s%2F1@bucket/{key}?region=x").path == f"bucket/{key}"


def test_reports_round_trip_as_json_lines() -> None:
    reports = [
        Report(env_steps=i, seconds=i / 3, timestamp_ms=i, metrics={"a": 0.1 * i, "b/c": -i})
        for i in range(3)
    ]
    assert from_json_lines(to_json_lines(reports)) == reports
    assert len(to_json_lines(reports).splitlines()) == 3


def test_the_last_value_of_each_metric_counts() -> None:
    def report(env_steps: int, **metrics: float) -> Report:
        return Report(env_steps=env_steps, seconds=0, timestamp_ms=0, metrics=metrics)

    assert last_values([report(1, a=1, b=1), report(2, a=2)]) == {"a": 2, "b": 1}


def test_canonical_json_is_unique() -> None:
    assert canonical_json({"b": 1.0, "a": [True, None]}) == '{"a":[true,null],"b":1.0}'
    with pytest.raises(ValueError, match="not JSON compliant"):
        canonical_json(float("nan"))


def test_an_atomic_write_leaves_no_trace_when_it_fails(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old")
    with pytest.raises(TypeError):
        write_atomically(path, "text")  # type: ignore[arg-type]
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_newest_checkpoint_up_to_a_number_of_steps_is_found(store: NodeStore) -> None:
    work = store.work_folder(KEY, 3)
    for steps in (1000, 2000, 3000):
        with work.new_checkpoint(steps) as draft:
            (draft.folder / "state").write_text(str(steps))
    for most, expected in ((None, "3000"), (3000, "3000"), (2999, "2000"), (999, None)):
        with work.newest(most=most) as saved:
            assert (saved and (saved.folder / "state").read_text()) == expected


def test_tidying_one_node_leaves_the_drafts_of_others(tmp_path: Path) -> None:
    from music_rllib.store.sealed import SealedFolders

    nodes = SealedFolders(open_storage(str(tmp_path)))
    killed = tmp_path / f".mine.{'0' * 32}"
    killed.mkdir()
    with nodes.sealing("other", {}) as draft:
        (draft / "file").write_text("x")
        nodes.tidy("mine")
        assert not killed.exists()
    assert nodes.read("other", "file") == b"x"


def test_the_reports_of_an_interrupted_run_are_those_of_the_newest_sound_checkpoint(
    store: NodeStore,
) -> None:
    from music_rllib.store.history import HISTORY

    work = store.work_folder(KEY)
    assert work.lines() == b""
    for steps in (1000, 2000):
        with work.new_checkpoint(steps) as draft:
            (draft.folder / HISTORY).write_text(str(steps))
    assert work.lines() == b"2000"
    work.folder.write(f"{work.names()[-1]}/manifest.json", b"damage")
    assert work.lines() == b"1000"


def test_a_worker_refuses_a_result_that_contradicts_its_history(
    tmp_path: Path, produced: Path
) -> None:
    store = local_store(tmp_path)
    store.publish(KEY, produced, RESULT)
    manifest = Path(store.path(KEY), "manifest.json")
    manifest.write_text(manifest.read_text().replace("0.5", "0.9"))
    assert list(store.damage([KEY])) == [KEY]
    with pytest.raises(DamagedError, match="--retrain-damaged"):
        store.verify(KEY)


def test_the_files_of_a_bucket_that_was_copied_to_a_disk(tmp_path: Path, produced: Path) -> None:
    store = local_store(tmp_path)
    store.publish(KEY, produced, RESULT)
    node = Path(store.path(KEY))
    prefix = "0" * 32 + "/"
    (node / prefix).mkdir()
    for name in ("handoff", HISTORY):
        (node / name).rename(node / prefix / name)
    manifest = node / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"prefix": prefix}))
    with store.files(KEY) as folder:
        assert (folder / "handoff" / "w.bin").read_bytes() == b"weights"
