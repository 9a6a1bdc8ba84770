"""The program: help within 80 columns, valid examples, starter file, presets, schema."""

from __future__ import annotations

import contextlib
import json
import os
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from typer.main import get_command

from music_rllib import __version__
from music_rllib.config.document import SCHEMA
from music_rllib.config.load import load_config
from music_rllib.program import app, main
from tests.processes import fresh

REPOSITORY = Path(__file__).parents[2]
PROGRAMS = ("music-rllib", "music_rllib.sweep")
HEAVY = {"ray", "torch", "mlflow", "gymnasium", "optuna", "numpy", "pandas", "music_rllib.config"}


def commands() -> list[tuple[str, ...]]:
    """All commands, as words of the command line."""

    def below(group: Any, words: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        yield words
        for name, command in getattr(group, "commands", {}).items():
            yield from below(command, (*words, name))

    return list(below(get_command(app), ()))


def help_of(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert main([*words, "--help"]) == 0
    return capsys.readouterr().out


def examples() -> list[list[str]]:
    """Commands in the output of help, without the text before the program's name."""
    found = []
    for words in commands():
        command: Any = get_command(app)
        for word in words:
            command = command.commands[word]
        text = (command.epilog or "").replace("\\\n", " ")
        for line in text.splitlines():
            if line.startswith("  ") and not line.startswith("   "):
                given = shlex.split(line)
                found += [given[given.index(name) + 1 :] for name in PROGRAMS if name in given]
    return found


def test_an_ascii_terminal_and_a_deleted_folder_print_no_traceback(tmp_path: Path) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    (tmp_path / "α.yaml").write_text("name: α\n", encoding="utf-8")
    code = """
import io, json, os, sys
from music_rllib.program import main
from music_rllib.command_line import console_for, print_json
raw = sys.stdout = io.TextIOWrapper(io.BytesIO(), "ascii")
assert main(["plan", "../α.yaml"]) == 2
console_for().print("α ≥ 1")
print_json({"α": 1})
os.rmdir(os.getcwd())
for call in json.loads(sys.argv[1]):
    assert main([*call, "x"][:2]) == 2, call
assert main(["--version"]) == main(["run", "--help"]) == 0
raw.flush()
sys.stdout = sys.__stdout__
print(raw.buffer.getvalue().decode("ascii"))
"""
    calls = json.dumps([["plan"], ["run"], ["compare"], ["report"], ["status"], ["best"]])
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONPATH": str(REPOSITORY)}
    done = fresh("-c", code, calls, cwd=folder, env=environment)
    assert "\\u03b1 \\u2265 1" in done.stdout
    assert '"\\u03b1": 1' in done.stdout
    assert "Traceback" not in done.stderr
    assert "name must be letters" in done.stderr
    assert r'"\u03b1"' in done.stderr
    assert done.stderr.count("the current folder must exist and be readable: No such file") == 6


@pytest.mark.parametrize("output", ["a reader that ends", "a full disk"])
def test_a_sweep_outlives_its_output(output: str) -> None:
    code = """
import sys
from music_rllib.command_line import console_for
console = console_for(unfailing=True)
for number in range(2000):
    console.print("line", number)
print("trained", file=sys.stderr)
"""
    with Path("/dev/full").open("w") as full, contextlib.ExitStack() as stack:
        target: Any = full
        if output == "a reader that ends":
            reader = subprocess.Popen(["head", "-n", "1"], stdin=-1, stdout=-3)
            stack.callback(reader.wait)
            assert reader.stdin is not None
            target = stack.enter_context(reader.stdin)
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
            stdout=target,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.stderr.startswith("trained\n")
    if output == "a reader that ends":
        assert (done.returncode, done.stderr) == (0, "trained\n")


def test_a_table_for_a_reader_that_has_ended_is_not_a_failure() -> None:
    code = """
import os
from music_rllib.command_line import console_for
read, write = os.pipe()
os.close(read)
os.dup2(write, 1)
try:
    console_for().print("line")
except BrokenPipeError:  # `Command` ends with 0
    os._exit(7)
"""
    fresh("-c", code, code=7)


@pytest.mark.parametrize(
    ("output", "code", "error"),
    [
        ("a reader that ended", 0, ""),
        ("/dev/full", 1, "error: the output can't be written: No space left on device\n"),
    ],
)
def test_output_that_is_written_last_can_fail(output: str, code: int, error: str) -> None:
    reader, sink = os.pipe()
    os.close(reader)
    if output == "/dev/full":
        os.dup2(os.open(output, os.O_WRONLY), sink)
    buffered = {name: text for name, text in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-m", "music_rllib", "presets", "--json"]
    done = subprocess.run(
        command, cwd=REPOSITORY, env=buffered, stdout=sink, stderr=subprocess.PIPE, text=True
    )
    os.close(sink)
    assert (done.returncode, done.stderr) == (code, error)


@pytest.mark.parametrize("closed", ["1", "2"])
def test_output_may_be_closed(closed: str) -> None:
    command = f"exec '{sys.executable}' -m music_rllib presets --json {closed}>&-"
    done = subprocess.run(["sh", "-c", command], cwd=REPOSITORY, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert bool(done.stdout) == (closed == "2")


def test_every_help_page_has_the_same_format(
    capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for words in commands():
        text = help_of(words, capsys)
        assert text.startswith(f"Usage: {shlex.join(['music-rllib', *words])} "), text
        assert max(map(len, text.splitlines())) <= 80, text
        assert "Examples:\n" in text or words == ("tracking",), words


def test_help_and_version_load_nothing_heavy(tmp_path: Path) -> None:
    calls: list[list[str]] = [[], ["--version"], *([*words, "--help"] for words in commands())]
    code = (
        "import json, sys; from music_rllib.program import main\n"
        "for call in json.loads(sys.argv[1]): assert main(call) == 0, call\n"
        f"loaded = {HEAVY!r} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )
    done = fresh("-c", code, json.dumps(calls), cwd=tmp_path)
    assert f"music-rllib {__version__}\n" in done.stdout


def test_the_program_accepts_the_examples_of_its_help() -> None:
    """Every option and argument is known; files that they name are not checked."""
    found = examples()
    assert len(found) > 30
    for given in found:
        command: Any = get_command(app)
        words = list(given)
        while hasattr(command, "commands") and words and words[0] in command.commands:
            command = command.commands[words.pop(0)]
        if hasattr(command, "commands"):
            command = command.commands["run"]  # python -m music_rllib.sweep my.yaml
        words = words[: words.index(">")] if ">" in words else words
        command.make_context("x", words)


def test_mistakes_before_the_command_print_a_suggestion(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["statsu", "x"]) == 2
    assert "Did you mean 'status'?" in capsys.readouterr().err
    assert main(["my.yaml"]) == 2
    assert "music-rllib run my.yaml" in capsys.readouterr().err


def test_init_writes_a_valid_sweep_and_overwrites_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init", "my reach.yaml"]) == 0
    assert main(["plan", "my reach.yaml", "seeds=2"]) == 0
    assert "6 runs, 60,000 env steps in total" in capsys.readouterr().out
    assert load_config("my reach.yaml").name == "my_reach"
    # The other sweep, in its comments.
    text = Path("my reach.yaml").read_text()
    kept, _, other = text.partition("# With MUSIC")
    shown = [line.removeprefix("#").removeprefix(" ") for line in other.splitlines()[2:]]
    document = yaml.safe_load(kept) | yaml.safe_load("\n".join(shown))
    Path("other.yaml").write_text(yaml.safe_dump(document))
    assert [stage.name for stage in load_config("other.yaml").stages] == ["pretrain", "finetune"]
    assert main(["init", "my reach.yaml"]) == 2
    assert "must not exist yet" in capsys.readouterr().err
    assert Path("my reach.yaml").read_text() == text
    assert main(["init", "nowhere/x.yaml"]) == 2


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("123.yaml", "123"),
        ("true.yaml", "true"),
        ("nodes.yaml", "nodes_sweep"),
        ("mlflow.db.yaml", "mlflow.db_sweep"),
        ("FILE NAME.yaml", "FILE_NAME"),
    ],
)
def test_init_writes_a_valid_name_and_command(
    file: str,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init", file]) == 0
    command = shlex.split(capsys.readouterr().out.partition("Check it with: ")[2])
    assert command == ["music-rllib", "plan", file]
    assert load_config(file).name == name
    assert f"#   music-rllib run {shlex.quote(file)} " in Path(file).read_text()


def test_presets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["presets", "--json"]) == 0
    found = {one["name"] for one in json.loads(capsys.readouterr().out)}
    assert found == {path.stem for path in (REPOSITORY / "music_rllib/presets").glob("*.yaml")}


def test_the_schema_accepts_shipped_sweeps_and_rejects_unknown_names(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert schema == json.loads(SCHEMA.read_text())
    check = jsonschema.Draft202012Validator(schema)
    for path in (REPOSITORY / "tune_configs").rglob("*.yaml"):
        text = path.read_text()
        assert not list(check.iter_errors(yaml.safe_load(text))), path
        _, given, named = text.partition("\n")[0].partition("yaml-language-server: $schema=")
        assert not given or (path.parent / named).resolve() == SCHEMA.resolve(), path
    stage = {"name": "a", "variant": "tac", "tac": {"alpha": 0.1, "hidden_sizes": [8]}}
    sweep = {"name": "a", "tasks": ["FetchPush"], "seeds": 3, "stages": [stage]}
    assert check.is_valid(sweep)
    for wrong in ({"q": 1}, {"tac": {"q": 1}}, {"env_steps": "many"}, {"variant": "sac"}):
        assert not check.is_valid(sweep | {"stages": [stage | wrong]}), wrong
    described = schema["$defs"]["TACSettings"]["properties"]
    assert all("description" in field for field in described.values())


WRONG = "error: command line: tac.alpha must be >= 0, got -1\n"


def test_it_runs_as_a_module_from_any_folder(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    module = ("-m", "music_rllib.sweep", "tac.alpha=-1")
    done = fresh(*module, code=2, cwd=tmp_path, env=environment)
    assert (done.stdout, done.stderr) == ("", WRONG)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("program", ["music_rllib plan", "music_rllib.sweep --name other"])
def test_a_module_takes_the_arguments_of_the_program(
    program: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module, *arguments = program.split()
    monkeypatch.setattr(sys, "argv", [module, *arguments, "tac.alpha=-1"])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_module(module, run_name="__main__")
    assert capsys.readouterr() == ("", WRONG)
