"""Files as a stranger may make them: valid ones, and others with defects.

`python -m tests.hostile_files FOLDER` runs the programs on each hostile file of `CORPUS`, and
prints the outcomes as lines of JSON.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import signal
import socket
import struct
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import yaml
from pyarrow import parquet

from music_rllib import names
from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.tasks import Task
from music_rllib.policy import load_policy
from music_rllib.results.archive import Format, write_archive
from music_rllib.results.data import Points, RunRecord, Sweep, columns
from music_rllib.store.handoff import Spaces, write_handoff
from music_rllib.store.sealed import SealedFolders
from music_rllib.store.storage import open_storage

INPUTS = 3
SPACES = Spaces(observation_size=INPUTS, goal_size=0, action_low=(-2.0,), action_high=(2.0,))
PENDULUM = Task(name="Pendulum", env_id="Pendulum-v1", horizon=20, success_key=None)


class Bomb:
    """An object that creates a file when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.target,))


def write_policy(folder: Path, task: Task) -> Path:
    """A handoff with weights for the spaces of Pendulum, for any task."""
    run = RunSettings.model_validate(
        {"task": task, "variant": "tac", "seed": 0, "tac": {"hidden_sizes": [2]}}
    )
    rng = np.random.default_rng(0)
    policy = {
        "0.weight": rng.normal(size=(2, INPUTS)),
        "0.bias": np.zeros(2),
        "2.weight": rng.normal(size=(2, 2)),
        "2.bias": np.zeros(2),
    }
    modules = {
        "policy": {name: array.astype(np.float32) for name, array in policy.items()},
        "normaliser": {
            "mean": np.zeros(INPUTS, np.float32),
            "inverse_std": np.ones(INPUTS, np.float32),
        },
    }
    write_handoff(folder / "handoff", modules, run.handoff_info("0" * 20, 1, SPACES))
    return folder


def seal_policy(storage: Path, task: Task) -> Path:
    with SealedFolders(open_storage(str(storage))).sealing("node", {}) as folder:
        write_policy(folder, task)
    return storage / "node"


# Not regular files --------------------------------------------------------------------------------


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        here = Path.cwd()
        os.chdir(path.parent)  # a socket's path must be short
        listening.bind(path.name)
        os.chdir(here)


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


STRANGE = {"device": _device, "FIFO": os.mkfifo, "socket": _socket, "sparse": _sparse}


# Valid files --------------------------------------------------------------------------------------

SWEEP: dict[str, Any] = {
    "name": "mine",
    "tasks": ["FetchPush"],
    "seeds": [0, 1],
    "stages": [
        {"name": "pretrain", "variant": "music-u"},
        {
            "name": "finetune",
            "variant": "music-r",
            "init_from": "pretrain",
            "grid": {"tac.entropic_index": [1.0, 1.5]},
        },
    ],
}
SEARCHES: list[dict[str, Any]] = [
    {
        "stage": "finetune",
        "mode": "search",
        "sampler": "tpe",
        "objectives": [{"name": "success", "direction": "maximize"}],
        "storage": None,
        "arms": [
            {
                "values": {},
                "importance": {"q": 0.9},
                "trials": [
                    {
                        "number": 0,
                        "state": "judged",
                        "values": {"q": 1.25},
                        "objective": [0.8],
                        "interval": [[0.7, None]],
                        "reason": None,
                    }
                ],
            }
        ],
        "ranking": [{"trial": 0, "values": {"q": 1.25}, "fresh": [0.7], "scores": [[[0.5]]]}],
    }
]


def write_export(folder: Path, table_format: Format = "parquet") -> Path:
    """An exported sweep of four runs."""
    runs, points = [], []
    for q in ("1", "1.5"):
        for seed in ("0", "1"):
            runs.append(
                RunRecord(
                    run_id=f"{q}-{seed}",
                    name=f"finetune/FetchPush/q={q}/seed{seed}",
                    status="FINISHED",
                    started=0,
                    ended=60_000,
                    params={"env_steps": "200", "tac.entropic_index": q, "seed": seed},
                    tags={
                        names.TAG_NODE_KEY: f"{q}-{seed}",
                        names.TAG_STAGE: "finetune",
                        names.TAG_VARIANT: "music-r",
                        names.TAG_TASK: "FetchPush",
                        names.TAG_SEED: seed,
                        names.TAG_ENTROPIC_INDEX: q,
                    },
                )
            )
            points.append(Points([names.EVAL_SUCCESS] * 2, [100, 200], [1, 2], [0.1, 0.5]))
    sweep = Sweep(
        name="mine",
        status="FINISHED",
        started=0,
        source="sqlite:///mlflow.db",
        tags={names.TAG_GIT_COMMIT: "c0ffee"},
        config=yaml.safe_dump(SWEEP),
        runs=runs,
        history=columns(points),
        searches=SEARCHES,
    )
    write_archive(sweep, folder, table_format)
    return folder


def write_sweep(file: Path, **changes: Any) -> Path:
    """A sweep's YAML file."""
    file.write_text(yaml.safe_dump(SWEEP | changes, sort_keys=False))
    return file


# The corpus ---------------------------------------------------------------------------------------

LAUGHS = "a0: &a0 [ha, ha]\n" + "".join(
    f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]\n" for i in range(12)
)
MERGES = "m0: &m0 {x: 1}\n" + "".join(
    f"m{i + 1}: &m{i + 1} {{<<: [{', '.join([f'*m{i}'] * 9)}]}}\n" for i in range(12)
)
DEEP = "[" * 100_000


class Hostile(NamedTuple):
    """A file, the program that reads it, and the expected message."""

    make: Callable[[Path], list[str]]
    """Creates it in an empty folder; returns the program's arguments."""
    said: str
    """A part of the message."""


def _plan(text: str) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        (folder / "sweep.yaml").write_text(text)
        return ["plan", str(folder / "sweep.yaml")]

    return make


def _plan_strange(kind: str) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        STRANGE[kind](folder / "sweep.yaml")
        return ["plan", str(folder / "sweep.yaml")]

    return make


def _plan_of(*options: str, **changes: Any) -> Callable[[Path], list[str]]:
    return lambda folder: [
        *("plan", str(write_sweep(folder / "sweep.yaml", **changes))),
        *("--storage", str(folder), *options),
    ]


def _grid(*sizes: int) -> list[dict[str, Any]]:
    grid = {f"tac.x{i}": list(range(size)) for i, size in enumerate(sizes)}
    return [{"name": "one", "variant": "tac", "grid": grid}]


def _environment(**changes: Any) -> dict[str, Any]:
    return {"Mine": {"env_id": "Pendulum-v1", "horizon": 5} | changes}


def _policy(file: str, change: Callable[[Path], object]) -> Callable[[Path], list[str]]:
    """A sealed policy with one changed file and the old hashes."""

    def make(folder: Path) -> list[str]:
        node = seal_policy(folder, PENDULUM)
        change(node / file)
        return ["evaluate", str(node), "--storage", str(folder)]

    return make


def _handoff(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], list[str]]:
    """A handoff without its run, with a changed manifest."""

    def make(folder: Path) -> list[str]:
        file = write_policy(folder, PENDULUM) / "handoff" / "handoff.json"
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))
        return ["evaluate", str(folder), "--storage", str(folder)]

    return make


def _packed(change: Callable[[Path], object]) -> Callable[[Path], list[str]]:
    """A policy's only file, changed."""

    def make(folder: Path) -> list[str]:
        file = folder / "policy.safetensors"
        file.write_bytes(load_policy(write_policy(folder / "made", PENDULUM)).to_bytes())
        change(file)
        return ["evaluate", str(file), "--storage", str(folder)]

    return make


def _export(
    file: str, change: Callable[[Path], object], table_format: Format = "parquet"
) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        change(write_export(folder / "export", table_format) / file)
        return ["report", str(folder / "export"), "--no-videos"]

    return make


def _json(change: Callable[[Any], object]) -> Callable[[Path], None]:
    def apply(file: Path) -> None:
        content = json.loads(file.read_text())
        changed = change(content)
        file.write_text(json.dumps(content if changed is None else changed))

    return apply


def _text(content: str) -> Callable[[Path], object]:
    return lambda file: file.write_text(content)


def _replaced(kind: str) -> Callable[[Path], None]:
    def apply(file: Path) -> None:
        file.unlink()
        STRANGE[kind](file)

    return apply


def _header(size: int) -> Callable[[Path], object]:
    return lambda file: file.write_bytes(struct.pack("<Q", size) + b"{" + b" " * min(size, 1 << 22))


def _about(change: dict[str, Any] | str) -> Callable[[Path], None]:
    """Change the text in the header of a policy's file."""

    def apply(file: Path) -> None:
        data = file.read_bytes()
        size = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + size])
        header["__metadata__"] = {
            "music_rllib_policy": change if isinstance(change, str) else json.dumps(change)
        }
        text = json.dumps(header).encode()
        file.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])

    return apply


def _nulls(rows: int, together: int = 1_000_000) -> Callable[[Path], None]:
    """A table with any number of rows in almost no bytes."""

    def apply(file: Path) -> None:
        kinds = {"run": pa.int64(), "metric": pa.string(), "env_steps": pa.int64()}
        kinds |= {"value": pa.float64(), "time_ms": pa.int64()}
        piece = pa.table({name: pa.nulls(together, kind) for name, kind in kinds.items()})
        with parquet.ParquetWriter(file, piece.schema) as writer:
            for _ in range(rows // len(piece)):
                writer.write_table(piece, row_group_size=len(piece))

    return apply


def _long_texts(file: Path) -> None:
    """The same long text in many rows, stored once in a dictionary."""
    rows = 50_000
    numbers = pa.array(np.zeros(rows, np.int64))
    table = {"run": numbers, "metric": pa.repeat("x" * 20_000, rows).dictionary_encode()}
    table |= {"env_steps": numbers, "value": numbers.cast(pa.float64()), "time_ms": numbers}
    parquet.write_table(pa.table(table), file, store_schema=False)


def _unpacking(cells: int, **options: Any) -> Callable[[Path], None]:
    """Texts of a megabyte each that compress to almost nothing."""

    def apply(file: Path) -> None:
        numbers = pa.array(np.zeros(cells, np.int64))
        table = {"run": numbers, "metric": pa.repeat("x" * (1 << 20), cells)}
        table |= {"env_steps": numbers, "value": numbers.cast(pa.float64()), "time_ms": numbers}
        written: dict[str, Any] = {"use_dictionary": False, "compression": "zstd"}
        parquet.write_table(pa.table(table), file, store_schema=False, **written | options)

    return apply


def _fewer_rows_said(file: Path) -> None:
    """The footer declares 5 rows, and its only row group two million."""
    _nulls(2_000_000, 2_000_000)(file)
    data, rows = file.read_bytes(), bytes((0x16, 0x80, 0x92, 0xF4, 0x01))
    assert data.count(rows) > 1, "Thrift's number of rows of the file, and of the group"
    file.write_bytes(data.replace(rows, bytes((0x16, 0x8A, 0x80, 0x80, 0x00)), 1))


def _less_said(file: Path) -> None:
    """The footer declares that 100 texts of a megabyte unpack to 100 bytes."""
    _unpacking(100, write_batch_size=1)(file)
    data = file.read_bytes()
    footer = parquet.ParquetFile(file).metadata
    sizes = [footer.row_group(0).column(1).total_uncompressed_size]
    sizes.append(footer.row_group(0).total_byte_size)
    start = len(data) - 8 - footer.serialized_size
    head, tail = data[:start], data[start:]
    for size in sizes:
        wanted = _varint(size)
        assert wanted in tail
        tail = tail.replace(wanted, _varint(100, len(wanted)))
    file.write_bytes(head + tail)


def _varint(value: int, length: int = 0) -> bytes:
    """A number in Thrift's compact protocol, in `length` bytes."""
    value <<= 1
    parts: list[int] = []
    while value or len(parts) < length:
        parts.append(value & 127 | 128)
        value >>= 7
    parts[-1] &= 127
    return bytes(parts)


def _columns(file: Path) -> None:
    names_of = ",".join(f"c{i}" for i in range(100_000))
    file.write_text(f"{names_of}\n{',' * 99_999}\n")


CORPUS: dict[str, Hostile] = {
    "yaml: laughs": Hostile(_plan(LAUGHS), "values, aliases included"),
    "yaml: merges": Hostile(_plan(MERGES), "values, aliases included"),
    "yaml: an alias in itself": Hostile(_plan("a: &a [*a]\n"), "must not contain itself"),
    "yaml: nested lists": Hostile(_plan(f"a: {'[' * 10_000}{']' * 10_000}\n"), "levels deep"),
    "yaml: nested mappings": Hostile(_plan("{a: " * 10_000), "levels deep"),
    "yaml: nested by indentation": Hostile(
        _plan("".join(f"{' ' * i}a:\n" for i in range(500))), "levels deep"
    ),
    "yaml: a long number": Hostile(_plan(f"seeds: [{'1' * 5001}]\n"), "at most 100 digits"),
    "yaml: no number": Hostile(_plan("seeds: [!!int x]\n"), "must be of its type, int"),
    "yaml: large": Hostile(_plan("# " + "x" * (1 << 20)), "more than 262144"),
    "yaml: halves of characters": Hostile(
        _plan('name: "\\ud800"\ntasks: [FetchPush]\n'), "sweep.yaml: Invalid JSON"
    ),
    "yaml: a device": Hostile(
        _plan_strange("device"),
        "is not a regular file",
    ),
    "yaml: a FIFO": Hostile(
        _plan_strange("FIFO"),
        "is not a regular file",
    ),
    "yaml: python": Hostile(_plan("a: !!python/object/apply:os.system [id]\n"), "must be valid"),
    "indices": Hostile(
        _plan_of(environments=_environment(agent_indices="0:99999999999")),
        "must be a list of indices or a range such as 0:3",
    ),
    "indices of 4,301 digits": Hostile(
        _plan_of(environments=_environment(agent_indices=f"0:{'9' * 4301}")),
        "must be a list of indices or a range such as 0:3",
    ),
    "grid points": Hostile(_plan_of(stages=_grid(10, 10, 10, 10, 10, 10, 10)), "got 10,000,000"),
    "runs": Hostile(
        _plan_of(
            stages=[
                {
                    "name": f"s{i}",
                    "variant": "tac" if i == 0 else "music-r",
                    **({"init_from": f"s{i - 1}"} if i else {}),
                    "grid": {"tac.alpha": [0.1 + 0.01 * k for k in range(30)]},
                }
                for i in range(4)
            ],
        ),
        "runs, got",
    ),
    "seeds": Hostile(_plan_of(seeds=list(range(10_001))), "must have at most 10,000 entries"),
    "values": Hostile(_plan_of(seeds=list(range(25_000))), "must have at most 12000 values"),
    "--seeds": Hostile(_plan_of("--seeds", "1000000"), "--seeds must be at most 10,000"),
    "--seeds of 5,001 digits": Hostile(_plan_of("--seeds", "1" * 5001), "--seeds must be"),
    "policy: a device": Hostile(
        _policy("handoff/policy.safetensors", _replaced("device")), "is not a regular file"
    ),
    "policy: a FIFO": Hostile(
        _policy("handoff/policy.safetensors", _replaced("FIFO")), "is not a regular file"
    ),
    "policy: sparse": Hostile(
        _policy("handoff/policy.safetensors", _replaced("sparse")), "it has 1099511627776"
    ),
    "policy: deep manifest": Hostile(_policy("manifest.json", _text(DEEP)), "must be a manifest"),
    "policy: deep and closed": Hostile(
        _policy("manifest.json", _text(f"{DEEP}{']' * 100_000}")), "levels deep"
    ),
    "policy: many lists": Hostile(
        _policy("manifest.json", _text(f"[{'[],' * 1_000_000}1]")), "lists and mappings"
    ),
    "policy: large manifest": Hostile(
        _policy("manifest.json", _text(f"[{'1.5,' * 5_000_000}1]")), "must have at most 8388608"
    ),
    "policy: a path outside": Hostile(
        _policy(
            "manifest.json",
            _json(lambda m: m["files"].update({"../../x": {"bytes": 1, "sha256": ""}})),
        ),
        "must be a path inside the folder",
    ),
    "handoff: a long number": Hostile(
        lambda folder: _policy("handoff/handoff.json", _text(f'{{"info": {"1" * 5001}}}'))(folder),
        "must have",
    ),
    "handoff: a module": Hostile(
        _handoff(lambda m: m["info"]["task"].update(env_id="evil_module:Evil-v0")),
        "a file doesn't choose what is imported",
    ),
    "handoff: a model's file": Hostile(
        _handoff(
            lambda m: m["info"]["task"].update(
                env_id="HalfCheetah-v5", env_kwargs={"xml_file": "/tmp/evil.xml"}
            )
        ),
        "a file doesn't choose what is imported",
    ),
    "handoff: indices": Hostile(
        _handoff(lambda m: m["info"]["task"].update(agent_indices="0:99999999999")),
        "must be a list of indices or a range such as 0:3",
    ),
    "handoff: beyond its observation": Hostile(
        _handoff(lambda m: m["info"]["task"].update(agent_indices=[0], surrounding_indices=[9999])),
        "surrounding_indices must be < 3",
    ),
    "handoff: another folder's weights": Hostile(
        _handoff(lambda m: m["modules"]["policy"].update(file="../../policy.safetensors")),
        "must be a handoff manifest",
    ),
    "handoff: much is declared": Hostile(
        _handoff(lambda m: m["modules"]["policy"].update(bytes=1 << 50)),
        "must have 1125899906842624 bytes, it has",
    ),
    "packed: large header": Hostile(_packed(_header(90 << 20)), "header must have at most"),
    "packed: a header beyond its file": Hostile(_packed(_header(1 << 60)), "header must have"),
    "packed: deep header": Hostile(_packed(_about(DEEP)), "must be a policy"),
    "packed: little header": Hostile(
        _packed(_about({"format": "music_rllib policy 1", "about": {}, "x": None})), "it lacks"
    ),
    "packed: a module": Hostile(
        _packed(
            _about(
                {
                    "format": "music_rllib policy 1",
                    "clip": 5.0,
                    "goal_size": 0,
                    "about": {
                        "task": {"name": "E", "env_id": "evil_module:E-v0", "horizon": 9},
                        "variant": "tac",
                        "seed": 0,
                        "node_key": "",
                        "env_steps": 1,
                        "max_episode_steps": 9,
                    },
                }
            )
        ),
        "a file doesn't choose what is imported",
    ),
    "packed: empty": Hostile(_packed(lambda file: file.write_bytes(b"")), "must be a policy"),
    "export: deep header": Hostile(_export("sweep.json", _text(DEEP)), "sweep.json:"),
    "export: deep search": Hostile(
        _export("search.json", _text(f"{DEEP}{']' * 100_000}")), "search.json: must be nested"
    ),
    "export: junk in its search": Hostile(
        _export("search.json", _text('[{"stage": 1}]')), "search.json: 0.stage"
    ),
    "export: a search without objectives": Hostile(
        _export("search.json", _json(lambda found: [found[0] | {"objectives": None}])), "objectives"
    ),
    "export: a long number": Hostile(
        _export("sweep.json", _text(f'{{"version": {"1" * 5001}}}')), "at most 100 digits"
    ),
    "export: tags that are none": Hostile(
        _export("sweep.json", _json(lambda header: header.update(tags=[1]))), "tags must be"
    ),
    "export: a beginning beyond the calendar": Hostile(
        _export("sweep.json", _json(lambda header: header.update(started=10**30))), "started must"
    ),
    "export: halves of characters": Hostile(
        _export("sweep.json", _json(lambda header: header.update(name="\ud800"))), "sweep.json:"
    ),
    "export: a FIFO": Hostile(
        _export("sweep.json", _replaced("FIFO")), "sweep.json: it is not a regular file"
    ),
    "export: a FIFO for a table": Hostile(
        _export("metrics.parquet", _replaced("FIFO")), "metrics.parquet: it is not a regular file"
    ),
    "export: a device for a table": Hostile(
        _export("runs.csv", _replaced("device"), "csv"), "runs.csv: it is not a regular file"
    ),
    "export: many rows": Hostile(
        _export("metrics.parquet", _nulls(60_000_000)), "metrics.parquet: must have at most"
    ),
    "export: long texts": Hostile(_export("metrics.parquet", _long_texts), "characters of text"),
    "export: much to unpack": Hostile(
        _export("metrics.parquet", _unpacking(100)), "bytes when unpacked"
    ),
    "export: more to unpack than it says": Hostile(
        _export("metrics.parquet", _less_said), "characters of text"
    ),
    "export: texts in each other": Hostile(
        _export(
            "metrics.parquet",
            _unpacking(100, use_dictionary=["run"], column_encoding={"metric": "DELTA_BYTE_ARRAY"}),
        ),
        "must be encoded as",
    ),
    "export: more rows than it says": Hostile(
        _export("metrics.parquet", _fewer_rows_said),
        "must have 5 rows, as its footer states, got 2000000",
    ),
    "export: many columns": Hostile(
        _export("runs.csv", _columns, "csv"), "must have at most 10000 columns"
    ),
    "export: no table": Hostile(
        _export("runs.parquet", lambda file: file.write_bytes(b"PAR1" * 9)), "runs.parquet:"
    ),
    "export: a table of nulls": Hostile(
        _export("metrics.parquet", _nulls(1000, 1000)), "run must have a value in each row"
    ),
}
SECONDS, MEGABYTES = 5.0, 300
"""Processor time and memory that a refusal may need in addition to its program's own. It needs less
than a second on an idle machine; a bomb that is not refused needs minutes."""
PATIENCE = 60
"""Seconds on a clock, for a busy machine."""


# The programs -------------------------------------------------------------------------------------


def run(arguments: list[str]) -> tuple[object, str]:
    """A program's exit code and output."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            if arguments[0] == "report":
                from music_rllib.program import app

                return app(arguments, standalone_mode=False), said.getvalue()
            from music_rllib.program import main

            return main(arguments), said.getvalue()
        except BaseException as error:
            if code := getattr(error, "exit_code", None):  # typer's Exit
                return code, said.getvalue()
            return None, said.getvalue() + "".join(traceback.format_exception(error))


def _refuse_in_a_fork(name: str, folder: Path) -> dict[str, Any]:
    """Outcome of one file, measured in a process that has loaded everything before."""
    folder.mkdir()
    arguments = CORPUS[name].make(folder)
    before = sorted(path.name for path in folder.rglob("*"))
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(PATIENCE)
        os.chdir(folder)
        had = resource.getrusage(resource.RUSAGE_SELF)
        code, said = run(arguments)
        used = resource.getrusage(resource.RUSAGE_SELF)
        result = {
            "name": name,
            "code": code,
            "said": said[-2000:],
            "seconds": used.ru_utime + used.ru_stime - had.ru_utime - had.ru_stime,
            "megabytes": (used.ru_maxrss - had.ru_maxrss) / 1024,
        }
        os.write(writer, json.dumps(result).encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as source:
        data = source.read()
    _, status = os.waitpid(child, 0)
    result = json.loads(data) if data else {"name": name, "code": None, "said": f"ended: {status}"}
    left = sorted(path.name for path in folder.rglob("*"))
    return {"seconds": 0.0, "megabytes": 0.0, "written": left != before} | result


def results(folder: Path) -> Iterator[dict[str, Any]]:
    """Outcome of each file of the corpus."""
    # Loading a program's modules is not part of the cost of reading.
    for number, arguments in enumerate((_plan_of(), _export("sweep.json", lambda file: None))):
        (folder / f"sound{number}").mkdir()
        code, said = run(arguments(folder / f"sound{number}"))
        assert code in (0, None), said
        assert "Traceback" not in said, said
    sound = write_policy(folder / "sound", PENDULUM)
    code, said = run(["evaluate", str(sound), "--episodes", "1", "--storage", str(folder)])
    assert code == 0, said
    for number, name in enumerate(CORPUS):
        yield _refuse_in_a_fork(name, folder / str(number))


if __name__ == "__main__":
    start = time.monotonic()
    for found in results(Path(sys.argv[1])):
        print(json.dumps(found), flush=True)
