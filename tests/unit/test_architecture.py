"""docs/architecture.md matches the code; files and folders stay small."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "music_rllib"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PLACES = sorted(set(re.findall(r"`(music_rllib(?:\.\w+)+):(\w+)`", PAGE)))
METHODS = sorted(set(re.findall(r"`([A-Z]\w+)\.(\w+)`", PAGE)))
CODE = sorted(path for path in PACKAGE.rglob("*.py") if "__pycache__" not in path.parts)


def _definitions(path: Path) -> dict[str, ast.stmt]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {
        node.name: node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)
    }


@pytest.mark.parametrize(("module", "name"), PLACES, ids=[f"{m}:{n}" for m, n in PLACES])
def test_each_step_of_the_journeys_exists(module: str, name: str) -> None:
    path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
    assert name in _definitions(path)


@pytest.mark.parametrize(("owner", "name"), METHODS, ids=[".".join(one) for one in METHODS])
def test_each_method_of_the_journeys_exists(owner: str, name: str) -> None:
    module = next(module for module, found in PLACES if found == owner)
    path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
    defined = _definitions(path)[owner]
    assert isinstance(defined, ast.ClassDef)
    assert name in {node.name for node in defined.body if isinstance(node, ast.FunctionDef)}


def test_every_room_is_on_the_page() -> None:
    folders = {path.parent.relative_to(PACKAGE).parts[0] for path in CODE if path.parent != PACKAGE}
    assert folders == set(re.findall(r"^\| `(\w+)/` \|", PAGE, re.MULTILINE))


def test_no_file_is_too_long_and_no_folder_too_full() -> None:
    long = {
        str(path.relative_to(PACKAGE)): lines
        for path in CODE
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > MOST_LINES
    }
    assert not long
    folders = {path.parent for path in CODE}
    full = {
        str(f.relative_to(PACKAGE)): n
        for f in folders
        if (n := len(list(f.glob("[!_]*.py")))) > MOST_FILES
    }
    assert not full


MOST_LINES = 420
MOST_FILES = 14
