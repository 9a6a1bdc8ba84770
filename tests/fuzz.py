"""Change sealed folders, exports and YAML at random, and read them: `make fuzz`.

Reading a file may return a value or raise one of the package's own errors. It must not raise other
exceptions, take longer than `PATIENCE`, write outside the fuzzer's folder, start a program or
import a module that the file names. `SEED` and the number of the case reproduce it: `python -m
tests.fuzz --seed 7 --case 1234`.
"""

from __future__ import annotations

import argparse
import copy
import gc
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from music_rllib.config.load import load_config
from music_rllib.config.problems import ConfigError
from music_rllib.envs.make import is_gymnasium_id
from music_rllib.experiment.plan import make_plan
from music_rllib.policy import PolicyError, load_policy
from music_rllib.policy.rollout import open_task
from music_rllib.report.build import limitations
from music_rllib.report.page import runs_table
from music_rllib.results.archive import read_archive
from music_rllib.results.conditions import find_stages
from music_rllib.results.data import ReportError
from music_rllib.results.search_tables import search_in_words, search_tables
from music_rllib.store.handoff import HandoffError
from music_rllib.store.sealed import SealedFolders
from music_rllib.store.serialization import StateError, read_state, write_state
from music_rllib.store.storage import StorageError, open_storage
from tests.hostile_files import PENDULUM, seal_policy, write_export, write_sweep

OWN_ERRORS = (ConfigError, HandoffError, PolicyError, ReportError, StateError, StorageError)
PATIENCE = 20
"""Seconds of processor time that one case may take."""
JUNK: tuple[Any, ...] = (
    *(None, True, 0, -1, 1.5, 10**20, -(10**99), 1e308, "", "x", "0:9", "../x", "\x00", "\ud800"),
    *("\x1b[31m", "$x_{1$", "<b>", "[red]", "os:system", "a" * 10_000, [], {}, [[[]]]),
    *({"a": 1}, [None], float("nan"), float("inf"), "1e999", "9" * 400, "²", "models:/x"),
)


class Violation(Exception):  # noqa: N818  not an error of the package, and not to be caught by it
    """Behavior that no file may cause."""


# Side effects of reading --------------------------------------------------------------------------


class Watch:
    """Records writes outside a folder, and processes that are started."""

    def __init__(self, folder: Path) -> None:
        self._inside = (str(folder), "/dev/null", "/proc/")
        self._on = False
        self.seen: list[str] = []
        sys.addaudithook(self._hear)

    def __enter__(self) -> None:
        self.seen.clear()
        self._on = True

    def __exit__(self, *_: object) -> None:
        self._on = False

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._on:
            return
        if event in (
            "subprocess.Popen",
            "os.system",
            "os.exec",
            "os.posix_spawn",
            "socket.connect",
        ):
            self.seen.append(f"{event} {arguments[:2]!r}")
        elif event == "import" and str(arguments[0]).startswith(("evil", "antigravity")):
            self.seen.append(f"import {arguments[0]}")
        elif event == "open" and isinstance(arguments[0], str | bytes):
            path, _, flags = arguments
            if isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
                self._written(path)
        elif event in ("os.mkdir", "os.remove", "os.rmdir", "os.rename", "os.symlink", "os.link"):
            self._written(arguments[1 if event in ("os.rename", "os.symlink", "os.link") else 0])

    def _written(self, path: Any) -> None:
        # `rmtree` passes names relative to an open folder.
        text = os.fsdecode(path) if isinstance(path, str | bytes | os.PathLike) else ""
        if text.startswith("/") and not text.startswith(self._inside):
            self.seen.append(f"written: {text}")


# Changes ------------------------------------------------------------------------------------------


def change_bytes(rng: random.Random, data: bytes) -> bytes:
    """Flip, cut, duplicate or overwrite bytes somewhere."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(len(changed) + 1)
        match rng.randrange(5):
            case 0 if at < len(changed):
                changed[at] ^= 1 << rng.randrange(8)
            case 1:
                del changed[at:]
            case 2:
                end = min(len(changed), at + rng.randrange(1, 64))
                changed[at:at] = changed[at:end] * rng.choice((1, 1, 100))
            case 3:
                changed[at : at + 8] = rng.randbytes(8)
            case _:
                changed[at:at] = rng.choice(
                    (b"\xff", b"\x00", b"[" * 99, b"{", b'"', b"-", b"9" * 99)
                )
    return bytes(changed)


def change_value(rng: random.Random, document: Any) -> Any:
    """Replace, drop, duplicate or rename one value somewhere in a document."""
    document = copy.deepcopy(document)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        here = list(_places(document))
        if not here:
            return rng.choice(JUNK)
        parent, key = rng.choice(here)
        match rng.randrange(6):
            case 0 | 1:
                parent[key] = copy.deepcopy(rng.choice(JUNK))
            case 2:
                del parent[key]
            case 3 if isinstance(parent, dict):
                parent[rng.choice([text for text in JUNK if isinstance(text, str)])] = parent[key]
            case 3:
                parent.append(parent[key])
            case 4:
                other, of = rng.choice(here)
                parent[key] = copy.deepcopy(other[of]) if of in _keys(other) else None
            case _:
                parent[key] = [parent[key]] if rng.random() < 0.5 else {"a": parent[key]}
    return document


def _keys(container: Any) -> Any:
    return container.keys() if isinstance(container, dict) else range(len(container))


def _places(document: Any) -> Iterator[tuple[Any, Any]]:
    for key in list(_keys(document)) if isinstance(document, dict | list) else ():
        yield document, key
        yield from _places(document[key])


def change_json(rng: random.Random, data: bytes) -> bytes:
    """A changed document, or changed bytes of it."""
    if rng.random() < 0.2:
        return change_bytes(rng, data)
    return json.dumps(change_value(rng, json.loads(data))).encode()


def change_safetensors(rng: random.Random, data: bytes) -> bytes:
    """Change the header as a document, its length, or bytes."""
    size = int.from_bytes(data[:8], "little")
    if rng.random() < 0.4:
        return change_bytes(rng, data)
    header = json.loads(data[8 : 8 + size])
    about = header.get("__metadata__", {}).get("music_rllib_policy")
    if about is not None and rng.random() < 0.7:
        changed = change_value(rng, json.loads(about))
        header["__metadata__"]["music_rllib_policy"] = json.dumps(changed)
    else:
        header = change_value(rng, header)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data[8 + size :]


def change_text(rng: random.Random, data: bytes) -> bytes:
    """Move, duplicate or replace lines and words of YAML or CSV."""
    if rng.random() < 0.3:
        return change_bytes(rng, data)
    lines = data.decode().split("\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(lines))
        words = lines[at].replace(",", " , ").split(" ")
        match rng.randrange(6):
            case 0:
                lines.insert(at, rng.choice(lines))
            case 1 if len(lines) > 1:
                del lines[at]
            case 2:
                words[rng.randrange(len(words))] = _word(rng)
                lines[at] = " ".join(words)
            case 3:
                lines[at] = " " * rng.randrange(9) + lines[at]
            case 4:
                lines[at] += rng.choice(
                    (" &a", " *a", " !!int", " {", " [", ": ", ",", '"', " |", "#")
                )
            case _:
                lines[at] = f"{lines[at].partition(':')[0]}: {_word(rng)}"
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _word(rng: random.Random) -> str:
    return json.dumps(rng.choice(JUNK), ensure_ascii=rng.random() < 0.5)


CHANGES: dict[str, Callable[[random.Random, bytes], bytes]] = {
    ".json": change_json,
    ".safetensors": change_safetensors,
    ".yaml": change_text,
    ".csv": change_text,
    ".parquet": change_bytes,
}


def change_file(rng: random.Random, file: Path) -> None:
    """Change a file according to its kind; rarely replace it by something else."""
    if rng.random() < 0.02:
        file.unlink()
        rng.choice((os.mkfifo, Path.mkdir, lambda path: path.symlink_to("/dev/zero")))(file)
        return
    file.write_bytes(CHANGES[file.suffix](rng, file.read_bytes()))


# Subjects, and their readers ----------------------------------------------------------------------


def sealed_policy(rng: random.Random, sound: Path, folder: Path) -> Callable[[], object]:
    """A node; usually sealed again, as an attacker would do."""
    shutil.copytree(sound / "node", folder / "node")
    files = [path for path in (folder / "node").rglob("*") if path.is_file()]
    changed = rng.choice(sorted(files))
    change_file(rng, changed)
    regular = changed.is_file() and not changed.is_symlink()
    if changed.name != "manifest.json" and regular and rng.random() < 0.8:
        _seal_again(folder)

    def read() -> None:
        storage = SealedFolders(open_storage(str(folder)))
        for name in storage.names():
            storage.fetch(name, folder / "copy")
        policy = load_policy(folder / "node")
        policy.act(np.zeros(policy.input_size, np.float32))
        open_task(policy).close()

    return read


def _seal_again(folder: Path) -> None:
    """Correct the hashes: of the weights in the handoff, of all files in the manifest."""
    node = folder / "node"
    handoff = node / "handoff" / "handoff.json"
    try:
        from music_rllib.store.sealed import _record

        content = json.loads(handoff.read_bytes())
        for module in content["modules"].values():
            record = _record(node / "handoff" / module["file"])
            module |= {"bytes": record.bytes, "sha256": record.sha256}
        handoff.write_text(json.dumps(content))
        manifest = json.loads((node / "manifest.json").read_bytes())
        for name in manifest["files"]:
            manifest["files"][name] = _record(node / name).model_dump()
        (node / "manifest.json").write_text(json.dumps(manifest))
    except (OSError, ValueError, TypeError, LookupError, AttributeError):
        pass  # too damaged to be sealed


def packed_policy(rng: random.Random, sound: Path, folder: Path) -> Callable[[], object]:
    """A policy's only file."""
    file = folder / "policy.safetensors"
    shutil.copy(sound / "policy.safetensors", file)
    change_file(rng, file)

    def read() -> None:
        policy = load_policy(file)
        policy.act(np.zeros(policy.input_size, np.float32))
        open_task(policy).close()

    return read


def export(rng: random.Random, sound: Path, folder: Path) -> Callable[[], object]:
    """An exported sweep, and the tables that a report reads before it draws."""
    shutil.copytree(sound / rng.choice(("parquet", "csv")), folder / "export")
    change_file(rng, rng.choice(sorted((folder / "export").iterdir())))

    def read() -> None:
        sweep = read_archive(folder / "export")
        for search in sweep.searches:
            search_in_words(search)
            list(search_tables(search))
        find_stages(sweep)
        limitations(sweep, [])
        runs_table(sweep).to_csv()

    return read


def sweep_file(rng: random.Random, sound: Path, folder: Path) -> Callable[[], object]:
    """A sweep's YAML."""
    file = folder / "sweep.yaml"
    shutil.copy(sound / "sweep.yaml", file)
    change_file(rng, file)
    return lambda: make_plan(load_config(file))


def state(rng: random.Random, sound: Path, folder: Path) -> Callable[[], object]:
    """A checkpoint's nested values and arrays."""
    shutil.copytree(sound / "state", folder / "state")
    change_file(rng, rng.choice(sorted((folder / "state").iterdir())))
    return lambda: read_state(folder / "state")


KINDS = (sealed_policy, packed_policy, export, sweep_file, state)


def make_sound(folder: Path) -> None:
    """One subject of each kind, written by the package itself."""
    node = seal_policy(folder, PENDULUM)
    (folder / "policy.safetensors").write_bytes(load_policy(node).to_bytes())
    write_export(folder / "parquet")
    write_export(folder / "csv", "csv")
    write_sweep(folder / "sweep.yaml", seeds=[0])
    (folder / "state").mkdir()
    write_state(folder / "state", {"a": np.arange(3), "b": [1, (2.5, None)], 3: {"c": "text"}})


def one_case(seed: int, number: int, sound: Path, folder: Path, watch: Watch) -> str:
    """Make and read a case; returns its outcome.

    Raises:
        Violation: Something that no file may bring about.
    """
    rng = random.Random(f"{seed}/{number}")
    kind = KINDS[number % len(KINDS)]
    read = kind(rng, sound, folder)
    outcome = "read"
    try:
        with watch:
            signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE)
            signal.alarm(3 * PATIENCE)  # on a clock: for a reader that waits forever
            try:
                read()
            except OWN_ERRORS as error:
                outcome = type(error).__name__
                if not str(error).strip():
                    raise Violation("an error says nothing") from error
            finally:
                signal.setitimer(signal.ITIMER_VIRTUAL, 0)
                signal.alarm(0)
    except Violation:
        raise
    except BaseException as error:
        raise Violation(f"{type(error).__name__} is no error of the package") from error
    if watch.seen:
        raise Violation("; ".join(watch.seen))
    return f"{kind.__name__}: {outcome}"


def main(arguments: list[str] | None = None) -> int:
    """Try cases until the time is over; 1 at the first violation."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="Of processor time.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="Only this one; its files stay.")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")

    def too_long(number: int, frame: FrameType | None) -> None:
        raise Violation(f"it takes longer than {PATIENCE} s")

    for late in (signal.SIGVTALRM, signal.SIGALRM):
        signal.signal(late, too_long)
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as temporary:
        folder = Path(temporary).resolve()
        tempfile.tempdir = str(folder)
        sound = folder / "sound"
        sound.mkdir()
        make_sound(sound)
        is_gymnasium_id("Nothing-v0")  # loads the robotics tasks, as the first unknown id would
        watch, end, number = Watch(folder), time.process_time() + options.seconds, options.case or 0
        while time.process_time() < end:
            case = folder / "case"
            case.mkdir()
            try:
                counts[one_case(options.seed, number, sound, case, watch)] += 1
            except Violation:
                traceback.print_exc()
                kept = Path(tempfile.mkdtemp(prefix="fuzz-case-", dir="/tmp"))
                shutil.copytree(case, kept, symlinks=True, dirs_exist_ok=True, copy_function=_copy)
                print(
                    f"SEED={options.seed} case {number}: its files are in {kept}", file=sys.stderr
                )
                return 1
            shutil.rmtree(case)
            if options.case is not None:
                break
            number += 1
            if number % 500 == 0:
                gc.collect()
    print(json.dumps({"seed": options.seed, "cases": number, **dict(sorted(counts.items()))}))
    return 0


def _copy(source: str, target: str) -> None:
    if Path(source).is_file() and not Path(source).is_symlink():
        shutil.copy(source, target)


if __name__ == "__main__":
    sys.exit(main())
