"""Checks of all commands and snippets of README and docs that are possible without running them.

The package's own commands parse their examples, in a folder outside the repository;
tests/integration/project/test_first_hour.py runs a newcomer's commands.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
import typer
import yaml

from music_rllib.config.load import load_config

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MODULES = {
    "music_rllib.sweep": "music_rllib.program",
}
"""Modules for `python -m`, and their applications."""
OTHERS = {
    ".",
    "aws",
    "base64",
    "cd",
    "curl",
    "docker",
    "export",
    "grafana",
    "head",
    "kubectl",
    "mlflow",
    "pip",
    "prometheus",
    "sacct",
    "squeue",
} | {
    "mkdir",
    "optuna-dashboard",
    "sh",
}
"""Programs of other projects that are not installed with this one, or that are checked below."""


def blocks(page: Path, language: str) -> list[str]:
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def snippets(language: str) -> list[Any]:
    return [
        pytest.param(block, id=f"{page.stem}-{position}")
        for page in PAGES
        for position, block in enumerate(blocks(page, language))
    ]


# --- commands ------------------------------------------------------------------------------------


def commands(text: str) -> Iterator[list[str]]:
    """The words of each simple command, without variables before it and redirections."""
    text = re.sub(r"(^|\s)#(\s|!|SBATCH).*$", "", text.replace("\\\n", " "), flags=re.MULTILINE)
    lexer = shlex.shlex(text, posix=True, punctuation_chars=";|&\n")
    lexer.whitespace_split, lexer.whitespace, lexer.commenters = True, " \t", ""
    words: list[str] = []
    for word in [*lexer, ";"]:
        if not set(word) <= set(";|&\n"):
            if words or not re.match(r"[A-Z_]+=", word):
                words.append(word)
        elif words:
            yield words
            words = []


def test_commands_are_told_apart() -> None:
    text = "A=b make x  # one\nray job \\\n  -- python -m y 'a b' && cd d | e &\n"
    assert list(commands(text)) == [
        ["make", "x"],
        ["ray", "job", "--", "python", "-m", "y", "a b"],
        ["cd", "d"],
        ["e"],
    ]


def parse(command: Any, name: str, words: list[str]) -> None:
    """Parse as the program does, down to the last sub-command, without calling it."""
    context = command.make_context(name, list(words))
    # A group, of click's (Ray) or of Typer's own copy of it.
    while hasattr(command, "resolve_command") and (
        rest := [*context._protected_args, *context.args]
    ):
        _, command, rest = command.resolve_command(context, rest)
        context = command.make_context(command.name, rest, parent=context)


def application(module: str) -> Any:
    return typer.main.get_command(importlib.import_module(module).app)


def check(words: list[str]) -> None:
    """Check that a command, its options and files exist, including commands in its arguments."""
    program = words[0].rpartition("/")[2]
    if program in ("exec", "srun"):
        check(words[1:])
    elif program == "music-rllib":
        parse(application("music_rllib.program"), program, words[1:])
    elif program == "python" and words[1:2] == ["-m"] and words[2] in MODULES:
        by_default = ["run"] * (words[2] == "music_rllib.sweep" and words[3].endswith(".yaml"))
        parse(application(MODULES[words[2]]), words[2], [*by_default, *words[3:]])
    elif program == "python" and words[1:2] == ["-m"]:
        assert importlib.util.find_spec(words[2]), words
    elif program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert {word for word in words[1:] if "=" not in word} <= set(targets), words
    elif program == "ray":
        from ray.scripts.scripts import cli

        parse(cli, program, words[1:])
    else:
        assert program in OTHERS or (program == "python" and (ROOT / words[1]).is_file()), words
    for word in words:
        if re.match(r"(benchmarks|cluster|dashboards|docs|tests|tune_configs)(/|$)", word):
            assert (ROOT / word).exists(), word
    for number, word in enumerate(words[1:], 1):
        if word == "python" or words[number - 1] == "--":  # `ray job submit ... -- python`
            check(words[number:])
            break
        if words[number - 1 : number + 1] == ["sh", "-c"]:
            for inner in commands(words[number + 1]):
                check(inner)


@pytest.mark.parametrize("block", snippets("sh"))
def test_the_programs_accept_the_commands(
    block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = list(commands(block))
    assert found
    for words in found:
        check(words)


@pytest.mark.parametrize(
    "command",
    [
        "music-rllib evaluate results/x --episode 5",
        "music-rllib trian my.yaml",
        "make tset",
        "ray job submit --workingdir . -- python x.py",
        "python -m music_rllib.sweep run tune_configs/smok.yaml",
        "docker compose exec head sh -c 'music-rllib serve x --prot 1'",
    ],
)
def test_wrong_commands_are_found(command: str) -> None:
    # Typer has its own copy of click, and Ray uses the real one.
    with pytest.raises((AssertionError, click.UsageError, *typer.BadParameter.__mro__[1:2])):
        check(shlex.split(command))


# --- YAML and Python ------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_yaml_is_a_sweep_or_a_part_of_the_one_before_it(page: Path, tmp_path: Path) -> None:
    sweep: dict[str, Any] = {}
    for block in blocks(page, "yaml"):
        document = yaml.safe_load(block)
        if "stages" in document:
            sweep, text = document, block
        else:  # of a search
            search = sweep["stages"][-1]["search"]
            sweep["stages"][-1]["search"] = search | document.get("search", document)
            text = yaml.safe_dump(sweep, sort_keys=False)
        path = tmp_path / "sweep.yaml"
        path.write_text(text, encoding="utf-8")
        assert load_config(path).stages


@pytest.mark.parametrize("block", snippets("python"))
def test_python_compiles_and_its_imports_exist(block: str) -> None:
    module = ast.parse(block)
    imports = [line for line in module.body if isinstance(line, ast.Import | ast.ImportFrom)]
    exec(compile(ast.Module([*imports], []), "snippet", "exec"), {})
